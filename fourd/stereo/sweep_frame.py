"""The two pinholes of a swept pair, and the inverse depths worth trying in each.

A swept pair is not turned towards its baseline: each side is its own camera without the lens. The
other camera is looked at through planes of constant inverse depth, so an epipole may lie anywhere.
With s = 1 / z, a pixel x of one side lies in the other at

    P(x, s) = A @ [x, y, 1] + s * b        A = R_o R.T K^-1,  b = R_o center + t_o

on the plane P2 = 1, whatever s: one homography per plane, and P2 / s is the depth there.

Source: R. Collins, "A Space-Sweep Approach to True Multi-Image Matching", CVPR 1996.
"""

import dataclasses

import numpy as np

from fourd.camera import Camera
from fourd.geometry import angle_deg
from fourd.stereo.guard import NOMINAL_SIGMA_PX, Guard
from fourd.stereo.rectification import Rectification, SweptSides
from fourd.stereo.volume import field_of_view

_GRID = 24
_DEPTHS = 65
_UNIT_PERCENTILE = 95
"""Of the motion in the other image: a few corners near the camera move faster than all the rest."""
_ANGLE_PERCENTILE = 75
"""Of the angles in an image: around the epipole they vanish, whatever the baseline."""


@dataclasses.dataclass(frozen=True, eq=False)
class SweepSide:
    """One side of a swept pair.

    camera: its ideal pinhole;  overlap: share of its image that the other camera can see
    inverse_depth_range: lowest and highest 1 / z that the other camera can see
    inverse_depth_per_px: the step that moves the other image by 1 px where it moves most
    angle_deg: between the rays to both cameras;  depth_error: relative, at the nominal sigma
    """

    camera: Camera
    overlap: float
    inverse_depth_range: tuple[float, float] = (0.0, 0.0)
    inverse_depth_per_px: float = float("nan")
    angle_deg: float = float("nan")
    depth_error: float = float("nan")

    @property
    def disparity_range(self) -> tuple[float, float]:
        low, high = self.inverse_depth_range
        return low / self.inverse_depth_per_px, high / self.inverse_depth_per_px


def ideal_pinhole(camera: Camera, focal_px: float) -> Camera:
    """The pinhole of square pixels with the same pose that just holds the image, its lens undone."""
    low, high = field_of_view(camera)
    # Rounding alone must not add a column.
    width, height = (int(n) for n in np.ceil(focal_px * (high - low) - 1e-6) + 1)
    K = np.array([[focal_px, 0.0, -focal_px * low[0]], [0.0, focal_px, -focal_px * low[1]], [0.0, 0.0, 1.0]])
    return Camera(K, camera.R, camera.t, (width, height))


def plane_motion(camera: Camera, other: Camera) -> tuple[np.ndarray, np.ndarray]:
    """A (3, 3) and b (3,) of the module's docstring: pixels of `camera` to the frame of `other`."""
    turned = other.R @ camera.R.T
    return turned @ np.linalg.inv(camera.K), other.t - turned @ camera.t


def sweep_sides(
    left: Camera,
    right: Camera,
    range_left: tuple[float, float],
    range_right: tuple[float, float],
    scale: float,
) -> tuple[SweepSide, SweepSide]:
    """Both sides of a pair, with one focal length: the geometric mean of theirs times `scale`.

    range_left, range_right: near > 0 and far (may be infinite) z of what each camera films
    """
    focal_px = float(np.sqrt(left.focal_px * right.focal_px)) * scale
    return (
        _measure_side(ideal_pinhole(left, focal_px), range_left, right, range_right),
        _measure_side(ideal_pinhole(right, focal_px), range_right, left, range_left),
    )


def _measure_side(
    camera: Camera, own_range: tuple[float, float], other: Camera, other_range: tuple[float, float]
) -> SweepSide:
    """Samples of the image times samples of inverse depth, where the other camera sees them."""
    width, height = camera.size
    across, down = np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID)
    pixels = np.stack(np.meshgrid(across, down, [1.0]), axis=-1).reshape(-1, 3)
    s = np.linspace(1 / own_range[1], 1 / own_range[0], _DEPTHS)
    A, b = plane_motion(camera, other)
    towards = pixels @ A.T
    in_other = towards[:, None] + s[:, None] * b
    depth_times_s = in_other[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = in_other[..., :2] / depth_times_s[..., None]
    low, high = field_of_view(other)
    seen = (depth_times_s > 0) & np.all((plane >= low) & (plane <= high), axis=-1)
    seen &= depth_times_s >= s * other_range[0]
    if np.isfinite(other_range[1]):
        seen &= depth_times_s <= s * other_range[1]
    step = s[1] - s[0]
    both = seen[:, 1:] & seen[:, :-1]
    moved = np.linalg.norm(np.diff(plane, axis=1), axis=-1)[both] * camera.focal_px / step
    if moved.size == 0 or not np.any(moved > 0):
        return SweepSide(camera, 0.0)
    reached = np.flatnonzero(seen.any(axis=0))
    low_s, high_s = max(s[reached[0]] - step, s[0]), min(s[reached[-1]] + step, s[-1])
    return SweepSide(
        camera,
        overlap=float(seen.any(axis=1).mean()),
        inverse_depth_range=(float(low_s), float(high_s)),
        inverse_depth_per_px=1 / float(np.percentile(moved, _UNIT_PERCENTILE)),
        angle_deg=_typical_angle_deg(towards, in_other, seen),
        depth_error=float(NOMINAL_SIGMA_PX / np.median(moved * _middle(s, both))),
    )


def _middle(s: np.ndarray, both: np.ndarray) -> np.ndarray:
    """Inverse depth between neighbouring samples, for those that are seen."""
    return np.broadcast_to((s[1:] + s[:-1]) / 2, both.shape)[both]


def _typical_angle_deg(towards: np.ndarray, in_other: np.ndarray, seen: np.ndarray) -> float:
    """A high percentile, over the image, of the angle at the middle of the depths that are seen."""
    some = seen.any(axis=1)
    ranks = np.cumsum(seen[some], axis=1)
    middle = np.argmax(ranks >= (ranks[:, -1:] + 1) // 2, axis=1)
    at_scene = in_other[some, middle]
    return float(np.percentile(angle_deg(towards[some], at_scene), _ANGLE_PERCENTILE))


def measure_sweep(guard: Guard, left: SweepSide, right: SweepSide) -> Guard:
    """The guard with what the two sides of a sweep tell: the worse of both.

    The angle is theirs only where no common plane has told it yet.
    """
    angle = max(left.angle_deg, right.angle_deg) if np.isnan(guard.angle_deg) else guard.angle_deg
    return dataclasses.replace(
        guard,
        angle_deg=angle,
        overlap=min(left.overlap, right.overlap),
        disparity_low=min(left.disparity_range[0], right.disparity_range[0]),
        disparity_high=max(left.disparity_range[1], right.disparity_range[1]),
        depth_error=max(left.depth_error, right.depth_error),
    )


def swept_rectification(left: SweepSide, right: SweepSide, guard: Guard, obstacle: str) -> Rectification:
    """Both sides as one Rectification.  obstacle: why one plane cannot hold both images."""
    return Rectification(
        left.camera.K,
        right.camera.K,
        left.camera.R,
        left.camera.center,
        right.camera.center,
        left.camera.size,
        left.disparity_range,
        guard,
        SweptSides(
            right.camera.R,
            right.camera.size,
            right.disparity_range,
            (left.inverse_depth_per_px, right.inverse_depth_per_px),
            obstacle,
        ),
    )
