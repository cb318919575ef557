import { describe, expect, it } from "vitest";
import {
  centerOf,
  forwardOf,
  interpolatePose,
  nearestCamera,
  nearestView,
  quaternionOf,
  relativePose,
  rotate,
  rotationOf,
  add,
} from "../src/geometry";
import { frustum, mapBasis, projector } from "../src/map";
import { makeManifest, poseOnCircle } from "./scene";

const close = (a: number[], b: number[], digits = 9): void =>
  a.forEach((value, i) => expect(value).toBeCloseTo(b[i]!, digits));

describe("poses", () => {
  it("have the centre that they were made with and look at the origin", () => {
    const pose = poseOnCircle(0.3);
    close(centerOf(pose), [5 * Math.sin(0.3), 0, -5 * Math.cos(0.3)]);
    close(forwardOf(pose), [-Math.sin(0.3), 0, Math.cos(0.3)]);
  });

  it("become quaternions and back, also half a turn", () => {
    const turns = [
      [1, 0, 0, 0, 1, 0, 0, 0, 1],
      [1, 0, 0, 0, -1, 0, 0, 0, -1],
      [-1, 0, 0, 0, 1, 0, 0, 0, -1],
      [-1, 0, 0, 0, -1, 0, 0, 0, 1],
    ];
    for (const R of [...turns, ...[-3, -0.5, 0.2, 2.9].map((angle) => poseOnCircle(angle).R)])
      close(rotationOf(quaternionOf(R)), R);
  });

  it("between two poses turn evenly and end at them", () => {
    const poses = [poseOnCircle(-0.2), poseOnCircle(0.2)];
    close(interpolatePose(poses, 0, 0).t, poses[0]!.t);
    close(interpolatePose(poses, 0, 1).R, poses[1]!.R);
    close(interpolatePose(poses, 0, 0.25).R, poseOnCircle(-0.1).R);
    close(centerOf(interpolatePose(poses, 0, 0.5)), [0, 0, -5 * Math.cos(0.2)]);
  });

  it("relative to each other carry points over", () => {
    const [a, b] = [poseOnCircle(-0.2), poseOnCircle(0.3)];
    const { R, t } = relativePose(a, b);
    const point = [0.4, -0.7, 0.9];
    const inA = add(rotate(a.R, point), a.t);
    close(add(rotate(R, inA), t), add(rotate(b.R, point), b.t));
  });

  it("know the nearest camera and view", () => {
    const { cameras, views } = makeManifest();
    expect(nearestCamera(poseOnCircle(0.35), cameras, 0)).toBe(2);
    expect(nearestView(centerOf(poseOnCircle(-0.4)), views)).toBe(0);
  });
});

describe("map", () => {
  it("has the right of the cameras on the right and up above", () => {
    const manifest = makeManifest();
    const basis = mapBasis(manifest);
    const project = projector(basis, { azimuth: 0, elevation: 0.5, zoom: 1 }, 300, 200);
    const at = (point: number[]): number[] => project(add(basis.origin, point));
    expect(at([0, 0, 0]).slice(0, 2)).toEqual([150, 100]);
    expect(at([1, 0, 0])[0]).toBeGreaterThan(150);
    expect(at([0, -1, 0])[1]).toBeLessThan(100);
    expect(at([0, 0, 1])[2]).toBeGreaterThan(0);
  });

  it("draws frustums whose corners are seen at the corners of the picture", () => {
    const pose = poseOnCircle(0.1);
    const corner = frustum(pose, [96, 54], 2)[2]!;
    const [x, y, z] = add(rotate(pose.R, corner), pose.t);
    close([100 * (x / z) + 47.5, 100 * (y / z) + 26.5, z], [95.5, 53.5, 2]);
  });
});
