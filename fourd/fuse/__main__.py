"""Stage `fuse`: the instantaneous foreground of a view, frame by frame (section 3.1 of the paper).

In: views/{view}.json, sfm/cameras.json, disparity/{pair}/{chunk}.npz of all pairs, frames/cameras/{cam}.npz.
Out: foreground/{view}/{chunk}.npz (docs/formats.md).
"""

import argparse
import dataclasses
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fourd.cli import add_options, options_from_args, run_stage, set_num_threads
from fourd.errors import InputError
from fourd.fuse.files import DisparityFiles, Pictures, Progress, Silhouettes, hull_depth_range
from fourd.fuse.hull import HullOptions
from fourd.fuse.options import ESTIMATES, FuseOptions
from fourd.fuse.view import FusedView, choose_device, fuse_view
from fourd.io import ArchiveWriter
from fourd.sfm.cameras import read_cameras
from fourd.views import read_view

log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Files:
    """What the job reads. films: paths, or CAMERA=PATH"""

    view: Path
    cameras: Path
    disparity: Sequence[Path]
    films: Sequence[str]
    silhouettes: Sequence[Path]


def run(
    files: Files,
    frames: Sequence[int],
    estimates: Sequence[str],
    options: FuseOptions,
    hull_options: HullOptions,
    device: str,
    output: Path,
) -> None:
    """Write foreground/{view}/{chunk}.npz.

    A frame without a usable pair or disparity is blank, with the reason in meta `frame_status`.
    Raises InputError for inputs that do not fit together.
    """
    view = read_view(files.view)
    frames = view.frames_of(frames)
    scene = read_cameras(files.cameras)
    disparities = DisparityFiles(files.disparity, view.name)
    pictures = Pictures(files.films, scene, view.name)
    silhouettes = Silhouettes(files.silhouettes, view.name)
    meta: dict[str, Any] = {
        "view": view.name,
        "cameras": list(pictures.names),
        "pairs": disparities.pairs,
        "refused": disparities.refused,
        "min_pairs": max(1, min(options.min_pairs, len(disparities.pairs))),
        "estimates": list(estimates),
        "options": dataclasses.asdict(options),
        # Filled while frames are written; the writer stores meta last.
        "frame_status": {},
    }
    if meta["min_pairs"] < options.min_pairs:
        log.info("%d usable pairs: a consensus takes %d", len(disparities.pairs), meta["min_pairs"])
    progress = Progress("frame", len(frames), time.monotonic)
    scene_frame, loaded = None, None
    with ArchiveWriter(output, meta) as writer:
        for frame in frames:
            entry = view.at(frame)
            if loaded is None or entry.scene_frame != scene_frame:
                scene_frame = entry.scene_frame
                loaded = disparities.at(scene_frame, options.memory_mb), *pictures.at(scene_frame)
            fused = fuse_view(
                entry.camera, *loaded, options, estimates, device=device,
                silhouettes=silhouettes.at(entry.scene_frame), depth_range=hull_depth_range(scene),
                hull_options=hull_options,
            )  # fmt: skip
            _write_frame(writer, frame, fused)
            meta["frame_status"][f"{frame:06d}"] = fused.status
            cover = {name: f"{100 * valid.mean():.0f} %" for name, valid in fused.valid.items()}
            progress.step(f"{fused.status}, {fused.num_points} points, covers {cover}")
    disparities.close()
    pictures.close()
    silhouettes.close()


def _write_frame(writer: ArchiveWriter, frame: int, fused: FusedView) -> None:
    for estimate, rgb in fused.rgb.items():
        writer.add_frame(frame, **{f"{estimate}_rgb": rgb, f"{estimate}_valid": fused.valid[estimate]})
    writer.add_frame(
        frame,
        depth=fused.depths["consensus"],
        support=fused.support,
        num_cameras=fused.num_cameras,
        source=fused.source,
        depth_source=fused.depth_source,
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of the stage."""
    parser = argparse.ArgumentParser(prog="python -m fourd.fuse", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("foreground", help="instantaneous images of a view")
    command.add_argument("--view-file", type=Path, nargs="+", required=True, help="views/{view}.json")
    command.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
    command.add_argument("--frames", type=int, nargs="+", required=True, help="output frames of the views")
    command.add_argument("--disparity", type=Path, nargs="*", default=[], help="files of all pairs")
    command.add_argument("--films", nargs="*", default=[], help="frames/cameras/{cam}.npz, or CAMERA=PATH")
    command.add_argument("--silhouettes", type=Path, nargs="*", default=[], help="silhouettes/{chunk}.npz")
    command.add_argument("--estimates", nargs="+", choices=ESTIMATES, default=list(ESTIMATES))
    command.add_argument("--device", default="auto", help="auto, cpu or a torch device")
    command.add_argument("--output", type=Path, nargs="+", required=True, help="one file per view file")
    add_options(command, FuseOptions)
    add_options(command, HullOptions)
    args = parser.parse_args(argv)
    if len(args.view_file) != len(args.output):
        raise InputError(
            f"expected one --output per --view-file, got {len(args.output)} for {len(args.view_file)}: "
            "name as many of the one as of the other"
        )
    set_num_threads(1)
    # The depth, support and source in the file are those of the consensus.
    estimates = [name for name in ESTIMATES if name in {"consensus", *args.estimates}]
    for view, output in zip(args.view_file, args.output, strict=True):
        run(
            Files(view, args.cameras, args.disparity, args.films, args.silhouettes),
            args.frames,
            estimates,
            options_from_args(FuseOptions, args),
            options_from_args(HullOptions, args),
            choose_device(args.device),
            output,
        )


if __name__ == "__main__":
    sys.exit(run_stage(main))
