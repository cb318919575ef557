import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fourd.camera import Camera, CameraTrack, camera_from_dict, check_camera, tracks_from_dict, tracks_to_dict
from fourd.errors import InputError

K = np.array([[400.0, 0, 160.0], [0, 410.0, 120.0], [0, 0, 1]])
LENS = np.array([-0.2, 0.05, 1e-3, -2e-3, 0.01])


def make_camera(rotvec=(0.1, -0.4, 0.2), t=(0.3, -0.2, 1.0), distortion=None, size=(320, 240)) -> Camera:
    R = Rotation.from_rotvec(rotvec).as_matrix()
    lens = np.zeros(5) if distortion is None else np.asarray(distortion)
    return Camera(K.copy(), R, np.asarray(t, float), size, lens)


unit = st.floats(-1, 1, allow_nan=False)
rotvecs = st.tuples(*[st.floats(-3, 3, allow_nan=False)] * 3)
vectors = st.tuples(*[st.floats(-10, 10, allow_nan=False)] * 3)


def test_convention_axes_are_opencv():
    camera = Camera(K, np.eye(3), np.zeros(3), (320, 240))
    (middle, right, down), _ = camera.project(np.array([[0, 0, 2.0], [1, 0, 2.0], [0, 1, 2.0]]))
    np.testing.assert_allclose(middle, [160, 120])
    assert right[0] > middle[0] and right[1] == middle[1]
    assert down[1] > middle[1] and down[0] == middle[0]
    np.testing.assert_array_equal(camera.forward, [0, 0, 1])


def test_convention_pose_is_cam_from_world():
    camera = make_camera()
    point = np.array([0.2, 0.1, 4.0])
    in_cam = camera.R @ point + camera.t
    pixels, depth = camera.project(point)
    np.testing.assert_allclose(pixels, (K @ in_cam)[:2] / in_cam[2])
    assert depth == pytest.approx(in_cam[2])
    np.testing.assert_allclose(camera.R @ camera.center + camera.t, 0, atol=1e-12)
    np.testing.assert_allclose(camera.center, -camera.R.T @ camera.t)


def test_convention_top_left_pixel_center_is_zero():
    # With a field of view that ends at the image's borders the left border is half a pixel left of (0, 0).
    width = 320
    camera = Camera(
        np.array([[100.0, 0, (width - 1) / 2], [0, 100, 0], [0, 0, 1]]), np.eye(3), np.zeros(3), (width, 240)
    )
    half_width = width / 2 / 100
    left_border, _ = camera.project(np.array([-half_width, 0, 1.0]))
    right_border, _ = camera.project(np.array([half_width, 0, 1.0]))
    assert left_border[0] == pytest.approx(-0.5)
    assert right_border[0] == pytest.approx(width - 0.5)


def test_convention_size_is_width_height():
    camera = make_camera(size=(320, 240)).resized((160, 60))
    assert camera.size == (160, 60)
    assert camera.K[0, 0] == pytest.approx(K[0, 0] / 2)
    assert camera.K[1, 1] == pytest.approx(K[1, 1] / 4)


def test_convention_depth_is_z_not_ray_length():
    camera = Camera(K, np.eye(3), np.zeros(3), (320, 240))
    pixel = np.array([10.0, 230.0])
    point = camera.unproject(pixel, np.array(5.0))
    assert point[2] == pytest.approx(5.0)
    assert np.linalg.norm(point) > 5.1
    assert camera.project(point)[1] == pytest.approx(5.0)


def test_convention_poses_are_float64():
    document = {"K": np.float32(K).tolist(), "R": np.eye(3, dtype=int).tolist(), "t": [0, 0, 1]}
    camera = camera_from_dict(document, (320, 240), "here")
    assert {a.dtype for a in (camera.K, camera.R, camera.t, camera.distortion)} == {np.dtype(np.float64)}


@settings(max_examples=50, deadline=None)
@given(
    rotvecs,
    vectors,
    st.lists(st.tuples(unit, unit, st.floats(0.1, 1e4)), min_size=1, max_size=5),
    st.booleans(),
)
def test_project_inverts_unproject(rotvec, t, samples, is_distorted):
    camera = make_camera(rotvec, t, LENS if is_distorted else None)
    values = np.array(samples)
    pixels = (values[:, :2] + 1) / 2 * [319, 239]
    again, depth = camera.project(camera.unproject(pixels, values[:, 2]))
    np.testing.assert_allclose(again, pixels, atol=1e-6)
    np.testing.assert_allclose(depth, values[:, 2], rtol=1e-9, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(rotvecs, vectors, st.floats(1e-6, 1e6))
def test_projection_does_not_depend_on_the_scale_of_the_world(rotvec, t, scale):
    camera = make_camera(rotvec, t)
    point = camera.unproject(np.array([30.0, 200.0]), np.array(3.0))
    scaled = dataclasses.replace(camera, t=camera.t * scale)
    np.testing.assert_allclose(scaled.project(point * scale)[0], [30, 200], atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 2000), st.integers(1, 2000), st.tuples(unit, unit))
def test_resized_keeps_pixel_areas(width, height, where):
    camera = make_camera()
    point = camera.unproject((np.array(where) + 1) / 2 * [319, 239], np.array(2.0))
    pixel, _ = camera.project(point)
    resized, _ = camera.resized((width, height)).project(point)
    np.testing.assert_allclose(resized, (pixel + 0.5) * [width / 320, height / 240] - 0.5, atol=1e-9)


def test_resized_agrees_with_area_averaging():
    # A box filter is what resizing means: the mean position of a 2x2 block is its middle.
    columns = np.tile(np.arange(8, dtype=np.float32), (8, 1))
    small = cv2.resize(columns, (4, 4), interpolation=cv2.INTER_AREA)
    camera = Camera(np.array([[8.0, 0, 0], [0, 8.0, 0], [0, 0, 1]]), np.eye(3), np.zeros(3), (8, 8))
    x_small = camera.resized((4, 4)).project(np.array([small[0, 2] / 8, 0, 1.0]))[0][0]
    assert x_small == pytest.approx(2)


def test_lens_is_opencvs():
    camera = make_camera(distortion=LENS)
    points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 6], (20, 3)) - camera.t
    points = points @ camera.R
    rotvec = Rotation.from_matrix(camera.R).as_rotvec()
    expected = cv2.projectPoints(points, rotvec, camera.t, camera.K, LENS)[0][:, 0]
    np.testing.assert_allclose(camera.project(points)[0], expected, atol=1e-9)
    assert camera.is_distorted and not camera.without_distortion().is_distorted


def test_skew_is_inverted():
    camera = make_camera()
    camera.K[0, 1] = 7.0
    pixel = np.array([12.0, 34.0])
    np.testing.assert_allclose(camera.project(camera.unproject(pixel, np.array(2.0)))[0], pixel)


def test_points_behind_have_no_pixel():
    camera = Camera(K, np.eye(3), np.zeros(3), (320, 240))
    pixels, depth = camera.project(np.array([[0, 0, -1.0], [0, 0, 0.0], [0, 0, 1e-9]]))
    assert np.isnan(pixels[:2]).all() and np.isfinite(pixels[2]).all()
    np.testing.assert_array_equal(depth[:2], [-1, 0])


@pytest.mark.parametrize("is_distorted", [False, True])
def test_tracks_round_trip_through_json(is_distorted):
    lens = LENS if is_distorted else None
    moving = CameraTrack(
        "cam00", (make_camera(distortion=lens), make_camera((0, 0.1, 0), distortion=lens)), 0.5, 9.0
    )
    still = CameraTrack("cam01", (make_camera(),), 0.25)
    tracks = tracks_from_dict(tracks_to_dict({"cam00": moving, "cam01": still}), "file")
    assert tracks["cam01"].far == float("inf") and tracks["cam00"].far == 9.0
    assert tracks["cam01"].is_static and not tracks["cam00"].is_static
    for before, after in zip(moving.cameras, tracks["cam00"].cameras, strict=True):
        assert before.size == after.size
        for key in ("K", "R", "t", "distortion"):
            np.testing.assert_array_equal(getattr(before, key), getattr(after, key))


def test_track_at_a_frame():
    still = CameraTrack("cam00", (make_camera(),))
    moving = CameraTrack("cam01", (make_camera(), make_camera((0, 0, 0))))
    assert still.at(1000) is still.cameras[0]
    assert moving.at(1) is moving.cameras[1]
    for frame in (-1, 2):
        with pytest.raises(InputError, match=r"camera cam01: expected a frame in 0\.\.1, got"):
            moving.at(frame)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"K": np.full((3, 3), np.nan)}, "finite"),
        ({"t": np.array([0, np.inf, 0])}, "finite"),
        ({"K": np.array([[400.0, 0, 1e300], [0, 400, 120], [0, 0, 1]])}, "below 1e"),
        ({"K": np.diag([0.0, 400, 1])}, "positive focal lengths"),
        ({"K": np.diag([400.0, -400, 1])}, "positive focal lengths"),
        ({"K": np.diag([400.0, 400, 2])}, "last row 0 0 1"),
        ({"K": np.array([[400.0, 0, 160], [1, 400, 120], [0, 0, 1]])}, "zeros below them"),
        ({"R": np.diag([1.0, 1, 1.01])}, "R must be a rotation"),
        ({"R": np.diag([1.0, 1, -1])}, "determinant -1"),
        ({"R": np.zeros((3, 3))}, "R must be a rotation"),
    ],
)
def test_unusable_cameras_are_refused_by_name(change, sentence):
    with pytest.raises(InputError, match=sentence) as caught:
        check_camera(dataclasses.replace(make_camera(), **change), "calib.json, camera left")
    assert str(caught.value).startswith("calib.json, camera left: ")


@pytest.mark.parametrize(
    "document",
    [
        {"R": np.eye(3).tolist(), "t": [0, 0, 0]},
        {"K": [1, 2], "R": np.eye(3).tolist(), "t": [0, 0, 0]},
        {"K": K.tolist(), "R": np.eye(3).tolist(), "t": "zero"},
        {"K": K.tolist(), "R": np.eye(3).tolist(), "t": [0, 0, 0], "distortion": [0] * 8},
    ],
)
def test_malformed_entries_are_refused_by_name(document):
    with pytest.raises(InputError, match="here: expected K 3x3"):
        camera_from_dict(document, (320, 240), "here")


def test_sizes_that_no_picture_has_are_refused():
    document = tracks_to_dict({"cam00": CameraTrack("cam00", (make_camera(),))})
    document["cam00"]["size"][1] = 10**300
    with pytest.raises(InputError, match="cameras by name in file"):
        tracks_from_dict(document, "file")
