"""Near and far of every camera, from whatever knows them best."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from fourd.camera import Camera
from fourd.sfm.importers import DepthBounds
from fourd.sfm.normalize import Similarity
from fourd.sfm.options import SfmOptions

# Frames of a moving camera at which the sparse points are looked at.
NUM_POSES = 9


@dataclasses.dataclass(frozen=True)
class DepthRange:
    """near, far: z in world units, far may be infinite;  source: what they were taken from."""

    near: float
    far: float
    source: str


def range_from_bounds(bounds: DepthBounds, scale: float, options: SfmOptions) -> DepthRange:
    """Range from the calibration's bounds in source units; scale: source units per world unit.

    Percentiles of sparse points leave some pixels outside, so `near_margin` widens them both ways.
    """
    margin = options.near_margin if bounds.are_percentiles else 1.0
    far = bounds.far / margin / scale if options.use_far_bound else float("inf")
    return DepthRange(bounds.near * margin / scale, far, "calibration")


def range_from_points(
    cameras: Sequence[Camera], points: np.ndarray, options: SfmOptions
) -> DepthRange | None:
    """Range of one camera over time from (N, 3) sparse points, or None if too few are in view.

    near is a low percentile of the depths in view times a margin, the smallest over the poses;
    far is infinite, because sky and far hills have no points.
    """
    poses = [cameras[i] for i in np.unique(np.linspace(0, len(cameras) - 1, NUM_POSES).round().astype(int))]
    nearest = float("inf")
    for camera in poses:
        depth = depths_in_view(camera, points)
        if len(depth) < options.min_points:
            return None
        nearest = min(nearest, float(np.percentile(depth, options.near_percentile)))
    return DepthRange(nearest * options.near_margin, float("inf"), "sparse points")


def depths_in_view(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(M,) depths of the points (N, 3) that project into the image."""
    pixels, depth = camera.project(points)
    width, height = camera.size
    # NaN behind the camera makes every comparison false.
    inside = (np.abs(pixels - [(width - 1) / 2, (height - 1) / 2]) <= [width / 2, height / 2]).all(axis=1)
    return depth[inside & (depth > 0)]


def range_from_geometry(cameras: Sequence[Camera], similarity: Similarity, options: SfmOptions) -> DepthRange:
    """Range without any point: a fraction of the way to where the cameras look, far infinite.

    The way is the smallest depth of the convergence point over time; without one (parallel axes)
    it is the world unit, the cameras' spread.
    """
    depths = [float(c.t[2]) for c in cameras if c.t[2] > 0] if similarity.converges else []
    distance = min(depths) if len(depths) == len(cameras) else 1.0
    return DepthRange(options.fallback_near_fraction * distance, float("inf"), "camera geometry")


def choose_depth_ranges(
    tracks: Mapping[str, Sequence[Camera]],
    given: tuple[float, float] | None,
    bounds: Mapping[str, DepthBounds],
    points: np.ndarray,
    similarity: Similarity,
    options: SfmOptions,
) -> dict[str, DepthRange]:
    """Range of every camera: the user's, else the calibration's, else from points, else geometry.

    tracks: normalised cameras;  points: (N, 3) world units
    given: (near, far) of the user, bounds: of the calibration, both in source units
    """
    chosen = {}
    for name, cameras in tracks.items():
        if given is not None:
            chosen[name] = DepthRange(given[0] / similarity.scale, given[1] / similarity.scale, "given")
        elif name in bounds:
            chosen[name] = range_from_bounds(bounds[name], similarity.scale, options)
        else:
            found = range_from_points(cameras, points, options)
            chosen[name] = found or range_from_geometry(cameras, similarity, options)
    return chosen
