"""The left-right check of disparities, and how far to trust what passes it.

The loops are compiled: in numpy their temporaries took a quarter as long as the matching.
"""

import dataclasses

import cv2
import numba
import numpy as np

from fourd.matchers import Match

# Variance of a disparity in units of sigma_px^2, one term per cue: 1, left-right difference (px),
# roughness (mean step between neighbours, px), share of unmatched neighbours, and lack of
# texture. Least squares on rendered footage with exact depth, pairs 13 to 45 degrees apart,
# errors cut at 2 px.
_LEFT_RIGHT_WEIGHT = 2.5
_ROUGHNESS_WEIGHT = 2.8
_GAP_WEIGHT = 8.3
_FLATNESS_WEIGHT = 5.0
_CUE_WINDOW_PX = 5
_MAX_STEP_PX = np.float32(2)
_MIN_CONFIDENCE = 0.1


@dataclasses.dataclass(frozen=True)
class StereoOptions:
    """How a rectified pair is matched, checked and trusted. Defaults are measured (benches/stereo.py)."""

    matcher: str = "sgbm"
    sgbm_mode: str = "3way"
    sgbm_block_size_px: int = 1
    sgbm_penalty_small: int = 8
    sgbm_penalty_large: int = 32
    sgbm_prefilter_cap: int = 15
    sgbm_uniqueness_percent: int = 5
    interpolation: str = "cubic"
    max_left_right_px: float = 1.5
    support_px: int = 7
    min_support: float = 0.4
    sigma_px: float = 0.3


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
    disparity, steps, num_steps = _supported_steps(
        match.disparity, passed, support, np.float32(options.min_support)
    )
    confidence = _confidence(
        match.confidence,
        disparity,
        difference,
        support,
        _window_sum(steps, _CUE_WINDOW_PX),
        _window_sum(num_steps, _CUE_WINDOW_PX),
        _gradient_energy(image),
    )
    return Match(disparity, confidence)


def _window_sum(array: np.ndarray, side: int) -> np.ndarray:
    """(H, W) float32 sums over square windows."""
    return cv2.boxFilter(array, cv2.CV_32F, (side, side), normalize=False)


def _gradient_energy(image: np.ndarray) -> np.ndarray:
    """(H, W) float32 mean square of the horizontal gradient in a window, (grey levels per px)^2."""
    gradient = cv2.Sobel(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
    return cv2.sqrBoxFilter(gradient, cv2.CV_32F, (_CUE_WINDOW_PX, _CUE_WINDOW_PX))


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
def _supported_steps(
    disparity: np.ndarray, passed: np.ndarray, support: np.ndarray, min_support: np.float32
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Disparities with support, else NaN; sum and count of steps to the right and lower neighbour."""
    height, width = disparity.shape
    kept = np.full((height, width), np.float32(np.nan), np.float32)
    steps = np.zeros((height, width), np.float32)
    num_steps = np.zeros((height, width), np.uint8)
    # Upwards and leftwards, so that both neighbours are decided before they are looked at.
    for y in range(height - 1, -1, -1):
        for x in range(width - 1, -1, -1):
            if not passed[y, x] or support[y, x] < min_support:
                continue
            here = disparity[y, x]
            kept[y, x] = here
            if x + 1 < width and not np.isnan(kept[y, x + 1]):
                steps[y, x] += min(abs(kept[y, x + 1] - here), _MAX_STEP_PX)
                num_steps[y, x] += 1
            if y + 1 < height and not np.isnan(kept[y + 1, x]):
                steps[y, x] += min(abs(kept[y + 1, x] - here), _MAX_STEP_PX)
                num_steps[y, x] += 1
    return kept, steps, num_steps


@numba.njit(cache=True, nogil=True)
def _confidence(
    own: np.ndarray,
    disparity: np.ndarray,
    difference: np.ndarray,
    support: np.ndarray,
    steps: np.ndarray,
    num_steps: np.ndarray,
    gradient_energy: np.ndarray,
) -> np.ndarray:
    height, width = disparity.shape
    confidence = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            if np.isnan(disparity[y, x]):
                continue
            roughness = steps[y, x] / max(num_steps[y, x], 1.0)
            gap = min(max(1.0 - support[y, x], 0.0), 1.0)
            flatness = 1 / (1 + np.sqrt(max(gradient_energy[y, x], 0.0)))
            variance = (
                1.0
                + (_LEFT_RIGHT_WEIGHT * difference[y, x]) ** 2
                + (_ROUGHNESS_WEIGHT * roughness) ** 2
                + (_GAP_WEIGHT * gap) ** 2
                + (_FLATNESS_WEIGHT * flatness) ** 2
            )
            confidence[y, x] = min(max(own[y, x] / np.sqrt(variance), _MIN_CONFIDENCE), 1.0)
    return confidence
