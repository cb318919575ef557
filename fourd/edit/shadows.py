"""Shadows of what is taken out: where the light comes from, and what stands in its way."""

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import KDTree

from fourd.edit.plate import DARKEST_SHADOW, is_plate

# A shadow leaves at most this share of the light.
_DARKER = 0.88
# Directions tried over half the sphere; places of each kind that are looked at, at most and at least.
_NUM_DIRECTIONS, _NUM_POINTS, _MIN_POINTS = 400, 600, 20
# Least share of the dark places that the light has to explain beyond what it would darken elsewhere.
_MIN_SCORE = 0.25
# Blur of what is compared to give a shadow its light back, px: wider than what depth is off.
_BLUR_PX = 2.0
# Reach of a voxel, in its sides.
_REACH = 1.5


def find_dark(image: np.ndarray, plate: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(H, W) bool: places that stand still and have less light than at other times.

    image, plate: (H, W, 3) uint8;  known: (H, W) bool where the plate is known
    """
    light = image.astype(np.float32).sum(axis=2) / np.maximum(plate.astype(np.float32).sum(axis=2), 1.0)
    return known & (light < _DARKER) & is_plate(image, plate)


def find_light(
    moments: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], up: np.ndarray, side: float
) -> np.ndarray | None:
    """(3,) unit vector towards the light; None where no single direction explains the dark places.

    moments: (N, 3) everything that moves, and (D, 3) dark and (L, 3) lit places that stand still, world;
    those with too few of any are left out
    up: (3,) unit;  side: of a voxel
    Directions are tried on a spiral over the upper half of the sphere, then around the best.
    """
    thin = [[_thin(p, _NUM_POINTS * k) for p, k in zip(moment, (4, 1, 1), strict=True)] for moment in moments]
    thin = [moment for moment in thin if min(map(len, moment)) >= _MIN_POINTS]
    best, best_score = None, _MIN_SCORE
    for spread in (1.0, 0.1, 0.02):
        for direction in _directions(up if best is None else best, spread, up):
            scores = [_score(moment, direction, _REACH * side) for moment in thin]
            if scores and np.mean(scores) > best_score:
                best, best_score = direction, float(np.mean(scores))
        if best is None:
            return None
    return best


def _score(moment: Sequence[np.ndarray], direction: np.ndarray, reach: float) -> float:
    """Share of the dark places that a direction explains, less the share of lit ones that it would darken."""
    points, dark, lit = moment
    shares = [float((_covered(points, places, direction) < reach).mean()) for places in (dark, lit)]
    return shares[0] - shares[1]


def _thin(points: np.ndarray, most: int) -> np.ndarray:
    step = max(1, -(-len(points) // most))
    return points[::step]


def _directions(center: np.ndarray, spread: float, up: np.ndarray) -> np.ndarray:
    """(N, 3) unit vectors within a cap of 1 - cos <= spread around the centre, above the horizon."""
    number = _NUM_DIRECTIONS if spread == 1.0 else 60
    i = np.arange(number) + 0.5
    z = 1 - spread * i / number
    radius, angle = np.sqrt(np.maximum(1 - z * z, 0)), i * np.pi * (3 - np.sqrt(5))
    across = np.cross(center, np.eye(3)[np.argmin(np.abs(center))])
    across /= np.linalg.norm(across)
    basis = np.stack([across, np.cross(center, across), center])
    found = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1) @ basis
    return found[found @ up > 0.1]


def _covered(points: np.ndarray, places: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(M,) distance of the line from each place towards the light to the nearest point before it."""
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    across /= np.linalg.norm(across)
    plane = np.stack([across, np.cross(direction, across)], axis=-1)
    distance, nearest = KDTree(points @ plane).query(places @ plane)
    ahead = (points[nearest] - places) @ direction > 0
    return np.where(ahead, distance, np.inf)


def shadow_of(
    points: np.ndarray, others: np.ndarray, places: np.ndarray, light: np.ndarray, side: float
) -> np.ndarray:
    """(M,) bool: places that the points (N, 3) keep the light from, and nothing of the others (K, 3) does."""
    if not len(points) or not len(places):
        return np.zeros(len(places), bool)
    ours = _covered(points, places, light)
    theirs = _covered(others, places, light) if len(others) else np.full(len(places), np.inf)
    return (ours < 2 * _REACH * side) & (ours <= theirs)


def relight(image: np.ndarray, plate: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32 picture with as much light as the plate has, its own details kept.

    image: (H, W, 3) float32 0-255;  plate: (H, W, 3) uint8;  opacity: (H, W) float32 of the shadow, 0 to 1
    """
    ground, dark = (
        cv2.GaussianBlur(i.astype(np.float32), (0, 0), _BLUR_PX) for i in (plate, np.clip(image, 0, 255))
    )
    gain = np.clip(ground / np.maximum(dark, 1.0), 1.0, 1 / DARKEST_SHADOW)
    return np.clip(image * (1 + opacity[..., None] * (gain - 1)), 0, 255)
