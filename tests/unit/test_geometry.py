import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fourd.camera import Camera
from fourd.geometry import (
    angle_deg,
    convergence_point,
    interpolate_rotations,
    look_at,
    nearest_rotation,
    triangulate,
)

K = np.array([[500.0, 0, 160], [0, 500, 120], [0, 0, 1]])
coordinate = st.floats(-10, 10, allow_nan=False)
vectors = st.tuples(coordinate, coordinate, coordinate).map(np.array)
rotations = st.tuples(*[st.floats(-3, 3, allow_nan=False)] * 3).map(
    lambda v: Rotation.from_rotvec(v).as_matrix()
)


def camera_at(center, target, up=(0.0, 0.0, 1.0)) -> Camera:
    R, t = look_at(np.asarray(center, float), np.asarray(target, float), np.asarray(up, float))
    return Camera(K, R, t, (320, 240))


def arc(num_cameras=5, radius=4.0, target=(0.3, -0.2, 1.0)) -> list[Camera]:
    angles = np.radians(np.linspace(-40, 40, num_cameras))
    offsets = radius * np.stack([np.sin(angles), -np.cos(angles), 0.2 + 0 * angles], axis=1)
    return [camera_at(np.asarray(target) + offset, target) for offset in offsets]


@pytest.mark.parametrize("degrees", [0.0, 1e-9, 1e-4, 45.0, 90.0, 179.9999, 180.0])
def test_angle_is_exact_when_tiny_and_when_flat(degrees):
    a = np.array([2.0, 0, 0])
    b = 3 * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0])
    assert angle_deg(a, b) == pytest.approx(degrees, rel=1e-9, abs=1e-13)


@settings(max_examples=50, deadline=None)
@given(rotations, st.floats(0, 0.3))
def test_nearest_rotation_is_a_rotation_and_keeps_rotations(R, noise):
    np.testing.assert_allclose(nearest_rotation(R), R, atol=1e-12)
    rough = nearest_rotation(R + noise * np.array([[0.3, -1, 0.5], [0.2, 0.7, -0.4], [1, 0.1, 0.6]]))
    np.testing.assert_allclose(rough @ rough.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rough) == pytest.approx(1)


def test_nearest_rotation_of_a_reflection_is_no_reflection():
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1, -1]))) == pytest.approx(1)


@settings(max_examples=50, deadline=None)
@given(vectors, vectors)
def test_look_at_puts_the_target_in_the_middle_and_up_upward(center, target):
    up = np.array([0.0, 0, 1])
    toward = target - center
    assume(
        np.linalg.norm(toward) > 1e-2 and np.linalg.norm(np.cross(toward, up)) > 1e-2 * np.linalg.norm(toward)
    )
    camera = camera_at(center, target)
    pixel, depth = camera.project(target)
    np.testing.assert_allclose(pixel, [160, 120], atol=1e-6)
    assert depth == pytest.approx(np.linalg.norm(toward))
    np.testing.assert_allclose(camera.center, center, atol=1e-9)
    above, _ = camera.project(target + 0.01 * depth * up)
    assert above[1] < 120 and above[0] == pytest.approx(160, abs=1e-6)
    assert np.linalg.det(camera.R) == pytest.approx(1)


def test_look_at_refuses_a_view_without_direction_or_roll():
    up = np.array([0.0, 0, 1])
    for target in (np.zeros(3), np.array([0, 0, 5.0]), np.array([0, 0, -5.0])):
        with pytest.raises(ValueError, match="look_at needs"):
            look_at(np.zeros(3), target, up)


def test_interpolated_rotations_pass_their_keys_and_turn_evenly():
    keys = [Rotation.from_rotvec([0, angle, 0]).as_matrix() for angle in (0.0, 0.5, 1.5)]
    got = interpolate_rotations(keys, np.array([0, 0.5, 1, 1.25, 2, 9]))
    angles = Rotation.from_matrix(got).as_rotvec()[:, 1]
    np.testing.assert_allclose(angles, [0, 0.25, 0.5, 0.75, 1.5, 1.5], atol=1e-12)
    np.testing.assert_allclose(interpolate_rotations(keys[:1], np.array([0.0, 3.0])), [keys[0]] * 2)


@settings(max_examples=30, deadline=None)
@given(vectors, st.floats(1e-3, 1e3))
def test_convergence_point_is_where_the_cameras_look(target, radius):
    # The point is known to the rounding of the largest position.
    point = convergence_point(arc(radius=radius, target=target))
    np.testing.assert_allclose(point, target, atol=1e-11 * (radius + 20))


def test_convergence_point_of_parallel_axes_lies_among_the_cameras():
    cameras = [Camera(K, np.eye(3), -np.array([x, 0.0, 0.0]), (320, 240)) for x in (0, 1, 2)]
    np.testing.assert_allclose(convergence_point(cameras), [1, 0, 0], atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-0.8, 0.8)] * 3), min_size=1, max_size=6), st.integers(2, 5))
def test_triangulated_points_are_those_projected(offsets, num_views):
    cameras = arc(num_views)
    points = np.array(offsets) + [0.3, -0.2, 1.0]
    pixels = np.stack([camera.project(points)[0] for camera in cameras])
    np.testing.assert_allclose(triangulate(cameras, pixels), points, atol=1e-9)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_triangulation_does_not_depend_on_the_scale(scale):
    cameras = arc(3)
    points = np.array([[0.1, 0.2, 1.1], [0.5, -0.4, 0.7]])
    noise = np.random.default_rng(1).normal(0, 0.5, (3, 2, 2))
    pixels = np.stack([camera.project(points)[0] for camera in cameras]) + noise
    scaled = [Camera(c.K, c.R, c.t * scale, c.size) for c in cameras]
    np.testing.assert_allclose(triangulate(scaled, pixels) / scale, triangulate(cameras, pixels), rtol=1e-9)


def test_parallel_rays_have_no_point():
    cameras = [Camera(K, np.eye(3), -np.array([x, 0.0, 0.0]), (320, 240)) for x in (0, 1)]
    pixels = np.array([[[160.0, 120], [170, 120]], [[160.0, 120], [160, 120]]])
    points = triangulate(cameras, pixels)
    assert np.isnan(points[0]).all()
    np.testing.assert_allclose(points[1], [1, 0, 50])


def test_triangulation_undoes_the_lens():
    lens = np.array([-0.2, 0.05, 1e-3, 2e-3, 0])
    cameras = [Camera(c.K, c.R, c.t, c.size, lens) for c in arc(2)]
    points = np.array([[0.1, 0.2, 1.1]])
    pixels = np.stack([camera.project(points)[0] for camera in cameras])
    np.testing.assert_allclose(triangulate(cameras, pixels), points, atol=1e-8)
