"""Command line of stage `background`; see the package."""

import argparse
import dataclasses
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fourd.background.estimate import Samples, blank_background, bytes_per_target, estimate_backgrounds
from fourd.background.options import BackgroundOptions
from fourd.cli import add_options, options_from_args, run_stage, set_num_threads
from fourd.errors import InputError
from fourd.fuse.files import DisparityFiles, Pictures, Progress
from fourd.fuse.options import FuseOptions
from fourd.io import ArchiveWriter
from fourd.sfm.cameras import SceneCameras, read_cameras
from fourd.views import View, read_view, spread

log = logging.getLogger(__name__)


def find_equal_poses(view: View, frames: Sequence[int]) -> dict[int, int]:
    """frame -> the first of the frames with exactly the same camera (itself, if it is the first)."""
    first: dict[bytes, int] = {}
    same_as = {}
    for frame in frames:
        camera = view.at(frame).camera
        key = camera.K.tobytes() + camera.R.tobytes() + camera.t.tobytes()
        same_as[frame] = first.setdefault(key, frame)
    return same_as


def run(
    view_path: Path,
    cameras_path: Path,
    frames: Sequence[int],
    disparity_paths: Sequence[Path],
    films: Sequence[str],
    fuse_options: FuseOptions,
    options: BackgroundOptions,
    output: Path,
) -> None:
    """Write background/{view}/{chunk}.npz; blank, with a reason in meta `status`, if no pair is usable.

    Raises InputError for inputs that do not fit together.
    """
    check_options(options)
    view = read_view(view_path)
    scene = read_cameras(cameras_path)
    frames = view.frames_of(frames)
    disparities = DisparityFiles(disparity_paths, view.name)
    pictures = Pictures(films, scene, view.name)
    samples = read_samples(disparities, pictures, scene, options.num_samples)
    same_as = find_equal_poses(view, frames)
    stored = [frame for frame in frames if same_as[frame] == frame]
    holes: dict[str, dict[str, float]] = {}
    meta: dict[str, Any] = {
        "view": view.name,
        "sample_frames": list(samples.frames),
        "same_as": {str(frame): first for frame, first in same_as.items()},
        "cameras": list(pictures.names),
        "pairs": disparities.pairs,
        "refused": disparities.refused,
        "options": dataclasses.asdict(options),
        "status": "ok" if samples.frames else "no usable pair",
        "holes": holes,
    }
    progress = Progress("image", len(stored) * len(samples.frames), time.monotonic)
    per_target = bytes_per_target(view.size, len(samples.frames), fuse_options.num_sources)
    together = max(1, fuse_options.memory_mb * 2**20 // per_target)
    with ArchiveWriter(output, meta) as writer:
        for batch in (stored[i : i + together] for i in range(0, len(stored), together)):
            targets = [view.at(frame).camera for frame in batch]
            if samples.frames:
                found = estimate_backgrounds(targets, samples, fuse_options, options, progress)
            else:
                found = [blank_background(view.size) for _ in targets]
            for frame, arrays in zip(batch, found, strict=True):
                unknown = 1 - float(arrays["farthest_valid"].mean())
                holes[str(frame)] = {"hole_share": unknown, "filled_share": float(arrays["filled"].mean())}
                log.info(
                    "frame %d: %.1f %% holes, %.1f %% closed", frame, 100 * unknown,
                    100 * holes[str(frame)]["filled_share"],
                )  # fmt: skip
                writer.add_frame(frame, **arrays)
    disparities.close()
    pictures.close()


def check_options(options: BackgroundOptions) -> None:
    """Raise InputError for settings that mean nothing."""
    if options.num_samples < 1 or options.fill_px < 0:
        raise InputError(
            f"expected num_samples of 1 or more and fill_px of 0 or more, got {options}: fix the config"
        )
    if not 0 < options.persistence <= 1:
        raise InputError(
            f"expected persistence above 0 and up to 1, got {options.persistence}: fix the config"
        )


def read_samples(
    disparities: DisparityFiles, pictures: Pictures, scene: SceneCameras, num_samples: int
) -> Samples:
    """The sampled times, spread over those that every usable pair has."""
    frames = spread(disparities.frames(), num_samples)
    cameras = [{name: scene.tracks[name].at(frame) for name in pictures.names} for frame in frames]
    return Samples(tuple(frames), tuple(cameras), disparities, pictures)


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of the stage."""
    parser = argparse.ArgumentParser(prog="python -m fourd.background", description=__doc__)
    parser.add_argument("--view-file", type=Path, required=True, help="views/{view}.json")
    parser.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
    parser.add_argument("--frames", type=int, nargs="+", required=True, help="output frames of the view")
    parser.add_argument("--disparity", type=Path, nargs="*", default=[], help="samples of all pairs")
    parser.add_argument("--films", nargs="*", default=[], help="frames/cameras/{cam}.npz, or CAMERA=PATH")
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
        args.output,
    )


if __name__ == "__main__":
    sys.exit(run_stage(main))
