"""Semi-global matching from coarse to fine: every disparity at a small size, then two narrow bands.

Wide ranges of disparities, as of cameras that stand far apart, cost an eighth of what they would.
"""

import math

import cv2
import numpy as np

from fourd.matchers import Match
from fourd.matchers.banded import (
    BAND_PX,
    NUM_BANDS,
    aggregate_bands,
    band_costs,
    best_in_bands,
    jump_penalties,
)
from fourd.matchers.census import census
from fourd.matchers.semi_global import aggregate, least_index

_HALF_CENSUS_PX = 2
_LARGE = 320.0
"""Penalty of a step of more than 1 px between pixels of one colour, in grey levels summed over the
channels."""
_COARSE_SMALL, _COARSE_LARGE = 48, 240.0
"""Penalties of a step of 1 px and of more at half size: low ones keep thin things, and what is wrong for it
costs no more than a band."""
_MAX_CELLS = 40_000_000
"""Pixels times disparities of a level that is searched whole, 4 bytes each; a larger one gets bands too."""
_SURFACE_REACH_PX = 3
"""Window of the half-size disparities in which another surface is looked for, px."""
_STEP_PX = 8
"""Surfaces farther apart than this meet in a step."""


class PyramidMatcher:
    """Semi-global matching of colours and census transforms, coarse to fine; sharp at edges."""

    def match(self, left: np.ndarray, right: np.ndarray, disparity_range: tuple[float, float]) -> Match:
        """See `Matcher.match`."""
        lowest, highest = math.floor(disparity_range[0]) - 1, math.ceil(disparity_range[1]) + 1
        total, first = _match_in_bands(left, right, lowest, max(highest, lowest + BAND_PX - 1))
        disparity = best_in_bands(total, first)
        disparity[disparity > highest] = np.nan
        return Match(disparity, np.isfinite(disparity).astype(np.float32))


def _match_in_bands(
    left: np.ndarray, right: np.ndarray, lowest: int, highest: int
) -> tuple[np.ndarray, np.ndarray]:
    """Summed costs (H, W, 2, BAND_PX) int16 of the bands that half the size suggests, and those bands."""
    coarse = _match_every_pixel(_halve(left), _halve(right), math.floor(lowest / 2), math.ceil(highest / 2))
    first = _choose_bands(2 * coarse, left.shape[:2], lowest, highest)
    is_step = np.abs(first[..., 1] - first[..., 0]) > _STEP_PX
    costs = _compare(left, right, is_step, first)
    return aggregate_bands(costs, first, jump_penalties(left, _LARGE, 2)), first


def _match_every_pixel(left: np.ndarray, right: np.ndarray, lowest: int, highest: int) -> np.ndarray:
    """(H, W) float32 whole disparity of the least cost between two bounds, px, whatever it is worth."""
    height, width = left.shape[:2]
    if height * width * (highest - lowest + 1) > _MAX_CELLS:
        total, first = _match_in_bands(left, right, lowest, max(highest, lowest + BAND_PX - 1))
        index = np.argmin(total.reshape(height, width, -1), axis=2)
        start = np.take_along_axis(first, index[..., None] // BAND_PX, axis=2)[..., 0]
        found = (start + index % BAND_PX).astype(np.float32)
    else:
        starts = np.arange(lowest, highest + 1, BAND_PX, dtype=np.int16)
        first = np.ascontiguousarray(np.broadcast_to(starts, (height, width, len(starts))))
        is_step = np.zeros((height, width), bool)
        costs = _compare(left, right, is_step, first).reshape(height, width, -1)
        total = aggregate(costs, _COARSE_SMALL, jump_penalties(left, _COARSE_LARGE, 4))
        found = least_index(total).astype(np.float32) + np.float32(lowest)
    return cv2.medianBlur(found, 3)


def _compare(left: np.ndarray, right: np.ndarray, is_step: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Arguments and result as `band_costs`, of images (H, W, 3) uint8."""
    channels = [np.ascontiguousarray(image.transpose(0, 2, 1), np.int16) for image in (left, right)]
    order = [
        census(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), _HALF_CENSUS_PX, _HALF_CENSUS_PX).astype(np.uint32)
        for image in (left, right)
    ]
    reach = int(np.abs(first).max(initial=0)) + BAND_PX
    return band_costs(channels[0], channels[1], order[0], order[1], is_step, first, reach)


def _choose_bands(coarse: np.ndarray, size: tuple[int, int], lowest: int, highest: int) -> np.ndarray:
    """Around every disparity of the coarser level, and around that of the nearest other surface.

    coarse: (H / 2, W / 2) px of the full size;  size: (H, W);  lowest, highest: bounds, inclusive
    Returns (H, W, 2) int16 lowest disparity of the bands
    """
    window = np.ones((_SURFACE_REACH_PX, _SURFACE_REACH_PX), np.uint8)
    nearest, farthest = cv2.dilate(coarse, window), cv2.erode(coarse, window)
    other = np.where(nearest - coarse >= coarse - farthest, nearest, farthest)
    first = np.empty((*size, NUM_BANDS), np.int16)
    for band, middle in enumerate((coarse, other)):
        start = np.clip(np.rint(middle) - BAND_PX // 2, lowest, highest - BAND_PX + 1)
        first[..., band] = np.repeat(np.repeat(start, 2, axis=0), 2, axis=1)[: size[0], : size[1]]
    return first


def _halve(image: np.ndarray) -> np.ndarray:
    """The image at half the size; an odd side is made even by repeating the border."""
    height, width = image.shape[:2]
    even = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    return cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
