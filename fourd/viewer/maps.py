"""Where the pixels of a rendered picture come from: depth and origin, small."""

import contextlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fourd.errors import InputError
from fourd.io import Archive, ArchiveWriter
from fourd.render import BackgroundReader, read_arrays
from fourd.viewer.lattice import MAP_REDUCTION

# Origins; a colour from camera i of the fused ones is FIRST_CAMERA + i.
NOTHING, STATIC, CONTINUED, HULL, FIRST_CAMERA = 0, 1, 2, 3, 4
FOREGROUND_KEYS = ("consensus_valid", "depth", "source", "depth_source")
BACKGROUND_KEYS = ("farthest_valid", "depth", "filled")
HULL_DEPTH = 2


def map_origins(
    foreground: Mapping[str, np.ndarray], background: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth (h, w) float32, 1 / world unit, 0 where unknown or infinite, and origin (h, w) uint8.

    foreground, background: arrays of one frame of these archives (docs/formats.md)
    Every MAP_REDUCTION-th pixel, not a mean: a mean of two surfaces is a place where nothing is.
    """
    start = MAP_REDUCTION // 2
    front = {key: foreground[key][start::MAP_REDUCTION, start::MAP_REDUCTION] for key in FOREGROUND_KEYS}
    back = {key: background[key][start::MAP_REDUCTION, start::MAP_REDUCTION] for key in BACKGROUND_KEYS}
    seen = front["consensus_valid"] & (front["source"] != 255)
    depth = np.where(seen, front["depth"], back["depth"]).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse_depth = np.nan_to_num(1 / depth, nan=0.0, posinf=0.0, neginf=0.0)
    origin = np.where(back["farthest_valid"], STATIC, NOTHING)
    origin = np.where(back["filled"], CONTINUED, origin)
    origin = np.where(seen, FIRST_CAMERA + front["source"].astype(np.int32), origin)
    origin = np.where(seen & (front["depth_source"] == HULL_DEPTH), HULL, origin)
    return inverse_depth, origin.astype(np.uint8)


def write_maps(foreground_path: Path, background_path: Path, output: Path) -> None:
    """Write lattice/maps/{view}/{chunk}.npz. Raises InputError for archives of two different views."""
    with (
        contextlib.closing(Archive(foreground_path)) as foreground,
        contextlib.closing(Archive(background_path)) as background,
    ):
        names = foreground.meta.get("view"), background.meta.get("view")
        if names[0] != names[1]:
            raise InputError(
                f"expected one view, got {names[0]} in {foreground_path} and {names[1]} in "
                f"{background_path}: check the paths"
            )
        backgrounds = BackgroundReader(background, BACKGROUND_KEYS)
        meta = {"view": names[0], "cameras": foreground.meta.get("cameras", [])}
        with ArchiveWriter(output, meta) as writer:
            for frame in foreground.frames():
                estimates = read_arrays(foreground, frame, FOREGROUND_KEYS)
                inverse_depth, origin = map_origins(estimates, backgrounds.read(frame))
                writer.add_frame(frame, inverse_depth=inverse_depth, origin=origin)
