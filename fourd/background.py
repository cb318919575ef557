"""Stage `background`: the static background of every pose of a view (section 3.2 of the paper).

In: views/{view}.json, sfm/cameras.json, disparity/{pair}/samples.npz of all pairs, frames/cameras/{cam}.npz.
Out: background/{view}/{chunk}.npz (docs/formats.md).

What stands still is seen at the same place at all sampled times. Per pose the farthest and the median
image are fused at every sampled time, and each pixel takes its median over time.
"""

import argparse
import dataclasses
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from fourd.camera import Camera
from fourd.cli import add_options, options_from_args, run_stage, set_num_threads
from fourd.errors import InputError
from fourd.fuse.files import DisparityFiles, Pictures, Progress
from fourd.fuse.options import FuseOptions
from fourd.fuse.view import choose_device, fuse_view
from fourd.io import ArchiveWriter
from fourd.sfm.cameras import read_cameras
from fourd.views import View, read_view

STAGE_VERSION = 1

log = logging.getLogger(__name__)

ESTIMATES = ("farthest", "median")


@dataclasses.dataclass(frozen=True)
class BackgroundOptions:
    """Settings of the stage.

    num_samples: scene frames that vote, spread evenly over those in the disparity files; odd numbers
        serve better, an even one averages two pictures wherever they disagree
    min_samples: votes that a pixel needs; blank below
    farthest_min_pairs: pairs that have to agree with the farthest depth; 1 is the paper's
    """

    num_samples: int = 7
    min_samples: int = 1
    farthest_min_pairs: int = 2


@njit(cache=True, nogil=True)
def _median_votes(votes: np.ndarray, valid: np.ndarray, values: np.ndarray, out: np.ndarray) -> None:
    """Median over axis 0 of votes (S, N, C) where valid (S, N); values: (S,) scratch of votes' type."""
    num_samples, num_pixels, num_channels = votes.shape
    for i in range(num_pixels):
        for c in range(num_channels):
            count = 0
            for s in range(num_samples):
                if valid[s, i]:
                    at = count
                    while at > 0 and values[at - 1] > votes[s, i, c]:
                        values[at] = values[at - 1]
                        at -= 1
                    values[at] = votes[s, i, c]
                    count += 1
            if count > 0:
                lower, upper = values[(count - 1) // 2], values[count // 2]
                out[i, c] = lower + (upper - lower) / 2


def median_over_time(votes: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Per-pixel, per-channel median over samples; those that are not valid do not vote.

    votes: (S, H, W) or (S, H, W, C), any real type;  valid: (S, H, W) bool
    Returns float32 without the first axis: of an even number of votes the mean of the middle two;
    NaN where nothing votes.
    """
    flat = np.ascontiguousarray(votes, dtype=np.float32).reshape(len(votes), valid[0].size, -1)
    out = np.full(flat.shape[1:], np.nan, np.float32)
    scratch = np.empty(len(votes), np.float32)
    _median_votes(flat, np.ascontiguousarray(valid).reshape(len(votes), -1), scratch, out)
    return out.reshape(votes.shape[1:])


@dataclasses.dataclass(frozen=True, eq=False)
class Votes:
    """What the sampled times say about one pose; S samples, of estimates farthest and median.

    rgb: estimate -> S arrays (H, W, 3) uint8;  valid: estimate -> S arrays (H, W) bool
    depth: S arrays (H, W) float32 of the farthest, NaN = blank
    """

    rgb: dict[str, list[np.ndarray]]
    valid: dict[str, list[np.ndarray]]
    depth: list[np.ndarray]


def estimate_background(votes: Votes, min_samples: int) -> dict[str, np.ndarray]:
    """The arrays of one stored frame (docs/formats.md, background). No sample gives no array."""
    arrays = {}
    for estimate in ESTIMATES:
        valid = np.stack(votes.valid[estimate])
        enough = valid.sum(axis=0) >= max(min_samples, 1)
        rgb = median_over_time(np.stack(votes.rgb[estimate]), valid)
        arrays[f"{estimate}_rgb"] = np.where(enough[..., None], np.rint(rgb), 0).astype(np.uint8)
        arrays[f"{estimate}_valid"] = enough
    valid = np.stack(votes.valid["farthest"])
    depth = median_over_time(np.stack(votes.depth), valid)
    arrays["depth"] = np.where(arrays["farthest_valid"], depth, np.float32(np.nan))
    arrays["num_samples"] = np.minimum(valid.sum(axis=0), 255).astype(np.uint8)
    return arrays


def spread(frames: Sequence[int], count: int) -> list[int]:
    """At most `count` of the frames, evenly spread, the ends included."""
    if count >= len(frames):
        return list(frames)
    positions = np.linspace(0, len(frames) - 1, count) if count > 1 else np.array([len(frames) // 2])
    return [frames[int(round(p))] for p in positions]


def find_equal_poses(view: View, frames: Sequence[int]) -> dict[int, int]:
    """frame -> the first of the frames with exactly the same camera (itself, if it is the first)."""
    first: dict[bytes, int] = {}
    same_as = {}
    for frame in frames:
        camera = view.at(frame).camera
        key = camera.K.tobytes() + camera.R.tobytes() + camera.t.tobytes()
        same_as[frame] = first.setdefault(key, frame)
    return same_as


def collect_votes(
    targets: Sequence[Camera],
    disparities: DisparityFiles,
    pictures: Pictures,
    samples: Sequence[int],
    fuse_options: FuseOptions,
    options: BackgroundOptions,
    device: str,
    progress: Progress,
) -> list[Votes]:
    """Fuse every target at every sampled time; one entry per target.

    Samples are the outer loop: their disparities are read once for all targets.
    """
    votes = [Votes({e: [] for e in ESTIMATES}, {e: [] for e in ESTIMATES}, []) for _ in targets]
    for sample in samples:
        pairs = disparities.at(sample, fuse_options.memory_mb)
        images, cameras = pictures.at(sample)
        for target, vote in zip(targets, votes, strict=True):
            fused = fuse_view(
                target, pairs, images, cameras, fuse_options, ESTIMATES,
                farthest_min_pairs=options.farthest_min_pairs, device=device,
            )  # fmt: skip
            for estimate in ESTIMATES:
                vote.rgb[estimate].append(fused.rgb[estimate])
                vote.valid[estimate].append(fused.valid[estimate])
            vote.depth.append(fused.depths["farthest"])
            progress.step(f"sample {sample}, farthest covers {100 * fused.valid['farthest'].mean():.0f} %")
    return votes


def blank_background(size: tuple[int, int]) -> dict[str, np.ndarray]:
    """The arrays of a frame that nothing is known about."""
    shape = (size[1], size[0])
    arrays: dict[str, np.ndarray] = {}
    for estimate in ESTIMATES:
        arrays[f"{estimate}_rgb"] = np.zeros((*shape, 3), np.uint8)
        arrays[f"{estimate}_valid"] = np.zeros(shape, bool)
    arrays["depth"] = np.full(shape, np.nan, np.float32)
    arrays["num_samples"] = np.zeros(shape, np.uint8)
    return arrays


def run(
    view_path: Path,
    cameras_path: Path,
    frames: Sequence[int],
    disparity_paths: Sequence[Path],
    films: Sequence[str],
    fuse_options: FuseOptions,
    options: BackgroundOptions,
    device: str,
    output: Path,
) -> None:
    """Write background/{view}/{chunk}.npz; blank, with a reason in meta `status`, if no pair is usable.

    Raises InputError for inputs that do not fit together.
    """
    if options.num_samples < 1 or options.min_samples < 1 or options.farthest_min_pairs < 1:
        raise InputError(f"expected background settings of 1 or more, got {options}: fix the config")
    view = read_view(view_path)
    frames = view.frames_of(frames)
    disparities = DisparityFiles(disparity_paths, view.name)
    pictures = Pictures(films, read_cameras(cameras_path), view.name)
    samples = spread(disparities.frames(), options.num_samples)
    same_as = find_equal_poses(view, frames)
    stored = [frame for frame in frames if same_as[frame] == frame]
    meta: dict[str, Any] = {
        "view": view.name,
        "sample_frames": samples,
        "same_as": {str(frame): first for frame, first in same_as.items()},
        "cameras": list(pictures.names),
        "pairs": disparities.pairs,
        "refused": disparities.refused,
        "options": dataclasses.asdict(options),
        "status": "ok" if samples else "no usable pair",
    }
    progress = Progress("image", len(stored) * len(samples), time.monotonic)
    with ArchiveWriter(output, meta) as writer:
        for batch in _batches(stored, view.size, len(samples), fuse_options.memory_mb):
            targets = [view.at(frame).camera for frame in batch]
            votes = collect_votes(
                targets, disparities, pictures, samples, fuse_options, options, device, progress
            )
            for frame, vote in zip(batch, votes, strict=True):
                known = estimate_background(vote, options.min_samples) if samples else None
                writer.add_frame(frame, **(known or blank_background(view.size)))
    disparities.close()
    pictures.close()


def _batches(
    frames: Sequence[int], size: tuple[int, int], num_samples: int, memory_mb: int
) -> list[list[int]]:
    """Frames in groups whose votes fit the budget: 12 bytes per pixel and sample."""
    per_frame = 12 * size[0] * size[1] * max(num_samples, 1)
    count = max(1, memory_mb * 2**20 // per_frame)
    return [list(frames[i : i + count]) for i in range(0, len(frames), count)]


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of the stage."""
    parser = argparse.ArgumentParser(prog="python -m fourd.background", description=__doc__)
    parser.add_argument("--view-file", type=Path, required=True, help="views/{view}.json")
    parser.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
    parser.add_argument("--frames", type=int, nargs="+", required=True, help="output frames of the view")
    parser.add_argument("--disparity", type=Path, nargs="*", default=[], help="samples of all pairs")
    parser.add_argument("--films", nargs="*", default=[], help="frames/cameras/{cam}.npz, or CAMERA=PATH")
    parser.add_argument("--device", default="auto", help="auto, cpu or a torch device")
    parser.add_argument("--output", type=Path, required=True)
    add_options(parser, BackgroundOptions)
    add_options(parser, FuseOptions)
    args = parser.parse_args(argv)
    set_num_threads(1)
    run(
        args.view_file,
        args.cameras,
        args.frames,
        args.disparity,
        args.films,
        options_from_args(FuseOptions, args),
        options_from_args(BackgroundOptions, args),
        choose_device(args.device),
        args.output,
    )


if __name__ == "__main__":
    sys.exit(run_stage(main))
