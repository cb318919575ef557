"""Coarse to fine matching, and its kernels against slow ones."""

import numpy as np
import pytest

from fourd.matchers import pyramid
from fourd.matchers.banded import (
    BAND_PX,
    NUM_BANDS,
    aggregate_bands,
    band_costs,
    best_in_bands,
    jump_penalties,
)
from fourd.matchers.census import census
from fourd.matchers.pyramid import PyramidMatcher
from fourd.matchers.semi_global import aggregate
from fourd.stereo.disparity import match_right
from tests.unit.test_matchers import overlapping, shifted_pair, texture

SMALL_STEP = 64


@pytest.mark.parametrize("disparity", [0, 7, -9, 40, -40])
@pytest.mark.parametrize("reach", [(9.5, 13.2), (150.0, 210.0), (2.0, 1.0)])
def test_finds_disparities_of_either_sign_in_any_range(disparity, reach):
    left, right = shifted_pair(disparity)
    match = PyramidMatcher().match(left, right, (disparity - reach[0], disparity + reach[1]))
    columns = overlapping(disparity)
    found = np.isfinite(match.disparity[:, columns])
    assert match.disparity.shape == left.shape[:2]
    assert match.disparity.dtype == match.confidence.dtype == np.float32
    assert found.mean() > 0.9
    assert np.mean(np.abs(match.disparity[:, columns][found] - disparity) <= 1) > 0.97
    np.testing.assert_array_equal(match.confidence > 0, np.isfinite(match.disparity))


def test_large_pictures_take_more_levels(monkeypatch):
    left, right = shifted_pair(21, 120, 320)
    two = PyramidMatcher().match(left, right, (-20, 90)).disparity
    monkeypatch.setattr(pyramid, "_MAX_CELLS", 60 * 160 * 56 - 1)
    three = PyramidMatcher().match(left, right, (-20, 90)).disparity
    columns = overlapping(21, 320)
    assert np.mean(np.abs(three[:, columns] - 21) <= 1) > 0.9
    # Another search, or the bound would not have worked.
    assert two.tobytes() != three.tobytes()


def test_right_image_has_the_same_disparity_at_the_matching_pixel():
    left, right = shifted_pair(-6)
    match = match_right(PyramidMatcher(), left, right, (-16, 16))
    assert np.nanmedian(np.abs(match.disparity[:, overlapping(6)] + 6)) < 0.1


def test_matches_outside_the_range_are_rejected():
    left, right = shifted_pair(12)
    match = PyramidMatcher().match(left, right, (-4, 2))
    assert np.nanmax(match.disparity) <= 3 and np.nanmin(match.disparity) >= -5


def test_a_near_bar_keeps_its_width():
    disparity, width = 24, 12
    left, right = shifted_pair(4, 80, 240)
    bar = texture(80, width, seed=5)
    left[:, 120 : 120 + width] = bar
    right[:, 120 - disparity : 120 - disparity + width] = bar
    found = PyramidMatcher().match(left, right, (0, 40)).disparity
    is_near = np.abs(found - disparity) < 2
    assert is_near[:, 120 : 120 + width].mean() > 0.9
    assert is_near[:, :119].mean() < 0.01 and is_near[:, 121 + width :].mean() < 0.01


@pytest.mark.parametrize("size", [(1, 1), (2, 40), (40, 2), (17, 33)])
def test_small_images_do_not_break_it(size):
    left, right = (texture(*size, seed=seed) for seed in (0, 1))
    assert PyramidMatcher().match(left, right, (-20, 30)).disparity.shape == size


def test_same_input_gives_the_same_bytes():
    left, right = shifted_pair(5)
    first, second = (PyramidMatcher().match(left, right, (-4, 20)) for _ in range(2))
    assert first.disparity.tobytes() == second.disparity.tobytes()


def random_bands(height, width, seed=0):
    return np.random.default_rng(seed).integers(-12, 12, (height, width, NUM_BANDS)).astype(np.int16)


def test_costs_are_those_of_birchfield_tomasi_and_census():
    rng = np.random.default_rng(1)
    ours, theirs = (rng.integers(0, 256, (3, 3, 30)).astype(np.int16) for _ in range(2))
    signatures = [rng.integers(0, 2**25, (3, 30)).astype(np.uint32) for _ in range(2)]
    first = random_bands(3, 30)
    is_step = rng.random((3, 30)) < 0.5
    costs = band_costs(ours, theirs, signatures[0], signatures[1], is_step, first, 40)
    nearest = sum(1 << (5 * row + column) for row in (1, 2, 3) for column in (1, 2, 3))

    def half(channel, x):
        """Values at x and half a pixel to either side."""
        here = int(channel[x])
        beside = [int(channel[np.clip(x + s, 0, 29)]) for s in (-1, 1)]
        return [here, *((b + here) >> 1 for b in beside)]

    for y, x, band, d in rng.integers(0, (3, 30, NUM_BANDS, BAND_PX), (200, 4)):
        column = int(np.clip(x - int(first[y, x, band]) - d, 0, 29))
        differs = int(signatures[0][y, x] ^ signatures[1][y, column])
        expected = 8 * (differs & nearest).bit_count() if is_step[y, x] else 4 * differs.bit_count()
        for c in range(3):
            a, b = half(ours[y, c], x), half(theirs[y, c], column)
            forth = max(0, a[0] - max(b), min(b) - a[0])
            back = max(0, b[0] - max(a), min(a) - b[0])
            expected += min(forth, back)
        assert costs[y, x, band, d] == expected


def test_paths_are_those_of_semi_global_matching():
    height, width = 4, 6
    rng = np.random.default_rng(2)
    first = random_bands(height, width)
    costs = rng.integers(0, 300, (height, width, NUM_BANDS, BAND_PX)).astype(np.int16)
    image = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    penalties = jump_penalties(image, 320.0, 2).astype(int)
    expected = np.zeros(costs.shape, int)

    def disparities(y, x):
        return [(band, d, int(first[y, x, band]) + d) for band in range(NUM_BANDS) for d in range(BAND_PX)]

    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        path = {}
        for y in range(height)[:: dy or 1]:
            for x in range(width)[:: dx or 1]:
                before = path.get((y - dy, x - dx))
                axis = 0 if dx else 1
                jump = penalties[axis, max(y, y - dy), max(x, x - dx)] if before else 0
                here = []
                for band, d, disparity in disparities(y, x):
                    best = 0
                    if before:
                        least = min(value for _, value in before)
                        steps = [least + jump]
                        steps += [v for at, v in before if at == disparity]
                        steps += [v + SMALL_STEP for at, v in before if abs(at - disparity) == 1]
                        best = min(steps) - least
                    value = int(costs[y, x, band, d]) + best
                    here.append((disparity, value))
                    expected[y, x, band, d] += value
                path[y, x] = here
    np.testing.assert_array_equal(aggregate_bands(costs, first, penalties.astype(np.int16)), expected)


def test_eight_paths_pay_the_price_between_their_pixels():
    height, width, count, small = 4, 5, 6, 9
    rng = np.random.default_rng(3)
    cost = rng.integers(0, 200, (height, width, count)).astype(np.int16)
    prices = rng.integers(10, 60, (4, height, width)).astype(np.int16)
    towards = ((0, -1), (-1, 0), (-1, -1), (-1, 1))
    expected = np.zeros(cost.shape, int)
    for direction, (up, aside) in enumerate(towards):
        for sign in (1, -1):
            path = {}
            for y in range(height)[::sign]:
                for x in range(width)[:: sign if up == 0 else 1]:
                    value = cost[y, x].astype(int)
                    before = path.get((y + sign * up, x + sign * aside))
                    if before is not None:
                        # The price stands at the pixel that comes later in the picture.
                        at = (y, x) if sign == 1 else (y - up, x - aside)
                        jump = before.min() + prices[direction][at]
                        padded = np.pad(before, 1, constant_values=10_000)
                        steps = [before, padded[:-2] + small, padded[2:] + small]
                        value = value + np.minimum(np.min(steps, axis=0), jump) - before.min()
                    path[y, x] = value
                    expected[y, x] += value
    np.testing.assert_array_equal(aggregate(cost, small, prices), expected)


def test_a_jump_is_cheaper_where_colours_change():
    image = np.full((3, 4, 3), 90, np.uint8)
    image[:, 2:] = 106
    across, down, down_left, down_right = jump_penalties(image, 320.0, 4)
    assert np.all(across[:, 0] == 0) and np.all(down[0] == 0)
    np.testing.assert_array_equal(across[:, 1:], [[320, 160, 320]] * 3)
    assert np.all(down[1:] == 320)
    np.testing.assert_array_equal(down_left[1:], [[0, 320, 160, 320]] * 2)
    np.testing.assert_array_equal(down_right[1:], [[320, 160, 320, 0]] * 2)
    image[:, 2:] = 255
    assert np.all(jump_penalties(image, 320.0, 2)[0][:, 2] == 96)


def test_best_of_two_bands_between_whole_disparities():
    total = np.full((1, 4, NUM_BANDS, BAND_PX), 1000, np.int16)
    first = np.zeros((1, 4, NUM_BANDS), np.int16)
    first[..., 1] = 40
    # Two lines of slope 40 that meet a quarter of a pixel above 45.
    total[0, 0, 1, 4:7] = 110, 70, 90
    total[0, 1, 0, 0] = 10
    total[0, 2, 0, 5], total[0, 2, 1, 5] = 100, 101
    # The same disparity in both bands is no rival of itself.
    first[0, 3, 1] = 4
    total[0, 3, 0, 10], total[0, 3, 1, 6] = 100, 100
    best = best_in_bands(total, first)[0]
    assert best[0] == pytest.approx(45.25)
    assert np.isnan(best[1]) and np.isnan(best[2])
    assert best[3] == 10


def test_census_marks_darker_neighbours():
    grey = np.array([[9, 1, 9], [5, 5, 5], [2, 9, 9]], np.uint8)
    assert int(census(grey, 1, 1)[1, 1]) == 0b010000100


@pytest.mark.parametrize("level", [0, 128, 255])
def test_constant_images_match_nothing(level):
    flat = np.full((40, 80, 3), level, np.uint8)
    assert np.isnan(PyramidMatcher().match(flat, flat, (-8, 60)).disparity).all()
