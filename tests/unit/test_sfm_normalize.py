import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.sfm.normalize import (
    CENTER_STEP,
    Similarity,
    estimate_similarity,
    estimate_up,
    sample_cameras,
    snap_center,
)
from tests.unit.sfm_rig import POINTS, SIZE, TARGET, make_rig, moved_rig, transform_world

K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])


def normalized(cameras: list[Camera]) -> list[Camera]:
    similarity = estimate_similarity(cameras)
    return [similarity.apply(camera) for camera in cameras]


def assert_same_poses(got, expected, atol):
    for a, b in zip(got, expected, strict=True):
        np.testing.assert_allclose(a.R, b.R, atol=atol)
        np.testing.assert_allclose(a.t, b.t, atol=atol)


def parallel_cameras(num_cameras=4) -> list[Camera]:
    return [Camera(K, np.eye(3), -np.array([0.1 * i, 0, 0]), SIZE) for i in range(num_cameras)]


@pytest.mark.parametrize("make", [lambda: list(make_rig().values()), parallel_cameras])
@pytest.mark.parametrize("shift", [0.0, 1e7])
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e6])
def test_normalised_cameras_do_not_depend_on_the_source_world(make, scale, shift):
    # The shift is in scene sizes; a camera position holds no more than 16 digits of it.
    cameras = make()
    moved = [transform_world(c, scale, np.array([shift, -0.3 * shift, 0.7 * shift]) * scale) for c in cameras]
    assert_same_poses(normalized(moved), normalized(cameras), atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(st.floats(-6, 6), st.tuples(*[st.floats(-100, 100)] * 3))
def test_convention_source_is_world_times_scale_plus_origin(exponent, shift):
    cameras = [transform_world(c, 10.0**exponent, np.array(shift)) for c in make_rig().values()]
    similarity = estimate_similarity(cameras)
    for camera in cameras:
        source = similarity.apply(camera).center * similarity.scale + similarity.origin
        np.testing.assert_allclose(source, camera.center, atol=1e-14 * (10.0**exponent * 10 + 200))


@pytest.mark.parametrize("shift", [0.0, 1e3, -1e7])
def test_last_digits_of_the_source_do_not_show(shift):
    """The same rig in a world with its origin elsewhere: positions are equal by a bit."""
    rigs = [
        list(make_rig().values()),
        [transform_world(c, 1.0, np.full(3, shift)) for c in make_rig().values()],
    ]
    found = [[snap_center(estimate_similarity(rig).apply(camera)).center for camera in rig] for rig in rigs]
    steps = np.abs(np.array(found[0]) - np.array(found[1])) / CENTER_STEP
    assert (steps < 0.5).mean() > 0.9 and steps.max() < 1.5


def test_centre_moves_by_at_most_half_a_step_and_only_once():
    for camera in make_rig().values():
        snapped = snap_center(camera)
        np.testing.assert_allclose(snapped.center, camera.center, atol=CENTER_STEP / 2 * (1 + 1e-9), rtol=0)
        np.testing.assert_array_equal(snap_center(snapped).t, snapped.t)


def test_positions_without_digits_to_tell_them_apart_are_refused():
    far = [transform_world(c, 1.0, np.full(3, 1e12)) for c in make_rig().values()]
    with pytest.raises(InputError, match="subtract a common offset"):
        estimate_similarity(far)


def test_images_are_unchanged():
    cameras = list(make_rig().values())
    similarity = estimate_similarity(cameras)
    points = similarity.world_from_source(POINTS)
    for camera in cameras:
        pixels, depth = similarity.apply(camera).project(points)
        expected, source_depth = camera.project(POINTS)
        np.testing.assert_allclose(pixels, expected, atol=1e-9)
        np.testing.assert_allclose(depth * similarity.scale, source_depth)


def test_converging_cameras_surround_the_origin_at_distance_one():
    similarity = estimate_similarity(list(make_rig(radius=4.0).values()))
    assert similarity.converges
    np.testing.assert_allclose(similarity.origin, TARGET, atol=0.1)
    distances = [np.linalg.norm(c.center) for c in normalized(list(make_rig().values()))]
    assert np.median(distances) == pytest.approx(1)


def test_parallel_cameras_are_centred_on_themselves():
    similarity = estimate_similarity(parallel_cameras())
    assert not similarity.converges
    np.testing.assert_allclose(similarity.origin, [0.15, 0, 0], atol=1e-12)
    spread = np.linalg.norm([c.center for c in normalized(parallel_cameras())], axis=1)
    assert np.sqrt((spread**2).mean()) == pytest.approx(1)


def test_cameras_that_look_apart_have_no_convergence_point():
    outward = [
        dataclasses.replace(c, R=np.diag([-1.0, 1, -1]) @ c.R, t=np.diag([-1.0, 1, -1]) @ c.t)
        for c in make_rig().values()
    ]
    similarity = estimate_similarity(outward)
    assert not similarity.converges
    centers = np.array([c.center for c in outward])
    np.testing.assert_allclose(similarity.origin, centers.mean(axis=0), atol=1e-12)


@pytest.mark.parametrize("shift", [0.0, 5.0, 1e7])
def test_one_place_for_all_cameras_keeps_the_scale(shift):
    rig = list(make_rig(3).values())
    cameras = [dataclasses.replace(c, t=-c.R @ np.full(3, shift)) for c in rig]
    similarity = estimate_similarity(cameras)
    assert similarity.scale == 1.0
    np.testing.assert_allclose(similarity.origin, shift, rtol=1e-15, atol=0)


def test_two_cameras_face_to_face_converge_between_them():
    # Anti-parallel axes share a line, on which no point is nearer than another: no convergence.
    ahead = Camera(K, np.eye(3), np.array([0, 0, 2.0]), SIZE)
    back = Camera(K, np.diag([-1.0, 1, -1]), np.array([0, 0, 2.0]), SIZE)
    similarity = estimate_similarity([ahead, back])
    assert not similarity.converges
    np.testing.assert_allclose(similarity.origin, 0, atol=1e-12)
    assert similarity.scale == pytest.approx(2)


def test_rounded_rotations_become_orthonormal_and_keep_the_centre():
    camera = make_rig()["cam01"]
    rounded = dataclasses.replace(camera, R=camera.R.round(5))
    exact = Similarity(np.zeros(3), 1.0, True).apply(rounded)
    np.testing.assert_allclose(exact.R @ exact.R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(exact.R @ np.linalg.solve(rounded.R, -rounded.t) + exact.t, 0, atol=1e-12)


def test_samples_weigh_still_and_moving_cameras_alike():
    tracks = {**moved_rig(30, num_cameras=2), "still": (make_rig()["cam02"],)}
    samples = sample_cameras(tracks, 9)
    assert len(samples) == 27
    assert sum(sample is tracks["still"][0] for sample in samples) == 9
    assert tracks["cam00"][0] in samples and tracks["cam00"][29] in samples
    assert len(sample_cameras({"a": tracks["still"], "b": tracks["still"]}, 9)) == 2


def test_up_is_up():
    up = estimate_up(list(make_rig().values()))
    assert np.linalg.norm(up) == pytest.approx(1)
    # The cameras look down by about 9 degrees, but they are held level; what is left is the tie-break.
    assert up[2] > np.cos(np.radians(1.5))


def test_up_of_cameras_that_cancel_is_the_first_ones():
    camera = make_rig()["cam00"]
    turned = dataclasses.replace(camera, R=np.diag([-1.0, -1, 1]) @ camera.R)
    np.testing.assert_allclose(estimate_up([camera, turned]), -camera.R[1])
