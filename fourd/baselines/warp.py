"""Input pictures brought to a view over the surface that is seen there."""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from fourd.camera import Camera

# A point is hidden if another one in the same cell lies nearer by more than this share of its depth.
HIDDEN_SHARE = 0.05
CELL_PX = 2
# Stands for infinity: beyond it no parallax is left, and directions still have digits.
FARTHEST = 1e6
# Smaller angles are rounding, and do not decide between two cameras in one place.
SMALLEST_ANGLE_RAD = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Warp:
    """The two inputs nearest by angle, blended, and how many inputs see each surface point.

    image: (H, W, 3) uint8, black where no input sees the surface
    num_seen: (H, W) uint8 inputs, 0 where there is no depth
    """

    image: np.ndarray
    num_seen: np.ndarray


def warp_inputs(
    depth: np.ndarray, camera: Camera, inputs: Sequence[tuple[np.ndarray, np.ndarray, Camera]]
) -> Warp:
    """Blend the input pictures over a depth map.

    depth: (H, W) z in `camera`, world units, NaN = none;  inputs: (h, w, 3) uint8, (h, w) bool where
    it is known, and its pinhole. An input sees a point that falls inside its picture and that no
    other point of the same depth map hides there: what hides it without being in view is not known.
    The two nearest by the angle between the rays are weighted by each other's angle.
    """
    has_depth = ~np.isnan(depth)
    rows, columns = np.nonzero(has_depth)
    z = np.minimum(depth[has_depth].astype(np.float64), FARTHEST)
    points = camera.unproject(np.stack([columns, rows], axis=-1).astype(np.float64), z)
    to_view = _unit((camera.center - points).astype(np.float32))
    # Of the nearest and the second camera by angle; -2 is no cosine.
    cosines = np.full((2, len(points)), -2, np.float32)
    colours = np.zeros((2, len(points), 3), np.uint8)
    num_seen = np.zeros(len(points), np.uint8)
    for image, valid, other in inputs:
        pixels, seen = find_visible(points, other, valid)
        index = np.flatnonzero(seen)
        num_seen[index] += 1
        to_other = _unit((other.center - points[index]).astype(np.float32))
        cosine = np.einsum("ij,ij->i", to_view[index], to_other)
        colour = _sample(image, pixels[index])
        is_first = cosine > cosines[0, index]
        is_second = ~is_first & (cosine > cosines[1, index])
        first, second = index[is_first], index[is_second]
        cosines[1, first], colours[1, first] = cosines[0, first], colours[0, first]
        cosines[0, first], colours[0, first] = cosine[is_first], colour[is_first]
        cosines[1, second], colours[1, second] = cosine[is_second], colour[is_second]
    counts = np.zeros(depth.shape, np.uint8)
    counts[has_depth] = num_seen
    blended = np.zeros((*depth.shape, 3), np.uint8)
    blended[has_depth] = _blend(cosines, colours)
    return Warp(blended, counts)


def find_visible(points: np.ndarray, camera: Camera, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points fall in a picture, (N, 2) float32 px, and which of them are seen there, (N,) bool.

    points: (N, 3) world units;  camera: an ideal pinhole;  valid: (h, w) bool of its size
    """
    # By coordinate, so that every step reads and writes memory in order.
    x, y, z = (camera.K @ camera.R @ points.T + (camera.K @ camera.t)[:, None]).astype(np.float32)
    width, height = camera.size
    with np.errstate(divide="ignore", invalid="ignore"):
        x /= z
        y /= z
        inside = (z > 0) & (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    index = np.flatnonzero(inside)
    column = np.minimum((x[index] + np.float32(0.5)).astype(np.int32), width - 1)
    row = np.minimum((y[index] + np.float32(0.5)).astype(np.int32), height - 1)
    cell = (row // CELL_PX) * width + column // CELL_PX
    known = valid[row, column]
    if not known.all():
        index, cell = index[known], cell[known]
    surface = np.full((height // CELL_PX + 1) * width, np.inf, np.float32)
    np.minimum.at(surface, cell, z[index])
    seen = np.zeros(len(points), bool)
    seen[index] = z[index] <= surface[cell] * np.float32(1 + HIDDEN_SHARE)
    return np.stack([x, y], axis=-1), seen


def _sample(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 bilinear colours at (N, 2) px; rows of 4096 since OpenCV bounds a picture's sides."""
    count = len(pixels)
    padded = np.zeros((max(1, -(-count // 4096)) * 4096, 2), np.float32)
    padded[:count] = pixels
    x, y = padded[:, 0].reshape(-1, 4096), padded[:, 1].reshape(-1, 4096)
    sampled = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled).reshape(-1, 3)[:count]


def _blend(cosines: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """(N, 3) uint8: each of two colours weighted by the other one's angle; one alone as it is."""
    first, second = np.maximum(np.arccos(np.clip(cosines, -1, 1)), SMALLEST_ANGLE_RAD)
    weight = np.where(cosines[1] >= -1, second / (first + second), 1).astype(np.float32)[:, None]
    return (weight * colours[0] + (1 - weight) * colours[1] + np.float32(0.5)).astype(np.uint8)


def _unit(vectors: np.ndarray) -> np.ndarray:
    lengths = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    return vectors / np.maximum(lengths, np.float32(1e-30))[:, None]
