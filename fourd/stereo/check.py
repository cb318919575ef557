"""The left-right check of disparities, and how far to trust what passes it.

The loops are compiled: in numpy their temporaries took a quarter as long as the matching.
"""

import dataclasses

import cv2
import numba
import numpy as np

from fourd.matchers import Match
from fourd.matchers.subpixel import PLANE_OFFSETS_PX, PLANE_REACH_PX, fit_planes

# Variance of a disparity in px^2, linear in what the match itself shows: left-right difference (px),
# spread (root mean square distance from the local plane, px) and share of unmatched neighbours.
# Most likely weights over two rendered events and nine real pairs with truth, errors cut at 2 px.
_LEFT_RIGHT_PX = 0.70
_SPREAD_PX = 1.44
_GAP_PX2 = 3.39
_MIN_SIGMA_PX = 0.15
"""No cue foretells smaller errors; that is confidence 1."""
_CUE_WINDOW_PX = 5
_MIN_CONFIDENCE = 0.1


@dataclasses.dataclass(frozen=True)
class StereoOptions:
    """How a rectified pair is matched, checked and trusted. Defaults are measured (benches/stereo.py)."""

    matcher: str = "pyramid"
    sgbm_mode: str = "3way"
    sgbm_block_size_px: int = 1
    sgbm_penalty_small: int = 8
    sgbm_penalty_large: int = 32
    sgbm_prefilter_cap: int = 15
    sgbm_uniqueness_percent: int = 5
    network_file: str = ""
    match_tones: bool = True
    align_rows: bool = True
    is_refined: bool = True
    interpolation: str = "cubic"
    max_left_right_px: float = 1.5
    support_px: int = 7
    min_support: float = 0.4
    sigma_px: float = 0.15


def left_right_difference(
    disparity: np.ndarray, valid: np.ndarray, other: np.ndarray, other_valid: np.ndarray, direction: int
) -> np.ndarray:
    """How far the match of the match lands from where it started.

    disparity, valid: (H, W) float32 px and bool of one image;  other, other_valid: of the other
    direction: -1 if the other image is the right one (x_right = x - disparity), +1 if the left
    Returns (H, W) float32 |difference of the two disparities| px, infinite where either has none
    """
    return _difference(disparity, valid, other, other_valid, direction)


def check_direction(
    match: Match, valid: np.ndarray, difference: np.ndarray, image: np.ndarray, options: StereoOptions
) -> Match:
    """Keep what passes the left-right check amid others that do, and say how far to trust it.

    match: of one image;  valid: (H, W) bool, inside the source;  image: (H, W, 3) uint8 rectified
    difference: (H, W) float32 from `left_right_difference`
    Returns a Match, NaN and 0 where rejected; noise of disparity is sigma_px / confidence
    """
    passed = (difference <= options.max_left_right_px).view(np.uint8)
    support = _window_sum(passed, options.support_px)
    support /= np.maximum(_window_sum(valid.view(np.uint8), options.support_px), np.float32(1))
    disparity = np.where(
        passed.view(bool) & (support >= options.min_support), match.disparity, np.float32(np.nan)
    )
    confidence = _confidence(match.confidence, disparity, difference, support, _spread_px2(disparity))
    return Match(disparity, confidence)


def _window_sum(array: np.ndarray, side: int) -> np.ndarray:
    """(H, W) float32 sums over square windows."""
    return cv2.boxFilter(array, cv2.CV_32F, (side, side), normalize=False)


def _spread_px2(disparity: np.ndarray) -> np.ndarray:
    """(H, W) float32 mean square distance of the disparities in a window from their local planes, px^2."""
    apart = fit_planes(disparity, PLANE_OFFSETS_PX, PLANE_REACH_PX) - disparity
    known = np.isfinite(apart)
    squares = _window_sum(np.where(known, apart, np.float32(0)) ** 2, _CUE_WINDOW_PX)
    return squares / np.maximum(_window_sum(known.view(np.uint8), _CUE_WINDOW_PX), np.float32(1))


@numba.njit(cache=True, nogil=True)
def _difference(
    disparity: np.ndarray, valid: np.ndarray, other: np.ndarray, other_valid: np.ndarray, direction: int
) -> np.ndarray:
    height, width = disparity.shape
    difference = np.full((height, width), np.float32(np.inf), np.float32)
    for y in range(height):
        for x in range(width):
            here = disparity[y, x]
            if not valid[y, x] or np.isnan(here):
                continue
            column = x + direction * int(np.rint(here))
            if 0 <= column < width and other_valid[y, column]:
                there = other[y, column]
                if not np.isnan(there):
                    difference[y, x] = abs(here - there)
    return difference


@numba.njit(cache=True, nogil=True)
def _confidence(
    own: np.ndarray,
    disparity: np.ndarray,
    difference: np.ndarray,
    support: np.ndarray,
    spread_px2: np.ndarray,
) -> np.ndarray:
    height, width = disparity.shape
    confidence = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            if np.isnan(disparity[y, x]):
                continue
            gap = min(max(1.0 - support[y, x], 0.0), 1.0)
            variance = (
                _LEFT_RIGHT_PX * difference[y, x]
                + _SPREAD_PX * np.sqrt(max(spread_px2[y, x], 0.0))
                + _GAP_PX2 * gap
            )
            sigma = max(np.sqrt(variance), _MIN_SIGMA_PX)
            confidence[y, x] = max(own[y, x] * _MIN_SIGMA_PX / sigma, _MIN_CONFIDENCE)
    return confidence
