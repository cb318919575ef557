import { describe, expect, it } from "vitest";
import { applyDrag, applyKey, applyWheel } from "../src/input";
import { formatLink, readLink } from "../src/link";
import {
  SPEEDS,
  advance,
  changeSpeed,
  initialState,
  latticePlace,
  momentOf,
  momentsPerSecond,
  orbit,
  seek,
  stepMoment,
  togglePlay,
} from "../src/state";
import { makeManifest } from "./scene";

const start = initialState();

describe("time", () => {
  it("plays a clip as long as it lasted, whatever the number of moments", () => {
    // 12 frames at 30 frames per second last 0.4 s; six moments of them too.
    const rate = momentsPerSecond(30, 12, 6);
    const playing = { ...start, isPlaying: true, isLooping: false };
    expect(momentOf(advance(playing, 0.2, rate, 6), 6)).toBe(3);
    expect(advance(playing, 0.39, rate, 6).isPlaying).toBe(true);
    const ended = advance(playing, 0.41, rate, 6);
    expect([ended.isPlaying, momentOf(ended, 6)]).toEqual([false, 5]);
  });

  it("loops without a gap, and stands still when it does not play", () => {
    const looping = { ...start, isPlaying: true, clock: 5.5 };
    expect(advance(looping, 1, 1, 6).clock).toBeCloseTo(0.5);
    expect(advance(start, 1, 1, 6)).toBe(start);
  });

  it("is as fast as the speed says, from a tenth to four times", () => {
    for (const speed of SPEEDS)
      expect(advance({ ...start, isPlaying: true, speed }, 0.5, 2, 100).clock).toBeCloseTo(speed);
    expect([SPEEDS[0], SPEEDS[SPEEDS.length - 1]]).toEqual([0.1, 4]);
    expect(changeSpeed({ ...start, speed: 4 }, 1).speed).toBe(4);
    expect(changeSpeed(start, -1).speed).toBe(0.5);
  });

  it("steps whole moments, around the ends only in a loop", () => {
    expect(stepMoment({ ...start, clock: 2.7 }, 1, 6).clock).toBe(3);
    expect(stepMoment(start, -1, 6).clock).toBe(5);
    expect(stepMoment({ ...start, isLooping: false }, -1, 6).clock).toBe(0);
    expect(momentOf(seek(start, 99, 6), 6)).toBe(5);
  });

  it("starts again when play is pressed at the end", () => {
    const ended = { ...start, clock: 5, isLooping: false };
    expect(togglePlay(ended, 6)).toMatchObject({ isPlaying: true, clock: 0 });
    expect(togglePlay({ ...ended, isPlaying: true }, 6).clock).toBe(5);
  });
});

describe("place", () => {
  it("lies between two neighbours, or is a view itself", () => {
    expect(latticePlace(0, 5)).toEqual([0, 0, 0]);
    expect(latticePlace(1, 5)).toEqual([4, 4, 0]);
    expect(latticePlace(0.5, 5)).toEqual([2, 2, 0]);
    const [a, b, weight] = latticePlace(0.3, 5);
    expect([a, b]).toEqual([1, 2]);
    expect(weight).toBeCloseTo(0.2);
  });

  it("never leaves the path", () => {
    expect(orbit(start, 1.4).share).toBe(1);
    expect(applyDrag(start, 3, 0, false, 6).share).toBe(0);
  });
});

describe("hands", () => {
  it("knows keys, and leaves others alone", () => {
    expect(applyKey("ArrowRight", false, start, 6)!.share).toBeGreaterThan(0.5);
    expect(applyKey("ArrowLeft", true, start, 6)!.share).toBeCloseTo(0.4);
    expect(momentOf(applyKey("ArrowUp", false, start, 6)!, 6)).toBe(1);
    expect(momentOf(applyKey("End", false, start, 6)!, 6)).toBe(5);
    expect(applyKey(" ", false, start, 6)!.isPlaying).toBe(true);
    expect(applyKey("Tab", false, start, 6)).toBeNull();
  });

  it("drags the scene with the hand, and time up and down", () => {
    expect(applyDrag(start, 0.1, 0, false, 6).share).toBeLessThan(0.5);
    expect(applyDrag(start, 0, -0.5, true, 6).clock).toBeCloseTo(3);
    expect(applyWheel(start, 0, 100, false, 6).clock).toBeCloseTo(3);
    expect(applyWheel(start, 0, 100, true, 6).share).toBeCloseTo(0.54);
  });
});

describe("links", () => {
  const manifest = makeManifest();
  it("come back as they went", () => {
    const state = { ...start, clock: 3.4, share: 0.3217, overlay: "depth" as const };
    const link = formatLink(state, manifest.frames);
    expect(link).toBe("#t=6&v=0.3217&o=depth");
    expect(readLink(link, start, manifest)).toMatchObject({ clock: 3, share: 0.3217, overlay: "depth" });
  });

  it("with nonsense change nothing", () => {
    for (const hash of ["", "#", "#t=x&v=", "#o=<script>", "#v=NaN&t="])
      expect(readLink(hash, start, manifest)).toEqual(start);
    expect(readLink("#t=999&v=7", start, manifest)).toMatchObject({ clock: 5, share: 1 });
  });
});
