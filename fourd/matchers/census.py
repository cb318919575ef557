"""Semi-global matching of census transforms: only the order of grey levels counts.

Gain, gamma and vignetting leave the order of neighbours as it is; noise and compression swap few.

Source: R. Zabih, J. Woodfill, "Non-parametric local transforms for computing visual correspondence",
ECCV 1994; H. Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information",
PAMI 2008.
"""

import math

import cv2
import numba
import numpy as np

from fourd.matchers import Match
from fourd.matchers.semi_global import aggregate, best_hypothesis

_HALF_WIDTH_PX = 4
_HALF_HEIGHT_PX = 3
_PENALTY_SMALL = 8
_PENALTY_LARGE = 40
_OUTSIDE_COST = 40


class CensusMatcher:
    """Census over 9x7 px, Hamming distances averaged over 3x3 px and summed along eight paths."""

    def match(self, left: np.ndarray, right: np.ndarray, disparity_range: tuple[float, float]) -> Match:
        """See `Matcher.match`."""
        lowest, highest = math.floor(disparity_range[0]) - 1, math.ceil(disparity_range[1]) + 1
        ours, theirs = (
            census(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), _HALF_WIDTH_PX, _HALF_HEIGHT_PX)
            for image in (left, right)
        )
        cost = _smooth(_hamming(ours, theirs, lowest, highest - lowest + 1))
        index = best_hypothesis(aggregate(cost, _PENALTY_SMALL, _PENALTY_LARGE))
        disparity = (index + lowest).astype(np.float32)
        return Match(disparity, np.isfinite(disparity).astype(np.float32))


@numba.njit(cache=True, nogil=True)
def census(grey: np.ndarray, half_width: int, half_height: int) -> np.ndarray:
    """One bit for every neighbour that is darker than the pixel; borders repeat.

    grey: (H, W) uint8;  half_width, half_height: of the window, px, at most 64 neighbours
    Returns (H, W) uint64
    """
    height, width = grey.shape
    signature = np.zeros((height, width), np.uint64)
    for y in range(height):
        for v in range(-half_height, half_height + 1):
            row = min(max(y + v, 0), height - 1)
            for u in range(-half_width, half_width + 1):
                for x in range(width):
                    column = min(max(x + u, 0), width - 1)
                    darker = np.uint64(grey[row, column] < grey[y, x])
                    signature[y, x] = (signature[y, x] << np.uint64(1)) | darker
    return signature


@numba.njit(cache=True, nogil=True)
def _hamming(left: np.ndarray, right: np.ndarray, lowest: int, count: int) -> np.ndarray:
    """(H, W, D) uint8 number of bits that differ; a constant where the match lies outside."""
    height, width = left.shape
    cost = np.full((height, width, count), np.uint8(_OUTSIDE_COST), np.uint8)
    for y in range(height):
        for x in range(width):
            for d in range(count):
                column = x - lowest - d
                if 0 <= column < width:
                    bits = left[y, x] ^ right[y, column]
                    bits -= (bits >> np.uint64(1)) & np.uint64(0x5555555555555555)
                    bits = (bits & np.uint64(0x3333333333333333)) + (
                        (bits >> np.uint64(2)) & np.uint64(0x3333333333333333)
                    )
                    bits = (bits + (bits >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
                    cost[y, x, d] = np.uint8((bits * np.uint64(0x0101010101010101)) >> np.uint64(56))
    return cost


@numba.njit(cache=True, nogil=True)
def _smooth(cost: np.ndarray) -> np.ndarray:
    """(H, W, D) uint8 mean over 3x3 px at each disparity; borders repeat."""
    height, width, count = cost.shape
    smooth = np.empty_like(cost)
    total = np.empty(count, np.uint16)
    for y in range(height):
        for x in range(width):
            total[:] = 4
            for row in (max(y - 1, 0), y, min(y + 1, height - 1)):
                for column in (max(x - 1, 0), x, min(x + 1, width - 1)):
                    at = cost[row, column]
                    for d in range(count):
                        total[d] += at[d]
            for d in range(count):
                smooth[y, x, d] = total[d] // 9
    return smooth
