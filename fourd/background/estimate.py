"""The backgrounds of some poses: depth voted over all pairs and times, then one colour per pixel."""

import dataclasses
import logging
from collections.abc import Mapping, Sequence

import numpy as np

from fourd.background.colour import (
    Points,
    bytes_per_point,
    choose_cameras,
    pack_pictures,
    sample_pictures,
    settle_colours,
)
from fourd.background.extend import extend_surfaces
from fourd.background.fill import drop_ghosts, drop_speckles, fill_holes
from fourd.background.options import ESTIMATES, BackgroundOptions
from fourd.background.surfaces import BYTES_PER_TIME, Surfaces, find_surfaces
from fourd.background.visibility import find_hidden
from fourd.background.vote import StaticDepth, bytes_per_pixel, vote_depth
from fourd.camera import Camera
from fourd.fuse.files import DisparityFiles, Pictures, Progress
from fourd.fuse.geometry import pack_cameras
from fourd.fuse.options import FuseOptions

log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, eq=False)
class Samples:
    """What is known about the sampled times.

    frames: scene frames;  cameras: per frame, name -> Camera, in the order of `pictures.names`
    """

    frames: tuple[int, ...]
    cameras: tuple[Mapping[str, Camera], ...]
    disparities: DisparityFiles
    pictures: Pictures


def estimate_backgrounds(
    targets: Sequence[Camera],
    samples: Samples,
    fuse_options: FuseOptions,
    options: BackgroundOptions,
    progress: Progress,
) -> list[dict[str, np.ndarray]]:
    """The arrays of a stored frame (docs/formats.md, background) for every target.

    targets: ideal pinholes of one size
    Samples are the outer loop: their disparities and pictures are read once for all targets, more than
    once only where a single target exceeds the memory.
    Raises InputError for more than 64 cameras, or a pair without pictures.
    """
    depths = _vote_all(targets, samples, fuse_options, options, progress)
    everybody = np.uint64((1 << len(samples.pictures.names)) - 1)
    filled = [_mend(depth, options.fill_px, everybody) for depth in depths]
    points = [
        _points_of(target, depth, holes, samples)
        for target, depth, holes in zip(targets, depths, filled, strict=True)
    ]
    colours = _colour_all(targets, points, samples, fuse_options)
    return [
        _arrays_of(depth, holes[0], rgb, valid)
        for depth, holes, (rgb, valid) in zip(depths, filled, colours, strict=True)
    ]


def bytes_per_target(size: tuple[int, int], num_samples: int, num_sources: int) -> int:
    """Memory that one target of a call takes; twice the points of one estimate have a colour at most."""
    voting = BYTES_PER_TIME * num_samples
    colouring = len(ESTIMATES) * bytes_per_point(num_sources, num_samples)
    return size[0] * size[1] * (bytes_per_pixel(num_samples) + max(voting, colouring))


def _vote_all(
    targets: Sequence[Camera],
    samples: Samples,
    fuse_options: FuseOptions,
    options: BackgroundOptions,
    progress: Progress,
) -> list[StaticDepth]:
    width, height = targets[0].size
    depths = [StaticDepth.blank(len(samples.frames), height, width) for _ in targets]
    num_pairs = len(samples.disparities.pairs)
    bytes_per_row = width * (len(targets) * BYTES_PER_TIME * len(samples.frames) + 8 * (num_pairs + 2))
    for rows in _split(height, bytes_per_row, fuse_options.memory_mb):
        found = [Surfaces.blank(len(samples.frames), rows[1] - rows[0], width) for _ in targets]
        for i, frame in enumerate(samples.frames):
            pairs = samples.disparities.at(frame, fuse_options.memory_mb)
            for target, surfaces in zip(targets, found, strict=True):
                find_surfaces(target, pairs, samples.pictures.names, fuse_options, rows, surfaces, i)
                if rows[1] == height:
                    progress.step(f"sample {frame}")
        for depth, surfaces in zip(depths, found, strict=True):
            vote_depth(surfaces, fuse_options.tolerance, options.persistence, num_pairs, rows, depth)
    return depths


def _mend(depth: StaticDepth, widest_px: int, everybody: np.uint64) -> list[np.ndarray]:
    """Mend both estimates in place. Returns what was filled, (H, W) bool of each.

    everybody: bits of all cameras. Whether one sees a surface that was guessed nobody knows: all may.
    """
    filled = []
    for inverse_depth, seen_by in zip(depth.inverse_depth, depth.seen_by, strict=True):
        drop_speckles(inverse_depth, seen_by)
        num_ghosts = drop_ghosts(inverse_depth, seen_by)
        log.debug("%d pixels of what passed are taken out", num_ghosts)
        filled.append(fill_holes(inverse_depth, seen_by, widest_px))
    unknown = depth.inverse_depth < 0
    extended = unknown & extend_surfaces(depth.inverse_depth[0])
    for estimate in range(len(ESTIMATES)):
        # One guess for both, so that it gets its colour once.
        depth.inverse_depth[estimate][extended[estimate]] = depth.inverse_depth[0][extended[estimate]]
        depth.seen_by[estimate][:, extended[estimate]] = everybody
        filled[estimate] |= extended[estimate]
    depth.num_times[~depth.seen_by[0].any(axis=0) | filled[0]] = 0
    return filled


def _split(count: int, bytes_each: int, memory_mb: int) -> list[tuple[int, int]]:
    """Ranges [first, last) of `count` things, of which each fits the budget."""
    step = max(1, min(count, memory_mb * 2**20 // max(bytes_each, 1)))
    return [(first, min(first + step, count)) for first in range(0, count, step)]


def _wanted(depth: StaticDepth) -> list[np.ndarray]:
    """(H, W) bool per estimate: what needs a colour. A median at the depth of the farthest has its own."""
    farthest, median = depth.inverse_depth
    return [farthest >= 0, (median >= 0) & (median != farthest)]


def _points_of(target: Camera, depth: StaticDepth, filled: list[np.ndarray], samples: Samples) -> Points:
    """The points that need a colour, of one estimate after the other.

    filled: (H, W) bool per estimate. What hides them is looked up at the middle of the sampled times.
    """
    wanted = _wanted(depth)
    y, x = np.concatenate([np.nonzero(mask) for mask in wanted], axis=1)
    inverse_depths = [values[mask] for values, mask in zip(depth.inverse_depth, wanted, strict=True)]
    seen_by = [cameras[:, mask] for cameras, mask in zip(depth.seen_by, wanted, strict=True)]
    place = x.astype(np.float32), y.astype(np.float32), np.concatenate(inverse_depths)
    cameras = samples.cameras[len(samples.cameras) // 2]
    measured = np.nonzero(wanted[0] & ~filled[0])
    occluders = (
        measured[1].astype(np.float32),
        measured[0].astype(np.float32),
        depth.inverse_depth[0][measured],
    )
    hidden_from = find_hidden(
        *place,
        occluders,
        pack_cameras(target, list(cameras.values())),
        [camera.size for camera in cameras.values()],
    )
    seen = np.concatenate(seen_by, axis=1)
    is_filled = np.concatenate([holes[mask] for holes, mask in zip(filled, wanted, strict=True)])
    # The cameras of a filled point are a guess, taken from beside it.
    seen[:, is_filled] &= ~hidden_from[is_filled]
    return Points(*place, seen, hidden_from)


def _colour_all(
    targets: Sequence[Camera],
    points: Sequence[Points],
    samples: Samples,
    fuse_options: FuseOptions,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """(M, 3) uint8 and (M,) bool for the points of every target."""
    params = [
        np.stack([pack_cameras(target, list(cameras.values())) for cameras in samples.cameras])
        for target in targets
    ]
    size = bytes_per_point(fuse_options.num_sources, len(samples.frames))
    parts = [_split(len(p.x), size, fuse_options.memory_mb) for p in points]
    colours: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in targets]
    for turn in range(max(map(len, parts))):
        active = [i for i in range(len(targets)) if turn < len(parts[i])]
        chosen = [points[i].part(*parts[i][turn]) for i in active]
        opinions = [
            choose_cameras(p, params[i], fuse_options.num_sources)
            for i, p in zip(active, chosen, strict=True)
        ]
        for s, frame in enumerate(samples.frames):
            packed = pack_pictures(list(samples.pictures.at(frame)[0].values()))
            for i, p, opinion in zip(active, chosen, opinions, strict=True):
                sample_pictures(p, params[i][s], packed, s, opinion)
        for i, opinion in zip(active, opinions, strict=True):
            colours[i].append(settle_colours(opinion))
    return [
        (np.concatenate([c[0] for c in parts]), np.concatenate([c[1] for c in parts]))
        if parts
        else (np.zeros((0, 3), np.uint8), np.zeros(0, bool))
        for parts in colours
    ]


def _arrays_of(
    depth: StaticDepth, filled: np.ndarray, colours: np.ndarray, has_colour: np.ndarray
) -> dict[str, np.ndarray]:
    """The arrays of one stored frame."""
    arrays = blank_background((filled.shape[1], filled.shape[0]))
    first = 0
    wanted = _wanted(depth)
    twins = (depth.inverse_depth[0] >= 0) & (depth.inverse_depth[0] == depth.inverse_depth[1])
    for estimate, mask in zip(ESTIMATES, wanted, strict=True):
        rgb, valid = arrays[f"{estimate}_rgb"], arrays[f"{estimate}_valid"]
        if estimate == "median":
            rgb[twins], valid[twins] = arrays["farthest_rgb"][twins], arrays["farthest_valid"][twins]
        last = first + int(mask.sum())
        rgb[mask], valid[mask] = colours[first:last], has_colour[first:last]
        first = last
    known = arrays["farthest_valid"]
    with np.errstate(divide="ignore"):
        arrays["depth"][known] = np.float32(1) / depth.inverse_depth[0][known]
    arrays["num_samples"] = np.where(known, depth.num_times, 0).astype(np.uint8)
    arrays["filled"] = filled & known
    return arrays


def blank_background(size: tuple[int, int]) -> dict[str, np.ndarray]:
    """The arrays of a frame that nothing is known about. size: (width, height)."""
    shape = size[::-1]
    arrays: dict[str, np.ndarray] = {}
    for estimate in ESTIMATES:
        arrays[f"{estimate}_rgb"] = np.zeros((*shape, 3), np.uint8)
        arrays[f"{estimate}_valid"] = np.zeros(shape, bool)
    arrays["depth"] = np.full(shape, np.nan, np.float32)
    arrays["num_samples"] = np.zeros(shape, np.uint8)
    arrays["filled"] = np.zeros(shape, bool)
    return arrays
