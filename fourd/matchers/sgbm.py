"""Semi-global block matching, OpenCV's StereoSGBM: the fastest where disparities are few.

Source: H. Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information",
PAMI 2008; the cost is that of S. Birchfield and C. Tomasi, "A Pixel Dissimilarity Measure That Is
Insensitive to Image Sampling", PAMI 1998.
"""

import dataclasses
import math

import cv2
import numpy as np

from fourd.errors import InputError
from fourd.matchers import Match

_MODES = {
    "3way": cv2.StereoSGBM_MODE_SGBM_3WAY,
    "sgbm": cv2.StereoSGBM_MODE_SGBM,
    "hh4": cv2.StereoSGBM_MODE_HH4,
    "hh": cv2.StereoSGBM_MODE_HH,
}
_FIXED_POINT = 16
"""StereoSGBM returns disparities in units of 1/16 px."""
_PARABOLIC = np.arange(-_FIXED_POINT // 2, _FIXED_POINT // 2 + 1, dtype=np.float32) / _FIXED_POINT
_EQUIANGULAR = 2 * _PARABOLIC / (1 + 2 * np.abs(_PARABOLIC))
"""Costs are absolute differences, whose minimum is a V: where StereoSGBM fits a parabola through three
of them, two lines meet at the true place, and one follows from the other."""
_MULTIPLE = 16
"""StereoSGBM takes numbers of disparities that are multiples of 16."""


@dataclasses.dataclass(frozen=True)
class SgbmOptions:
    """Settings of StereoSGBM; penalties are per channel and pixel of the block.

    mode: paths of the aggregation: `3way`, `sgbm` (5), `hh4` (4, two passes), `hh` (8, two passes)
    block_size_px: odd side of the block that is compared
    penalty_small, penalty_large: for a disparity step of 1 px, and of more, between neighbours
    prefilter_cap: bound of the horizontal gradient that is compared beside the colours
    uniqueness_percent: by how much the best cost must be below any other
    """

    mode: str = "3way"
    block_size_px: int = 1
    penalty_small: int = 8
    penalty_large: int = 32
    prefilter_cap: int = 15
    uniqueness_percent: int = 5


class SgbmMatcher:
    """StereoSGBM for any range of disparities, negative ones included, on all columns."""

    def __init__(self, options: SgbmOptions) -> None:
        if options.mode not in _MODES:
            raise InputError(
                f"expected an SGBM mode out of {', '.join(_MODES)}, got {options.mode!r}: "
                "set stereo sgbm_mode"
            )
        if options.block_size_px < 1 or options.block_size_px % 2 == 0:
            raise InputError(
                f"expected an odd SGBM block size, got {options.block_size_px}: set stereo sgbm_block_size_px"
            )
        if not 0 < options.penalty_small < options.penalty_large:
            raise InputError(
                f"expected SGBM penalties 0 < small < large, got {options.penalty_small} and "
                f"{options.penalty_large}: set stereo sgbm_penalty_small and sgbm_penalty_large"
            )
        self._options = options

    def match(self, left: np.ndarray, right: np.ndarray, disparity_range: tuple[float, float]) -> Match:
        """See `Matcher.match`."""
        # One more at both ends: the fit between whole disparities needs neighbours.
        lowest, highest = math.floor(disparity_range[0]) - 1, math.ceil(disparity_range[1]) + 1
        count = _MULTIPLE * math.ceil((highest - lowest + 1) / _MULTIPLE)
        # StereoSGBM leaves out columns whose range does not lie wholly inside the right image.
        before, after = max(lowest + count, 0), max(-lowest, 0)
        padded_left, padded_right = (
            cv2.copyMakeBorder(image, 0, 0, before, after, cv2.BORDER_REPLICATE) for image in (left, right)
        )
        channels = 1 if left.ndim == 2 else left.shape[2]
        options = self._options
        area = channels * options.block_size_px**2
        sgbm = cv2.StereoSGBM.create(
            minDisparity=lowest,
            numDisparities=count,
            blockSize=options.block_size_px,
            P1=options.penalty_small * area,
            P2=options.penalty_large * area,
            disp12MaxDiff=-1,
            preFilterCap=options.prefilter_cap,
            uniquenessRatio=options.uniqueness_percent,
            mode=_MODES[options.mode],
        )
        fixed = sgbm.compute(padded_left, padded_right)[:, before : before + left.shape[1]]
        first = (lowest - 1) * _FIXED_POINT
        # One below the lowest means not found; above the highest is only there to fill the multiple.
        levels = _disparity_levels(first, (lowest + count) * _FIXED_POINT)
        levels[:_FIXED_POINT] = np.nan
        levels[highest * _FIXED_POINT - first + 1 :] = np.nan
        disparity = levels[fixed.astype(np.intp) - first]
        return Match(disparity, np.isfinite(disparity).astype(np.float32))


def _disparity_levels(first: int, last: int) -> np.ndarray:
    """(N,) float32 px of every value that StereoSGBM may give, first to last inclusive."""
    fixed = np.arange(first, last + 1)
    half = _FIXED_POINT // 2
    whole = (fixed + half) // _FIXED_POINT
    return whole.astype(np.float32) + _EQUIANGULAR[fixed - whole * _FIXED_POINT + half]
