/** A mark on a real picture: a box or a polygon around what is to be edited. */

export type Point = [number, number];
export interface Mark {
  shape: "box" | "polygon";
  points: Point[];
}

export const isComplete = (mark: Mark): boolean =>
  mark.shape === "box" ? mark.points.length === 2 && areaOf(mark) > 0 : mark.points.length >= 3;

/** Corners of a box from two opposite ones, left, top, right, bottom. */
export function boxOf([a, b]: Point[]): [number, number, number, number] {
  return [Math.min(a![0], b![0]), Math.min(a![1], b![1]), Math.max(a![0], b![0]), Math.max(a![1], b![1])];
}

export function areaOf(mark: Mark): number {
  if (mark.points.length < 2) return 0;
  const [left, top, right, bottom] = boxOf(mark.points);
  return (right - left) * (bottom - top);
}

/** From shares of the picture's sides to pixels, the centre of the top left one at (0, 0). */
export function toPixels(point: Point, size: [number, number]): Point {
  return [Math.round((point[0] * size[0] - 0.5) * 10) / 10, Math.round((point[1] * size[1] - 0.5) * 10) / 10];
}

/** The file of an edit (docs/editing.md). size: of the camera's own pictures, px. */
export function exportMark(
  mark: Mark,
  scene: string,
  operation: string,
  camera: string,
  frame: number,
  size: [number, number],
): Record<string, unknown> {
  const points = mark.points.map((point) => toPixels(point, size));
  const shape = mark.shape === "box" ? { box: boxOf(points) } : { polygon: points };
  return { scene, operation, views: [camera], marks: [{ view: camera, frame, ...shape }] };
}
