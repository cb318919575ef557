"""What colours a thing has, against those of everything else: a histogram of the frame that was marked."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.ndimage import gaussian_filter

_BINS = 16
# Blur of the histograms, bins: light and noise shift colours by about as much.
_BLUR = 1.0
# Pixels that a colour must have had to count at all.
_PRIOR = 2.0


@dataclasses.dataclass(frozen=True, eq=False)
class Colours:
    """How much more often the thing has a colour than everything else: (16, 16, 16) float32 in -1..1."""

    belief: np.ndarray

    def of(self, rgb: np.ndarray) -> np.ndarray:
        """(...,) float32 belief of (..., 3) uint8 colours."""
        at = rgb.astype(np.int64) * _BINS // 256
        return self.belief[at[..., 0], at[..., 1], at[..., 2]]


def learn_colours(
    images: Mapping[str, np.ndarray], masks: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> Colours:
    """Colours of a thing.

    images: camera -> (H, W, 3) uint8;  masks: camera -> (H, W) bool of the thing, and of what it is not
    """
    histograms = []
    for which in (0, 1):
        counts = np.zeros((_BINS,) * 3)
        for name, pair in masks.items():
            at = images[name][pair[which]].astype(np.int64) * _BINS // 256
            np.add.at(counts, (at[:, 0], at[:, 1], at[:, 2]), 1.0)
        histograms.append(gaussian_filter(counts, _BLUR, mode="nearest"))
    ours, theirs = histograms
    # As shares, so that a small thing is not outvoted by a large one.
    ours, theirs = (h / max(float(h.sum()), 1.0) for h in (ours, theirs))
    total = float(sum(pair[0].sum() + pair[1].sum() for pair in masks.values()))
    belief = (ours - theirs) / (ours + theirs + _PRIOR / max(total, 1.0))
    return Colours(belief.astype(np.float32))
