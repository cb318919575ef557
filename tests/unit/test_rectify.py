import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from fourd import config
from fourd.camera import Camera, CameraTrack
from fourd.errors import InputError
from fourd.geometry import look_at
from fourd.stereo.guard import Refusal
from fourd.stereo.rectify import (
    Rectification,
    disparity_from_depth,
    inverse_depth_from_disparity,
    rectify_pair,
    rectify_tracks,
    rectifying_rotation,
    sampling_maps,
)
from fourd.stereo.volume import RectifyOptions, common_volume

LENS = np.array([-0.12, 0.03, 0.001, -0.002, 0.0])
RANGE = (2.0, 20.0)


def camera_at(center, target, focal_px=300.0, size=(320, 180), roll_deg=0.0, lens=None):
    R, _ = look_at(np.asarray(center, float), np.asarray(target, float), np.array([0.0, 0.0, 1.0]))
    roll = np.radians(roll_deg)
    spin = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    K = np.array([[focal_px, 0, (size[0] - 1) / 2], [0, focal_px, (size[1] - 1) / 2], [0, 0, 1.0]])
    R = spin @ R
    return Camera(K, R, -R @ np.asarray(center, float), size, np.zeros(5) if lens is None else lens)


def on_arc(angle_deg, radius=5.0, height=1.6, **kwargs):
    angle = np.radians(angle_deg)
    center = [radius * np.sin(angle), -radius * np.cos(angle), height]
    return camera_at(center, [0.0, 0.0, 1.0], **kwargs)


def rectified(left, right, options=None, far=RANGE[1], near=RANGE[0]):
    result = rectify_pair(left, right, (near, far), (near, far), options or RectifyOptions())
    assert isinstance(result, Rectification), result
    return result


def refused(left, right, options=None, far=RANGE[1], near=RANGE[0]):
    result = rectify_pair(left, right, (near, far), (near, far), options or RectifyOptions())
    assert isinstance(result, Refusal)
    return result.reason


def seen_points(left, right, near=RANGE[0], far=RANGE[1], count=4000):
    """World points inside both images and both depth ranges, drawn along rays of the left image."""
    rng = np.random.default_rng(0)
    size = np.array(left.size) - 1
    points = left.unproject(rng.uniform(0, size, (count, 2)), 1 / rng.uniform(1 / far, 1 / near, count))
    pixels, depth = right.project(points)
    with np.errstate(invalid="ignore"):
        seen = np.all((pixels >= 0) & (pixels <= np.array(right.size) - 1), axis=1)
    return points[seen & (depth >= near) & (depth <= far)]


def interpolated(array, pixels):
    return map_coordinates(array.astype(np.float64), pixels[:, ::-1].T, order=1, mode="nearest")


def check_alignment(left, right, rectification, tolerance_px=0.01):
    """Points that both cameras see lie inside both rectified images, on one row, at the source's pixel."""
    points = seen_points(left, right)
    assert len(points) > 20
    rows = []
    low, high = rectification.disparity_range
    columns = []
    for side, source in (("left", left), ("right", right)):
        pixels, _ = rectification.camera(side).project(points)
        assert np.all(pixels >= -1e-6)
        assert np.all(pixels <= np.array(rectification.size) - 1 + 1e-6)
        map_x, map_y, valid = sampling_maps(rectification, source, side)
        inside = interpolated(valid, pixels) > 1 - 1e-9
        assert inside.mean() > 0.9
        sampled = np.stack([interpolated(map_x, pixels), interpolated(map_y, pixels)], axis=1)
        expected, _ = source.project(points)
        assert np.abs(sampled - expected)[inside].max() < tolerance_px
        rows.append(pixels[:, 1])
        columns.append(pixels[:, 0])
    assert np.abs(rows[0] - rows[1]).max() < 1e-8
    disparity = columns[0] - columns[1]
    assert low - 1e-6 <= disparity.min() and disparity.max() <= high + 1e-6


class TestRectifiedPair:
    @pytest.mark.parametrize("angle_deg", [2, 13, 26, 40])
    def test_rows_of_projected_points_agree(self, angle_deg):
        left, right = on_arc(0), on_arc(angle_deg, height=1.9)
        check_alignment(left, right, rectified(left, right))

    @pytest.mark.parametrize("rolls", [(0, 180), (90, 0), (180, 180), (-90, 90), (30, -60)])
    def test_rows_agree_for_rolled_cameras(self, rolls):
        left, right = on_arc(0, roll_deg=rolls[0]), on_arc(15, roll_deg=rolls[1])
        check_alignment(left, right, rectified(left, right))

    def test_rows_agree_for_portrait_beside_landscape(self):
        left, right = on_arc(0, size=(180, 320)), on_arc(14, focal_px=350.0)
        check_alignment(left, right, rectified(left, right))

    def test_rows_agree_through_a_lens(self):
        left, right = on_arc(0, lens=LENS), on_arc(14, lens=-LENS)
        check_alignment(left, right, rectified(left, right))

    def test_rows_agree_for_a_vertical_baseline(self):
        left, right = camera_at([0, -5, 0.6], [0, 0, 1]), camera_at([0, -5, 1.9], [0, 0, 1])
        check_alignment(left, right, rectified(left, right))

    @given(
        angle_deg=st.floats(-45, 45),
        heights=st.tuples(st.floats(0.5, 3), st.floats(0.5, 3)),
        radii=st.tuples(st.floats(4, 7), st.floats(4, 7)),
        rolls=st.tuples(st.floats(-180, 180), st.floats(-180, 180)),
        focals=st.tuples(st.floats(200, 500), st.floats(200, 500)),
        bent=st.booleans(),
    )
    @settings(max_examples=40, deadline=None)
    def test_any_pair_is_aligned_or_refused_with_a_reason(
        self, angle_deg, heights, radii, rolls, focals, bent
    ):
        lens = LENS if bent else None
        left, right = (
            on_arc(a, radius=r, height=h, roll_deg=roll, focal_px=f, lens=lens)
            for a, r, h, roll, f in zip((0, angle_deg), radii, heights, rolls, focals, strict=True)
        )
        result = rectify_pair(left, right, RANGE, RANGE, RectifyOptions())
        if isinstance(result, Refusal):
            assert len(result.reason) > 20
        elif result.kind == "planar":
            # A pixel near a lens' fold is bent more between samples of the map.
            check_alignment(left, right, result, 0.02 if bent else 0.01)

    def test_resolution_at_the_image_centre_is_kept(self):
        left, right = on_arc(0), on_arc(30)
        rectification = rectified(left, right)
        map_x, map_y, _ = sampling_maps(rectification, left, "left")
        centre, _ = rectification.camera("left").project(left.center + 5 * left.forward)
        column, row = np.rint(centre).astype(int)
        area = np.linalg.det(
            [
                [map_x[row, column + 1] - map_x[row, column], map_x[row + 1, column] - map_x[row, column]],
                [map_y[row, column + 1] - map_y[row, column], map_y[row + 1, column] - map_y[row, column]],
            ]
        )
        assert abs(area) == pytest.approx(1, rel=0.02)

    def test_images_hold_nothing_that_cannot_match(self):
        """Cameras in parallel, half overlapping: half of each image is left."""
        left, right = camera_at([0, 0, 0], [0, 1, 0]), camera_at([1, 0, 0], [1, 1, 0])
        rectification = rectified(left, right, RectifyOptions(depth_margin=0), near=2, far=2.001)
        assert rectification.size[0] == pytest.approx(320 - 150, abs=2)
        assert rectification.size[1] == pytest.approx(180, abs=2)

    @pytest.mark.parametrize("scale", [1e-6, 1e6])
    def test_world_scale_changes_nothing(self, scale):
        def scaled(camera):
            return dataclasses.replace(camera, t=camera.t * scale)

        left, right = on_arc(0), on_arc(20)
        plain = rectified(left, right)
        other = rectified(scaled(left), scaled(right), near=RANGE[0] * scale, far=RANGE[1] * scale)
        assert other.size == plain.size
        np.testing.assert_allclose(other.disparity_range, plain.disparity_range, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(other.K_left, plain.K_left, rtol=1e-6)

    def test_infinite_far_reaches_the_disparity_of_infinity(self):
        rectification = rectified(on_arc(0), on_arc(13), far=np.inf)
        assert rectification.disparity_range[0] == pytest.approx(rectification.disparity_at_infinity[0])

    def test_arrays_round_trip(self):
        rectification = rectified(on_arc(0), on_arc(13))
        arrays = rectification.to_arrays()
        assert set(arrays) == {
            "K_left", "K_right", "R_left", "R_right", "center_left", "center_right", "baseline",
            "disparity_range", "disparity_at_infinity", "inverse_depth_per_px",
        }  # fmt: skip
        again = Rectification.from_arrays(arrays, rectification.size, rectification.size, "here")
        for key, array in again.to_arrays().items():
            np.testing.assert_array_equal(array, arrays[key])

    def test_maps_leave_the_source_image_as_invalid(self):
        left = on_arc(0, lens=LENS)
        rectification = rectified(left, on_arc(13))
        map_x, map_y, valid = sampling_maps(rectification, left, "left")
        assert map_x.dtype == map_y.dtype == np.float32
        assert map_x.shape == valid.shape == rectification.size[::-1]
        assert 0.5 < valid.mean() < 1
        assert map_x[valid].min() > -0.01 and map_x[valid].max() < 319.01
        assert map_y[valid].min() > -0.01 and map_y[valid].max() < 179.01

    def test_a_lens_that_folds_back_shows_nothing_twice(self):
        left = on_arc(0, lens=np.array([-0.25, 0, 0, 0, 0.0]))
        rectification = dataclasses.replace(rectified(left, on_arc(13)), size=(2600, 1800))
        _, _, valid = sampling_maps(rectification, left, "left")
        rows, columns = np.nonzero(valid)
        rays = rectification.camera("left").rays(np.stack([columns, rows], axis=-1))
        in_left = rays @ (left.R @ rectification.R.T).T
        assert np.abs(in_left[:, 0] / in_left[:, 2]).max() < 0.7

    def test_stretch_is_that_of_the_maps(self):
        left, right = on_arc(0), on_arc(30)
        rectification = rectified(left, right)
        worst = 1.0
        for side, source in (("left", left), ("right", right)):
            map_x, map_y, valid = sampling_maps(rectification, source, side)
            (xy, xx), (yy, yx) = np.gradient(map_x), np.gradient(map_y)
            linear = np.sqrt(np.abs(xx * yy - xy * yx))[valid]
            worst = max(worst, linear.max(), 1 / linear.min())
        assert rectification.guard.stretch == pytest.approx(worst, rel=0.05)


class TestCommonVolume:
    def test_vertices_of_parallel_cameras_in_closed_form(self):
        left, right = camera_at([0, 0, 0], [0, 1, 0]), camera_at([1, 0, 0], [1, 1, 0])
        vertices = common_volume(left, right, rectifying_rotation(left, right), (2, 4), (2, 4))
        edge = 159.5 / 300
        x, y, disparity = vertices.T
        assert disparity.min() == pytest.approx(1 / 4) and disparity.max() == pytest.approx(1 / 2)
        assert x.max() == pytest.approx(edge) and x.min() == pytest.approx(1 / 4 - edge)
        assert y.max() == pytest.approx(89.5 / 300) and y.min() == pytest.approx(-89.5 / 300)

    def test_is_empty_when_depth_ranges_contradict(self):
        left, right = on_arc(0), on_arc(13)
        vertices = common_volume(left, right, rectifying_rotation(left, right), (2, 3), (20, 30))
        assert len(vertices) == 0


class TestRefusals:
    def test_one_centre(self):
        assert "share one centre" in refused(
            camera_at([0, 0, 0], [0, 1, 0]), camera_at([0, 0, 0], [0.1, 1, 0])
        )

    def test_cameras_that_face_each_other(self):
        reason = refused(camera_at([0, -5, 1], [0, 0, 1]), camera_at([0, 5, 1], [0, 0, 1]), far=9)
        assert "epipole" in reason and "swept" in reason and "degrees apart, more than 50" in reason

    def test_ninety_degrees_apart(self):
        assert "89 degrees apart, more than 50" in refused(
            on_arc(0, focal_px=700.0), on_arc(90, focal_px=700.0)
        )

    def test_opposite_axes_side_by_side(self):
        reason = refused(camera_at([0, 0, 0], [0, 1, 0]), camera_at([1, 0, 0], [1, -1, 0]))
        assert "180 degrees apart" in reason

    def test_narrow_baseline_names_the_depth_error(self):
        reason = refused(on_arc(0), on_arc(0.1))
        assert "0.099 degrees apart" in reason and "% of its depth" in reason

    def test_focal_lengths_too_different(self):
        assert "factor 10.0" in refused(on_arc(0), on_arc(13, focal_px=3000.0))

    def test_no_overlap(self):
        left, right = camera_at([0, 0, 0], [0, 1, 0]), camera_at([9, 0, 0], [9, 1, 0])
        assert "no overlap" in refused(left, right, far=4)

    def test_little_overlap(self):
        left, right = camera_at([0, 0, 0], [-0.4, 1, 0]), camera_at([1.5, 0, 0], [1.9, 1, 0])
        assert "can be seen by the other camera" in refused(left, right, far=20)

    def test_very_wide_lens(self):
        left, right = (camera_at([x, 0, 0], [x, 1, 0], focal_px=25.0) for x in (0, 1))
        assert "one plane cannot hold both" in refused(left, right)


class TestTracks:
    def test_static_pair_has_one_frame(self):
        pair = rectify_tracks(
            CameraTrack("a", (on_arc(0),), *RANGE), CameraTrack("b", (on_arc(13),), *RANGE), RectifyOptions()
        )
        assert pair.status == "ok" and len(pair.frames) == pair.num_frames == 1
        assert pair.angle_deg == pytest.approx(13, abs=0.5)
        assert pair.at(7) is pair.frames[0]

    def test_moving_pair_has_one_size(self):
        moving = tuple(on_arc(13 + i, height=1.6 + 0.1 * i) for i in range(4))
        pair = rectify_tracks(
            CameraTrack("a", (on_arc(0),), *RANGE), CameraTrack("b", moving, *RANGE), RectifyOptions()
        )
        assert [r.size for r in pair.frames] == [pair.size] * 4
        alone = [rectified(on_arc(0), camera).size for camera in moving]
        assert pair.size == tuple(np.max(alone, axis=0))
        for camera, rectification in zip(moving, pair.frames, strict=True):
            check_alignment(on_arc(0), camera, rectification)

    def test_one_refused_frame_refuses_the_pair(self):
        moving = (on_arc(13), on_arc(70), on_arc(75))
        pair = rectify_tracks(
            CameraTrack("a", (on_arc(0),), *RANGE), CameraTrack("b", moving, *RANGE), RectifyOptions()
        )
        assert "frame 1; 2 of 3 frames refused" in pair.status
        assert pair.frames == () and pair.num_frames == 3

    @pytest.mark.parametrize("near, far", [(0.0, 5.0), (5.0, 5.0), (-1.0, 5.0), (float("nan"), 5.0)])
    def test_depth_range_must_be_one(self, near, far):
        bad = CameraTrack("cam07", (on_arc(0),), near, far)
        with pytest.raises(InputError, match="cam07.*0 < near < far"):
            rectify_tracks(bad, CameraTrack("b", (on_arc(13),), *RANGE), RectifyOptions())


@given(
    depth=st.floats(0.5, 1e4),
    angle_deg=st.floats(3, 30),
)
@settings(max_examples=50, deadline=None)
def test_depth_and_disparity_are_inverse(depth, angle_deg):
    rectification = rectified(on_arc(0), on_arc(angle_deg))
    disparity = disparity_from_depth(rectification, np.array([depth]))
    assert 1 / inverse_depth_from_disparity(rectification, disparity)[0] == pytest.approx(depth, rel=1e-6)


def test_convention_disparity_is_x_left_minus_x_right():
    left, right = on_arc(0), on_arc(13)
    rectification = rectified(left, right)
    points = seen_points(left, right)
    x_left = rectification.camera("left").project(points)[0][:, 0]
    in_right, depth = rectification.camera("right").project(points)
    np.testing.assert_allclose(disparity_from_depth(rectification, depth), x_left - in_right[:, 0], atol=1e-8)


def test_convention_infinity_has_the_disparity_of_the_principal_points():
    rectification = rectified(on_arc(0), on_arc(13))
    expected = rectification.K_left[0, 2] - rectification.K_right[0, 2]
    assert expected < 0
    assert disparity_from_depth(rectification, np.array([np.inf]))[0] == expected
    assert inverse_depth_from_disparity(rectification, np.float32([expected]))[0] == pytest.approx(
        0, abs=1e-6
    )


def test_convention_rectified_cameras_differ_in_cx_alone():
    left, right = on_arc(0, roll_deg=20), on_arc(13)
    rectification = rectified(left, right)
    difference = rectification.K_left - rectification.K_right
    assert [tuple(i) for i in np.argwhere(difference != 0)] == [(0, 2)]
    x, y, z = rectification.R
    baseline = right.center - left.center
    np.testing.assert_allclose(x, baseline / np.linalg.norm(baseline), atol=1e-12)
    np.testing.assert_allclose(np.cross(z, x), y, atol=1e-12)
    assert z @ left.forward > 0.9 and z @ right.forward > 0.9


def test_disparity_keeps_single_precision():
    rectification = rectified(on_arc(0), on_arc(13))
    assert inverse_depth_from_disparity(rectification, np.zeros(3, np.float32)).dtype == np.float32


def test_schema_has_the_options_and_their_defaults():
    schema = config.load_yaml(config.SCHEMA_FOLDER / "rectify.schema.yaml")
    defaults = {key: entry["default"] for key, entry in schema["properties"].items()}
    assert defaults == dataclasses.asdict(RectifyOptions())
    assert schema["additionalProperties"] is False
    assert all(len(entry["description"]) > 20 for entry in schema["properties"].values())


def test_order_of_the_cameras_mirrors_the_pair():
    """Exchanging left and right turns the rectified frame by 180 degrees and keeps disparities."""
    left, right = on_arc(0), on_arc(13)
    one, two = rectified(left, right), rectified(right, left)
    assert one.size == two.size
    np.testing.assert_allclose(one.disparity_range, two.disparity_range, atol=1.0)
    np.testing.assert_allclose(one.R[:2], -two.R[:2], atol=1e-12)
