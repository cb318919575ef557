"""What moves by itself, told by depth: a point that lies on no surface at other times."""

from collections.abc import Sequence

import numpy as np

from fourd.camera import Camera
from fourd.edit.sample_kernels import look_up

# Standard deviation from a median absolute difference of two equally noisy values.
_SIGMA_PER_MEDIAN = 1.4826 / np.sqrt(2)
# Combined sigmas of two depths that are one surface.
_TOLERANCE = 4.0
# Views that see a surface, per view that sees through, up to which it moves.
_MIN_SEEN_THROUGH = 3
# Noise below this share of an inverse depth is rounding.
_LEAST_NOISE = 1e-3
# Noise above this share is no noise: few of the points asked about stand still.
_MOST_NOISE = 1e-2


def world_points(camera: Camera, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World points of the pixels that have a finite depth, and which these are.

    camera: ideal pinhole;  depth: (H, W) float32 z, NaN = unknown, infinity allowed
    Returns (N, 3) float64 and (N,) flat indices of pixels, rising.
    """
    index = np.flatnonzero(np.isfinite(depth))
    width = depth.shape[1]
    pixels = np.stack([index % width, index // width], axis=-1).astype(np.float64)
    return camera.unproject(pixels, depth.ravel()[index].astype(np.float64)), index


def places_of(camera: Camera, depth: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(N, 3) world points of chosen pixels, (H, W) bool, that have a finite depth, row by row."""
    return world_points(camera, np.where(where, depth, np.nan))[0]


def project_ideal(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) px and (N,) z of (N, 3) world points in an ideal pinhole; any px where z <= 0."""
    homogeneous = points @ (camera.K @ camera.R).T + camera.K @ camera.t
    z = homogeneous[:, 2]
    return homogeneous[:, :2] / np.where(z > 0, z, 1.0)[:, None], z


def sample_depth(camera: Camera, depth: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth map where points lie: what is seen there, and how far the points are.

    Returns (N,) float32 z of the nearest pixel, NaN outside the picture or where unknown, and (N,) z.
    """
    seen, z = np.empty(len(points), np.float32), np.empty(len(points))
    image_from_world, offset = camera.K @ camera.R, camera.K @ camera.t
    look_up(np.ascontiguousarray(points), image_from_world, offset, np.ascontiguousarray(depth), seen, z)
    return seen, z


def find_moving(
    camera: Camera, depth: np.ndarray, views: Sequence[tuple[Camera, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels whose surface is not there at other times, and pixels that nobody can tell of.

    camera: ideal pinhole of `depth`, (H, W) float32 z;  views: any cameras at other times, with depth
    Two views of one surface differ by noise, which a picture itself tells: most of it stands still. What
    moves along a ray, or slowly, is still there at some times, so a third of the views is enough to see
    through it. A view in which something nearer hides the place says nothing.
    Returns (H, W) bool twice.
    """
    points, index = world_points(camera, depth)
    gone, standing = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for other, its_depth in views:
        seen, z = sample_depth(other, its_depth, points)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Of the inverse depth, relative to the point's own.
            difference = z.astype(np.float32) / seen - 1
        known = np.isfinite(difference) & (z > 0)
        if not known.any():
            continue
        noise = _SIGMA_PER_MEDIAN * float(np.median(np.abs(difference[known])))
        tolerance = _TOLERANCE * np.sqrt(2) * np.clip(noise, _LEAST_NOISE, _MOST_NOISE)
        gone += known & (difference < -tolerance)
        standing += known & (np.abs(difference) <= tolerance)
    moving, untold = np.zeros(depth.shape, bool), ~np.isfinite(depth)
    moving.ravel()[index] = _MIN_SEEN_THROUGH * gone > standing
    untold.ravel()[index] = gone + standing == 0
    return moving, untold


def times_to_compare(frame: int, num_frames: int, count: int) -> list[int]:
    """Up to `count` other frames, evenly spread over the clip."""
    chosen = {(2 * i + 1) * num_frames // (2 * count) for i in range(count)} if count < num_frames else None
    return sorted((set(range(num_frames)) if chosen is None else chosen) - {frame})
