"""Properties of projection and rectification that hold for any cameras."""

import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fourd.camera import Camera, check_camera
from fourd.errors import InputError
from fourd.geometry import look_at, triangulate
from fourd.stereo.files import decode_confidence, decode_disparity, encode_confidence, encode_disparity
from fourd.stereo.rectification import Rectification
from fourd.stereo.rectify import (
    RectifyOptions,
    disparity_from_depth,
    inverse_depth_from_disparity,
    rectify_pair,
)

NEAR_FAR = (2.0, 30.0)
UP = np.array([0.0, 0.0, 1.0])


def looking(angle_deg, distance, height, focal_px, roll_deg, size, scale=1.0):
    angle = np.radians(angle_deg)
    center = np.array([distance * np.sin(angle), -distance * np.cos(angle), height])
    R, _ = look_at(center, np.array([0.0, 0.0, 1.0]), UP)
    R = Rotation.from_euler("z", roll_deg, degrees=True).as_matrix() @ R
    K = np.array([[focal_px, 0, (size[0] - 1) / 2], [0, focal_px, (size[1] - 1) / 2], [0, 0, 1.0]])
    return Camera(K, R, -R @ center * scale, size)


cameras = st.builds(
    looking,
    st.floats(-40, 40),
    st.floats(3.5, 7),
    st.floats(0.3, 3),
    st.floats(120, 420),
    st.floats(-180, 180),
    st.sampled_from([(160, 90), (90, 160), (128, 128), (64, 36)]),
)
places = st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1), st.floats(0.2, 1e3)), min_size=1, max_size=20)


def rectified(left, right, near_far=NEAR_FAR):
    result = rectify_pair(left, right, near_far, near_far, RectifyOptions())
    return result if isinstance(result, Rectification) else None


def common_points(left, right, near_far=NEAR_FAR):
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, np.array(left.size) - 1, (500, 2))
    points = left.unproject(pixels, 1 / rng.uniform(1 / near_far[1], 1 / near_far[0], 500))
    at, depth = right.project(points)
    at = np.nan_to_num(at, nan=-1.0)
    inside = ((at >= 0) & (at <= np.array(right.size) - 1)).all(axis=1)
    return points[inside & (depth > near_far[0]) & (depth < near_far[1])]


@given(cameras, places)
def test_unprojected_pixels_project_onto_themselves(camera, places):
    x, y, depth = np.array(places).T
    pixels = np.stack([x * camera.size[0], y * camera.size[1]], axis=1)
    found, found_depth = camera.project(camera.unproject(pixels, depth))
    np.testing.assert_allclose(found, pixels, atol=1e-8)
    np.testing.assert_allclose(found_depth, depth, rtol=1e-11)


def reach(lens):
    """Largest distorted radius at z = 1 that a ray reaches before the radial polynomial turns back."""
    radius = np.linspace(0, 10, 100_001)
    distorted = radius * (1 + lens[0] * radius**2 + lens[1] * radius**4)
    turning = np.flatnonzero(np.diff(distorted) <= 0)
    return distorted[turning[0]] if turning.size else np.inf


@given(cameras, places, st.floats(-0.3, 0.15), st.floats(-0.05, 0.05))
def test_any_lens_that_is_accepted_is_undone(camera, places, k1, k2):
    """Wherever a ray exists: corners of an accepted lens may lie beyond where it turns back."""
    camera = dataclasses.replace(camera, distortion=np.array([k1, k2, 1e-3, -1e-3, 0.0]))
    try:
        check_camera(camera, "camera")
    except InputError:
        assume(False)
    x, y, depth = np.array(places).T
    pixels = np.stack([x * (camera.size[0] - 1), y * (camera.size[1] - 1)], axis=1)
    distorted = camera.without_distortion().rays(pixels)[:, :2]
    # Five percent short of the turn, where the tangential terms do not matter.
    has_ray = np.linalg.norm(distorted, axis=1) < 0.95 * reach(camera.distortion)
    found, _ = camera.project(camera.unproject(pixels, depth))
    np.testing.assert_allclose(found[has_ray], pixels[has_ray], atol=1e-6)


@pytest.mark.parametrize("k1", [-0.9, -3.0])
def test_a_lens_that_folds_back_inside_the_picture_is_refused(k1):
    camera = looking(0, 5, 1, 150.0, 0, (160, 90))
    with pytest.raises(InputError, match="cam07: the lens must give every pixel a ray.*folds back"):
        check_camera(dataclasses.replace(camera, distortion=np.array([k1, 0, 0, 0, 0])), "cam07")


@settings(max_examples=60)
@given(cameras, cameras)
def test_rows_of_planar_pairs_agree_and_disparity_is_inverse_depth(left, right):
    result = rectified(left, right)
    assume(result is not None and result.kind == "planar")
    points = common_points(left, right)
    assume(len(points) > 5)
    at_left, depth = result.camera("left").project(points)
    at_right, depth_right = result.camera("right").project(points)
    np.testing.assert_allclose(at_left[:, 1], at_right[:, 1], atol=1e-7)
    np.testing.assert_allclose(depth, depth_right, rtol=1e-9)
    disparity = at_left[:, 0] - at_right[:, 0]
    np.testing.assert_allclose(disparity, disparity_from_depth(result, depth), atol=1e-7)
    low, high = result.disparity_range
    assert low - 1e-6 <= disparity.min() and disparity.max() <= high + 1e-6


@settings(max_examples=60)
@given(cameras, cameras)
def test_refusals_say_why(left, right):
    result = rectify_pair(left, right, NEAR_FAR, NEAR_FAR, RectifyOptions())
    if not isinstance(result, Rectification):
        assert len(result.reason.split()) > 3


@settings(max_examples=40)
@given(cameras, cameras, st.integers(-20, 20))
def test_scale_of_the_world_scales_inverse_depth_alone(left, right, exponent):
    scale = 2.0**exponent
    result = rectified(left, right)
    assume(result is not None)
    larger = [dataclasses.replace(camera, t=camera.t * scale) for camera in (left, right)]
    other = rectified(*larger, (NEAR_FAR[0] * scale, NEAR_FAR[1] * scale))
    assert other is not None
    assert other.kind == result.kind
    for side in ("left", "right"):
        here, there = result.camera(side), other.camera(side)
        assert here.size == there.size
        np.testing.assert_allclose(there.K, here.K, rtol=1e-9)
        np.testing.assert_allclose(there.R, here.R, atol=1e-12)
        np.testing.assert_allclose(there.center, here.center * scale, rtol=1e-9, atol=1e-12 * scale)
    np.testing.assert_allclose(other.disparity_range, result.disparity_range, rtol=1e-6, atol=1e-6)
    expected = np.array(result.inverse_depth_per_px) / scale
    np.testing.assert_allclose(other.inverse_depth_per_px, expected, rtol=1e-9)


@settings(max_examples=60)
@given(cameras, cameras, st.lists(st.floats(1e-3, 1e9), min_size=1, max_size=20))
def test_disparity_and_depth_are_inverse(left, right, depths):
    result = rectified(left, right)
    assume(result is not None)
    depth = np.array(depths)
    back = inverse_depth_from_disparity(result, disparity_from_depth(result, depth))
    # What is lost is the rounding of a disparity beside the one of infinity.
    unit = max(abs(result.disparity_at_infinity[0]), 1.0) * result.inverse_depth_per_px[0]
    np.testing.assert_allclose(back, 1 / depth, rtol=1e-9, atol=1e-14 * unit)


@settings(max_examples=40)
@given(st.lists(cameras, min_size=2, max_size=5), st.randoms(use_true_random=False))
def test_order_of_the_views_does_not_move_a_triangulated_point(views, random):
    points = common_points(views[0], views[1])[:20]
    pixels = np.stack([camera.project(points)[0] for camera in views])
    seen = np.isfinite(pixels).all(axis=(0, 2))
    assume(seen.sum() > 0)
    found = triangulate(views, pixels[:, seen])
    assume(np.isfinite(found).all())
    order = list(range(len(views)))
    random.shuffle(order)
    other = triangulate([views[i] for i in order], pixels[order][:, seen])
    spread = np.linalg.norm(views[0].center - views[1].center)
    assume(spread > 0.1)
    np.testing.assert_allclose(other, found, rtol=1e-6)


@given(st.lists(st.one_of(st.floats(-1023, 1023, width=32), st.just(float("nan"))), min_size=1, max_size=40))
def test_stored_disparities_are_within_half_a_step_and_holes_stay_holes(values):
    disparity = np.array([values], np.float32)
    found = decode_disparity(encode_disparity(disparity))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(found), np.isnan(disparity))
    known = np.isfinite(disparity)
    assert np.abs(found[known] - disparity[known]).max(initial=0) <= 1 / 64
    # What was stored once is stored again unchanged.
    np.testing.assert_array_equal(decode_disparity(encode_disparity(found)), found)


@given(st.lists(st.floats(0, 1, width=32), min_size=1, max_size=40))
def test_stored_confidence_is_within_half_a_step_and_keeps_order(values):
    confidence = np.sort(np.array([values], np.float32))
    found = decode_confidence(encode_confidence(confidence))
    assert np.abs(found - confidence).max() <= 1 / 510 + 1e-7
    assert (np.diff(found) >= 0).all()
    np.testing.assert_array_equal(decode_confidence(encode_confidence(found)), found)
