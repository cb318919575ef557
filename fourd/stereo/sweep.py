"""Depth of both images of a pair by plane sweep, where no common plane can hold them.

The other picture is laid on planes of rising inverse depth and compared with the reference picture;
costs are aggregated as in semi-global matching, and what is found is refined with windows that lie on
the surface. What one side finds has to lead back from the other. Memory is 3 bytes per pixel and plane.

Source: D. Gallup et al., "Real-Time Plane-Sweeping Stereo with Multiple Sweeping Directions", CVPR
2007; H. Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI 2008.
"""

import dataclasses

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.matchers import Match
from fourd.matchers.semi_global import aggregate, best_hypothesis
from fourd.stereo.check import StereoOptions, check_direction
from fourd.stereo.disparity import PairDisparity, rectify_image
from fourd.stereo.rectification import Rectification
from fourd.stereo.sweep_frame import plane_motion
from fourd.stereo.sweep_kernels import (
    fit_planes,
    refine_on_planes,
    reproject,
    warp_by_plane,
)
from fourd.stereo.volume import field_of_view

_WINDOW_PX = 5
_WINDOW_SIGMA_PX = 1.2
_COST_LEVELS = 60
"""Costs of a perfect match and of an unlike one are 0 and this, so that the sum of 8 paths fits 16 bits."""
_REFINE_WINDOW_PX = 7
_REFINE_SIGMA_PX = 2.0
_REFINE_STEP = 0.75
"""Between trials, in steps of the sweep: about the width of a correlation's peak, for the parabola."""
_PENALTY_SMALL = 3
_PENALTY_LARGE = 40
_NOISE_VARIANCE = 4.0
"""Grey levels squared: a window that varies less is noise, and its correlation means nothing."""
_MAX_PLANES = 256
SWEEP_SIGMA_PX = 0.3
"""Noise of a swept disparity at confidence 1. Most pixels move less than the unit tells, hence have more."""
_MIN_CONFIDENCE = 0.1


@dataclasses.dataclass(frozen=True, eq=False)
class _Side:
    """One side: its ideal pinhole, its picture there, and what its maps are measured in."""

    pinhole: Camera
    image: np.ndarray
    valid: np.ndarray
    disparity_range: tuple[float, float]
    inverse_depth_per_px: float


def sweep_pair(
    rectification: Rectification,
    cameras: tuple[Camera, Camera],
    images: tuple[np.ndarray, np.ndarray],
    options: StereoOptions,
) -> PairDisparity:
    """Disparity of both images of a swept pair at one instant.

    cameras, images: left and right source views, (h, w, 3) uint8 RGB each of its camera's size
    Raises InputError as `fourd.stereo.disparity.rectify_image`
    """
    swept = rectification.swept
    if swept is None:
        raise ValueError("expected a swept pair, got a planar one: match its rows")
    ranges = rectification.disparity_range, swept.disparity_range_right
    sides = []
    for i, side in enumerate(("left", "right")):
        image, valid = rectify_image(images[i], rectification, cameras[i], side, options.interpolation)
        sides.append(
            _Side(rectification.camera(side), image, valid, ranges[i], swept.inverse_depth_per_px[i])
        )
    found = [_sweep_side(side, cameras[1 - i], images[1 - i]) for i, side in enumerate(sides)]
    left, right = (_check_side(sides[i], found[i], sides[1 - i], found[1 - i], options) for i in range(2))
    return PairDisparity(
        rectification, left.disparity, right.disparity, left.confidence, right.confidence, SWEEP_SIGMA_PX
    )


def _sweep_side(side: _Side, other: Camera, other_image: np.ndarray) -> Match:
    """Disparity of one side, NaN where no plane inside the range is the best, and its correlation.

    other, other_image: the other source camera, and its picture (h, w, 3) uint8
    """
    # One more at both ends: the fit between planes needs neighbours.
    low, high = side.disparity_range
    step = max(1.0, (high - low) / (_MAX_PLANES - 3))
    planes = np.arange(-1, int(np.ceil((high - low) / step)) + 2) * step + low
    reference, picture = _centered_grey(side.image), _centered_grey(other_image)
    A, b = plane_motion(side.pinhole, other)
    lens, bounds = lens_of(other)
    cost = np.empty((*reference.shape, len(planes)), np.uint8)
    warped = np.empty_like(reference)
    moments = _window_moments(reference)
    for i, plane in enumerate(planes * side.inverse_depth_per_px):
        warp_by_plane(picture, A, b, plane, lens, bounds, warped)
        cost[:, :, i] = _unlikeness(reference, moments, warped)
    index = best_hypothesis(aggregate(cost, _PENALTY_SMALL, _PENALTY_LARGE))
    disparity = (index * step + planes[0]).astype(np.float32)
    disparity[~side.valid] = np.nan
    weights = cv2.getGaussianKernel(_REFINE_WINDOW_PX, _REFINE_SIGMA_PX)
    disparity, correlation = refine_on_planes(
        disparity, fit_planes(disparity), side.inverse_depth_per_px, _REFINE_STEP * step,
        reference, picture, A, b, lens, bounds, weights @ weights.T, _NOISE_VARIANCE,
    )  # fmt: skip
    disparity[(disparity < low - step) | (disparity > high + step)] = np.nan
    return Match(disparity, correlation)


def lens_of(camera: Camera) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Lens and bounds of a source camera, as the compiled loops take them."""
    K = camera.K
    lens = (K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2], *camera.distortion)
    return tuple(map(float, lens)), tuple(map(float, field_of_view(camera).ravel()))


def _centered_grey(image: np.ndarray) -> np.ndarray:
    """(H, W) float32 grey about 0, so that sums of squares keep their precision."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) - 128


def _unlikeness(
    reference: np.ndarray, moments: tuple[np.ndarray, np.ndarray], warped: np.ndarray
) -> np.ndarray:
    """(H, W) float32 cost: 1 minus the zero-mean normalised correlation, none where `warped` is NaN."""
    outside = np.isnan(warped)
    warped[outside] = 0
    mean, deviation = moments
    other_mean, other_deviation = _window_moments(warped)
    covariance = _window_mean(reference * warped) - mean * other_mean
    unlike = np.clip(1 - covariance / (deviation * other_deviation), 0, 1)
    unlike[outside] = 1
    return np.rint(unlike * np.float32(_COST_LEVELS))


def _window_mean(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (_WINDOW_PX, _WINDOW_PX), _WINDOW_SIGMA_PX)


def _window_moments(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation in a window, the latter with the camera's noise added."""
    mean = _window_mean(image)
    variance = np.maximum(_window_mean(image * image) - mean * mean, 0)
    return mean, np.sqrt(variance + np.float32(_NOISE_VARIANCE))


def _check_side(side: _Side, match: Match, other: _Side, other_match: Match, options: StereoOptions) -> Match:
    """Keep what leads back from the other side; trust it less where the other image moves less."""
    missed, motion = reproject(
        match.disparity * np.float32(side.inverse_depth_per_px),
        other_match.disparity * np.float32(other.inverse_depth_per_px),
        *_pixel_motion(side.pinhole, other.pinhole),
        *_pixel_motion(other.pinhole, side.pinhole),
    )
    sharpness = np.minimum(motion * np.float32(side.inverse_depth_per_px), np.float32(1))
    kept = check_direction(match, side.valid, missed, side.image, options)
    confidence = np.minimum(kept.confidence * sharpness * np.float32(SWEEP_SIGMA_PX / options.sigma_px), 1)
    # The check gives its lowest confidence to all whose error it cannot bound.
    certain = (confidence >= _MIN_CONFIDENCE) & (kept.confidence > _MIN_CONFIDENCE)
    return Match(
        np.where(certain, kept.disparity, np.float32(np.nan)), np.where(certain, confidence, np.float32(0))
    )


def _pixel_motion(camera: Camera, other: Camera) -> tuple[np.ndarray, np.ndarray]:
    """As `plane_motion`, on to the pixels of an ideal pinhole."""
    A, b = plane_motion(camera, other)
    return other.K @ A, other.K @ b
