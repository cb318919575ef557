import cv2
import numpy as np
import pytest

from fourd.matchers.sgbm import SgbmMatcher, SgbmOptions
from fourd.matchers.subpixel import PLANE_OFFSETS_PX, PLANE_REACH_PX, fit_planes, refine
from fourd.stereo.normalise import match_tones


def slanted_pair(start, slope, height=80, width=240):
    """Images of a plane: disparity start + slope * x in the left image, and that disparity."""
    noise = np.random.default_rng(2).uniform(0, 255, (height, width + 80, 3)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 1.5) * 4 - 380
    y, x = np.mgrid[:height, :width].astype(np.float32)
    right = np.clip(cv2.remap(texture, x, y, cv2.INTER_CUBIC), 0, 255).astype(np.uint8)
    disparity = start + slope * x
    left = np.clip(cv2.remap(texture, x - disparity, y, cv2.INTER_LANCZOS4), 0, 255).astype(np.uint8)
    return left, right, disparity


def grey(image):
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)


def test_points_of_a_plane_stay_and_holes_stay_holes():
    y, x = np.mgrid[:30, :40].astype(np.float32)
    plane = 3 + 0.15 * x - 0.1 * y
    plane[10:13, 5:9] = np.nan
    fitted = fit_planes(plane, PLANE_OFFSETS_PX, PLANE_REACH_PX)
    np.testing.assert_array_equal(np.isnan(fitted), np.isnan(plane))
    # The spread added for stability flattens a slope at the border a little.
    assert np.nanmax(np.abs(fitted - plane)) < 0.02


def test_a_step_between_surfaces_is_not_smoothed():
    step = np.where(np.arange(40) < 20, 5, 9).astype(np.float32) * np.ones((30, 1), np.float32)
    np.testing.assert_array_equal(fit_planes(step, PLANE_OFFSETS_PX, PLANE_REACH_PX), step)


def test_lonely_pixels_are_left_alone():
    lonely = np.full((20, 20), np.nan, np.float32)
    lonely[10, 10:13] = [1.0, 1.4, 1.2]
    np.testing.assert_array_equal(fit_planes(lonely, PLANE_OFFSETS_PX, PLANE_REACH_PX), lonely)


@pytest.mark.parametrize("slope", [0.0, 0.02, 0.08])
@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 0.8])
def test_refinement_is_nearer_to_the_truth_and_without_bias(slope, fraction):
    left, right, truth = slanted_pair(4 + fraction, slope)
    found = SgbmMatcher(SgbmOptions()).match(left, right, (0, 28)).disparity
    refined = refine(found, grey(left), grey(right), direction=-1)
    np.testing.assert_array_equal(np.isnan(refined), np.isnan(found))
    inner = np.isfinite(found) & (np.arange(truth.shape[1]) > 32)
    error = (refined - truth)[inner]
    assert np.median(np.abs(error)) < 0.06
    assert abs(np.median(error)) < 0.04
    before = np.median(np.abs((found - truth)[inner]))
    assert np.median(np.abs(error)) <= before + 0.01


def test_refinement_of_the_right_image_mirrors_that_of_the_left():
    left, right, _ = slanted_pair(5.3, 0.03)
    found = SgbmMatcher(SgbmOptions()).match(left, right, (0, 20)).disparity
    straight = refine(found, grey(left), grey(right), direction=-1)
    flipped = [np.ascontiguousarray(a[:, ::-1]) for a in (found, grey(left), grey(right))]
    mirrored = refine(flipped[0], flipped[1], flipped[2], direction=1)[:, ::-1]
    np.testing.assert_allclose(mirrored, straight, atol=2e-3)


def test_a_blown_out_half_does_not_bend_the_tones_of_the_other():
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(20, 230, (120, 160, 3)).astype(np.uint8), (0, 0), 0.6)
    everywhere = np.ones(image.shape[:2], bool)
    blown = image.copy()
    blown[:, :80] = 255
    np.testing.assert_array_equal(match_tones(image, everywhere, blown, everywhere), image)
    np.testing.assert_array_equal(match_tones(blown, everywhere, image, everywhere), blown)


def test_tones_of_unlike_cameras_are_brought_together():
    rng = np.random.default_rng(0)
    reference = cv2.GaussianBlur(rng.integers(0, 256, (120, 160, 3)).astype(np.uint8), (0, 0), 0.6)
    everywhere = np.ones(reference.shape[:2], bool)
    unlike = np.rint(255 * (reference / 255.0) ** 1.3 * 0.75).astype(np.uint8)
    matched = match_tones(unlike, everywhere, reference, everywhere)
    apart = np.abs(matched.astype(int) - reference)
    assert matched.dtype == np.uint8 and np.median(apart) <= 2
    assert apart.mean() < 0.1 * np.abs(unlike.astype(int) - reference).mean()


def test_like_cameras_and_empty_images_are_left_as_they_are():
    reference = np.random.default_rng(1).integers(0, 256, (60, 80, 3)).astype(np.uint8)
    everywhere, nowhere = np.ones((60, 80), bool), np.zeros((60, 80), bool)
    nearly = np.clip(reference.astype(int) - 5, 0, 255).astype(np.uint8)
    assert match_tones(nearly, everywhere, reference, everywhere) is nearly
    dark = reference // 3
    assert match_tones(dark, nowhere, reference, everywhere) is dark


def test_a_constant_image_has_a_curve_too():
    reference = np.full((30, 30, 3), 200, np.uint8)
    everywhere = np.ones((30, 30), bool)
    matched = match_tones(np.full((30, 30, 3), 20, np.uint8), everywhere, reference, everywhere)
    np.testing.assert_array_equal(matched, reference)
