"""Marks as masks of the pictures they were drawn on."""

import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from fourd.edit.spec import Mark
from fourd.errors import InputError

_SCRIBBLE_PX = 5
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def draw_mark(mark: Mark, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool, True where the mark is.

    size: (width, height) of the picture that it was drawn on, px
    Raises InputError for a mark outside the picture, or a mask that is none.
    """
    if mark.mask is not None:
        return read_mask(mark.mask, size)
    width, height = size
    points = np.array(mark.points, dtype=np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    if (high < -0.5).any() or low[0] > width - 0.5 or low[1] > height - 0.5:
        raise InputError(
            f"{mark.describe()} lies outside the picture of {width} x {height} px: x and y count from the "
            "top left corner, draw it again"
        )
    # Far corners are cut, so that they fit the integers of the drawing.
    points = np.clip(points, -16 * max(size), 16 * max(size))
    canvas = np.zeros((height, width), np.uint8)
    if mark.shape == "box":
        points = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
        points = np.clip(points, -1, np.array([width, height]))
    corners = np.rint(points).astype(np.int32).reshape(-1, 1, 2)
    if mark.shape == "scribble":
        cv2.polylines(canvas, [corners], False, 1, _SCRIBBLE_PX)
    else:
        cv2.fillPoly(canvas, [corners], 1)
    mask = canvas > 0
    if not mask.any():
        raise InputError(f"{mark.describe()} covers no pixel of the picture: draw it again, larger")
    return mask


def read_mask(path: Path | str, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool of a mask PNG, True where any channel is not 0; a fully transparent pixel is not marked.

    size: (width, height) that it must have, px
    Raises InputError for anything but a whole PNG of that size that marks something. The size is read from
    the header first: a small file may unfold into more pixels than fit the memory.
    """
    source = Path(path)
    expected = f"expected a PNG mask of {size[0]} x {size[1]} px at {source}"
    if not source.is_file():
        raise InputError(f"{expected}, found nothing: check the path")
    limit = 64 * 1024 + 16 * size[0] * size[1]
    if source.stat().st_size > limit:
        raise InputError(f"{expected}, got a file of {source.stat().st_size} bytes: save it as an 8-bit PNG")
    data = source.read_bytes()
    if not data.startswith(_PNG_SIGNATURE) or len(data) < 33:
        raise InputError(f"{expected}, got something else: save the mask as PNG")
    given = struct.unpack(">II", data[16:24])
    if given != tuple(size):
        raise InputError(
            f"{expected}, got {given[0]} x {given[1]} px: draw the mask on the camera's own picture "
            "(`python -m fourd.edit mark --picture` writes it)"
        )
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(f"{expected}, got one that cannot be decoded: save it again")
    if image.ndim == 3 and image.shape[2] == 4:
        marked = (image[:, :, 3] > 0) & (image[:, :, :3] > 0).any(axis=2)
    else:
        marked = image > 0 if image.ndim == 2 else (image > 0).any(axis=2)
    if not marked.any():
        raise InputError(f"{source}: the mask is 0 everywhere, nothing is marked: paint the thing white")
    return np.asarray(marked)


def check_conflicts(marks: Sequence[Mark], masks: Sequence[np.ndarray]) -> None:
    """Raise InputError when one mark says that pixels belong to the thing and another that they do not."""
    for i, (mark, mask) in enumerate(zip(marks, masks, strict=True)):
        for other, its_mask in zip(marks[:i], masks[:i], strict=True):
            same_picture = (mark.view, mark.frame) == (other.view, other.frame)
            if same_picture and mark.is_part != other.is_part and (mask & its_mask).any():
                raise InputError(
                    f"{other.describe()} and {mark.describe()} contradict each other on "
                    f"{int((mask & its_mask).sum())} px: one says that these are part of the thing, the "
                    "other that they are not; change one of them"
                )
