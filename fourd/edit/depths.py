"""Depth of every input camera's own picture at every frame: what places a mark in the world."""

import dataclasses
import logging
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fourd.errors import InputError
from fourd.fuse.files import DisparityFiles, Pictures, Progress
from fourd.fuse.options import FuseOptions
from fourd.fuse.view import fuse_view
from fourd.io import ArchiveWriter
from fourd.sfm.cameras import read_cameras

log = logging.getLogger(__name__)
# No camera has this name, so no pair is left out: a camera may help to measure its own depth.
_NOBODY = ""


def run(
    cameras_path: Path,
    frames: Sequence[int],
    disparity_paths: Sequence[Path],
    films: Sequence[str],
    options: FuseOptions,
    output: Path,
) -> None:
    """Write edit/depth/{chunk}.npz: per frame and camera z of the ideal pinhole, float32, NaN = unknown.

    Raises InputError without a usable pair: nothing can be placed then.
    """
    scene = read_cameras(cameras_path)
    disparities = DisparityFiles(disparity_paths, _NOBODY)
    pictures = Pictures(films, scene, _NOBODY)
    if not disparities.pairs:
        raise InputError(
            "expected pairs of cameras whose disparity places a mark in the world, got none that could be "
            f"used ({next(iter(disparities.refused.values()), 'no file was given')}): film closer together"
        )
    # What is carried has to be sure rather than complete: of a sample that one pair has nobody else says
    # whether it is the thing's or that of what stands beside it.
    agreed = dataclasses.replace(options, visibility=False)
    progress = Progress("depths of frame", len(frames), time.monotonic)
    with ArchiveWriter(output, {"cameras": list(pictures.names), "pairs": disparities.pairs}) as writer:
        for frame in frames:
            pairs = disparities.at(frame, options.memory_mb)
            images, cameras = pictures.at(frame)
            for name in pictures.names:
                target = cameras[name].without_distortion()
                fused = fuse_view(target, pairs, images, cameras, agreed, ("consensus",))
                writer.add_frame(frame, **{name: fused.depths["consensus"].astype(np.float32)})
            progress.step(f"{len(pictures.names)} cameras")
    disparities.close()
    pictures.close()
