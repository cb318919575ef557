"""Where the pixels of a rendered picture come from: depth and origin, small."""

import contextlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fourd.errors import InputError
from fourd.io import Archive, ArchiveWriter
from fourd.provenance import (
    BACKGROUND_KEYS,
    CONTINUED,
    FOREGROUND_KEYS,
    HULL,
    NOTHING,
    STATIC,
    find_provenance,
)
from fourd.render import BackgroundReader, read_arrays
from fourd.viewer.lattice import MAP_REDUCTION

# The page's numbers; a colour from camera i of the fused ones is FIRST_CAMERA + i.
ORIGINS = {NOTHING: 0, STATIC: 1, CONTINUED: 2, HULL: 3}
FIRST_CAMERA = len(ORIGINS)


def map_origins(
    foreground: Mapping[str, np.ndarray], background: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth (h, w) float32, 1 / world unit, 0 where unknown or infinite, and origin (h, w) uint8.

    foreground, background: arrays of one frame of these archives (docs/formats.md)
    Every MAP_REDUCTION-th pixel, not a mean: a mean of two surfaces is a place where nothing is.
    """
    some = np.s_[MAP_REDUCTION // 2 :: MAP_REDUCTION, MAP_REDUCTION // 2 :: MAP_REDUCTION]
    front = {key: foreground[key][some] for key in FOREGROUND_KEYS}
    found = find_provenance(front, {key: background[key][some] for key in BACKGROUND_KEYS})
    origin = FIRST_CAMERA + found.source
    for kind, number in ORIGINS.items():
        origin[found.kind == kind] = number
    return np.where(found.depth > 0, 1 / found.depth, 0).astype(np.float32), origin.astype(np.uint8)


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
