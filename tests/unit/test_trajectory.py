import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fourd import trajectory
from fourd.camera import Camera, CameraTrack, check_camera
from fourd.config import fill_defaults, validate
from fourd.errors import InputError
from fourd.geometry import angle_deg, look_at
from fourd.trajectory import TrajectorySpec, scene_frames, trajectory_from_mapping
from fourd.trajectory.arc_path import ArcPath
from fourd.trajectory.presets import place_cameras

SCHEMA = Path(__file__).resolve().parents[2] / "config" / "schemas" / "trajectories.schema.yaml"
UP = np.array([0.0, 0.0, 1.0])


def camera_at(center, target, up=UP, focal=300.0, size=(160, 90)) -> Camera:
    R, t = look_at(np.asarray(center, float), np.asarray(target, float), np.asarray(up, float))
    K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
    return Camera(K, R, t, size)


def scene_of(cameras, num_frames=10, up=UP):
    tracks = {}
    for i, entry in enumerate(cameras):
        frames = entry if isinstance(entry, tuple) else (entry,)
        tracks[f"cam{i:02d}"] = CameraTrack(f"cam{i:02d}", frames)
    return SimpleNamespace(num_frames=num_frames, up=up, inputs=tuple(tracks), tracks=tracks)


def arc_of(azimuths_deg, radii, heights):
    angles = np.radians(azimuths_deg)
    return [
        camera_at([r * np.cos(a), r * np.sin(a), h], [0, 0, 1])
        for a, r, h in zip(angles, radii, heights, strict=True)
    ]


def centers_of(cameras) -> np.ndarray:
    return np.stack([camera.center for camera in cameras])


def sample(cameras, count=401, **kwargs) -> list[Camera]:
    spec = TrajectorySpec(path_from=0, path_to=1, num_frames=count, ease=False, **kwargs)
    return place_cameras(spec, scene_of(cameras), (160, 90))


def test_schema_defaults_are_the_dataclass_defaults():
    schema = yaml.safe_load(SCHEMA.read_text())
    entry = schema["additionalProperties"]
    expected = {field.name: field.default for field in dataclasses.fields(TrajectorySpec)}
    defaults = {key: value["default"] for key, value in entry["properties"].items()}
    lists = {key: tuple(value) for key, value in defaults.items() if isinstance(value, list)}
    assert {**defaults, **lists} == expected
    assert schema["default"] == trajectory.DEFAULT_TRAJECTORIES


def test_default_trajectories_are_valid_and_complete_after_filling():
    schema = yaml.safe_load(SCHEMA.read_text())
    filled = fill_defaults({"trajectories": schema["default"]}, {"properties": {"trajectories": schema}})
    validate(filled["trajectories"], schema, "test")
    for name, document in filled["trajectories"].items():
        assert trajectory_from_mapping(document, name) == trajectory_from_mapping(
            schema["default"][name], name
        )


@pytest.mark.parametrize("name", ["cam03", "Freeze", "a b"])
def test_schema_refuses_names_that_are_no_trajectory(name):
    with pytest.raises(InputError):
        validate({name: {}}, yaml.safe_load(SCHEMA.read_text()), "test")


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 200), st.integers(1, 200))
def test_running_time_covers_the_clip_without_going_back(num_frames, length):
    frames = scene_frames(TrajectorySpec(num_frames=length), num_frames)
    assert len(frames) == length
    assert all(0 <= a <= b < num_frames for a, b in zip(frames, frames[1:], strict=False))
    if length > 1:
        assert frames[0] == 0 and frames[-1] == num_frames - 1
    if length == num_frames and length > 1:
        assert frames == list(range(num_frames))


def test_frozen_time_is_one_frame():
    spec = trajectory_from_mapping(trajectory.DEFAULT_TRAJECTORIES["freeze_time"], "freeze_time")
    assert scene_frames(spec, 30) == [15] * 30
    assert scene_frames({"time": "frozen"}, 30) == [15] * 30
    assert scene_frames(dataclasses.replace(spec, time_frame=4, num_frames=7), 30) == [4] * 7
    with pytest.raises(InputError, match=r"time_frame is 30, expected 0\.\.29"):
        scene_frames(dataclasses.replace(spec, time_frame=30), 30)


def test_path_passes_through_every_camera_in_order_around_the_scene():
    order = [40, -35, 0, 20, -15]
    cameras = arc_of(order, [5, 4.6, 5.3, 4.8, 5.1], [1.5, 1.7, 1.4, 1.6, 1.5])
    path = centers_of(sample(cameras))
    nearest = [int(np.linalg.norm(path - c.center, axis=1).argmin()) for c in cameras]
    gaps = [float(np.linalg.norm(path - c.center, axis=1).min()) for c in cameras]
    assert max(gaps) < 0.02
    assert [order[i] for i in np.argsort(nearest)] == sorted(order)
    assert np.linalg.norm(path[0] - cameras[1].center) < 1e-9
    assert np.linalg.norm(path[-1] - cameras[0].center) < 1e-9


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 12), st.integers(0, 2**31))
def test_path_does_not_overshoot_the_cameras(count, seed):
    rng = np.random.default_rng(seed)
    azimuths = np.cumsum(rng.uniform(8, 25, count))
    cameras = arc_of(azimuths, rng.uniform(4.5, 5.5, count), rng.uniform(1.2, 1.8, count))
    path = centers_of(sample(cameras, 101))
    inputs = centers_of(cameras)
    # The cameras' common point is near (0, 0, 1), not on it: a few per cent of the distance.
    assert path[:, 2].min() > inputs[:, 2].min() - 0.1 and path[:, 2].max() < inputs[:, 2].max() + 0.1
    radius, given_radius = np.linalg.norm(path[:, :2], axis=1), np.linalg.norm(inputs[:, :2], axis=1)
    assert radius.min() > given_radius.min() - 0.1 and radius.max() < given_radius.max() + 0.1


def test_speed_is_even_and_directions_turn_smoothly():
    cameras = arc_of([-40, -25, -13, 2, 14, 28, 41], [5, 4.6, 5.3, 4.8, 5.1, 4.7, 5], [1.5] * 7)
    film = sample(cameras, 121)
    speed = np.linalg.norm(np.diff(centers_of(film), axis=0), axis=1)
    assert speed.max() / speed.min() < 1.05
    forward = np.stack([camera.forward for camera in film])
    turn = angle_deg(forward[1:], forward[:-1])
    assert turn.max() < 3 * np.median(turn)
    for camera in film:
        check_camera(camera, "film")
        assert abs(camera.R[0] @ UP) < 1e-12


def test_easing_starts_and_stops_slowly_and_keeps_the_ends():
    scene = scene_of(arc_of([-30, 0, 30], [5] * 3, [1.5] * 3))
    eased = place_cameras(TrajectorySpec(num_frames=41), scene, (160, 90))
    plain = place_cameras(TrajectorySpec(num_frames=41, ease=False), scene, (160, 90))
    speed = np.linalg.norm(np.diff(centers_of(eased), axis=0), axis=1)
    assert speed[0] < 0.1 * speed.max() and speed[-1] < 0.1 * speed.max()
    for index in (0, 20, -1):
        np.testing.assert_allclose(eased[index].center, plain[index].center, atol=1e-9)


def test_two_cameras_are_joined_by_an_arc_around_what_they_look_at():
    film = sample(arc_of([-45, 45], [5, 5], [1, 1]), 51)
    np.testing.assert_allclose(np.linalg.norm(centers_of(film) - [0, 0, 1], axis=1), 5, rtol=1e-9)
    np.testing.assert_allclose(film[25].center, [5, 0, 1], atol=1e-6)
    np.testing.assert_allclose(film[25].forward, [-1, 0, 0], atol=1e-6)


def test_hold_stays_between_the_two_middle_cameras():
    cameras = arc_of([-45, -15, 15, 45], [5] * 4, [1.5] * 4)
    spec = trajectory_from_mapping(trajectory.DEFAULT_TRAJECTORIES["hold_view"], "hold_view")
    film = place_cameras(spec, scene_of(cameras), (160, 90))
    assert len(film) == 10
    assert all(np.array_equal(c.R, film[0].R) and np.array_equal(c.t, film[0].t) for c in film)
    assert abs(np.degrees(np.arctan2(film[0].center[1], film[0].center[0]))) < 1e-6
    at_end = place_cameras(dataclasses.replace(spec, position=1.0), scene_of(cameras), (160, 90))
    np.testing.assert_allclose(at_end[0].center, cameras[3].center, atol=1e-9)


def test_parallel_cameras_give_a_straight_parallel_path():
    cameras = [camera_at([x, 0, 1], [x, 9, 1]) for x in (2.0, 0.0, 1.0, 3.5)]
    film = sample(cameras, 21)
    np.testing.assert_allclose(centers_of(film)[:, 1:], [[0, 1]] * 21, atol=1e-9)
    np.testing.assert_allclose(centers_of(film)[:, 0], np.linspace(0, 3.5, 21), atol=1e-6)
    np.testing.assert_allclose([c.forward for c in film], [[0, 1, 0]] * 21, atol=1e-9)


def test_wall_of_cameras_gives_a_path_along_its_middle_row():
    cameras = [camera_at([x, 0.02 * z, z], [x, 9, z]) for x in (0.0, 1.0, 2.0, 3.0) for z in (0.5, 1.0, 1.5)]
    path = centers_of(sample(cameras, 61))
    np.testing.assert_allclose(path[:, 2], 1.0, atol=1e-6)
    assert path[0, 0] == pytest.approx(0, abs=1e-6) and path[-1, 0] == pytest.approx(3, abs=1e-6)


def test_cameras_one_above_the_other_give_a_rising_path():
    cameras = [camera_at([5, 0, z], [0, 0, 1]) for z in (3.0, 0.5, 1.5)]
    heights = centers_of(sample(cameras, 31))[:, 2]
    assert heights[0] == pytest.approx(0.5) and heights[-1] == pytest.approx(3.0)
    assert (np.diff(heights) > 0).all()


def test_ring_is_cut_at_its_widest_gap():
    cameras = arc_of([0, 60, 120, 200, 300], [5] * 5, [1.5] * 5)
    path = centers_of(sample(cameras, 61))
    np.testing.assert_allclose(path[0], cameras[4].center, atol=1e-6)
    np.testing.assert_allclose(path[-1], cameras[3].center, atol=1e-6)


def test_cameras_that_look_straight_down_keep_their_own_up():
    cameras = [camera_at([x, 0.1 * x, 6], [x, 0.1 * x, 0], up=[0, 1, 0]) for x in (0.0, 1.0, 2.0)]
    film = sample(cameras, 11)
    np.testing.assert_allclose([c.forward for c in film], [[0, 0, -1]] * 11, atol=1e-9)
    np.testing.assert_allclose([-c.R[1] for c in film], [[0, 1, 0]] * 11, atol=1e-9)


def test_hand_shake_does_not_enter():
    rng = np.random.default_rng(0)
    steady = arc_of([-30, 0, 30], [5] * 3, [1.5] * 3)
    shaky = []
    for camera in steady:
        jitter = rng.normal(0, 0.05, (20, 3))
        jitter -= jitter.mean(axis=0)
        shaky.append(tuple(Camera(camera.K, camera.R, camera.t - camera.R @ j, camera.size) for j in jitter))
    still = place_cameras(TrajectorySpec(), scene_of(steady), (160, 90))
    moving = place_cameras(TrajectorySpec(), scene_of(shaky), (160, 90))
    np.testing.assert_allclose(centers_of(moving), centers_of(still), atol=1e-9)


def test_focal_length_follows_the_cameras_and_the_output_size():
    cameras = [
        camera_at([-2, -5, 1], [0, 0, 1], focal=300.0, size=(160, 90)),
        camera_at([2, -5, 1], [0, 0, 1], focal=2 * 450.0, size=(320, 180)),
    ]
    spec = TrajectorySpec(path_from=0, path_to=1, num_frames=3, ease=False)
    film = place_cameras(spec, scene_of(cameras), (320, 180))
    assert [c.focal_px for c in film] == pytest.approx([600, np.sqrt(600 * 900), 900], rel=1e-6)
    assert film[0].K[:2, 2].tolist() == [159.5, 89.5]
    assert film[0].size == (320, 180) and not film[0].is_distorted


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_of_the_world_does_not_matter(scale):
    cameras = arc_of([-30, 0, 30, 45], [5, 4.5, 5.2, 5], [1.5, 1.4, 1.6, 1.5])
    scaled = [Camera(c.K, c.R, c.t * scale, c.size) for c in cameras]
    for a, b in zip(sample(cameras, 21), sample(scaled, 21), strict=True):
        np.testing.assert_allclose(b.center, a.center * scale, rtol=1e-9, atol=1e-9 * scale)
        np.testing.assert_allclose(b.R, a.R, atol=1e-9)


def test_order_of_the_cameras_does_not_matter():
    cameras = arc_of([-30, 0, 30, 45], [5, 4.5, 5.2, 5], [1.5, 1.4, 1.6, 1.5])
    for a, b in zip(sample(cameras, 9), sample(cameras[::-1], 9), strict=True):
        np.testing.assert_allclose(a.center, b.center, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(st.integers(2, 15), st.integers(0, 2**31), st.floats(1e-6, 1e6))
def test_any_cameras_give_usable_pinholes_near_them(count, seed, scale):
    rng = np.random.default_rng(seed)
    tracks = []
    for i in range(count):
        R = Rotation.from_rotvec(rng.normal(0, rng.choice([1e-3, 0.3, 3]), 3)).as_matrix()
        camera = Camera(np.diag([300.0, 300, 1]), R, -R @ rng.normal(0, scale, 3), (160, 90))
        tracks.append(CameraTrack(f"cam{i:02d}", (camera,)))
    path = ArcPath(tracks, rng.normal(size=3))
    given_centers = centers_of([track.cameras[0] for track in tracks])
    extent = np.ptp(given_centers, axis=0).max()
    assert 0 < path.middle_share() < 1
    for share in np.linspace(0, 1, 7):
        camera = path.camera_at(float(share), (160, 90))
        check_camera(camera, "film")
        assert np.linalg.norm(given_centers - camera.center, axis=1).min() < 3 * extent


def test_too_few_places_are_refused():
    camera = camera_at([5, 0, 1], [0, 0, 1])
    with pytest.raises(InputError, match="at least 2 input cameras"):
        ArcPath([CameraTrack("cam00", (camera,))], UP)
    with pytest.raises(InputError, match="stand in one"):
        sample([camera, camera, camera])
    with pytest.raises(InputError, match="up must be"):
        ArcPath([CameraTrack("a", (camera,)), CameraTrack("b", (camera,))], np.zeros(3))


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"kindd": "arc"}, "unknown key 'kindd'"),
        ({"kind": "spiral"}, "kind is 'spiral', expected one of arc, hold"),
        ({"path_from": 1.5}, "path_from is 1.5"),
        ({"path_to": None}, "path_to is None"),
        ({"position": float("nan")}, "position is nan"),
        ({"num_frames": 0}, "num_frames is 0"),
        ({"time_frame": 2.5}, "time_frame is 2.5"),
        ({"ease": 1}, "ease is 1"),
    ],
)
def test_bad_specs_are_named(document, message):
    with pytest.raises(InputError, match=f"film: {message}"):
        trajectory_from_mapping(document, "film")
