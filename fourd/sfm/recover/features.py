"""Features of pictures and their matches, by the method that the options name."""

import dataclasses

import numpy as np

from fourd.errors import InputError
from fourd.sfm.recover.learned import load_learned_features
from fourd.sfm.recover.options import RecoverOptions
from fourd.sfm.sparse import detect_features, match_descriptors

METHODS = ("sift", "aliked")
# Half of the detector's own, for pictures with few corners (less than a part of those allowed): the few
# that two distant cameras share decide whether the first model stands. Where there are many, weak ones
# make the poses a quarter worse.
_LEAST_CONTRAST = 0.02
_FEW_FEATURES = 0.25


@dataclasses.dataclass(frozen=True, eq=False)
class Features:
    """pixels: (N, 2) float64 px;  descriptors: (N, 128) float32"""

    pixels: np.ndarray
    descriptors: np.ndarray


def find_features(image: np.ndarray, options: RecoverOptions) -> Features:
    """At most `max_features` features of a (H, W, 3) uint8 RGB picture. Raises InputError without weights."""
    if options.features not in METHODS:
        raise InputError(
            f"expected recover features as one of {', '.join(METHODS)}, got {options.features!r}: set one"
        )
    if options.features == "aliked":
        networks = load_learned_features(options.learned_weights)
        return Features(*networks.detect(image, options.max_features))
    pixels, descriptors = detect_features(image, options.max_features)
    if len(pixels) < _FEW_FEATURES * options.max_features:
        pixels, descriptors = detect_features(image, options.max_features, _LEAST_CONTRAST)
    return Features(pixels, descriptors)


def match_features(
    a: Features,
    b: Features,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    options: RecoverOptions,
) -> np.ndarray:
    """(M, 2) int64 indices of features that match. sizes: (width, height) px of both pictures"""
    if options.features == "aliked":
        networks = load_learned_features(options.learned_weights)
        return networks.match((a.pixels, b.pixels), (a.descriptors, b.descriptors), sizes)
    return match_descriptors(a.descriptors, b.descriptors, options.match_ratio)
