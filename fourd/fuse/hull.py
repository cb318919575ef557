"""Depth from silhouettes: the visual hull along target rays, refined by photo-consistency.

Where pairs are too wide to be matched, what moves still lies inside the cone of every silhouette. The
hull is carved along the rays of the target itself, to a pixel of every silhouette, without a grid in
space (W. Matusik et al., Image-based visual hulls, 2000). Inside it the surface is where the pictures of
the nearest cameras agree, and at the front of the hull where they say nothing.
"""

import dataclasses
from collections.abc import Mapping

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.fuse.geometry import pack_cameras
from fourd.fuse.hull_kernels import MAX_INTERVALS, carve_rays
from fourd.fuse.hull_photo import NUM_COMPARED, aggregate, choose_levels, compare_sources
from fourd.geometry import angle_deg
from fourd.image import grey_from_rgb, resize_area
from fourd.silhouettes.options import BACKGROUND, MOVING, UNKNOWN

# More levels than this along one ray say no more about a surface that two pictures hardly share.
MAX_LEVELS = 256
# The march along a ray moves on by at least this share of the range of inverse depth.
MIN_STEP = 2.0**-16
# Sides of the blocks of target pixels that are carved at once, px; each divides the one before.
BLOCKS = (8, 2, 1)


@dataclasses.dataclass(frozen=True)
class HullOptions:
    """Settings of depth from silhouettes.

    min_silhouettes: cameras whose silhouette has to hold a point, fewer where there are fewer; at least 2
    max_dissent: cameras that may say background all the same
    max_angle_deg: cameras farther apart, seen from the surface, are not compared
    small_penalty, large_penalty: cost of a neighbour at the next level, at another one; a perfect match
        costs 0, no likeness 1
    behind_cost: cost of lying behind the front of the hull, per share of the depth there
    """

    min_silhouettes: int = 3
    max_dissent: int = 0
    max_angle_deg: float = 50.0
    small_penalty: float = 0.2
    large_penalty: float = 2.5
    behind_cost: float = 5.0


@dataclasses.dataclass(frozen=True, eq=False)
class HullDepth:
    """Depth of what moves, from silhouettes.

    depth: (H, W) float32 z in the target, NaN = outside the hull
    sigma: (H, W) float32 of the inverse depth, NaN likewise
    num_cameras: (H, W) uint8 silhouettes that hold the front of the hull
    status: `ok` or why everything is blank
    """

    depth: np.ndarray
    sigma: np.ndarray
    num_cameras: np.ndarray
    status: str


def carve_view(
    target: Camera,
    cameras: Mapping[str, Camera],
    silhouettes: Mapping[str, np.ndarray],
    images: Mapping[str, np.ndarray],
    wanted: np.ndarray | None,
    depth_range: tuple[float, float],
    options: HullOptions,
) -> HullDepth:
    """Depth of what moves, as a target sees it, from silhouettes of other cameras.

    target: ideal pinhole;  cameras: name -> Camera of the same instant, lens included
    silhouettes: name -> (H, W) uint8 of that camera's picture, 255 moving, 0 background, 128 unknown
    images: name -> (H, W, 3) uint8 RGB; a camera without one has a silhouette all the same
    wanted: (H, W) bool pixels that get depth, all when None;  depth_range: near, far (z of the target)
    A camera that says background carves; unknown does not, nor does a camera that does not see the point.
    With fewer than two silhouettes there is no hull, and the status says so.
    Raises InputError for a silhouette that is not of its camera's size, or a range without depth.
    """
    width, height = target.size
    _check(cameras, silhouettes, images, depth_range)
    blank = HullDepth(
        np.full((height, width), np.nan, np.float32),
        np.full((height, width), np.nan, np.float32),
        np.zeros((height, width), np.uint8),
        "ok",
    )
    if len(silhouettes) < 2:
        return dataclasses.replace(blank, status=f"a hull takes 2 silhouettes, got {len(silhouettes)}")
    # By name, so that the order of arguments changes nothing.
    names = sorted(silhouettes)
    views = pack_views(target, [cameras[name] for name in names])
    classes, distances, starts = pack_silhouettes([silhouettes[name] for name in names])
    if wanted is None:
        wanted = np.ones((height, width), bool)
    rules = max(min(options.min_silhouettes, len(names)), 2), options.max_dissent
    intervals = _carve(views, (classes, distances, starts), wanted, depth_range, rules, blank.num_cameras)
    rows, columns = np.nonzero(intervals[..., 0, 0] >= 0)
    if not len(rows):
        return dataclasses.replace(blank, status="the silhouettes have no point in common")
    hull = _Hull(rows, columns, intervals[rows, columns], target)
    seen = [name for name in names if name in images]
    index = np.array([names.index(name) for name in seen], np.int64)
    s, sigma = _front(hull)
    if len(seen) >= 2:
        pictures = _Pictures(target, [cameras[n] for n in seen], [images[n] for n in seen])
        step = _level_step(hull, pictures)
        if step > 0:
            s, sigma = _refine(hull, step, views[index], classes, starts[index], pictures, options)
    blank.depth[rows, columns] = 1 / s
    blank.sigma[rows, columns] = sigma
    return blank


def _carve(
    views: np.ndarray,
    silhouettes: tuple[np.ndarray, np.ndarray, np.ndarray],
    wanted: np.ndarray,
    depth_range: tuple[float, float],
    rules: tuple[int, int],
    votes: np.ndarray,
) -> np.ndarray:
    """(H, W, MAX_INTERVALS, 2) float32 inverse depths of the hull: of blocks, of their parts, of pixels."""
    height, width = wanted.shape
    low, high = np.float32(1 / depth_range[1]), np.float32(1 / depth_range[0])
    least = (high - low) * np.float32(MIN_STEP)
    padded = np.pad(wanted, ((0, -height % BLOCKS[0]), (0, -width % BLOCKS[0])))
    ranges = np.broadcast_to(np.array([high, low]), (1, 1, 2))
    for block in BLOCKS:
        rows, columns = padded.shape[0] // block, padded.shape[1] // block
        ranges = ranges.repeat(rows // ranges.shape[0], axis=0).repeat(columns // ranges.shape[1], axis=1)
        asked = np.asarray(padded.reshape(rows, block, columns, block).any(axis=(1, 3)))
        ranges = np.where(asked[..., None], ranges, np.float32(np.nan))
        intervals = np.full((rows, columns, MAX_INTERVALS, 2), np.nan, np.float32)
        found = np.zeros((rows, columns), np.uint8)
        middle = (block - 1) / 2
        grid = np.float32(middle), np.float32(block), np.float32(middle * np.sqrt(2))
        carve_rays(views, *silhouettes, grid, ranges, least, rules, intervals, found)
        # A march that found as many intervals as there is room for has stopped there.
        is_full = intervals[..., -1, 1] >= 0
        last = np.where(is_full, ranges[..., 1], np.fmin.reduce(intervals[..., 1], axis=-1))
        ranges = np.stack([intervals[..., 0, 0], last], axis=-1)
    votes[:] = found[:height, :width]
    return intervals[:height, :width]


@dataclasses.dataclass(frozen=True, eq=False)
class _Hull:
    """Pixels of the target in the hull: (N,) rows and columns, (N, MAX_INTERVALS, 2) inverse depths."""

    rows: np.ndarray
    columns: np.ndarray
    intervals: np.ndarray
    target: Camera

    @property
    def last(self) -> np.ndarray:
        """(N,) least inverse depth of the hull."""
        return np.nanmin(self.intervals[..., 1], axis=1)


class _Pictures:
    """Grey pictures of the sources, no finer than the target, and how target rays map to them."""

    def __init__(self, target: Camera, cameras: list[Camera], images: list[np.ndarray]) -> None:
        self.cameras, greys = [], []
        for camera, image in zip(cameras, images, strict=True):
            ratio = min(1.0, target.focal_px / camera.focal_px)
            size = (max(2, round(camera.size[0] * ratio)), max(2, round(camera.size[1] * ratio)))
            self.cameras.append(camera.resized(size))
            greys.append(grey_from_rgb(resize_area(image, size)).ravel())
        self.views = pack_views(target, self.cameras)
        self.greys = np.concatenate(greys)
        self.starts = _starts(greys)
        self.centers = np.array([target.R @ (c.center - target.center) for c in cameras], np.float32)


def pack_views(target: Camera, cameras: list[Camera]) -> np.ndarray:
    """(C, 27) float32 how rays of the target map to every camera, as `hull_kernels` reads it."""
    scales = np.array([[_largest_scale(camera)] for camera in cameras], np.float32)
    return np.concatenate([pack_cameras(target, cameras), scales], axis=1)


def _largest_scale(camera: Camera) -> float:
    """Most pixels per unit of the image plane."""
    width, height = camera.size
    x, y = np.meshgrid(np.linspace(-0.5, width - 0.5, 17), np.linspace(-0.5, height - 0.5, 17))
    plane = camera.rays(np.stack([x, y], axis=-1))[..., :2]
    small = 1e-4 * max(width, height) / camera.focal_px
    center = camera.pixels_from_normalized(plane)
    moved = [camera.pixels_from_normalized(plane + small * np.array(d)) - center for d in ((1, 0), (0, 1))]
    return float(np.linalg.svd(np.stack(moved, axis=-1) / small, compute_uv=False).max())


def pack_silhouettes(masks: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Silhouettes one after the other, for `hull_kernels`.

    masks: (h, w) uint8; what is neither MOVING nor BACKGROUND is unknown
    Returns flat uint8 classes, flat float32 distances in px to the next pixel of another class or beyond
    the border, and (C,) int64 where each begins.
    """
    classes, distances = [], []
    for mask in masks:
        kind = np.where((mask == MOVING) | (mask == BACKGROUND), mask, np.uint8(UNKNOWN))
        distance = np.zeros(mask.shape, np.float32)
        for value in (UNKNOWN, MOVING, BACKGROUND):
            same = np.pad(kind == value, 1).astype(np.uint8)
            if same.any():
                to_other = cv2.distanceTransform(same, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
                distance = np.where(kind == value, to_other, distance)
        classes.append(kind.ravel())
        # The transform rounds differently from call to call; a sixteenth of a pixel is as good.
        distances.append(np.rint(distance * 16).ravel() / np.float32(16))
    return np.concatenate(classes), np.concatenate(distances), _starts(classes)


def _starts(parts: list[np.ndarray]) -> np.ndarray:
    return np.cumsum([0] + [part.size for part in parts[:-1]], dtype=np.int64)


def _front(hull: _Hull) -> tuple[np.ndarray, np.ndarray]:
    """(N,) inverse depth of the hull's front, and sigma: the surface is there or behind, in the hull."""
    front = hull.intervals[:, 0, 0]
    return front, (front - hull.last) / np.float32(np.sqrt(12))


def _level_step(hull: _Hull, pictures: _Pictures) -> float:
    """Step of inverse depth that moves a point of the hull by one pixel in the best pictures.

    0 where no two cameras see the middle of the hull.
    """
    middle = len(hull.rows) // 2
    at = np.argsort(hull.intervals[:, 0, 0], kind="stable")[middle]
    s = float(hull.intervals[at, 0, 0])
    pixel = np.array([hull.columns[at], hull.rows[at]], np.float64)
    near, moved = (hull.target.unproject(pixel, np.array(1 / x)) for x in (s, s * (1 - 1e-4)))
    speeds = []
    for camera in pictures.cameras:
        angle = float(angle_deg(near - camera.center, near - hull.target.center))
        speed = np.linalg.norm(camera.project(moved)[0] - camera.project(near)[0]) / (s * 1e-4)
        if np.isfinite(speed) and speed > 0:
            speeds.append((angle, float(speed)))
    best = [speed for _, speed in sorted(speeds)[:NUM_COMPARED]]
    if len(best) < 2:
        return 0.0
    extent = float(hull.intervals[:, 0, 0].max() - hull.last.min())
    return max(1 / max(best), extent / MAX_LEVELS)


def _refine(
    hull: _Hull,
    step: float,
    views: np.ndarray,
    classes: np.ndarray,
    starts: np.ndarray,
    pictures: _Pictures,
    options: HullOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) inverse depth where the pictures agree best inside the hull, and its sigma."""
    top = float(hull.intervals[:, 0, 0].max())
    front, last = hull.intervals[:, 0, 0], hull.last
    first = np.floor((top - front) / step).astype(np.int64)
    counts = np.ceil((top - last) / step).astype(np.int64) - first + 1
    offsets = np.concatenate([[0], np.cumsum(counts)])
    pixels = np.stack([hull.columns, hull.rows], axis=1).astype(np.int64)
    rays = hull.target.rays(pixels.astype(np.float64)).astype(np.float32)
    costs = np.empty(int(offsets[-1]), np.float32)
    compare_sources(
        views, pictures.views, classes, starts, pictures.greys, pictures.starts, pictures.centers, rays,
        pixels, hull.intervals, (np.float32(top), np.float32(step)), first, offsets,
        (np.float32(np.cos(np.radians(options.max_angle_deg))), np.float32(options.behind_cost)), costs,
    )  # fmt: skip
    width, height = hull.target.size
    index = np.full((height + 2, width + 2), -1, np.int64)
    index[hull.rows + 1, hull.columns + 1] = np.arange(len(hull.rows))
    total = np.zeros_like(costs)
    penalties = np.float32(options.small_penalty), np.float32(options.large_penalty)
    aggregate(costs, offsets, first, pixels, index, *penalties, total)
    level, spread = np.empty(len(pixels), np.float32), np.empty(len(pixels), np.float32)
    choose_levels(total, offsets, np.float32(0.5), level, spread)
    s = np.float32(top) - (first + level) * np.float32(step)
    s = np.clip(s, last, front).astype(np.float32)
    return s, (spread * np.float32(step / 2)).astype(np.float32)


def _check(
    cameras: Mapping[str, Camera],
    silhouettes: Mapping[str, np.ndarray],
    images: Mapping[str, np.ndarray],
    depth_range: tuple[float, float],
) -> None:
    near, far = depth_range
    if not 0 < near < far:
        raise InputError(
            f"expected a depth range with 0 < near < far for the hull, got {near:g} to {far:g}: give the "
            "scene's depth_range"
        )
    for name in {*silhouettes, *images}:
        if name not in cameras:
            raise InputError(
                f"expected a calibrated camera {name} for its silhouette, got "
                f"{', '.join(cameras) or 'none'}: calibrate it or leave it out"
            )
    for name, mask in silhouettes.items():
        width, height = cameras[name].size
        if mask.shape != (height, width) or mask.dtype != np.uint8:
            raise InputError(
                f"camera {name}: expected a silhouette of {width}x{height} in 8 bits, got {mask.shape[::-1]} "
                f"{mask.dtype}: make the silhouettes anew"
            )
