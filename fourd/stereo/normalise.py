"""Brings the tones of two unlike cameras together before they are compared.

Gain, gamma, white balance and tone curve act on grey levels alone, so that equal shares of both images
lie below corresponding levels. Different content moves these shares too: a small difference of the
distributions is no proof of unlike cameras and is left alone (measured: correcting it costs matches).
"""

import numpy as np

_QUANTILES = np.linspace(0.005, 0.995, 33)
_THIN = (slice(None, None, 3), slice(None, None, 3))
"""Every third row and column says the same in a ninth of the time."""
_CLIPPED = (2, 253)
"""Levels outside are cut off: how many pixels lie there tells nothing of the curve between."""
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
    here, there = _quantiles(image, valid), _quantiles(reference, reference_valid)
    if here is None or there is None:
        return image
    if np.abs(here - there).mean() <= _MIN_DIFFERENCE:
        return image
    # Equal quantiles, as of a clipped channel, would leave the curve without a slope.
    here += 1e-3 * np.arange(len(_QUANTILES))[:, None]
    curves = [np.interp(np.arange(256), here[:, c], there[:, c]) for c in range(image.shape[2])]
    return np.stack(
        [np.rint(curve).astype(np.uint8)[image[..., c]] for c, curve in enumerate(curves)], axis=-1
    )


def _quantiles(image: np.ndarray, valid: np.ndarray) -> np.ndarray | None:
    """(Q, 3) float64 levels below which those shares of the pixels lie, of what is not clipped, if any."""
    image, valid = image[_THIN], valid[_THIN]
    low, high = _CLIPPED
    levels = image[valid & (image.min(axis=2) >= low) & (image.max(axis=2) <= high)]
    if levels.size == 0:
        return None
    ranks = np.rint(_QUANTILES * (len(levels) - 1)).astype(np.intp)
    # Counting the 256 levels is faster than sorting the pixels.
    counts = [np.cumsum(np.bincount(channel, minlength=256)) for channel in levels.T]
    return np.stack([np.searchsorted(count, ranks, side="right") for count in counts], axis=1).astype(float)
