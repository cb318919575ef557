/** What the workflow says about the scene; written by fourd/viewer/manifest.py. */

/** A pinhole: focal lengths and principal point in px, cam_from_world row by row, world units. */
export interface Pose {
  intrinsics: number[];
  R: number[];
  t: number[];
}

export interface LatticeView extends Pose {
  name: string;
  /** Place on the cameras' path, 0 the leftmost camera, 1 the rightmost. */
  share: number;
}

export interface RealCamera {
  name: string;
  is_heldout: boolean;
  size: [number, number];
  picture: [number, number];
  /** One per moment, or a single one of a camera that stands still. */
  poses: Pose[];
}

export interface Manifest {
  scene: string;
  fps: number;
  num_frames: number;
  /** Scene frame of every moment. */
  frames: number[];
  size: [number, number];
  up: number[];
  inverse_depth_max: number;
  fused: string[];
  views: LatticeView[];
  /** Poses of the films' path, evenly from the first view to the last. */
  way: Pose[];
  /** For every pose of the way, the moments at which the cameras cannot know what it shows. */
  outside: number[][];
  cameras: RealCamera[];
  points: number[][];
  files: string[];
}

export function poseAt(camera: RealCamera, moment: number): Pose {
  return camera.poses[Math.min(moment, camera.poses.length - 1)]!;
}

/** The moment whose scene frame is nearest to a frame. */
export function momentOfFrame(frames: number[], frame: number): number {
  let best = 0;
  frames.forEach((shown, moment) => {
    if (Math.abs(shown - frame) < Math.abs(frames[best]! - frame)) best = moment;
  });
  return best;
}
