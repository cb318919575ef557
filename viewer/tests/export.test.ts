import { describe, expect, it } from "vitest";
import { centerOf, forwardOf, rotationOf } from "../src/geometry";
import { exportMark, isComplete, toPixels } from "../src/mark";
import {
  CONTINUED,
  FIRST_CAMERA,
  HULL,
  NOTHING,
  STATIC,
  colourMap,
  depthColour,
  legendOf,
} from "../src/overlay";
import { type Path, durationOf, exportPath, isOutside, pathAt, poseOfShare, tidyPath } from "../src/path";
import { makeManifest } from "./scene";

const manifest = makeManifest();
const path: Path = {
  isEased: false,
  keys: [
    { frame: 0, share: 0, seconds: 0 },
    { frame: 4, share: 1, seconds: 2 },
    { frame: 4, share: 0.5, seconds: 1 },
  ],
};

describe("paths", () => {
  it("pass their keys at their times", () => {
    expect(durationOf(path)).toBe(3);
    expect(pathAt(path, 0)).toEqual({ frame: 0, share: 0 });
    expect(pathAt(path, 1)).toEqual({ frame: 2, share: 0.5 });
    expect(pathAt(path, 2.5)).toEqual({ frame: 4, share: 0.75 });
    expect(pathAt(path, 99)).toEqual({ frame: 4, share: 0.5 });
    expect(pathAt({ ...path, isEased: true }, 0.5).share).toBeCloseTo(0.15625);
  });

  it("are films with poses and moments by their place in the film", () => {
    const film = exportPath(path, manifest) as {
      num_frames: number;
      keys: Record<string, number[]>[];
      time: Record<string, number>[];
    };
    expect(film).toMatchObject({ kind: "keys", world: "scene", num_frames: 90 });
    const places = film.keys.map((key) => key.at as unknown as number);
    expect(places).toEqual([...places].sort((a, b) => a - b));
    expect([places[0], places[places.length - 1]]).toEqual([0, 1]);
    expect(film.time).toEqual([
      { at: 0, frame: 0 },
      { at: 0.666666667, frame: 4 },
      { at: 1, frame: 4 },
    ]);
    // Four views are passed to the second key: the way around is not cut short.
    expect(film.keys.length).toBe(3 + 4 + 2);
    const middle = film.keys.find((key) => Math.abs((key.at as unknown as number) - 0.4) < 1e-6)!;
    const pose = poseOfShare(manifest, pathAt(path, 1.2).share);
    middle.position!.forEach((value, i) => expect(value).toBeCloseTo(centerOf(pose)[i]!, 6));
    const R = rotationOf(middle.rotation as [number, number, number, number]);
    expect(R.slice(6)).toEqual(forwardOf(pose).map((value) => expect.closeTo(value, 6)));
    expect(middle.fov_deg).toBeCloseTo((360 * Math.atan(27 / 100)) / Math.PI, 6);
  });

  it("start with their first key, whatever was removed", () => {
    const tidy = tidyPath({ ...path, keys: path.keys.slice(1) });
    expect(tidy.keys.map((key) => key.seconds)).toEqual([0, 1]);
  });
});

describe("places", () => {
  it("outside the cameras are known by pose and moment", () => {
    const scene = makeManifest();
    const last = scene.frames.length - 1;
    expect([0, 0.5, 1].map((share) => isOutside(scene, share, last))).toEqual([false, false, true]);
    expect(isOutside(scene, 1, 0)).toBe(false);
  });
});

describe("marks", () => {
  it("are in pixels of the camera's picture, the first pixel's centre at zero", () => {
    expect(toPixels([0, 1], [96, 54])).toEqual([-0.5, 53.5]);
    const mark = {
      shape: "box" as const,
      points: [
        [0.75, 0.5],
        [0.25, 1],
      ] as [number, number][],
    };
    expect(exportMark(mark, "event", "remove", "cam01", 7, [96, 54])).toEqual({
      scene: "event",
      operation: "remove",
      views: ["cam01"],
      marks: [{ view: "cam01", frame: 7, box: [23.5, 26.5, 71.5, 53.5] }],
    });
  });

  it("are complete with an area or three corners", () => {
    expect(
      isComplete({
        shape: "box",
        points: [
          [0, 0],
          [0, 1],
        ],
      }),
    ).toBe(false);
    expect(
      isComplete({
        shape: "box",
        points: [
          [0, 0],
          [1, 1],
        ],
      }),
    ).toBe(true);
    expect(
      isComplete({
        shape: "polygon",
        points: [
          [0, 0],
          [1, 1],
        ],
      }),
    ).toBe(false);
    expect(
      isComplete({
        shape: "polygon",
        points: [
          [0, 0],
          [1, 1],
          [0, 1],
        ],
      }),
    ).toBe(true);
  });
});

describe("overlays", () => {
  const map = new Uint8ClampedArray(
    [NOTHING, STATIC, CONTINUED, HULL, FIRST_CAMERA + 1].flatMap((origin) => [128, origin, 0, 255]),
  );
  const alphas = (overlay: "holes" | "hull" | "origin" | "depth"): number[] =>
    [...colourMap(map, overlay)].filter((_, i) => i % 4 === 3).map((a) => Number(a > 0));

  it("cover what they are about and nothing else", () => {
    expect(alphas("holes")).toEqual([1, 0, 1, 0, 0]);
    expect(alphas("hull")).toEqual([0, 0, 0, 1, 0]);
    expect(alphas("origin")).toEqual([1, 1, 1, 1, 1]);
    expect(alphas("depth")).toEqual([1, 1, 1, 1, 1]);
  });

  it("grow lighter towards the camera and name every colour", () => {
    const sums = [0, 0.25, 0.5, 0.75, 1].map((share) => depthColour(share).reduce((a, b) => a + b, 0));
    expect(sums).toEqual([...sums].sort((a, b) => a - b));
    expect(legendOf("origin", manifest).map(([, text]) => text)).toContain("cam02");
    expect(legendOf("none", manifest)).toEqual([]);
  });
});
