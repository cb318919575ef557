"""Which camera saw a static surface at which of the sampled times."""

from collections.abc import Sequence

import numpy as np

from fourd.camera import Camera
from fourd.edit.compose import NOBODY
from fourd.edit.moving import sample_depth, world_points

_SAME = 0.02


def find_origin(
    camera: Camera,
    depth: np.ndarray,
    wanted: np.ndarray,
    sights: Sequence[tuple[int, int, Camera, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The camera and time that show each static surface best.

    camera: ideal pinhole of the view;  depth: (H, W) float32 z of the background;  wanted: (H, W) bool
    sights: index of a camera, index of a time, ideal pinhole then, and (H, W) float32 z
    Best is the smallest angle between the rays; of equal ones the first.
    Returns (H, W) bool seen, (H, W) uint8 camera, (H, W) uint8 time.
    """
    points, index = world_points(camera, np.where(wanted, depth, np.nan))
    best = np.full(len(points), -2.0)
    who, when = (np.full(len(points), NOBODY, np.uint8) for _ in range(2))
    rays = _unit(points - camera.center)
    for cam, time, pinhole, seen_depth in sights:
        seen, z = sample_depth(pinhole, seen_depth, points)
        with np.errstate(invalid="ignore"):
            visible = np.abs(seen - z) <= _SAME * z
        likeness = np.where(visible, (rays * _unit(points - pinhole.center)).sum(axis=1), -2.0)
        better = likeness > best
        best[better], who[better], when[better] = likeness[better], cam, time
    shape = depth.shape
    result = np.zeros(shape, bool), np.full(shape, NOBODY, np.uint8), np.full(shape, NOBODY, np.uint8)
    for image, values in zip(result, (best > -2, who, when), strict=True):
        image.ravel()[index] = values
    return result


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
