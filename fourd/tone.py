"""Colour tables: how the pictures of one camera are brought to the colours that the scene shares.

A table is (3, 256) uint8: the new level of each level of red, green and blue. A camera's document
`tone` is None (leave the picture as it is) or {"frames": [scene frames, rising], "tables": [one
table per listed frame]}; in between, tables are interpolated linearly, outside the nearest holds.
"""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from fourd.errors import InputError

NUM_LEVELS = 256


def identity_table() -> np.ndarray:
    """(3, 256) uint8 table that changes nothing."""
    return np.tile(np.arange(NUM_LEVELS, dtype=np.uint8), (3, 1))


def apply_tone(image: np.ndarray, table: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 RGB through a (3, 256) uint8 table; a new array.

    Raises ValueError for other shapes or types.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"expected (H, W, 3) uint8, got {image.shape} {image.dtype}")
    if table.dtype != np.uint8 or table.shape != (3, NUM_LEVELS):
        raise ValueError(f"expected a (3, {NUM_LEVELS}) uint8 table, got {table.shape} {table.dtype}")
    return np.asarray(cv2.LUT(image, np.ascontiguousarray(table.T)[None]))


def table_at(tone: Mapping[str, Any] | None, frame: float) -> np.ndarray | None:
    """(3, 256) uint8 table of a scene frame, None where the pictures stay as they are.

    tone: entry `tone` of frames/{cam}.json
    Raises InputError for a document that is none.
    """
    if tone is None:
        return None
    try:
        frames = np.asarray(tone["frames"], dtype=np.float64)
        tables = np.asarray(tone["tables"], dtype=np.float64)
        if tables.shape != (len(frames), 3, NUM_LEVELS) or not len(frames) or (np.diff(frames) <= 0).any():
            raise ValueError(f"{len(frames)} frames and tables of shape {tables.shape}")
        if not ((tables >= 0) & (tables < NUM_LEVELS)).all():
            raise ValueError("levels outside 0..255")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"expected a colour table per listed frame, frames rising, got {error!r}: delete the results' "
            "folder frames and run again"
        ) from None
    at = float(np.interp(frame, frames, np.arange(len(frames))))
    before = int(at)
    after = min(before + 1, len(frames) - 1)
    table = tables[before] + (at - before) * (tables[after] - tables[before])
    return np.rint(table).astype(np.uint8)
