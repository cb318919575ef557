"""How far recovered cameras are from the true ones, after the best similarity between the worlds."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from fourd.camera import Camera
from fourd.geometry import convergence_point, nearest_rotation


@dataclasses.dataclass(frozen=True, eq=False)
class CameraErrors:
    """Errors of N cameras, in the order they were given.

    rotation_deg: (N,);  center: (N,) distance of the centres, true world units
    distance: (N,) of the true centre from the point that all cameras look at, true world units
    extent: greatest distance of two true centres;  focal: (N,) relative error, signed
    """

    rotation_deg: np.ndarray
    center: np.ndarray
    distance: np.ndarray
    extent: float
    focal: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class WorldSimilarity:
    """From one world into another: x -> scale * R @ (x - source_middle) + target_middle.

    R: (3, 3) rotation;  scale: target units per source unit
    source_middle, target_middle: (3,) points that correspond, in units of their worlds
    """

    R: np.ndarray
    scale: float
    source_middle: np.ndarray
    target_middle: np.ndarray

    def apply(self, camera: Camera) -> Camera:
        """The same camera in the target world."""
        center = self.scale * self.R @ (camera.center - self.source_middle) + self.target_middle
        R = camera.R @ self.R.T
        return dataclasses.replace(camera, R=R, t=-R @ center)


def fit_similarity(estimated: Sequence[Camera], true: Sequence[Camera]) -> WorldSimilarity:
    """The similarity that takes the estimated cameras nearest to the true ones, pair by pair.

    The rotation comes from the cameras' rotations and from their centres together, scale and shift
    from the centres; the scale is 1 where the estimated centres coincide. Raises ValueError unless
    both lists have the same length of 2 or more.
    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", equations 34 to 43, with the rotations as further pairs of unit vectors.
    """
    if len(estimated) != len(true) or len(true) < 2:
        raise ValueError(f"expected two equal lists of 2 or more cameras, got {len(estimated)}, {len(true)}")
    from_centers = np.stack([c.center for c in estimated])
    to_centers = np.stack([c.center for c in true])
    from_middle, to_middle = from_centers.mean(axis=0), to_centers.mean(axis=0)
    from_centered, to_centered = from_centers - from_middle, to_centers - to_middle
    from_spread, to_spread = np.linalg.norm(from_centered), np.linalg.norm(to_centered)
    covariance = np.mean([b.R.T @ a.R for a, b in zip(estimated, true, strict=True)], axis=0)
    if from_spread > 0 and to_spread > 0:
        covariance = covariance + to_centered.T @ from_centered / (from_spread * to_spread)
    R = nearest_rotation(covariance)
    scale = float((from_centered @ R.T * to_centered).sum() / from_spread**2) if from_spread > 0 else 1.0
    return WorldSimilarity(R, scale, from_middle, to_middle)


def align_similarity(estimated: Sequence[Camera], true: Sequence[Camera]) -> CameraErrors:
    """Errors of cameras that are known up to a similarity, which is fitted to all of them.

    Raises ValueError unless both lists have the same length of 2 or more.
    """
    similarity = fit_similarity(estimated, true)
    found = [similarity.apply(camera) for camera in estimated]
    relative = [b.R @ a.R.T for a, b in zip(found, true, strict=True)]
    # The skew part keeps the digits of tiny angles that the trace loses.
    sines = [np.linalg.norm([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / 2 for m in relative]
    cosines = [(np.trace(m) - 1) / 2 for m in relative]
    centers = np.stack([c.center for c in true])
    return CameraErrors(
        rotation_deg=np.degrees(np.arctan2(sines, cosines)),
        center=np.linalg.norm(np.stack([c.center for c in found]) - centers, axis=1),
        distance=np.linalg.norm(centers - convergence_point(true), axis=1),
        extent=float(np.linalg.norm(centers[:, None] - centers[None], axis=-1).max()),
        focal=np.array([a.focal_px / b.focal_px - 1 for a, b in zip(estimated, true, strict=True)]),
    )
