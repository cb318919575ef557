import { describe, expect, it } from "vitest";
import { LEVELS, Pace } from "../src/pace";
import { meshIndices } from "../src/warp";

const run = (pace: Pace, gap: number, isBusy: boolean, times: number): void => {
  for (let i = 0; i < times; i++) pace.note(gap, isBusy);
};

describe("pace", () => {
  it("stays careful where bending costs nothing, whatever the screen's rate", () => {
    for (const gap of [7, 16.7, 33.4]) {
      const pace = new Pace();
      run(pace, gap, false, 60);
      run(pace, gap, true, 200);
      expect(pace.level).toBe(0);
    }
  });

  it("becomes coarser step by step where it is slow, and no coarser than the last", () => {
    const pace = new Pace();
    run(pace, 60, true, 8);
    expect(pace.level).toBe(1);
    run(pace, 17, true, 80);
    expect(pace.level).toBe(1);
    run(pace, 60, true, 80);
    expect(pace.level).toBe(LEVELS - 1);
  });

  it("forgives a single long pause", () => {
    const pace = new Pace();
    run(pace, 16.7, true, 7);
    pace.note(70, true);
    expect(pace.level).toBe(0);
  });
});

describe("mesh", () => {
  it("covers the whole grid at any stride, once", () => {
    for (const [width, height, stride] of [
      [5, 4, 1],
      [8, 7, 3],
      [160, 90, 3],
      [2, 2, 3],
    ] as const) {
      const cells = meshIndices(width, height, stride);
      let area = 0;
      for (let i = 0; i < cells.length; i += 3) {
        const [a, b, c] = [0, 1, 2].map((j) => [
          cells[i + j]! % width,
          Math.floor(cells[i + j]! / width),
        ]) as [number[], number[], number[]];
        area += ((b[0]! - a[0]!) * (c[1]! - a[1]!) - (b[1]! - a[1]!) * (c[0]! - a[0]!)) / 2;
      }
      expect(area).toBe((width - 1) * (height - 1));
    }
  });
});
