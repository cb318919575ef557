"""Planes continued into what no two cameras see."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd.background.extend import extend_surfaces

HEIGHT, WIDTH = 90, 160


def plane(constant, slope_x, slope_y, height=HEIGHT, width=WIDTH):
    y, x = np.mgrid[:height, :width]
    return (constant + slope_x * x + slope_y * y).astype(np.float32)


@settings(max_examples=20, deadline=None)
@given(
    slope_x=st.floats(-1.5e-3, 1.5e-3),
    slope_y=st.floats(-1.5e-3, 1.5e-3),
    exponent=st.sampled_from([-6, 0, 6]),
    known=st.integers(60, 120),
)
def test_plane_goes_on_exactly_at_any_scale_of_the_world(slope_x, slope_y, exponent, known):
    truth = plane(1.0, slope_x, slope_y) * np.float32(10.0**exponent)
    inverse_depth = truth.copy()
    inverse_depth[:, known:] = -1
    filled = extend_surfaces(inverse_depth)
    assert np.array_equal(filled, np.arange(WIDTH)[None] >= known + np.zeros((HEIGHT, 1)))
    nearest = truth[:, :known].max()
    np.testing.assert_allclose(inverse_depth, np.minimum(truth, nearest), rtol=2e-3)
    assert np.array_equal(inverse_depth[~filled], truth[~filled])


def test_ground_and_wall_go_on_side_by_side():
    wall, ground = plane(0.2, 0, 0), plane(-0.04, 0, 0.004)
    truth = np.maximum(wall, ground)
    inverse_depth = truth.copy()
    inverse_depth[:, 130:] = -1
    filled = extend_surfaces(inverse_depth)
    error = np.abs(inverse_depth / truth - 1)
    assert np.median(error[filled]) < 0.005
    assert error.max() < 0.06


def test_the_rest_is_untouched():
    inverse_depth = plane(1.0, 0.001, 0)
    inverse_depth[:40, :50] = -1
    before = inverse_depth.copy()
    filled = extend_surfaces(inverse_depth)
    assert filled.sum() == 2000
    assert np.array_equal(inverse_depth[~filled], before[~filled])


def test_ground_beyond_the_horizon_is_at_infinity():
    inverse_depth = plane(-0.4, 0, 0.01)
    inverse_depth[:45] = -1
    extend_surfaces(inverse_depth)
    assert (inverse_depth[:38] == 0).all()
    assert (inverse_depth >= 0).all()


def test_small_holes_stay():
    inverse_depth = plane(1.0, 0, 0)
    inverse_depth[30:36, 50:60] = -1
    before = inverse_depth.copy()
    assert not extend_surfaces(inverse_depth).any()
    assert np.array_equal(inverse_depth, before)


@pytest.mark.parametrize("kind", ["nothing", "noise", "speck"])
def test_without_any_plane_all_stays_unknown(kind):
    inverse_depth = np.full((HEIGHT, WIDTH), -1, np.float32)
    if kind == "noise":
        inverse_depth[:, :80] = np.random.default_rng(0).uniform(0.1, 1, (HEIGHT, 80))
    if kind == "speck":
        inverse_depth[:5, :5] = 1
    before = inverse_depth.copy()
    assert not extend_surfaces(inverse_depth).any()
    assert np.array_equal(inverse_depth, before)


def test_larger_pictures_are_fitted_on_a_grid():
    truth = plane(1.0, 2e-4, -3e-4, 540, 960)
    inverse_depth = truth.copy()
    inverse_depth[:, 700:] = -1
    extend_surfaces(inverse_depth)
    np.testing.assert_allclose(inverse_depth, np.minimum(truth, truth[:, :700].max()), rtol=3e-3)
