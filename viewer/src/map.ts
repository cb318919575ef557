/** The small map: cameras, points and the shown place, turned by hand. */

import {
  type Vector,
  add,
  centerOf,
  cross,
  dot,
  forwardOf,
  normalize,
  rotateBack,
  scale,
  subtract,
} from "./geometry";
import { type Manifest, type Pose, poseAt } from "./manifest";
import { clamp } from "./state";

export interface MapView {
  azimuth: number;
  elevation: number;
  zoom: number;
}

export type Project = (point: number[]) => [number, number, number];

/** World basis of the map: right, ahead and up, ahead where the cameras look on average. */
export function mapBasis(manifest: Manifest): {
  origin: Vector;
  axes: [Vector, Vector, Vector];
  extent: number;
} {
  const poses = manifest.cameras.map((camera) => poseAt(camera, 0));
  const centers = poses.map(centerOf);
  const middle = scale(centers.reduce(add, [0, 0, 0] as Vector), 1 / centers.length);
  const up = normalize(manifest.up);
  const look = poses.map(forwardOf).reduce(add, [0, 0, 0] as Vector);
  const level = subtract(look, scale(up, dot(look, up)));
  const ahead =
    Math.hypot(...level) > 0.05 * poses.length ? normalize(level) : normalize(cross(up, [0.3, 0.5, 0.8]));
  const extent = Math.max(...centers.map((center) => Math.hypot(...subtract(center, middle))), 1e-9);
  // Cameras stand in the lower part of the map, what they look at above.
  return { origin: add(middle, scale(ahead, extent * 0.45)), axes: [cross(ahead, up), ahead, up], extent };
}

/** Orthographic picture coordinates and depth of world points. */
export function projector(
  basis: ReturnType<typeof mapBasis>,
  view: MapView,
  width: number,
  height: number,
): Project {
  const [ca, sa] = [Math.cos(view.azimuth), Math.sin(view.azimuth)];
  const [ce, se] = [Math.cos(view.elevation), Math.sin(view.elevation)];
  const zoom = (view.zoom * 0.37 * width) / basis.extent;
  return (point) => {
    const local = subtract(point, basis.origin);
    const [x, y, z] = basis.axes.map((axis) => dot(local, axis)) as Vector;
    const [right, away] = [x * ca - y * sa, x * sa + y * ca];
    return [width / 2 + right * zoom, height / 2 - (away * se + z * ce) * zoom, away * ce - z * se];
  };
}

/** Four corners of a camera's picture at some distance, world units. */
export function frustum(pose: Pose, size: number[], distance: number): Vector[] {
  const [fx, fy, cx, cy] = pose.intrinsics as [number, number, number, number];
  const center = centerOf(pose);
  return [
    [-0.5, -0.5],
    [size[0]! - 0.5, -0.5],
    [size[0]! - 0.5, size[1]! - 0.5],
    [-0.5, size[1]! - 0.5],
  ].map(([u, v]) => add(center, scale(rotateBack(pose.R, [(u! - cx) / fx, (v! - cy) / fy, 1]), distance)));
}

export interface MapColours {
  ink: string;
  soft: string;
  camera: string;
  heldout: string;
  shown: string;
  card: string;
}

export function drawMap(
  context: CanvasRenderingContext2D,
  manifest: Manifest,
  view: MapView,
  shown: Pose,
  moment: number,
  nearest: number,
  colours: MapColours,
): [number, number][] {
  const { width, height } = context.canvas;
  const unit = width / 320;
  const basis = mapBasis(manifest);
  const project = projector(basis, view, width, height);
  context.clearRect(0, 0, width, height);
  context.fillStyle = colours.soft;
  context.globalAlpha = 0.55;
  for (const point of manifest.points) {
    const [x, y] = project(point);
    context.fillRect(x, y, 1.5 * unit, 1.5 * unit);
  }
  context.globalAlpha = 1;
  context.lineWidth = 1.2 * unit;
  context.strokeStyle = colours.shown;
  context.setLineDash([4 * unit, 3 * unit]);
  strokeLine(
    context,
    manifest.views.map((entry) => project(centerOf(entry))),
  );
  context.setLineDash([]);
  const places = manifest.cameras.map((camera, i): [number, number] => {
    const pose = poseAt(camera, moment);
    context.strokeStyle = camera.is_heldout ? colours.heldout : colours.camera;
    context.lineWidth = (i === nearest ? 2.4 : 1.1) * unit;
    drawFrustum(context, project, pose, camera.size, basis.extent * 0.22);
    const [x, y] = project(centerOf(pose));
    return [x, y];
  });
  context.strokeStyle = colours.shown;
  context.lineWidth = 2.6 * unit;
  drawFrustum(context, project, shown, manifest.size, basis.extent * 0.34);
  const names = manifest.cameras.map((camera) => camera.name);
  drawNames(context, names, places, nearest, colours, unit);
  return places;
}

/** Names of the cameras below their places, the nearest one's first; one that would cover another is left out. */
function drawNames(
  context: CanvasRenderingContext2D,
  names: string[],
  places: [number, number][],
  nearest: number,
  colours: MapColours,
  unit: number,
): void {
  context.font = `${11 * unit}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.lineJoin = "round";
  context.lineWidth = 3 * unit;
  context.strokeStyle = colours.card;
  context.fillStyle = colours.ink;
  const taken: [number, number, number][] = [];
  for (const i of new Set([nearest, ...names.keys()])) {
    const half = context.measureText(names[i]!).width / 2 + 2 * unit;
    const x = clamp(places[i]![0], half, context.canvas.width - half);
    for (const y of [places[i]![1] + 14 * unit, places[i]![1] - 20 * unit]) {
      if (taken.some(([u, v, w]) => Math.abs(u - x) < w + half && Math.abs(v - y) < 12 * unit)) continue;
      taken.push([x, y, half]);
      context.strokeText(names[i]!, x, y);
      context.fillText(names[i]!, x, y);
      break;
    }
  }
}

function strokeLine(context: CanvasRenderingContext2D, points: [number, number, number][]): void {
  context.beginPath();
  points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.stroke();
}

function drawFrustum(
  context: CanvasRenderingContext2D,
  project: Project,
  pose: Pose,
  size: number[],
  distance: number,
): void {
  const corners = frustum(pose, size, distance).map(project);
  const tip = project(centerOf(pose));
  strokeLine(context, [...corners, corners[0]!]);
  for (const corner of corners) strokeLine(context, [tip, corner]);
}
