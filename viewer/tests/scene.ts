import type { Manifest, Pose } from "../src/manifest";

/** A camera on a circle around the origin that looks at it, y down. */
export function poseOnCircle(angle: number, radius = 5): Pose {
  const center = [radius * Math.sin(angle), 0, -radius * Math.cos(angle)];
  const R = [Math.cos(angle), 0, Math.sin(angle), 0, 1, 0, -Math.sin(angle), 0, Math.cos(angle)];
  const t = [0, 1, 2].map(
    (i) => -(R[3 * i]! * center[0]! + R[3 * i + 1]! * center[1]! + R[3 * i + 2]! * center[2]!),
  );
  return { intrinsics: [100, 100, 47.5, 26.5], R, t };
}

export function makeManifest(numViews = 5, frames = [0, 2, 4, 6, 8, 10]): Manifest {
  const angles = Array.from({ length: numViews }, (_, i) => -0.4 + (0.8 * i) / (numViews - 1));
  const views = angles.map((angle, i) => ({
    name: `lattice-0${i}`,
    share: i / (numViews - 1),
    ...poseOnCircle(angle),
  }));
  const way = Array.from({ length: 8 * (numViews - 1) + 1 }, (_, i) =>
    poseOnCircle(-0.4 + (0.8 * i) / (8 * (numViews - 1))),
  );
  const cameras = [-0.4, 0, 0.4].map((angle, i) => ({
    name: `cam0${i}`,
    is_heldout: i === 1,
    size: [96, 54] as [number, number],
    picture: [64, 36] as [number, number],
    poses: [poseOnCircle(angle)],
  }));
  const files = views.flatMap(({ name }) => [`view-${name}-0.js`, `map-${name}-0.js`]);
  return {
    scene: "event",
    fps: 30,
    num_frames: 12,
    frames,
    size: [96, 54],
    up: [0, -1, 0],
    inverse_depth_max: 0.5,
    fused: ["cam00", "cam02"],
    views,
    way,
    // The second half of the way, at the last moment.
    outside: way.map((_, i) => (i > way.length / 2 ? [frames.length - 1] : [])),
    cameras,
    points: [[0, 0, 0]],
    files: [...files, ...cameras.map(({ name }) => `camera-${name}-0.js`)],
  };
}
