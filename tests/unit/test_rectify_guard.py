"""What is measured of a pair before it is matched, and which kind of matching follows from it."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd.camera import CameraTrack
from fourd.cli import run_stage
from fourd.io import Archive, write_json
from fourd.stereo.__main__ import main
from fourd.stereo.files import read_rectification, write_rectification
from fourd.stereo.guard import Refusal, epipole_outside, measure_poses, roll_deg
from fourd.stereo.rectification import Rectification
from fourd.stereo.rectify import disparity_from_depth, rectify_pair, rectify_tracks, sampling_maps
from fourd.stereo.sweep_frame import plane_motion
from fourd.stereo.volume import RectifyOptions
from tests.unit.test_rectify import (
    LENS,
    RANGE,
    camera_at,
    check_alignment,
    interpolated,
    on_arc,
    rectified,
    refused,
    seen_points,
)

BEHIND = camera_at([0, -6, 1], [0, 0, 1])
BEFORE = camera_at([0.2, -4.6, 1.1], [0, 0, 1])


def check_sweep(left, right, swept, tolerance_px=0.1):
    """Points that both cameras see are found where the maps and the planes say, inside range and image."""
    points = seen_points(left, right)
    assert len(points) > 20
    for side, source, other in (("left", left, right), ("right", right, left)):
        pinhole = swept.camera(side)
        pixels, depth = pinhole.project(points)
        assert np.all(pixels >= -0.01) and np.all(pixels <= np.array(pinhole.size) - 0.99)
        map_x, map_y, valid = sampling_maps(swept, source, side)
        inside = interpolated(valid, pixels) > 1 - 1e-9
        sampled = np.stack([interpolated(map_x, pixels), interpolated(map_y, pixels)], axis=1)
        assert np.abs(sampled - source.project(points)[0])[inside].max() < tolerance_px
        disparity = disparity_from_depth(swept, depth, side)
        A, b = plane_motion(pinhole, other)
        i = 0 if side == "left" else 1
        s = disparity * swept.inverse_depth_per_px[i]
        plane = np.c_[pixels, np.ones(len(pixels))] @ A.T + s[:, None] * b
        there = other.pixels_from_normalized(plane[:, :2] / plane[:, 2:])
        assert np.abs(there - other.project(points)[0]).max() < 1e-6
        low, high = swept.disparity_range if i == 0 else swept.swept.disparity_range_right
        slack = 0.02 * (high - low)
        assert low - slack <= disparity.min() and disparity.max() <= high + slack


class TestMeasures:
    @pytest.mark.parametrize("roll", [0, 35, 90, -90, 179])
    def test_roll_in_closed_form(self, roll):
        left = camera_at([0, -5, 1], [0, 0, 1])
        right = camera_at([0.3, -5, 1], [0.3, 0, 1], roll_deg=roll)
        assert roll_deg(left, right) == pytest.approx(roll, abs=1e-6)
        assert roll_deg(right, left) == pytest.approx(-roll, abs=1e-6)

    def test_epipole_in_closed_form(self):
        """The other camera is seen at the left border, half a width to the left, and nowhere."""
        camera = camera_at([0, 0, 0], [0, 1, 0])
        edge = 159.5 / 300
        assert epipole_outside(camera, np.array([-0.99 * edge, 1, 0])) == 0
        assert epipole_outside(camera, np.array([-2 * edge, 1, 0])) == pytest.approx(0.5)
        assert epipole_outside(camera, np.array([2 * edge, -1, 0])) == pytest.approx(0.5)
        assert epipole_outside(camera, np.array([1.0, 0, 0])) == np.inf
        assert np.isnan(epipole_outside(camera, np.zeros(3)))

    def test_planar_pair_is_measured_whole(self):
        guard = rectified(on_arc(0), on_arc(13, focal_px=450.0)).guard
        assert guard.angle_deg == pytest.approx(13, abs=0.5) and guard.axes_deg == pytest.approx(13, abs=0.5)
        assert guard.focal_ratio == pytest.approx(1.5)
        assert 0.2 < guard.overlap <= 1 and 1 < guard.stretch < 3
        assert guard.disparity_low < guard.disparity_high
        assert all(np.isfinite(v) or v == np.inf for v in dataclasses.asdict(guard).values())

    def test_depth_error_is_that_of_a_shifted_disparity(self):
        """Two ways to the same number: from the angle, and by moving the disparity of the centre."""
        left, right = on_arc(0), on_arc(10)
        rectification = rectified(left, right)
        depth = rectification.camera("left").project(np.array([[0, 0, 1.0]]))[1]
        disparity = disparity_from_depth(rectification, depth) - rectification.disparity_at_infinity[0]
        assert rectification.guard.depth_error == pytest.approx(0.3 / disparity[0], rel=0.05)

    @given(scale=st.sampled_from([1e-6, 1.0, 1e6]), far_away=st.sampled_from([0.0, 1e7]))
    @settings(max_examples=6, deadline=None)
    def test_scale_and_origin_of_the_world_change_nothing(self, scale, far_away):
        def moved(camera):
            center = (camera.center + np.array([far_away, -far_away, 0])) * scale
            return dataclasses.replace(camera, t=-camera.R @ center)

        depths = (RANGE[0] * scale, RANGE[1] * scale)
        for left, right in ((on_arc(0), on_arc(20)), (BEHIND, BEFORE)):
            plain = rectified(left, right)
            other = rectify_pair(moved(left), moved(right), depths, depths, RectifyOptions())
            assert isinstance(other, Rectification) and other.kind == plain.kind
            assert other.size == plain.size and other.size_right == plain.size_right
            np.testing.assert_allclose(other.disparity_range, plain.disparity_range, rtol=1e-5, atol=1e-4)
            for name, value in dataclasses.asdict(plain.guard).items():
                expected = value * scale if name == "baseline" else value
                # Of 24 x 24 samples, one on the very border may fall to either side.
                slack = 2 / 24**2 if name == "overlap" else 1e-4
                assert getattr(other.guard, name) == pytest.approx(expected, rel=1e-4, abs=slack, nan_ok=True)


class TestKinds:
    def test_epipole_in_the_image_is_swept(self):
        swept = rectified(BEHIND, BEFORE)
        assert swept.kind == "sweep" and "epipole" in swept.swept.obstacle
        assert swept.guard.epipole_left == swept.guard.epipole_right == 0
        check_sweep(BEHIND, BEFORE, swept)

    @pytest.mark.parametrize(
        "left, right",
        [
            (camera_at([0, -6, 1], [0, 0, 1], lens=LENS), camera_at([0.2, -4.6, 1.1], [0, 0, 1], lens=-LENS)),
            (camera_at([0, -6, 1], [0, 0, 1], size=(180, 320)), BEFORE),
            (camera_at([0, -6, 1], [0, 0, 1], roll_deg=180), BEFORE),
            (
                camera_at([0, -6, 1], [0, 0, 1], roll_deg=90),
                camera_at([0.2, -4.6, 1], [0, 0, 1], roll_deg=-60),
            ),
            (camera_at([0, -6, 1], [0, 0, 1], focal_px=500.0), camera_at([0.2, -4.6, 1], [0, 0, 1])),
        ],
        ids=["lens", "portrait", "upside_down", "rolled", "zoomed"],
    )
    def test_sides_of_a_sweep_are_where_the_cameras_look(self, left, right):
        swept = rectified(left, right)
        assert swept.kind == "sweep"
        check_sweep(left, right, swept)

    def test_too_much_stretch_is_swept(self):
        swept = rectified(on_arc(0), on_arc(30), RectifyOptions(max_stretch=1.05))
        assert swept.kind == "sweep" and "stretch" in swept.swept.obstacle
        check_sweep(on_arc(0), on_arc(30), swept)

    def test_exchanged_cameras_exchange_the_sides(self):
        one, two = rectified(BEHIND, BEFORE), rectified(BEFORE, BEHIND)
        assert one.inverse_depth_per_px == two.inverse_depth_per_px[::-1]
        assert one.disparity_range == two.swept.disparity_range_right and one.size == two.size_right

    def test_near_zero_baseline_along_the_axis_names_the_depth_error(self):
        reason = refused(BEHIND, camera_at([0, -5.99, 1], [0, 0, 1]))
        assert "epipole" in reason and "less than 1" in reason and "% of its depth" in reason

    def test_pure_rotation_is_refused(self):
        assert "share one centre" in refused(BEHIND, camera_at([0, -6, 1], [0.5, 0, 1], roll_deg=90))

    @given(
        center=st.tuples(st.floats(-3, 3), st.floats(-6, -2), st.floats(0.3, 2.5)),
        roll=st.floats(-180, 180),
        focal_px=st.floats(150, 700),
        bent=st.booleans(),
    )
    @settings(max_examples=40, deadline=None)
    def test_any_pair_is_planar_swept_or_refused_for_good(self, center, roll, focal_px, bent):
        left = camera_at([0, -5, 1], [0, 0, 1], lens=LENS if bent else None)
        right = camera_at(center, [0, 0.3, 1], roll_deg=roll, focal_px=focal_px)
        result = rectify_pair(left, right, RANGE, RANGE, RectifyOptions())
        if isinstance(result, Refusal):
            assert len(result.reason) > 20
        elif result.kind == "planar":
            check_alignment(left, right, result, 0.02)
        else:
            check_sweep(left, right, result)


class TestFiles:
    def test_swept_pair_round_trip(self, tmp_path):
        moving = tuple(camera_at([0.2, -4.6 + 0.1 * i, 1.1], [0, 0, 1]) for i in range(3))
        pair = rectify_tracks(
            CameraTrack("a", (BEHIND,), *RANGE), CameraTrack("b", moving, *RANGE), RectifyOptions()
        )
        assert pair.kind == "sweep" and len(pair.frames) == 3
        write_rectification(tmp_path / "a-b.npz", pair)
        again = read_rectification(tmp_path / "a-b.npz")
        assert (again.kind, again.obstacle) == (pair.kind, pair.obstacle)
        assert (again.size, again.size_right, again.measures) == (pair.size, pair.size_right, pair.measures)
        for one, two in zip(pair.frames, again.frames, strict=True):
            for key, array in one.to_arrays().items():
                np.testing.assert_array_equal(two.to_arrays()[key], array)

    def test_all_frames_are_of_one_kind(self):
        """One frame that no plane can hold has every frame swept."""
        moving = (camera_at([2.2, -4.6, 1.1], [0, 0, 1]), BEFORE)
        kinds = [rectified(BEHIND, camera).kind for camera in moving]
        assert kinds == ["planar", "sweep"]
        pair = rectify_tracks(
            CameraTrack("a", (BEHIND,), *RANGE), CameraTrack("b", moving, *RANGE), RectifyOptions()
        )
        assert [r.kind for r in pair.frames] == ["sweep", "sweep"]

    def test_refused_pair_keeps_what_was_measured(self, tmp_path):
        """Parallel cameras without overlap: their epipoles are infinitely far away."""
        left, right = camera_at([0, 0, 0], [0, 1, 0]), camera_at([9, 0, 0], [9, 1, 0])
        pair = rectify_tracks(
            CameraTrack("a", (left,), 2, 4), CameraTrack("b", (right,), 2, 4), RectifyOptions()
        )
        write_rectification(tmp_path / "a-b.npz", pair)
        again = read_rectification(tmp_path / "a-b.npz")
        assert again.kind is None and "no overlap" in again.status
        assert again.measures["overlap"] == (0, 0) and again.measures["epipole_left"] == (np.inf, np.inf)
        assert "angle_deg" not in again.measures

    def test_command_says_what_it_measured(self, tmp_path, caplog):
        from fourd.camera import tracks_to_dict

        caplog.set_level("INFO")
        tracks = {n: CameraTrack(n, (c,), *RANGE) for n, c in (("cam00", BEHIND), ("cam01", BEFORE))}
        write_json(tmp_path / "cameras.json", {"cameras": tracks_to_dict(tracks)})
        words = ["rectify", "--cameras", tmp_path / "cameras.json", "--left", "cam00", "--right", "cam01"]
        assert run_stage(main, [str(w) for w in [*words, "--output", tmp_path / "pair.npz"]]) == 0
        assert "cam00-cam01 sweep (the epipole lies" in caplog.text and "depth error" in caplog.text
        meta = Archive(tmp_path / "pair.npz").meta
        assert meta["kind"] == "sweep" and meta["guard"]["focal_ratio"] == [1, 1]


def test_poses_alone_are_measured_for_one_centre():
    guard = measure_poses(BEHIND, BEHIND)
    assert guard.baseline == 0 and guard.axes_deg == 0 and np.isnan(guard.epipole_left)


@pytest.mark.filterwarnings("error")
def test_epipole_of_an_axis_across_a_tiny_baseline_and_of_one_column():
    camera = on_arc(0)
    across = camera.R.T @ np.array([1e-170, 0, 0])
    centred = dataclasses.replace(camera, t=np.zeros(3))
    assert epipole_outside(centred, across) == float("inf")
    column = dataclasses.replace(camera, size=(1, camera.size[1]))
    assert epipole_outside(column, camera.center + camera.R.T @ np.array([1.0, 0, 1.0])) == float("inf")
