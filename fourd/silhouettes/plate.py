"""Background plate of a camera: what it films where nothing moves, and how much that varies.

A camera on a tripod, or pictures of the empty scene: the median over time of every pixel. A camera in
the hand: its other pictures turned to the wanted view by the known rotation, which is exact for what is
far; what is near disagrees by its parallax, and is unknown.
"""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from fourd.camera import Camera

# Least noise of a camera, grey levels: quantisation and compression leave none below.
NOISE_FLOOR = 1.5
# Median absolute deviation to standard deviation, of a normal distribution.
SIGMA_PER_MAD = 1.4826
# Samples that see a pixel of a turned plate; fewer have no median to trust.
MIN_SAMPLES = 3
# A pixel whose samples deviate by more than this many times what the picture's noise and edges explain
# shows no background that most samples share.
MAX_UNREST = 6.0


@dataclasses.dataclass(frozen=True, eq=False)
class Plate:
    """What a camera films where nothing moves.

    rgb: (H, W, 3) float32, 0-255;  sigma: (H, W, 3) float32 standard deviation of a picture about it
    known: (H, W) bool, False where no background is to be trusted
    unrest: (H, W) float32 share of the samples in which something else is seen, 1 where nothing is known;
        None of a film that shows nothing else, or of a camera that moves
    """

    rgb: np.ndarray
    sigma: np.ndarray
    known: np.ndarray
    unrest: np.ndarray | None = None


def estimate_plate(images: Sequence[np.ndarray], jitter_px: float) -> Plate:
    """Plate of pictures that share one view.

    images: (H, W, 3) uint8 each;  jitter_px: shifts that are no motion
    A pixel is known where the samples agree about as well as elsewhere in the picture.
    """
    stack = np.stack(images)
    seen = np.ones(stack.shape[:3], bool)
    return _plate_of(stack, seen, jitter_px)


def turned_plate(
    images: Sequence[np.ndarray], cameras: Sequence[Camera], camera: Camera, jitter_px: float
) -> Plate:
    """Plate of a camera that moves, for one of its frames.

    images: (H, W, 3) uint8 taken by `cameras`;  camera: the view wanted
    Pictures are mapped by the rotation between the views and by the lens. What is so near that the
    camera's path shows as parallax is not known.
    """
    height, width = images[0].shape[:2]
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    rays = camera.rays(grid)
    stack, seen = [], []
    for image, other in zip(images, cameras, strict=True):
        directions = rays @ (other.R @ camera.R.T).T
        with np.errstate(divide="ignore", invalid="ignore"):
            at = other.pixels_from_normalized(directions[..., :2] / directions[..., 2:])
        inside = (directions[..., 2] > 0) & ((at >= 0) & (at <= (width - 1, height - 1))).all(axis=-1)
        at = np.where(inside[..., None], at, -1).astype(np.float32)
        stack.append(cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR))
        seen.append(inside)
    return _plate_of(np.stack(stack), np.stack(seen), jitter_px)


def without_motion(plate: Plate, jitter_px: float) -> Plate:
    """The plate with the noise of the whole picture, which nobody who passes has raised."""
    usual = np.median(plate.sigma.reshape(-1, 3), axis=0)
    sigma = np.sqrt(usual**2 + (jitter_px * _edge_strength(plate.rgb)) ** 2)
    return dataclasses.replace(plate, sigma=np.minimum(sigma, plate.sigma).astype(np.float32))


def _plate_of(stack: np.ndarray, seen: np.ndarray, jitter_px: float) -> Plate:
    """Median and spread over the first axis; stack: (S, H, W, 3) uint8, seen: (S, H, W) bool."""
    counts = seen.sum(axis=0)
    values = stack.astype(np.float32)
    rgb = _masked_median(values, seen)
    spread = SIGMA_PER_MAD * _masked_median(np.abs(values - rgb), seen)
    edges = jitter_px * _edge_strength(rgb)
    enough = counts >= min(MIN_SAMPLES, len(stack))
    usual = np.maximum(np.median(spread[enough], axis=0) if enough.any() else NOISE_FLOOR, NOISE_FLOOR)
    explained = np.sqrt(usual**2 + edges**2)
    known = enough & (spread <= MAX_UNREST * explained).all(axis=-1)
    return Plate(rgb, np.sqrt(np.maximum(spread, usual) ** 2 + edges**2).astype(np.float32), known)


def _masked_median(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32 lower median over the first axis of what is seen; 0 where nothing is."""
    if seen.all():
        return np.median(values, axis=0).astype(np.float32)
    ordered = np.sort(np.where(seen[..., None], values, np.inf), axis=0)
    middle = np.maximum(seen.sum(axis=0) - 1, 0) // 2
    median = np.take_along_axis(ordered, middle[None, ..., None], axis=0)[0]
    return np.where(np.isfinite(median), median, 0).astype(np.float32)


def _edge_strength(rgb: np.ndarray) -> np.ndarray:
    """(H, W, 3) length of the gradient, grey levels per px."""
    across = cv2.Scharr(rgb, cv2.CV_32F, 1, 0, scale=1 / 32)
    along = cv2.Scharr(rgb, cv2.CV_32F, 0, 1, scale=1 / 32)
    return np.sqrt(across**2 + along**2)
