"""Delays from motion on epipolar planes: blobs on known paths, seen from directions far apart."""

import dataclasses

import numpy as np
import pytest

from fourd.align.epipolar_motion import compare_motion, motion_on_planes
from fourd.align.motion_maps import MotionMaps
from fourd.camera import Camera
from fourd.geometry import look_at

SIZE = (120, 68)
K = np.array([[100.0, 0, 59.5], [0, 100, 33.5], [0, 0, 1]])
UP = np.array([0, 0, 1.0])


def make_camera(angle_deg: float) -> Camera:
    angle = np.radians(angle_deg)
    R, t = look_at(np.array([5 * np.sin(angle), -5 * np.cos(angle), 1.6]), np.array([0, 0, 1.0]), UP)
    return Camera(K, R, t, SIZE)


def make_maps(angle_deg: float, start_s: float, fps=30.0, num_frames=60, event=0, shake=0.02) -> MotionMaps:
    """Twelve blobs that rise, fall and stop; how bright each is depends on the camera."""
    paths, own = np.random.default_rng(event), np.random.default_rng(int(angle_deg) + 100)
    center = paths.uniform([-1, -0.5, 0.2], [1, 0.5, 1.8], (12, 3))
    swing, rate, phase = (
        paths.uniform(0.1, 0.4, (12, 3)),
        paths.uniform(3, 8, (12, 3)),
        paths.uniform(0, 6, (12, 3)),
    )
    look = own.uniform(0.3, 1, 12)
    own_s = np.arange(num_frames) / fps
    column, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    still, maps, cameras = make_camera(angle_deg), [], []
    for time_s in own_s + start_s:
        moved = dataclasses.replace(still, t=still.t + own.normal(0, shake, 3))
        pixels, _ = moved.project(center + swing * np.sin(rate * time_s + phase))
        speed = np.linalg.norm(swing * rate * np.cos(rate * time_s + phase), axis=1)
        distance = (column[..., None] - pixels[:, 0]) ** 2 + (row[..., None] - pixels[:, 1]) ** 2
        amount = (look * np.minimum(speed, 1) * np.exp(-distance / 8)).sum(axis=-1)
        maps.append(np.clip(255 * amount, 0, 255).astype(np.uint8))
        cameras.append(moved)
    return MotionMaps(f"cam{int(angle_deg):02d}", "ok", own_s, np.stack(maps), tuple(cameras))


@pytest.mark.parametrize(("angle_deg", "delay_s", "fps"), [(15, 0.0, 30), (45, 0.311, 30), (60, -0.747, 25)])
def test_delay_across_wide_angles_and_frame_rates(angle_deg, delay_s, fps):
    left, right = make_maps(0, 0.2), make_maps(angle_deg, 0.2 + delay_s, fps)
    delay = compare_motion(left, right, (-1.2, 1.2)).delay
    assert delay.status == "ok"
    assert delay.delay_s == pytest.approx(delay_s, abs=0.3 / 30)
    assert delay.sigma_s < 1 / 30


def test_swapped_films_give_the_opposite_delay():
    left, right = make_maps(0, 0.0), make_maps(30, 0.25)
    forth, back = compare_motion(left, right, (-1, 1)).delay, compare_motion(right, left, (-1, 1)).delay
    assert back.delay_s == pytest.approx(-forth.delay_s, abs=0.15 / 30)


@pytest.mark.parametrize("event", range(1, 7))
def test_another_event_is_refused(event):
    match = compare_motion(make_maps(0, 0.0), make_maps(30, 0.1, event=event), (-1.2, 1.2))
    assert "no offset stands out" in match.delay.status
    assert match.delay.score < 0.5


def test_a_film_played_backwards_is_refused():
    left, right = make_maps(0, 0.0), make_maps(30, 0.1)
    backwards = dataclasses.replace(right, maps=right.maps[::-1], cameras=right.cameras[::-1])
    assert compare_motion(left, backwards, (-1.2, 1.2)).delay.status != "ok"


def test_silent_films_and_films_that_do_not_overlap_are_named():
    left = make_maps(0, 0.0)
    silent = MotionMaps("cam30", "nothing moves", np.zeros(0), np.zeros((0, 1, 1), np.uint8), ())
    match = compare_motion(left, silent, (-1, 1))
    assert match.delay.status == "cam30: nothing moves"
    assert match.delay.score == 0
    assert "share less than" in compare_motion(left, make_maps(30, 0.0), (5.0, 6.0)).delay.status


def test_cameras_in_one_place_have_no_epipolar_planes():
    left = make_maps(0, 0.0, shake=0.0)
    assert motion_on_planes(left, left) is None
    assert "share no epipolar plane" in compare_motion(left, left, (-1, 1)).delay.status


def test_the_scale_of_the_world_changes_nothing():
    left, right = make_maps(0, 0.0), make_maps(45, 0.2)
    tables = motion_on_planes(left, right)
    large = [
        dataclasses.replace(m, cameras=tuple(dataclasses.replace(c, t=c.t * 1000) for c in m.cameras))
        for m in (left, right)
    ]
    scaled = motion_on_planes(*large)
    assert tables is not None
    assert scaled is not None
    for one, other in zip(tables, scaled, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
