"""Disparity of both images of a pair: resampled, matched both ways, checked one against the other."""

import dataclasses
import functools

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.matchers import Match, Matcher
from fourd.matchers.sgbm import SgbmMatcher, SgbmOptions
from fourd.matchers.subpixel import refine
from fourd.stereo.check import StereoOptions, check_direction, left_right_difference
from fourd.stereo.normalise import match_tones
from fourd.stereo.rectify import Rectification, sampling_maps
from fourd.stereo.rows import RowShift, measure_rows

MATCHERS = ("pyramid", "sgbm", "census", "psmnet", "network")
_INTERPOLATIONS = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "lanczos": cv2.INTER_LANCZOS4}

# Both sides of a pair whose cameras stand still have the same maps in every frame.
_cached_maps = functools.lru_cache(maxsize=2)(sampling_maps)


@dataclasses.dataclass(frozen=True, eq=False)
class PairDisparity:
    """Disparities of both images of a pair at one instant.

    left_disparity, right_disparity: (H, W) float32 px, x_left - x_right, NaN where invalid; the
    right one is indexed by pixels of the right image
    left_confidence, right_confidence: (H, W) float32 in 0..1, 0 where invalid; the noise of a
    disparity is sigma_px / confidence
    """

    rectification: Rectification
    left_disparity: np.ndarray
    right_disparity: np.ndarray
    left_confidence: np.ndarray
    right_confidence: np.ndarray
    sigma_px: float


def make_matcher(options: StereoOptions) -> Matcher:
    """The matcher that the options name. Raises InputError if there is none, or it lacks its weights."""
    # Only the matcher at work is imported: torch alone takes 2 seconds.
    if options.matcher == "sgbm":
        return SgbmMatcher(
            SgbmOptions(
                options.sgbm_mode,
                options.sgbm_block_size_px,
                options.sgbm_penalty_small,
                options.sgbm_penalty_large,
                options.sgbm_prefilter_cap,
                options.sgbm_uniqueness_percent,
            )
        )
    if options.matcher == "pyramid":
        from fourd.matchers.pyramid import PyramidMatcher

        return PyramidMatcher()
    if options.matcher == "census":
        from fourd.matchers.census import CensusMatcher

        return CensusMatcher()
    if options.matcher == "psmnet":
        from fourd.matchers.psmnet import PsmnetMatcher

        return PsmnetMatcher(options.network_file)
    if options.matcher == "network":
        from fourd.matchers.network import NetworkMatcher

        return NetworkMatcher(options.network_file)
    raise InputError(
        f"expected a matcher out of {', '.join(MATCHERS)}, got {options.matcher!r}: set stereo matcher"
    )


def match_right(
    matcher: Matcher, left: np.ndarray, right: np.ndarray, disparity_range: tuple[float, float]
) -> Match:
    """Disparity of the right image by a matcher that gives that of the left one.

    Mirrored, the right image is a left one, and x_left - x_right keeps its value.
    Arguments and result as `Matcher.match`, indexed by pixels of the right image.
    """
    mirrored = matcher.match(cv2.flip(right, 1), cv2.flip(left, 1), disparity_range)
    return Match(cv2.flip(mirrored.disparity, 1), cv2.flip(mirrored.confidence, 1))


def rectify_image(
    image: np.ndarray,
    rectification: Rectification,
    camera: Camera,
    side: str,
    interpolation: str,
    rows: RowShift | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Resample a source image once, lens and rotation together.

    image: (h, w, 3) uint8 of `camera`;  side: `left` or `right`;  rows: of `sampling_maps`
    Returns the rectified image (H, W, 3) uint8 and valid (H, W) bool
    Raises InputError for an unknown interpolation or an image that is not the camera's size
    """
    if interpolation not in _INTERPOLATIONS:
        raise InputError(
            f"expected an interpolation out of {', '.join(_INTERPOLATIONS)}, got {interpolation!r}: "
            "set stereo interpolation"
        )
    if (image.shape[1], image.shape[0]) != tuple(camera.size):
        raise InputError(
            f"expected a {side} image of {camera.size[0]}x{camera.size[1]} px as in the cameras file, got "
            f"{image.shape[1]}x{image.shape[0]}: calibrate at the size of the frames"
        )
    map_x, map_y, valid = _cached_maps(rectification, camera, side, rows)
    # Replicated borders keep false edges, and thus false matches, out of the search.
    rectified = cv2.remap(
        image, map_x, map_y, _INTERPOLATIONS[interpolation], borderMode=cv2.BORDER_REPLICATE
    )
    return rectified, valid


def find_row_shift(
    rectification: Rectification,
    cameras: tuple[Camera, Camera],
    images: tuple[np.ndarray, np.ndarray],
    options: StereoOptions,
) -> RowShift | None:
    """Vertical misalignment of a planar pair, None where it is not significant. Arguments as `match_pair`."""
    (left, left_valid), (right, right_valid) = (
        rectify_image(image, rectification, camera, side, options.interpolation)
        for image, camera, side in zip(images, cameras, ("left", "right"), strict=True)
    )
    return measure_rows(left, right, (left_valid, right_valid), rectification.disparity_range)


def match_pair(
    rectification: Rectification,
    cameras: tuple[Camera, Camera],
    images: tuple[np.ndarray, np.ndarray],
    matcher: Matcher,
    options: StereoOptions,
    rows: RowShift | None = None,
) -> PairDisparity:
    """Disparity of both images of a pair at one instant.

    cameras, images: left and right source views, (h, w, 3) uint8 RGB each of its camera's size
    rows: how far the right image lies off the rows, of `find_row_shift`
    Raises ValueError for a swept pair, whose rows do not correspond; InputError as `rectify_image`
    """
    if rectification.swept is not None:
        raise ValueError("expected a planar pair, got a swept one: use fourd.stereo.sweep.sweep_pair")
    left, left_valid = rectify_image(images[0], rectification, cameras[0], "left", options.interpolation)
    right, right_valid = rectify_image(
        images[1], rectification, cameras[1], "right", options.interpolation, rows
    )
    if options.match_tones:
        right = match_tones(right, right_valid, left, left_valid)
    from_left = matcher.match(left, right, rectification.disparity_range)
    from_right = match_right(matcher, left, right, rectification.disparity_range)
    if options.is_refined:
        greys = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in (left, right)]
        from_left = Match(refine(from_left.disparity, *greys, direction=-1), from_left.confidence)
        from_right = Match(refine(from_right.disparity, *greys[::-1], direction=1), from_right.confidence)
    to_right = left_right_difference(
        from_left.disparity, left_valid, from_right.disparity, right_valid, direction=-1
    )
    to_left = left_right_difference(
        from_right.disparity, right_valid, from_left.disparity, left_valid, direction=1
    )
    left_match = check_direction(from_left, left_valid, to_right, left, options)
    right_match = check_direction(from_right, right_valid, to_left, right, options)
    return PairDisparity(
        rectification,
        left_match.disparity,
        right_match.disparity,
        left_match.confidence,
        right_match.confidence,
        options.sigma_px,
    )
