"""Cameras around the demo event, and what stereo and fusion find between them, against the truth."""

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from fourd.camera import Camera
from fourd.demo import DemoOptions, FrozenScene
from fourd.demo.cameras import TARGET, UP, arc_position
from fourd.fuse import PairFrame
from fourd.geometry import look_at
from fourd.stereo.disparity import PairDisparity, StereoOptions, make_matcher, match_pair
from fourd.stereo.rectification import SWEEP, Rectification
from fourd.stereo.rectify import RectifyOptions, rectify_pair
from fourd.stereo.sweep import sweep_pair

SIZE = (160, 90)
RANGE = (1.5, 60.0)
NEAR_PX = 2.0


def camera_at(center: np.ndarray, size: tuple[int, int] = SIZE, focal_px: float = 130.0) -> Camera:
    """A level camera that looks at the middle of the event."""
    R, t = look_at(np.asarray(center, np.float64), TARGET, UP)
    K = np.array([[focal_px, 0, (size[0] - 1) / 2], [0, focal_px, (size[1] - 1) / 2], [0, 0, 1.0]])
    return Camera(K, R, t, size)


def on_arc(
    angle_deg: float,
    size: tuple[int, int] = SIZE,
    focal_px: float = 130.0,
    distance_m: float = 4.5,
    roll_deg: float = 0.0,
) -> Camera:
    """One of the people who film; roll turns the camera about its own axis."""
    camera = camera_at(arc_position(angle_deg, distance_m, 1.6), size, focal_px)
    roll = Rotation.from_euler("z", roll_deg, degrees=True).as_matrix()
    return dataclasses.replace(camera, R=roll @ camera.R, t=roll @ camera.t)


@functools.cache
def scene() -> FrozenScene:
    """The event at one instant."""
    return FrozenScene(0.5, DemoOptions(width=SIZE[0], height=SIZE[1]))


def render(camera: Camera) -> np.ndarray:
    """(H, W, 3) uint8 picture of an ideal pinhole."""
    return scene().render(camera)[0]


def true_depth(camera: Camera) -> np.ndarray:
    """(H, W) float64 depth, infinite in the sky."""
    return scene().trace(camera)[0].astype(np.float64)


def rectify(
    left: Camera, right: Camera, near_far: tuple[float, float] = RANGE
) -> tuple[Rectification | None, str]:
    """The rectification of a pair with one depth range for both, or None and why it is refused."""
    result = rectify_pair(left, right, near_far, near_far, RectifyOptions())
    return (result, "") if isinstance(result, Rectification) else (None, result.reason)


def match(
    rectification: Rectification, left: Camera, right: Camera, images: tuple[np.ndarray, np.ndarray]
) -> PairDisparity:
    """Disparities of a pair with the default settings, matched along rows or swept."""
    options = StereoOptions()
    if rectification.kind == SWEEP:
        return sweep_pair(rectification, (left, right), images, options)
    return match_pair(rectification, (left, right), images, make_matcher(options), options)


def pair_frame(names: tuple[str, str], found: PairDisparity) -> PairFrame:
    """Disparities as fusion takes them."""
    geometry = found.rectification
    return PairFrame(
        *names, geometry.K_left, geometry.K_right, geometry.R_left, geometry.R_right, geometry.center_left,
        geometry.center_right, geometry.disparity_at_infinity, geometry.inverse_depth_per_px,
        found.left_disparity, found.right_disparity, found.left_confidence, found.right_confidence,
        found.sigma_px,
    )  # fmt: skip


def true_disparities(rectification: Rectification) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) float64 px of the left and the right map."""
    zeros, units = rectification.disparity_at_infinity, rectification.inverse_depth_per_px
    left, right = (
        1 / (true_depth(rectification.camera(side)) * unit) + zero
        for side, zero, unit in zip(("left", "right"), zeros, units, strict=True)
    )
    return left, right


def true_pair(names: tuple[str, str], rectification: Rectification, sigma_px: float = 0.1) -> PairFrame:
    """A pair without any error of matching: exact disparities in float32, all trusted."""
    left, right = (disparity.astype(np.float32) for disparity in true_disparities(rectification))
    ones = (np.ones_like(left), np.ones_like(right))
    return pair_frame(names, PairDisparity(rectification, left, right, *ones, sigma_px))


def true_pairs(cameras: Mapping[str, Camera]) -> list[PairFrame]:
    """All pairs of the cameras that can be rectified, exact."""
    pairs = []
    for names in itertools.combinations(cameras, 2):
        rectification, _ = rectify(cameras[names[0]], cameras[names[1]])
        if rectification is not None:
            pairs.append(true_pair(names, rectification))
    return pairs


def seen_points(cameras: Sequence[Camera], near_far: tuple[float, float] = RANGE) -> np.ndarray:
    """(N, 3) world points inside all pictures and the depth range, spread evenly in inverse depth."""
    rng = np.random.default_rng(0)
    first = cameras[0]
    pixels = rng.uniform(0, np.array(first.size) - 1, (4000, 2))
    points = first.unproject(pixels, 1 / rng.uniform(1 / near_far[1], 1 / near_far[0], len(pixels)))
    seen = np.ones(len(points), bool)
    for camera in cameras[1:]:
        at, depth = camera.project(points)
        inside = np.nan_to_num(at, nan=-1.0)
        seen &= ((inside >= 0) & (inside <= np.array(camera.size) - 1)).all(axis=1)
        seen &= (depth >= near_far[0]) & (depth <= near_far[1])
    return points[seen]


def share_wrong(found: np.ndarray, truth: np.ndarray) -> float:
    """Share of the disparities found that are off by more than `NEAR_PX`."""
    valid = np.isfinite(found)
    wrong = np.abs(found[valid] - truth[valid]) > NEAR_PX
    return float(wrong.mean()) if wrong.size else 0.0


def with_maps(pair: PairFrame, value: float, confidence: float = 1.0) -> PairFrame:
    """The pair with the same disparity everywhere."""
    maps = {}
    for side in ("left", "right"):
        shape = getattr(pair, f"{side}_disparity").shape
        maps[f"{side}_disparity"] = np.full(shape, value, np.float32)
        maps[f"{side}_confidence"] = np.full(shape, confidence, np.float32)
    return dataclasses.replace(pair, **maps)


def plane_depth(camera: Camera, facing: Camera, distance_m: float) -> np.ndarray:
    """(H, W) float64 depth of a plane that stands across the axis of the camera `facing`, at a distance."""
    y, x = np.mgrid[: camera.size[1], : camera.size[0]].astype(np.float64)
    directions = camera.rays(np.stack([x, y], axis=-1)) @ camera.R
    normal = facing.forward
    return (distance_m - normal @ (camera.center - facing.center)) / (directions @ normal)


def with_plane(pair: PairFrame, facing: Camera, distance_m: float) -> PairFrame:
    """The pair with the disparities of `plane_depth`."""
    maps = {}
    for i, side in enumerate(("left", "right")):
        height, width = getattr(pair, f"{side}_disparity").shape
        R, center = getattr(pair, f"R_{side}"), getattr(pair, f"center_{side}")
        camera = Camera(getattr(pair, f"K_{side}"), R, -R @ center, (width, height))
        inverse_depth = 1 / plane_depth(camera, facing, distance_m)
        disparity = inverse_depth / pair.inverse_depth_per_px[i] + pair.disparity_at_infinity[i]
        maps[f"{side}_disparity"] = disparity.astype(np.float32)
    return dataclasses.replace(pair, **maps)
