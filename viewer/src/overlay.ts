/** Colours that say where a picture's pixels come from, over the picture. */

import type { Manifest } from "./manifest";
import type { Overlay } from "./state";

/** Origins in the green channel of a map, as in fourd/viewer/maps.py; cameras follow. */
export const NOTHING = 0;
export const STATIC = 1;
export const CONTINUED = 2;
export const HULL = 3;
export const FIRST_CAMERA = 4;

type Colour = [number, number, number];

// Okabe and Ito's colours, told apart by most colour-blind people too.
const CAMERA_COLOURS: Colour[] = [
  [0, 114, 178],
  [230, 159, 0],
  [0, 158, 115],
  [204, 121, 167],
  [86, 180, 233],
  [213, 94, 0],
  [240, 228, 66],
  [150, 110, 220],
];
const MISSING: Colour = [220, 30, 60];
const GUESSED: Colour = [255, 255, 255];
const STILL: Colour = [120, 120, 120];
const HULL_COLOUR: Colour = [150, 60, 255];
const ALPHA = 165;

export const cameraColour = (index: number): Colour => CAMERA_COLOURS[index % CAMERA_COLOURS.length]!;

/** Near is yellow, far is violet: five stops of a ramp that rises in lightness. */
const RAMP: Colour[] = [
  [48, 18, 80],
  [60, 80, 140],
  [33, 145, 140],
  [110, 205, 90],
  [253, 231, 37],
];

export function depthColour(share: number): Colour {
  const place = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1);
  const first = Math.min(Math.floor(place), RAMP.length - 2);
  const weight = place - first;
  return RAMP[first]!.map((value, i) =>
    Math.round(value + (RAMP[first + 1]![i]! - value) * weight),
  ) as Colour;
}

/** RGBA of an overlay from RGBA of a map, of the same length. */
export function colourMap(map: Uint8ClampedArray, overlay: Overlay): Uint8ClampedArray<ArrayBuffer> {
  const out = new Uint8ClampedArray(map.length);
  for (let i = 0; i < map.length; i += 4) {
    const colour = colourOf(overlay, map[i]!, map[i + 1]!);
    if (!colour) continue;
    out[i] = colour[0];
    out[i + 1] = colour[1];
    out[i + 2] = colour[2];
    out[i + 3] = overlay === "depth" ? 235 : ALPHA;
  }
  return out;
}

function colourOf(overlay: Overlay, depth: number, origin: number): Colour | null {
  if (overlay === "depth") return depth ? depthColour(depth / 255) : MISSING;
  if (overlay === "hull") return origin === HULL ? HULL_COLOUR : null;
  if (overlay === "holes") return origin === NOTHING ? MISSING : origin === CONTINUED ? GUESSED : null;
  if (origin === NOTHING) return MISSING;
  if (origin === CONTINUED) return GUESSED;
  if (origin === STATIC) return STILL;
  return origin === HULL ? HULL_COLOUR : cameraColour(origin - FIRST_CAMERA);
}

/** What the colours of an overlay mean. */
export function legendOf(overlay: Overlay, manifest: Pick<Manifest, "fused">): [Colour, string][] {
  if (overlay === "depth")
    return [
      [depthColour(1), "near"],
      [depthColour(0.5), "middle"],
      [depthColour(0.02), "far"],
      [MISSING, "unknown"],
    ];
  if (overlay === "holes")
    return [
      [MISSING, "no camera pair saw this"],
      [GUESSED, "continued from around"],
    ];
  if (overlay === "hull") return [[HULL_COLOUR, "depth from silhouettes"]];
  if (overlay === "none") return [];
  const cameras = manifest.fused.map((name, i): [Colour, string] => [cameraColour(i), name]);
  return [
    ...cameras,
    [STILL, "static background"],
    [GUESSED, "continued from around"],
    [HULL_COLOUR, "silhouettes"],
    [MISSING, "nothing"],
  ];
}
