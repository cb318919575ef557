/** Which pictures are needed now and soon, most urgent first. */

import type { Manifest } from "./manifest";
import { type State, latticePlace, momentOf } from "./state";
import type { Key } from "./store";

// Moments decoded ahead while playing, and around while it stands.
const AHEAD = 10;
const AROUND = 4;
const SIDEWAYS = 3;

export function neededKeys(state: State, manifest: Manifest, camera: string | null): Key[] {
  const { frames, views } = manifest;
  const moment = momentOf(state, frames.length);
  const [first, second, weight] = latticePlace(state.share, views.length);
  const near = weight > 0.5 ? second : first;
  const keys: Key[] = [];
  const addView = (view: number, at: number, withMap: boolean): void => {
    const entry = views[view];
    if (!entry || at < 0 || at >= frames.length) return;
    keys.push({ kind: "view", name: entry.name, moment: at });
    if (withMap) keys.push({ kind: "map", name: entry.name, moment: at });
  };
  addView(near, moment, state.overlay !== "none");
  for (const view of new Set([first, second])) addView(view, moment, true);
  if (camera) keys.push({ kind: "camera", name: camera, moment });
  const later = state.isPlaying ? AHEAD : AROUND;
  for (let step = 1; step <= later; step++) {
    const wrapped = state.isLooping ? (moment + step) % frames.length : moment + step;
    for (const view of new Set([first, second]))
      addView(view, wrapped, weight > 0 || state.overlay !== "none");
    if (!state.isPlaying)
      for (const view of new Set([first, second])) addView(view, moment - step, weight > 0);
    if (camera) keys.push({ kind: "camera", name: camera, moment: Math.min(wrapped, frames.length - 1) });
  }
  if (!state.isPlaying)
    for (let step = 1; step <= SIDEWAYS; step++) {
      addView(first - step, moment, true);
      addView(second + step, moment, true);
    }
  return keys;
}

/** Files in the order in which they become useful: from the shown view outwards, real pictures last. */
export function fileOrder(manifest: Manifest, view: number): string[] {
  const place = new Map(manifest.views.map((entry, i) => [entry.name, Math.abs(i - view)]));
  const rank = (file: string): number => {
    const [kind] = file.split("-", 1);
    const name = file.slice(kind!.length + 1, file.lastIndexOf("-"));
    const distance = place.get(name) ?? manifest.views.length;
    return 2 * distance + (kind === "view" ? 0 : 1);
  };
  return [...manifest.files].sort((a, b) => rank(a) - rank(b));
}
