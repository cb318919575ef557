"""From stored to displayed pictures: the display matrix and pixels that are not square."""

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from fourd.errors import InputError


def display_matrix(frame: av.VideoFrame, path: Path | str) -> tuple[int, int, int, int]:
    """(a, b, c, d), each -1, 0 or 1: the stored pixel (x, y) is shown at (a x + c y, b x + d y).

    Raises InputError for a matrix that is no quarter turn or mirroring.
    Source: ISO/IEC 14496-12, 8.3.2 (transformation matrix).
    """
    data = frame.side_data.get("DISPLAYMATRIX")
    if data is None:
        return 1, 0, 0, 1
    # Rows of (a, b, u), 16.16 fixed point.
    a, b, _, c, d = (np.frombuffer(bytes(data), dtype=np.int32)[:5] / 65536.0).tolist()
    matrix = round(a), round(b), round(c), round(d)
    turned = np.abs(np.subtract((a, b, c, d), matrix)).max() < 1e-3
    if not turned or sorted(map(abs, matrix)) != [0, 0, 1, 1] or (a == 0) != (d == 0):
        raise InputError(
            f"expected {path} to be turned by 0, 90, 180 or 270 degrees, got the display matrix "
            f"{(a, b, c, d)}: write the video anew without it"
        )
    return matrix


def rotation_from_matrix(matrix: tuple[int, int, int, int]) -> int:
    """Counterclockwise turn, degrees in 0..270, that a display matrix makes before it mirrors, if it does."""
    a, b, c, d = matrix
    is_mirrored = a * d - b * c < 0
    return -round(np.degrees(np.arctan2(b, -a if is_mirrored else a))) % 360


def displayed_size(
    stored_size: tuple[int, int], matrix: tuple[int, int, int, int], pixel_aspect: Fraction
) -> tuple[int, int]:
    """(width, height) px on a screen of square pixels.

    stored_size: (width, height) px as coded;  pixel_aspect: width of a stored pixel over its height
    The side that is too short grows, so that no detail is lost.
    """
    width, height = stored_size
    if pixel_aspect > 1:
        width = round(width * pixel_aspect)
    else:
        height = round(height / pixel_aspect)
    return (height, width) if matrix[0] == 0 else (width, height)


def display_image(image: np.ndarray, matrix: tuple[int, int, int, int], size: tuple[int, int]) -> np.ndarray:
    """(H, W, 3) uint8 as displayed: turned or mirrored, then resampled to `size` where it differs."""
    a, b, c, d = matrix
    upright = np.ascontiguousarray(image[::d, ::a] if a else image.transpose(1, 0, 2)[::b, ::c])
    if (upright.shape[1], upright.shape[0]) == size:
        return upright
    return cv2.resize(upright, size, interpolation=cv2.INTER_CUBIC)
