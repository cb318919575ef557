"""One target camera at one instant: project all pairs, reduce, colour. Section 3.1 of the paper."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.fuse.cpu import CpuBackend
from fourd.fuse.geometry import PairFrame, make_sources, maps_of_pair
from fourd.fuse.hull import HullDepth, HullOptions, carve_view
from fourd.fuse.options import (
    ESTIMATES,
    HULL,
    MAX_CAMERAS,
    NO_DEPTH,
    STEREO,
    FuseOptions,
    FusionRules,
)
from fourd.fuse.reference import ReferenceBackend
from fourd.fuse.visibility import apply_visibility

_HULL_OPTIONS = HullOptions()


@dataclasses.dataclass(frozen=True, eq=False)
class FusedView:
    """The instantaneous images of one target camera.

    rgb, valid, depths: estimate -> (H, W, 3) uint8, (H, W) bool, (H, W) float32 z, NaN = blank
    support: (H, W) uint8 pairs that agree on the consensus;  num_cameras: (H, W) uint8
    source: (H, W) uint8 index into `cameras` of the heaviest source of the first estimate, 255 = none
    depth_source: (H, W) uint8 what gave the depth of the first estimate, `NO_DEPTH`, `STEREO` or `HULL`
    cameras: names;  num_pairs: pairs used;  min_pairs: what a consensus needed
    num_points: valid disparities projected, once per tile that they may touch
    status: `ok` or why everything is blank
    """

    rgb: dict[str, np.ndarray]
    valid: dict[str, np.ndarray]
    depths: dict[str, np.ndarray]
    support: np.ndarray
    num_cameras: np.ndarray
    source: np.ndarray
    depth_source: np.ndarray
    cameras: tuple[str, ...]
    num_pairs: int
    min_pairs: int
    num_points: int
    status: str


def fuse_view(
    target: Camera,
    pairs: Sequence[PairFrame],
    images: Mapping[str, np.ndarray],
    cameras: Mapping[str, Camera],
    options: FuseOptions,
    estimates: Sequence[str] = ESTIMATES,
    *,
    farthest_min_pairs: int = 1,
    device: str = "cpu",
    silhouettes: Mapping[str, np.ndarray] | None = None,
    depth_range: tuple[float, float] = (0.0, float("inf")),
    hull_options: HullOptions = _HULL_OPTIONS,
) -> FusedView:
    """Fuse all pairs at one instant in a target camera.

    target: ideal pinhole;  pairs: those that do not contain the target camera; read in order, once
        per tile: a sequence that loads on access bounds memory
    images: name -> (H, W, 3) uint8 original image;  cameras: name -> Camera, lens included
    estimates: any of `ESTIMATES`;  farthest_min_pairs: the farthest sample that this many pairs
        support, or the plain farthest where there is none; 1 is the paper's
    device: `cpu` (compiled), a torch device such as `cuda` or `torch:cpu`, or `reference` (slow)
    silhouettes: name -> (H, W) uint8 of that camera's picture, 255 moving, 0 background, 128 unknown: where
        the consensus is blank, the visual hull gives its depth, with no pair in `support`
    depth_range: nearest and farthest z in the target where a hull is looked for
    With fewer pairs than `options.min_pairs` that number is asked for instead. No pair gives blanks
    and a status.
    Raises InputError for a distorted target, more than 64 cameras, or a pair without images.
    """
    _check(target, images, cameras, estimates)
    wanted = [e for e in ESTIMATES if e in estimates]
    rules = _rules(options, len(pairs), farthest_min_pairs, wanted)
    width, height = target.size
    result = _Arrays(wanted, height, width)
    num_points = 0
    if pairs:
        sources = make_sources(target, dict(cameras), dict(images))
        tiles = _tiles(height, width, len(pairs), options.memory_mb)
        backend = _backend_class(device)(sources, options, target.size, len(pairs), tiles[0][1])
        for rows in tiles:
            num_points += _fuse_tile(backend, target, pairs, list(images), rules, rows, result)
    status = "ok" if num_points else ("no valid disparity" if pairs else "no usable pair")
    if silhouettes and "consensus" in wanted:
        blank = ~result.valid["consensus"]
        hull = carve_view(target, cameras, silhouettes, images, blank, depth_range, hull_options)
        if _add_hull(hull, blank, target, images, cameras, options, device, result):
            status = "ok"
    return FusedView(
        result.rgb, result.valid, result.depths, result.counts[0], result.counts[1], result.source,
        result.depth_source, tuple(images), len(pairs), rules.min_pairs, num_points, status,
    )  # fmt: skip


def _rules(
    options: FuseOptions, num_pairs: int, farthest_min_pairs: int, wanted: Sequence[str]
) -> FusionRules:
    has_visibility = options.visibility and "consensus" in wanted
    return FusionRules(
        options.tolerance,
        max(1, min(options.min_pairs, num_pairs)),
        options.min_cameras,
        options.max_front,
        farthest_min_pairs,
        # What the visibility test chooses among, whether it is coloured or not.
        (*wanted, *ESTIMATES[:3]) if has_visibility else tuple(wanted),
        has_visibility,
    )


class _Arrays:
    """Blank outputs of one view, filled tile by tile."""

    def __init__(self, wanted: Sequence[str], height: int, width: int) -> None:
        self.rgb = {e: np.zeros((height, width, 3), np.uint8) for e in wanted}
        self.valid = {e: np.zeros((height, width), bool) for e in wanted}
        self.depths = {e: np.full((height, width), np.nan, np.float32) for e in wanted}
        self.counts = np.zeros((2, height, width), np.uint8)
        self.source = np.full((height, width), 255, np.uint8)
        self.depth_source = np.full((height, width), NO_DEPTH, np.uint8)


def _fuse_tile(
    backend: Any,
    target: Camera,
    pairs: Sequence[PairFrame],
    names: Sequence[str],
    rules: FusionRules,
    rows: tuple[int, int],
    result: _Arrays,
) -> int:
    """Fill rows [first, last) of the result. Returns the points whose source row was read."""
    masks = []
    num_points = 0
    for index, pair in enumerate(pairs):
        num_points += backend.layer(index, maps_of_pair(pair, target), rows)
        masks.append(_camera_mask(pair, names))
    chosen, cameras, counts = backend.reduce(np.array(masks, dtype=np.uint64), rules, rows)
    if rules.visibility:
        apply_visibility(target, pairs, names, rows[0], chosen, cameras, counts)
    for index, estimate in enumerate(ESTIMATES):
        if estimate not in result.rgb:
            chosen[index] = -1
    rgb, source = backend.colours(chosen, cameras, rows[0])
    part = slice(*rows)
    result.counts[:, part] = counts
    for estimate in result.rgb:
        e = ESTIMATES.index(estimate)
        depth = result.depths[estimate][part]
        with np.errstate(divide="ignore"):
            np.divide(np.float32(1), chosen[e], out=depth)
        np.copyto(depth, np.float32(np.nan), where=chosen[e] < 0)
        result.rgb[estimate][part] = rgb[e]
        np.not_equal(source[e], 255, out=result.valid[estimate][part])
    if result.rgb:
        result.source[part] = source[ESTIMATES.index(next(iter(result.rgb)))]
        result.depth_source[part][result.source[part] != 255] = STEREO
    return num_points


def _add_hull(
    hull: HullDepth,
    blank: np.ndarray,
    target: Camera,
    images: Mapping[str, np.ndarray],
    cameras: Mapping[str, Camera],
    options: FuseOptions,
    device: str,
    result: _Arrays,
) -> bool:
    """Depth and colour of the hull at blank pixels (H, W) bool, which any camera may have seen.

    Returns whether any pixel got one.
    """
    width, height = target.size
    chosen = np.full((4, height, width), -1, np.float32)
    held = blank & np.isfinite(hull.depth)
    chosen[0][held] = 1 / hull.depth[held]
    masks = np.zeros(chosen.shape, np.uint64)
    masks[0] = np.uint64((1 << len(images)) - 1)
    sources = make_sources(target, dict(cameras), dict(images))
    rgb, source = _backend_class(device)(sources, options, target.size, 1, height).colours(chosen, masks, 0)
    found = source[0] != 255
    result.rgb["consensus"][found] = rgb[0][found]
    result.depths["consensus"][found] = hull.depth[found]
    result.source[found] = source[0][found]
    result.depth_source[found] = HULL
    result.valid["consensus"] |= found
    return bool(found.any())


def _tiles(height: int, width: int, num_pairs: int, memory_mb: int) -> list[tuple[int, int]]:
    """Row ranges whose cost volume (inverse depth and sigma, float32) fits the budget."""
    bytes_per_row = 8 * width * num_pairs
    rows = max(1, min(height, memory_mb * 2**20 // bytes_per_row))
    return [(first, min(first + rows, height)) for first in range(0, height, rows)]


def _camera_mask(pair: PairFrame, names: Sequence[str]) -> int:
    """Bits of the two cameras of a pair. Raises InputError for a camera without pictures."""
    for name in (pair.left, pair.right):
        if name not in names:
            raise InputError(
                f"pair {pair.left}-{pair.right}: expected an image of {name}, got {', '.join(names)}: "
                "give every camera of the pairs"
            )
    return 1 << names.index(pair.left) | 1 << names.index(pair.right)


def choose_device(device: str) -> str:
    """`auto` as `cuda` where torch can use it, else the compiled kernels; anything else as it is.

    Raises InputError for CUDA where there is none.
    """
    if device in ("cpu", "reference") or device.startswith("torch:"):
        return device
    if device == "auto" and not Path("/dev/nvidiactl").exists():
        # Asking torch would take two seconds.
        return "cpu"
    import torch

    if torch.cuda.is_available():
        return "cuda" if device == "auto" else device
    if device == "auto":
        return "cpu"
    raise InputError(f"expected a device that torch can use, got {device}: use cpu or auto")


def _backend_class(device: str) -> Any:
    if device == "cpu":
        return CpuBackend
    if device == "reference":
        return ReferenceBackend
    # torch takes two seconds to import, and the CPU path does without it.
    from fourd.fuse.torch_kernels import TorchBackend

    return functools.partial(TorchBackend, device=device.removeprefix("torch:"))


def _check(
    target: Camera,
    images: Mapping[str, np.ndarray],
    cameras: Mapping[str, Camera],
    estimates: Sequence[str],
) -> None:
    unknown = set(estimates) - set(ESTIMATES)
    if unknown:
        raise InputError(f"expected estimates among {', '.join(ESTIMATES)}, got {', '.join(sorted(unknown))}")
    if target.is_distorted:
        raise InputError(
            "expected an ideal pinhole as the target of fusion, got lens distortion "
            f"{target.distortion.tolist()}: take the view's camera without distortion"
        )
    if len(images) > MAX_CAMERAS:
        raise InputError(
            f"fusion keeps a mask of {MAX_CAMERAS} cameras per pixel, got {len(images)} cameras: "
            "leave cameras out of the scene"
        )
    for name, image in images.items():
        if name not in cameras:
            raise InputError(f"expected a calibrated camera {name} for its image, got {', '.join(cameras)}")
        width, height = cameras[name].size
        if image.shape != (height, width, 3) or image.dtype != np.uint8:
            raise InputError(
                f"camera {name}: expected an image of {width}x{height} RGB in 8 bits as calibrated, got "
                f"{image.shape} {image.dtype}: calibrate at the size of the images"
            )
