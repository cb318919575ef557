"""What moves in a picture: its difference to the plate, weighed with the plate's own noise."""

from collections.abc import Sequence

import cv2
import numpy as np

from fourd.silhouettes.options import BACKGROUND, MOVING, UNKNOWN, SilhouetteOptions
from fourd.silhouettes.plate import NOISE_FLOOR, Plate, without_motion

# Rounds in which the gain of a picture is fitted to what agrees with the plate.
GAIN_ROUNDS = 4
# Share of the pixels that keep the best agreement while the gain is found: what moves fills less.
GAIN_KEEP = 0.5
# Levels that say nothing of a gain: clipped or lost in noise.
DARKEST, BRIGHTEST = 16, 240
# Share of the samples in which something passes; above which it may be in the plate itself.
MIN_UNREST, MOSTLY_UNREST = 0.1, 0.25
GRABCUT_ROUNDS = 4
# A rectangle that is not read where a mask is given.
WHOLE = (0, 0, 1, 1)


def fit_gain(image: np.ndarray, plate: Plate) -> np.ndarray:
    """(3,) factors that bring the plate to the brightness and white of a picture.

    image: (H, W, 3) uint8
    The median ratio of known, well exposed pixels, then of the half that agrees best: what moves, or
    what a lamp brightens, does not count. Ones where there is nothing to compare.
    """
    rgb = image.astype(np.float32)
    usable = plate.known & (plate.rgb > DARKEST).all(axis=-1)
    usable &= ((rgb > DARKEST / 2) & (rgb < BRIGHTEST)).all(axis=-1)
    if not usable.any():
        return np.ones(3, np.float32)
    picture, background = rgb[usable], plate.rgb[usable]
    gain = np.median(picture / background, axis=0)
    for _ in range(GAIN_ROUNDS):
        error = np.abs(picture - gain * background).sum(axis=-1)
        agrees = error <= np.quantile(error, GAIN_KEEP)
        gain = np.median(picture[agrees] / background[agrees], axis=0)
    return gain.astype(np.float32)


def segment(image: np.ndarray, plate: Plate, options: SilhouetteOptions) -> np.ndarray:
    """What moves in a picture.

    image: (H, W, 3) uint8;  plate: of the same view
    Returns (H, W) uint8, 255 moving, 0 background, 128 unknown. A shadow is background: every channel
    is darker by about the same factor, and what remains of the difference is noise.
    """
    clean = clean_mask(find_differences(image, plate, options), options.min_area_share)
    mask = np.where(clean, MOVING, BACKGROUND).astype(np.uint8)
    mask[clean_mask(~plate.known, options.min_area_share)] = UNKNOWN
    return mask if plate.unrest is None else resolve_unknown(image, mask, plate.unrest, options)


def find_differences(image: np.ndarray, plate: Plate, options: SilhouetteOptions) -> np.ndarray:
    """(H, W) bool where a picture differs from the plate by more than noise, gain and shadow."""
    rgb = image.astype(np.float32)
    gain = fit_gain(image, plate)
    # A light that clips in the plate clips in the picture as well.
    background = np.minimum(plate.rgb * gain, 255)
    sigma = np.maximum(plate.sigma * gain, NOISE_FLOOR)
    differs = _mean_squares((rgb - background) / sigma, options.threshold) > options.threshold**2
    return differs & ~_is_shadow(rgb, background, sigma, options)


def find_unrest(images: Sequence[np.ndarray], plate: Plate, options: SilhouetteOptions) -> np.ndarray:
    """(H, W) float32 share of the pictures that differ from the plate; 1 where it is not known."""
    quiet = without_motion(plate, options.jitter_px)
    share = np.mean([find_differences(image, quiet, options) for image in images], axis=0)
    return np.where(plate.known, share, 1).astype(np.float32)


def resolve_unknown(
    image: np.ndarray, mask: np.ndarray, unrest: np.ndarray, options: SilhouetteOptions
) -> np.ndarray:
    """What moves, where somebody who hardly leaves the place has spoilt the plate.

    mask: (H, W) uint8 of `segment`;  unrest: of the plate
    Places where much changes over time probably move, their surroundings probably do not; colours of what
    surely moves and of what surely stands still decide, with edges of the picture (C. Rother et al.,
    GrabCut, 2004). The mask comes back as it is if nothing is unknown or nothing surely moves.
    """
    swept = clean_mask(unrest > MIN_UNREST, options.min_area_share)
    if not ((mask == UNKNOWN) & swept).any() or not (mask == MOVING).any():
        return mask
    around = cv2.dilate(swept.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    labels = np.full(mask.shape, cv2.GC_BGD, np.uint8)
    labels[around] = cv2.GC_PR_BGD
    labels[swept & ((mask == UNKNOWN) | (unrest > MOSTLY_UNREST))] = cv2.GC_PR_FGD
    # Where the plate itself shows somebody, what differs may be the background.
    labels[(mask == MOVING) & (unrest <= MOSTLY_UNREST)] = cv2.GC_FGD
    # Its first guess of colours is random.
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(image), labels, WHOLE, *models, GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    moving = clean_mask((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD), options.min_area_share)
    return np.where(around | (mask == MOVING), np.where(moving, MOVING, BACKGROUND), mask).astype(np.uint8)


def _mean_squares(errors: np.ndarray, threshold: float) -> np.ndarray:
    """(H, W) mean square over channels and 3 x 3 pixels, so that noise of single pixels cancels.

    errors: (H, W, 3) in standard deviations. Cut at twice the threshold: what is very different would
    grow by a pixel.
    """
    squares = np.minimum((errors**2).mean(axis=-1), 4 * threshold**2)
    return cv2.GaussianBlur(squares, (3, 3), 0.6)


def _is_shadow(
    rgb: np.ndarray, background: np.ndarray, sigma: np.ndarray, options: SilhouetteOptions
) -> np.ndarray:
    """(H, W) bool: the plate, darker by one factor for all channels."""
    weight = 1 / sigma**2
    factor = (weight * rgb * background).sum(axis=-1) / np.maximum(
        (weight * background**2).sum(axis=-1), 1e-6
    )
    rest = (rgb - factor[..., None] * background) / sigma
    dark = (factor >= options.shadow_strength) & (factor < 1)
    return dark & (_mean_squares(rest, options.threshold) <= options.threshold**2)


def clean_mask(mask: np.ndarray, min_area_share: float) -> np.ndarray:
    """(H, W) bool without specks and gaps smaller than a share of the picture."""
    smallest = max(1, round(min_area_share * mask.size))
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(bool)
    return ~_without_small(~_without_small(opened, smallest), smallest)


def _without_small(mask: np.ndarray, smallest: int) -> np.ndarray:
    """The connected parts of a mask with at least `smallest` pixels."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    keep = stats[:, cv2.CC_STAT_AREA] >= smallest
    keep[0] = False
    return keep[np.asarray(labels, np.int64)]
