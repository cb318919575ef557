import dataclasses

import cv2
import numpy as np
import pytest

from fourd.errors import InputError
from fourd.matchers.sgbm import SgbmMatcher, SgbmOptions
from fourd.stereo.disparity import match_right


def texture(height=60, width=160, seed=0):
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 1.0)


def shifted_pair(disparity, height=60, width=160):
    """Two images of a fronto-parallel plane: left[x] = right[x - disparity]."""
    margin = abs(disparity)
    wide = texture(height, width + 2 * margin)
    left = wide[:, margin : margin + width]
    right = wide[:, margin + disparity : margin + disparity + width]
    return np.ascontiguousarray(left), np.ascontiguousarray(right)


def overlapping(disparity, width=160):
    """Columns of the left image whose match lies inside the right one."""
    return slice(max(disparity, 0), width + min(disparity, 0))


@pytest.mark.parametrize("disparity", [0, 7, -9, 40, -40])
@pytest.mark.parametrize("mode", ["3way", "hh4"])
def test_finds_positive_negative_and_zero_disparities_up_to_the_border(disparity, mode):
    left, right = shifted_pair(disparity)
    matcher = SgbmMatcher(SgbmOptions(mode=mode))
    match = matcher.match(left, right, (disparity - 11.5, disparity + 13.2))
    columns = overlapping(disparity)
    found = np.isfinite(match.disparity[:, columns])
    assert match.disparity.shape == left.shape[:2]
    assert match.disparity.dtype == match.confidence.dtype == np.float32
    assert found.mean() > 0.9
    assert found[:, [0, -1]].mean() > 0.6
    assert np.mean(np.abs(match.disparity[:, columns][found] - disparity) <= 1) > 0.97
    np.testing.assert_array_equal(match.confidence > 0, np.isfinite(match.disparity))


@pytest.mark.parametrize("disparity", [5, -6])
def test_right_image_has_the_same_disparity_at_the_matching_pixel(disparity):
    left, right = shifted_pair(disparity)
    match = match_right(SgbmMatcher(SgbmOptions()), left, right, (-16, 16))
    columns = overlapping(-disparity)
    assert np.isfinite(match.disparity[:, columns]).mean() > 0.9
    assert np.nanmedian(np.abs(match.disparity[:, columns] - disparity)) < 0.1


def test_convention_disparity_of_a_nearer_point_is_larger():
    left, right = shifted_pair(4)
    near_left, near_right = shifted_pair(20)
    left[20:40], right[20:40] = near_left[20:40], near_right[20:40]
    match = SgbmMatcher(SgbmOptions()).match(left, right, (0, 31))
    assert np.nanmedian(match.disparity[24:36, 30:]) == pytest.approx(20, abs=0.2)
    assert np.nanmedian(match.disparity[:16, 30:]) == pytest.approx(4, abs=0.2)


def test_range_that_is_no_multiple_of_16_is_covered():
    left, right = shifted_pair(31)
    match = SgbmMatcher(SgbmOptions()).match(left, right, (0.5, 30.9))
    assert np.nanmedian(match.disparity[:, overlapping(31)]) == pytest.approx(31, abs=0.2)


def test_matches_outside_the_range_are_rejected():
    left, right = shifted_pair(12)
    match = SgbmMatcher(SgbmOptions()).match(left, right, (-4, 2))
    assert np.nanmax(match.disparity) <= 3 and np.nanmin(match.disparity) >= -5


@pytest.mark.parametrize("mode", ["3way", "sgbm", "hh4", "hh"])
@pytest.mark.parametrize("size", [(1, 1), (2, 40), (40, 2), (17, 33)])
def test_small_images_do_not_break_any_mode(mode, size):
    left, right = (texture(*size, seed=seed) for seed in (0, 1))
    match = SgbmMatcher(SgbmOptions(mode=mode)).match(left, right, (-20, 30))
    assert match.disparity.shape == size


@pytest.mark.parametrize("level", [0, 128, 255])
def test_constant_images_give_no_nan_confidence(level):
    flat = np.full((40, 80, 3), level, np.uint8)
    match = SgbmMatcher(SgbmOptions()).match(flat, flat, (-8, 8))
    assert np.isfinite(match.confidence).all()
    assert np.isfinite(match.disparity).mean() < 0.1


def test_same_input_gives_the_same_bytes():
    left, right = shifted_pair(5)
    first, second = (SgbmMatcher(SgbmOptions()).match(left, right, (-4, 20)) for _ in range(2))
    assert first.disparity.tobytes() == second.disparity.tobytes()


def test_threads_do_not_change_the_result():
    left, right = shifted_pair(5)
    threads = cv2.getNumThreads()
    results = []
    for count in (1, 4):
        cv2.setNumThreads(count)
        results.append(SgbmMatcher(SgbmOptions()).match(left, right, (-4, 20)).disparity.tobytes())
    cv2.setNumThreads(threads)
    assert results[0] == results[1]


@pytest.mark.parametrize(
    "change, message",
    [
        ({"mode": "best"}, "sgbm_mode"),
        ({"block_size_px": 4}, "odd"),
        ({"block_size_px": 0}, "odd"),
        ({"penalty_small": 40}, "0 < small < large"),
    ],
)
def test_impossible_options_are_refused_by_name(change, message):
    with pytest.raises(InputError, match=message):
        SgbmMatcher(dataclasses.replace(SgbmOptions(), **change))
