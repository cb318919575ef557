/** Poses between poses. Vectors are arrays of three, rotations nine numbers row by row, cam_from_world. */

import { type Pose, type RealCamera, poseAt } from "./manifest";

export type Vector = [number, number, number];
type Quaternion = [number, number, number, number];

export const add = (a: number[], b: number[]): Vector => [a[0]! + b[0]!, a[1]! + b[1]!, a[2]! + b[2]!];
export const scale = (a: number[], s: number): Vector => [a[0]! * s, a[1]! * s, a[2]! * s];
export const dot = (a: number[], b: number[]): number => a[0]! * b[0]! + a[1]! * b[1]! + a[2]! * b[2]!;
export const cross = (a: number[], b: number[]): Vector => [
  a[1]! * b[2]! - a[2]! * b[1]!,
  a[2]! * b[0]! - a[0]! * b[2]!,
  a[0]! * b[1]! - a[1]! * b[0]!,
];
export const subtract = (a: number[], b: number[]): Vector => add(a, scale(b, -1));
export const length = (a: number[]): number => Math.hypot(a[0]!, a[1]!, a[2]!);
export const normalize = (a: number[]): Vector => scale(a, 1 / Math.max(length(a), 1e-12));
const mix = (a: number, b: number, w: number): number => a + (b - a) * w;

/** R @ x. */
export const rotate = (R: number[], x: number[]): Vector => [
  dot(R.slice(0, 3), x),
  dot(R.slice(3, 6), x),
  dot(R.slice(6, 9), x),
];

/** R.T @ x. */
export const rotateBack = (R: number[], x: number[]): Vector =>
  add(add(scale(R.slice(0, 3), x[0]!), scale(R.slice(3, 6), x[1]!)), scale(R.slice(6, 9), x[2]!));

export const centerOf = (pose: Pose): Vector => scale(rotateBack(pose.R, pose.t), -1);
export const forwardOf = (pose: Pose): Vector => [pose.R[6]!, pose.R[7]!, pose.R[8]!];

/** Rotation and shift of `to_from_from`: x_to = R @ x_from + t. */
export function relativePose(from: Pose, to: Pose): { R: number[]; t: Vector } {
  const R: number[] = [];
  for (let i = 0; i < 3; i++)
    for (let j = 0; j < 3; j++) R.push(dot(to.R.slice(3 * i, 3 * i + 3), from.R.slice(3 * j, 3 * j + 3)));
  return { R, t: subtract(to.t, rotate(R, from.t)) };
}

/** Part of the way from pose `first` to the next: straight in place, evenly in angle. */
export function interpolatePose(poses: Pose[], first: number, weight: number): Pose {
  const [a, b] = [poses[first]!, poses[first + 1]!];
  const center = add(scale(centerOf(a), 1 - weight), scale(centerOf(b), weight));
  const R = rotationOf(slerp(quaternionOf(a.R), quaternionOf(b.R), weight));
  const intrinsics = a.intrinsics.map((value, i) => mix(value, b.intrinsics[i]!, weight));
  return { intrinsics, R, t: scale(rotate(R, center), -1) };
}

export function quaternionOf(R: number[]): Quaternion {
  const [a, b, c, d, e, f, g, h, i] = R as [
    number,
    number,
    number,
    number,
    number,
    number,
    number,
    number,
    number,
  ];
  // The largest of the four is divided by, so that none is lost to rounding.
  const squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i];
  const largest = squares.indexOf(Math.max(...squares));
  const s = 2 * Math.sqrt(squares[largest]!);
  if (largest === 0) return [s / 4, (h - f) / s, (c - g) / s, (d - b) / s];
  if (largest === 1) return [(h - f) / s, s / 4, (b + d) / s, (c + g) / s];
  if (largest === 2) return [(c - g) / s, (b + d) / s, s / 4, (f + h) / s];
  return [(d - b) / s, (c + g) / s, (f + h) / s, s / 4];
}

export function rotationOf([w, x, y, z]: Quaternion): number[] {
  return [
    1 - 2 * (y * y + z * z),
    2 * (x * y - w * z),
    2 * (x * z + w * y),
    2 * (x * y + w * z),
    1 - 2 * (x * x + z * z),
    2 * (y * z - w * x),
    2 * (x * z - w * y),
    2 * (y * z + w * x),
    1 - 2 * (x * x + y * y),
  ];
}

function slerp(a: Quaternion, b: Quaternion, weight: number): Quaternion {
  let cosine = a.reduce((sum, value, i) => sum + value * b[i]!, 0);
  const sign = cosine < 0 ? -1 : 1;
  cosine = Math.min(cosine * sign, 1);
  const angle = Math.acos(cosine);
  const [p, q] =
    angle < 1e-6
      ? [1 - weight, weight]
      : [Math.sin((1 - weight) * angle) / Math.sin(angle), Math.sin(weight * angle) / Math.sin(angle)];
  const sum = a.map((value, i) => p * value + q * sign * b[i]!);
  const norm = Math.hypot(...sum);
  return sum.map((value) => value / norm) as Quaternion;
}

/** The camera that stands and looks most like a pose: distance in units of the cameras' spread, plus angle. */
export function nearestCamera(pose: Pose, cameras: RealCamera[], moment: number): number {
  const centers = cameras.map((camera) => centerOf(poseAt(camera, moment)));
  const middle = scale(centers.reduce(add, [0, 0, 0] as Vector), 1 / cameras.length);
  const spread = Math.max(...centers.map((center) => length(subtract(center, middle))), 1e-9);
  const costs = cameras.map((camera, i) => {
    const angle = Math.acos(
      Math.min(1, Math.max(-1, dot(forwardOf(pose), forwardOf(poseAt(camera, moment))))),
    );
    return length(subtract(centers[i]!, centerOf(pose))) / spread + angle;
  });
  return costs.indexOf(Math.min(...costs));
}

/** The view of a list that stands nearest to a point. */
export function nearestView(center: number[], views: Pose[]): number {
  const distances = views.map((view) => length(subtract(centerOf(view), center)));
  return distances.indexOf(Math.min(...distances));
}
