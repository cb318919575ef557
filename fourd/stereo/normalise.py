"""Brings the tones of two unlike cameras together before they are compared.

Gain, gamma, white balance and tone curve act on grey levels alone, so that equal shares of both images
lie below corresponding levels. Different content moves these shares too: a small difference of the
distributions is no proof of unlike cameras and is left alone (measured: correcting it costs matches).
"""

import numpy as np

_QUANTILES = np.linspace(0.005, 0.995, 33)
_MIN_DIFFERENCE = 12.5
"""Grey levels, mean over quantiles and channels. Pairs of one camera stay below 12 for their content
alone; a gain of 0.9 makes 14 and costs a tenth of the matches."""


def match_tones(
    image: np.ndarray, valid: np.ndarray, reference: np.ndarray, reference_valid: np.ndarray
) -> np.ndarray:
    """The image with the tones of the reference, or as it is where they hardly differ.

    image, reference: (H, W, 3) uint8;  valid, reference_valid: (H, W) bool, pixels that count
    Returns (H, W, 3) uint8: each channel through a monotone curve that brings its quantiles to those of
    the reference
    """
    if not valid.any() or not reference_valid.any():
        return image
    # Every third row and column says the same in a ninth of the time.
    thin = (slice(None, None, 3), slice(None, None, 3))
    ours, theirs = image[thin][valid[thin]], reference[thin][reference_valid[thin]]
    if ours.size == 0 or theirs.size == 0:
        return image
    here, there = (np.quantile(levels, _QUANTILES, axis=0) for levels in (ours, theirs))
    if np.abs(here - there).mean() <= _MIN_DIFFERENCE:
        return image
    # Equal quantiles, as of a clipped channel, would leave the curve without a slope.
    here += 1e-3 * np.arange(len(_QUANTILES))[:, None]
    curves = [np.interp(np.arange(256), here[:, c], there[:, c]) for c in range(image.shape[2])]
    return np.stack(
        [np.rint(curve).astype(np.uint8)[image[..., c]] for c, curve in enumerate(curves)], axis=-1
    )
