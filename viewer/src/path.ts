/** Camera paths: key frames taken while browsing, their preview, and the file that renders them. */

import { centerOf, interpolatePose, quaternionOf } from "./geometry";
import type { Manifest, Pose } from "./manifest";
import { clamp, latticePlace } from "./state";

export interface PathKey {
  /** Scene frame. */
  frame: number;
  share: number;
  /** Seconds from the key before; 0 of the first. */
  seconds: number;
}

export interface Path {
  keys: PathKey[];
  isEased: boolean;
}

const DIGITS = 9;
// Poses between two keys, per view of the lattice that is passed: between fewer the way would be cut short.
const POSES_PER_VIEW = 1;
const MAX_POSES_BETWEEN = 24;

const smooth = (x: number): number => x * x * (3 - 2 * x);

export function durationOf(path: Path): number {
  return path.keys.slice(1).reduce((sum, key) => sum + key.seconds, 0);
}

/** Where the film is some seconds after its start. */
export function pathAt(path: Path, seconds: number): { frame: number; share: number } {
  const { keys, isEased } = path;
  let start = 0;
  for (let i = 1; i < keys.length; i++) {
    const [a, b] = [keys[i - 1]!, keys[i]!];
    if (seconds < start + b.seconds) {
      const run = clamp((seconds - start) / b.seconds, 0, 1);
      const weight = isEased ? smooth(run) : run;
      return { frame: a.frame + (b.frame - a.frame) * run, share: a.share + (b.share - a.share) * weight };
    }
    start += b.seconds;
  }
  const last = keys[keys.length - 1]!;
  return { frame: last.frame, share: last.share };
}

/** The pose at a place of the path. */
export function poseOfShare({ way }: Pick<Manifest, "way">, share: number): Pose {
  const [first, , weight] = latticePlace(share, way.length);
  return weight ? interpolatePose(way, first, weight) : way[first]!;
}

/** Whether a place of the path lies outside what the cameras can know, at a moment. */
export function isOutside({ outside }: Pick<Manifest, "outside">, share: number, moment: number): boolean {
  return outside[Math.round(share * (outside.length - 1))]!.includes(moment);
}

const round = (value: number): number => Number(value.toFixed(DIGITS));

/** The trajectory that `render_all` takes (docs/paths.md): poses and moments by their place in the film. */
export function exportPath(path: Path, manifest: Manifest): Record<string, unknown> {
  const total = durationOf(path);
  const numFrames = Math.max(2, Math.round(total * manifest.fps));
  const keys: Record<string, unknown>[] = [];
  const addPose = (seconds: number): void => {
    const pose = poseOfShare(manifest, pathAt(path, seconds).share);
    keys.push({
      at: round(seconds / total),
      position: centerOf(pose).map(round),
      rotation: quaternionOf(pose.R).map(round),
      fov_deg: round((2 * 180 * Math.atan(manifest.size[1] / 2 / pose.intrinsics[1]!)) / Math.PI),
    });
  };
  const time: Record<string, unknown>[] = [];
  let start = 0;
  path.keys.forEach((key, i) => {
    if (i > 0) {
      const views = Math.abs(key.share - path.keys[i - 1]!.share) * (manifest.views.length - 1);
      const between = Math.min(Math.ceil(views * POSES_PER_VIEW), MAX_POSES_BETWEEN);
      for (let j = 1; j <= between; j++) addPose(start + (key.seconds * j) / (between + 1));
      start += key.seconds;
    }
    addPose(start);
    time.push({ at: round(start / total), frame: key.frame });
  });
  return { kind: "keys", world: "scene", num_frames: numFrames, keys, time };
}

/** Keys in the order of the film, the first at its start. */
export function tidyPath(path: Path): Path {
  return {
    ...path,
    keys: path.keys.map((key, i) => ({ ...key, seconds: i ? Math.max(key.seconds, 0.1) : 0 })),
  };
}
