"""Stereo matchers behind one interface; each method is one small adapter in this package."""

import dataclasses
from typing import Protocol

import numpy as np


@dataclasses.dataclass(frozen=True, eq=False)
class Match:
    """What a matcher found for every pixel of the left image.

    disparity: (H, W) float32, x_left - x_right in px, NaN where nothing was found
    confidence: (H, W) float32 in 0..1, the matcher's own opinion, 0 where nothing was found;
    a method that has none says 1
    """

    disparity: np.ndarray
    confidence: np.ndarray


class Matcher(Protocol):
    """Finds the disparity of the left image of a rectified pair."""

    def match(self, left: np.ndarray, right: np.ndarray, disparity_range: tuple[float, float]) -> Match:
        """Match two images (H, W, 3) uint8 RGB of one size whose rows correspond.

        disparity_range: lowest and highest x_left - x_right to look for, px; any sign
        Returns a Match of shape (H, W). Matches may point outside the right image: the caller,
        who knows which pixels are real, rejects those.
        """
        ...
