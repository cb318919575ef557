"""From a rectified camera to the target and from the target to a source image, as linear maps.

A point on the ray of pixel (x, y) of a rectified camera at inverse depth s = 1 / z is, in the world,
`R.T @ K^-1 @ [x, y, 1] / s + center`. Its homogeneous position in the target, times s, is

    P(x, y) = A @ [x, y, 1] + s * b        A = K_t R_t R.T K^-1,  b = K_t (R_t center + t_t)

so that (u, v) = (P0, P1) / P2 and the inverse depth in the target is s / P2. Nothing divides by s:
points at infinity are ordinary.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from fourd.camera import Camera
from fourd.fuse.options import MAX_REACH_PX


@dataclasses.dataclass(frozen=True, eq=False)
class PairFrame:
    """The disparities of one pair at one frame, with what places them in the world.

    left, right: names of the cameras;  K_*, R_*: (3, 3), R is rectified_from_world
    center_*: (3,) world;  sigma_px: noise at confidence 1
    disparity_at_infinity, inverse_depth_per_px: of the left and the right map; 1 / depth is
        (disparity - disparity_at_infinity) * inverse_depth_per_px
    *_disparity: (H, W) float32 px, NaN where invalid;  *_confidence: (H, W) float32 in 0..1
    The two maps may differ in size.
    """

    left: str
    right: str
    K_left: np.ndarray
    K_right: np.ndarray
    R_left: np.ndarray
    R_right: np.ndarray
    center_left: np.ndarray
    center_right: np.ndarray
    disparity_at_infinity: tuple[float, float]
    inverse_depth_per_px: tuple[float, float]
    left_disparity: np.ndarray
    right_disparity: np.ndarray
    left_confidence: np.ndarray
    right_confidence: np.ndarray
    sigma_px: float


@dataclasses.dataclass(frozen=True, eq=False)
class DisparityMap:
    """One disparity map and where its pixels go in the target.

    A: (3, 3), b: (3,) float32, as in the module's docstring
    disparity, confidence: (H, W) float32;  disparity_at_infinity: px
    inverse_depth_per_px: see PairFrame;  sigma_px: noise at confidence 1
    """

    A: np.ndarray
    b: np.ndarray
    disparity: np.ndarray
    confidence: np.ndarray
    disparity_at_infinity: np.float32
    inverse_depth_per_px: np.float32
    sigma_px: np.float32


def maps_of_pair(pair: PairFrame, target: Camera) -> tuple[DisparityMap, DisparityMap]:
    """The left and the right disparity map of a pair with their projections to the target."""
    left = _linear_map(target, pair.K_left, pair.R_left, pair.center_left)
    right = _linear_map(target, pair.K_right, pair.R_right, pair.center_right)
    left_units, right_units = (
        (np.float32(zero), np.float32(per_px), np.float32(pair.sigma_px))
        for zero, per_px in zip(pair.disparity_at_infinity, pair.inverse_depth_per_px, strict=True)
    )
    return (
        DisparityMap(*left, pair.left_disparity, pair.left_confidence, *left_units),
        DisparityMap(*right, pair.right_disparity, pair.right_confidence, *right_units),
    )


def _linear_map(
    target: Camera, K: np.ndarray, R: np.ndarray, center: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    A = target.K @ target.R @ R.T @ np.linalg.inv(K)
    b = target.K @ (target.R @ center + target.t)
    return A.astype(np.float32), b.astype(np.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class Sources:
    """The original images and how target pixels map to them; C cameras.

    names: (C,) bit and index of every camera in masks and `source`
    params: (C, 26) float32, `pack_cameras`;  images: C arrays (H, W, 3) uint8
    """

    names: tuple[str, ...]
    params: np.ndarray
    images: tuple[np.ndarray, ...]

    @property
    def A(self) -> np.ndarray:
        """(C, 3, 3), see `pack_cameras`, as the three below."""
        return self.params[:, :9].reshape(-1, 3, 3)

    @property
    def b(self) -> np.ndarray:
        """(C, 3)"""
        return self.params[:, 9:12]

    @property
    def lens(self) -> np.ndarray:
        """(C, 9)"""
        return self.params[:, 12:21]

    @property
    def distortion(self) -> np.ndarray:
        """(C, 5)"""
        return self.params[:, 21:]


def make_sources(target: Camera, cameras: dict[str, Camera], images: dict[str, np.ndarray]) -> Sources:
    """Sources in the order of `images`; the cameras are those of the same instant."""
    params = pack_cameras(target, [cameras[name] for name in images])
    return Sources(tuple(images), params, tuple(np.ascontiguousarray(image) for image in images.values()))


def pack_cameras(target: Camera, cameras: Sequence[Camera]) -> np.ndarray:
    """(C, 26) float32: how every camera sees pixels of a target.

    A row by row (9), b (3): pixel (u, v) of the target at inverse depth t is at A @ [u, v, 1] + t * b on
    the image plane of the camera, homogeneous
    lens (9): fx, skew, cx, fy, cy, largest squared radius on the image plane, target focal length over the
    camera's, width - 1, height - 1;  distortion (5): k1, k2, p1, p2, k3
    """
    rows = []
    ray_from_pixel = np.linalg.inv(target.K)
    for camera in cameras:
        camera_from_target = camera.R @ target.R.T
        A, b = camera_from_target @ ray_from_pixel, camera.t - camera_from_target @ target.t
        K, (width, height) = camera.K, camera.size
        lens = [K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2], _largest_radius_squared(camera)]
        lens += [target.focal_px / camera.focal_px, width - 1, height - 1]
        rows.append([*A.ravel(), *b, *lens, *camera.distortion])
    return np.array(rows, np.float32).reshape(len(rows), 26)


def _largest_radius_squared(camera: Camera) -> float:
    """Squared radius on the image plane (z = 1) that the image's border reaches.

    A strong negative k1 folds rays from far outside back into the image; they stop here.
    """
    width, height = camera.size
    x = np.linspace(0, width - 1, 9)
    y = np.linspace(0, height - 1, 9)
    border = [(a, b) for a in x for b in (0, height - 1)] + [(a, b) for a in (0, width - 1) for b in y]
    rays = camera.rays(np.asarray(border, dtype=np.float64))
    return float((rays[:, :2] ** 2).sum(axis=1).max()) * 1.02


def source_rows(
    disparity_map: DisparityMap, tile_rows: tuple[int, int], target_height: int
) -> tuple[int, int]:
    """Range of rows of a disparity map that can touch rows [first, last) of the target.

    Returns (first, last); a superset, because only bounds enter. Where P2 > 0 at the four corners
    of a source row's (x, s) rectangle, v is a ratio of two linear functions and is extreme there.
    """
    m = disparity_map
    height, width = m.disparity.shape
    if tile_rows == (0, target_height):
        return 0, height
    extent = np.array([np.fmin.reduce(m.disparity, axis=None), np.fmax.reduce(m.disparity, axis=None)])
    if not np.isfinite(extent).all():
        return 0, height
    inverse_depths = np.maximum(
        (extent.astype(np.float64) - m.disparity_at_infinity) * m.inverse_depth_per_px, 0.0
    )
    A, b = m.A.astype(np.float64), m.b.astype(np.float64)
    y = np.arange(height, dtype=np.float64)
    low, high = np.full(height, np.inf), np.full(height, -np.inf)
    always = np.zeros(height, dtype=bool)
    for x in (0.0, width - 1.0):
        for s in inverse_depths:
            v1 = A[1, 0] * x + A[1, 1] * y + A[1, 2] + s * b[1]
            v2 = A[2, 0] * x + A[2, 1] * y + A[2, 2] + s * b[2]
            always |= v2 <= 1e-6 * np.abs(A[2]).max()
            v = v1 / np.where(v2 > 0, v2, 1.0)
            low, high = np.minimum(low, v), np.maximum(high, v)
    # One more row for rounding in float32.
    margin = MAX_REACH_PX + 1
    touched = np.flatnonzero(always | ((low - margin < tile_rows[1]) & (high + margin >= tile_rows[0])))
    return (int(touched[0]), int(touched[-1]) + 1) if touched.size else (0, 0)
