"""Kinds of paths, their timing, and how far they lie from the cameras."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fourd.errors import InputError
from fourd.geometry import angle_deg
from fourd.io import write_json
from fourd.paths.hull import describe_path, describe_view, distance_to_hull
from fourd.trajectory import (
    TrajectorySpec,
    resolve_trajectories,
    scene_frames,
    trajectory_from_mapping,
)
from fourd.trajectory.presets import focal_of_fov, fov_of_focal, place_cameras
from fourd.trajectory.spline import PoseSpline, even_places, smooth_progress
from fourd.views import virtual_view
from tests.unit.test_trajectory import UP, arc_of, centers_of, scene_of
from tests.unit.test_views import make_scene

SIZE = (160, 90)
SUBJECT = np.array([0.0, 0.0, 1.0])


def five_cameras(num_frames=10):
    return scene_of(arc_of([-40, -20, 0, 20, 40], [5] * 5, [1.5] * 5), num_frames)


def film_of(scene, **document):
    return place_cameras(trajectory_from_mapping(document, "film"), scene, SIZE)


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        ("reversed", [9, 8, 7, 6, 5, 4, 3, 2, 1, 0]),
        ("there_and_back", [0, 2, 4, 6, 8, 8, 6, 4, 2, 0]),
        ([{"at": 0, "frame": 2}, {"at": 1, "frame": 2}], [2] * 10),
        ([{"at": 0, "frame": 0}, {"at": 1, "frame": 9}], list(range(10))),
        ([{"at": 0, "frame": 9}, {"at": 1, "frame": 0}], list(range(10))[::-1]),
        (
            [{"at": 0, "frame": 0, "ease": "hold"}, {"at": 0.5, "frame": 6}, {"at": 1, "frame": 6}],
            [0] * 5 + [6] * 5,
        ),
    ],
)
def test_time_runs_as_stated(time, expected):
    assert scene_frames({"time": time}, 10) == expected


def test_a_loop_jumps_back_and_a_ramp_changes_the_speed():
    loop = [{"at": at, "frame": frame} for at, frame in ((0, 0), (0.5, 9), (0.5, 0), (1, 9))]
    frames = scene_frames({"time": loop, "num_frames": 21}, 10)
    assert frames[:10] == sorted(frames[:10]) and frames[10] == 0 and frames[-1] == 9
    assert np.diff(frames).min() <= -8 and np.sum(np.diff(frames) < 0) == 1
    ramp = [{"at": 0, "frame": 0, "ease": "in"}, {"at": 1, "frame": 90}]
    steps = np.diff(scene_frames({"time": ramp, "num_frames": 31}, 100))
    assert steps[0] == 0 and steps[-1] >= 5 and (np.diff(steps) >= -1).all()


def test_bullet_time_stops_while_the_view_moves():
    scene = five_cameras(11)
    spec = trajectory_from_mapping({"kind": "bullet_time", "time_frame": 4}, "film")
    shown, film = scene_frames(spec, 11), place_cameras(spec, scene, SIZE)
    assert len(shown) == len(film) == 22
    assert (shown[0], shown[-1]) == (0, 10) and shown == sorted(shown) and shown.count(4) >= 10
    moves = np.linalg.norm(np.diff(centers_of(film), axis=0), axis=1) > 1e-9
    still = np.diff(shown) == 0
    assert moves.sum() >= 8 and not (moves & ~still)[1:-1].any()


@settings(max_examples=60, deadline=None)
@given(st.integers(2, 9), st.integers(0, 2**31), st.floats(1e-5, 1e5))
def test_spline_passes_its_keys_and_stays_between_them(count, seed, scale):
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(count, 3)) * scale
    rotations = Rotation.random(count, rng=rng)
    spline = PoseSpline(centers, rotations.as_matrix(), np.log(rng.uniform(100, 400, count)))
    at = even_places(spline.distance)
    found, turned, _ = spline.poses_at(*smooth_progress(at, spline.knots, at))
    np.testing.assert_allclose(found, centers, atol=1e-9 * scale)
    np.testing.assert_allclose(turned, rotations.as_matrix(), atol=1e-9)
    for k in range(count - 1):
        part = np.linspace(0, 1, 33)
        inside = spline.poses_at(np.full(33, k), part)[0]
        chord = centers[k + 1] - centers[k]
        along = (inside - centers[k]) @ chord / (chord @ chord)
        assert along.min() > -1e-9 and along.max() < 1 + 1e-9
        beside = inside - centers[k] - along[:, None] * chord
        assert np.linalg.norm(beside, axis=1).max() <= 0.75 * np.linalg.norm(chord) + 1e-9 * scale


def test_spline_is_smooth_and_its_shape_turns_with_the_world():
    rng = np.random.default_rng(1)
    centers = np.cumsum(rng.normal(size=(6, 3)) + [2, 0, 0], axis=0)
    rotations = Rotation.from_rotvec(rng.normal(0, 0.2, (6, 3))).as_matrix()
    spline = PoseSpline(centers, rotations, np.zeros(6))
    shares = np.linspace(0, 1, 2001)
    at = even_places(spline.distance)
    path = spline.poses_at(*smooth_progress(at, spline.knots, shares))[0]
    velocity = np.diff(path, axis=0)
    assert angle_deg(velocity[1:], velocity[:-1]).max() < 3
    speed = np.linalg.norm(velocity, axis=1)
    assert np.abs(np.diff(speed)).max() < 0.03 * speed.mean()
    turn = Rotation.from_rotvec([0.3, -1, 2]).as_matrix()
    other = PoseSpline(centers @ turn.T, rotations @ turn.T, np.zeros(6))
    turned = other.poses_at(*smooth_progress(at, other.knots, shares))[0]
    np.testing.assert_allclose(turned, path @ turn.T, atol=1e-9)


def test_a_path_back_and_forth_turns_at_its_end():
    centers = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 0]])
    spline = PoseSpline(centers, np.repeat(np.eye(3)[None], 3, axis=0), np.zeros(3))
    path = spline.poses_at(np.repeat([0, 1], 50), np.tile(np.linspace(0, 1, 50), 2))[0]
    assert path[:, 0].max() <= 1 + 1e-12 and np.abs(path[:, 1:]).max() == 0


def test_orbit_is_one_line_and_a_circle_around_what_is_looked_at():
    film = film_of(five_cameras(), kind="orbit", num_frames=31)
    offset = centers_of(film) - SUBJECT
    np.testing.assert_allclose(np.linalg.norm(offset[:, :2], axis=1), 5, rtol=1e-6)
    np.testing.assert_allclose(offset[:, 2], 0.5, atol=1e-6)
    assert max(angle_deg(-offset, np.stack([c.forward for c in film]))) < 1e-6
    angles = np.degrees(np.arctan2(offset[:, 1], offset[:, 0]))
    assert (angles[0], angles[-1]) == (pytest.approx(-40, abs=1e-6), pytest.approx(40, abs=1e-6))
    assert (np.diff(angles) > 0).all()


def test_orbit_of_a_ring_closes_and_plays_in_a_loop():
    ring = scene_of(arc_of(np.arange(0, 360, 45), [5] * 8, [1.5] * 8))
    steps = np.linalg.norm(
        np.diff(centers_of(film := film_of(ring, kind="orbit", num_frames=36)), axis=0), axis=1
    )
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
    assert np.linalg.norm(film[-1].center - film[0].center) == pytest.approx(steps[0])


def test_dolly_moves_towards_the_subject_and_keeps_its_size():
    film = film_of(five_cameras(), kind="dolly", closer=0.4, keep_size=True, num_frames=9)
    distance = np.linalg.norm(centers_of(film) - SUBJECT, axis=1)
    assert distance[-1] == pytest.approx(0.6 * distance[0])
    np.testing.assert_allclose([c.focal_px for c in film] / distance, film[0].focal_px / distance[0])
    plain = film_of(five_cameras(), kind="dolly", closer=-0.2, num_frames=5)
    assert np.linalg.norm(plain[-1].center - SUBJECT) == pytest.approx(1.2 * distance[0])
    assert plain[-1].focal_px == plain[0].focal_px


def test_follow_keeps_its_offset_to_a_moving_point():
    track = [{"frame": 0, "point": [0, 0, 1]}, {"frame": 9, "point": [0, 1.8, 1]}]
    film = film_of(five_cameras(), kind="follow", look_at=track)
    points = np.stack([[0, 0.2 * i, 1] for i in range(10)])
    offsets = centers_of(film) - points
    np.testing.assert_allclose(offsets, np.repeat(offsets[:1], 10, axis=0), atol=1e-9)
    for camera, point in zip(film, points, strict=True):
        np.testing.assert_allclose(camera.project(point)[0], (79.5, 44.5), atol=1e-6)


def test_look_at_turns_any_path_and_field_of_view_is_vertical():
    film = film_of(five_cameras(), kind="arc", look_at=[1, 0, 2], fov_deg=50, num_frames=7)
    for camera in film:
        np.testing.assert_allclose(camera.project(np.array([1.0, 0, 2]))[0], (79.5, 44.5), atol=1e-9)
        assert abs(camera.R[0] @ UP) < 1e-12
        top = camera.rays(np.array([[79.5, -0.5], [79.5, 89.5]]))
        assert angle_deg(top[0], top[1]) == pytest.approx(50)
    assert fov_of_focal(focal_of_fov(37.5, 1080), 1080) == pytest.approx(37.5, abs=1e-12)


def test_cameras_are_passed_in_the_stated_order():
    scene = five_cameras()
    film = film_of(scene, kind="cameras", cameras=["cam04", "cam00", "cam02"], num_frames=201, ease=False)
    path = centers_of(film)
    nearest = [
        np.linalg.norm(path - scene.tracks[n].cameras[0].center, axis=1) for n in ("cam04", "cam00", "cam02")
    ]
    assert [d.min() < 0.05 for d in nearest] == [True] * 3
    assert nearest[0].argmin() == 0 and 0 < nearest[1].argmin() < nearest[2].argmin() == 200


def test_keys_are_obeyed_where_they_stand():
    keys = [
        {"at": 0, "camera": "cam01"},
        {"at": 0.25, "position": [6, 0, 1], "look_at": [0, 0, 1], "fov_deg": 30},
        {"at": 1, "position": [5, 2, 2], "rotation": [0.5, 0.5, 0.5, 0.5]},
    ]
    film = film_of(five_cameras(), kind="keys", keys=keys, num_frames=41)
    np.testing.assert_allclose(film[0].center, five_cameras().tracks["cam01"].cameras[0].center, atol=1e-12)
    np.testing.assert_allclose(film[10].center, [6, 0, 1], atol=1e-12)
    assert fov_of_focal(film[10].focal_px, 90) == pytest.approx(30)
    np.testing.assert_allclose(
        film[-1].R, Rotation.from_quat([0.5] * 4, scalar_first=True).as_matrix(), atol=1e-12
    )
    cut = [{**key, "ease": "hold"} for key in keys]
    steps = np.linalg.norm(
        np.diff(centers_of(film_of(five_cameras(), kind="keys", keys=cut, num_frames=41)), axis=0), axis=1
    )
    assert np.flatnonzero(steps > 1e-9).tolist() == [9, 39]


def test_source_world_is_brought_into_the_scenes():
    scene = five_cameras()
    scene.origin, scene.scale = np.array([10.0, -3, 2]), 4.0
    key = {"position": [30, -3, 6], "look_at": [10, -3, 6]}
    film = film_of(scene, kind="keys", world="source", keys=[key], num_frames=2)
    np.testing.assert_allclose(film[0].center, [5, 0, 1])
    np.testing.assert_allclose(film[0].forward, [-1, 0, 0], atol=1e-12)


def test_stereo_film_is_two_views_that_agree_at_the_scenes_distance():
    resolved = resolve_trajectories({"film": {"kind": "hold", "stereo": 0.02}, "other": {"kind": "arc"}})
    assert list(resolved) == ["film", "film_right", "other"]
    scene = five_cameras()
    left, right = (
        place_cameras(trajectory_from_mapping(resolved[n], n), scene, SIZE)[0] for n in list(resolved)[:2]
    )
    middle = film_of(scene, kind="hold")[0]
    np.testing.assert_allclose((left.center + right.center) / 2, middle.center)
    assert np.linalg.norm(left.center - right.center) == pytest.approx(0.02)
    assert (right.center - left.center) @ middle.R[0] > 0
    point = middle.center + middle.forward
    np.testing.assert_allclose(left.project(point)[0], right.project(point)[0], atol=1e-9)
    near = middle.center + 0.5 * middle.forward
    assert left.project(near)[0][0] > right.project(near)[0][0]
    with pytest.raises(InputError, match="film_right, which exists"):
        resolve_trajectories({"film": {"stereo": 0.02}, "film_right": {}})


def test_path_file_says_all_and_its_content_counts(tmp_path):
    path = tmp_path / "path.json"
    write_json(path, {"kind": "orbit", "num_frames": 7})
    resolved = resolve_trajectories({"film": {"file": str(path), "kind": "arc"}})
    assert trajectory_from_mapping(resolved["film"], "film") == TrajectorySpec(
        "orbit", num_frames=7, file=str(path)
    )
    assert len(scene_frames(resolved["film"], 30)) == 7
    write_json(path, {"kind": "orbit", "num_frames": 8})
    assert resolve_trajectories({"film": {"file": str(path)}})["film"]["digest"] != resolved["film"]["digest"]
    path.with_suffix(".yaml").write_text("kind: dolly\ncloser: 0.2\n")
    spec = trajectory_from_mapping({"file": str(path.with_suffix(".yaml"))}, "film")
    assert (spec.kind, spec.closer) == ("dolly", 0.2)
    path.write_text("[1, 2]")
    with pytest.raises(InputError, match="expected the keys of a path"):
        resolve_trajectories({"film": {"file": str(path)}})
    with pytest.raises(InputError, match="found nothing"):
        resolve_trajectories({"film": {"file": "nowhere.json"}})


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"kind": "keys"}, "needs `keys`"),
        ({"kind": "follow"}, "needs `look_at`"),
        ({"kind": "cameras"}, "needs `cameras`"),
        ({"keys": [{"position": [1, 2]}]}, "key 0: expected either the name of a camera or a position"),
        ({"keys": [{"position": [1, 2, 3], "rotation": [0, 0, 0, 0]}]}, "quaternion"),
        ({"keys": [{"pose": 1}]}, "key 0 is"),
        ({"keys": [{"at": 0.5, "camera": "cam00"}, {"at": 0.2, "camera": "cam01"}]}, "keys: at is"),
        ({"keys": [{"at": 0.5, "camera": "cam00"}, {"camera": "cam01"}]}, "some keys have `at`"),
        ({"time": "backwards"}, "time is 'backwards'"),
        ({"time": [{"at": 0, "frame": 0}]}, "two keys or more"),
        ({"time": [{"at": 0, "frame": 0}, {"at": 1, "frme": 1}]}, "time key 1"),
        ({"time": [{"at": 0, "frame": 0, "ease": "fast"}, {"at": 1, "frame": 1}]}, "ease is 'fast'"),
        ({"look_at": [1, 2]}, "look_at holds"),
        (
            {"look_at": [{"frame": 3, "point": [0, 0, 1]}, {"frame": 1, "point": [0, 0, 1]}]},
            "expected them rising",
        ),
        ({"closer": 1}, "closer is 1"),
        ({"size": [10, 10]}, "size is"),
        ({"eye": "both"}, "eye is 'both', expected one of middle, left, right"),
        ({"fov_deg": float("nan")}, "fov_deg is nan"),
    ],
)
def test_bad_paths_are_named(document, message):
    with pytest.raises(InputError, match=f"film.*{message}"):
        trajectory_from_mapping(document, "film")


def test_faults_that_the_cameras_show_are_named():
    scene = five_cameras()
    with pytest.raises(InputError, match="'cam09': expected one of cam00"):
        film_of(scene, kind="cameras", cameras=["cam09"])
    with pytest.raises(InputError, match="cannot look at"):
        film_of(scene, look_at=centers_of([film_of(scene, kind="hold")[0]])[0].tolist(), kind="hold")
    with pytest.raises(InputError, match=r"time shows frame 30, expected 0\.\.9"):
        scene_frames({"time": [{"at": 0, "frame": 0}, {"at": 1, "frame": 30}]}, 10)
    parallel = scene_of(
        arc_of([0], [5], [1]) * 1 + [dataclasses.replace(arc_of([0], [5], [1])[0], t=np.ones(3) * 9)]
    )
    parallel.tracks["cam01"].cameras[0].R[:] = parallel.tracks["cam00"].cameras[0].R
    with pytest.raises(InputError, match="needs a point to look at"):
        film_of(parallel, kind="orbit")


def test_distance_to_hull_of_known_shapes():
    cube = np.array([[x, y, z] for x in (0, 2) for y in (0, 2) for z in (0, 2)], dtype=float)
    assert distance_to_hull(np.array([1.0, 1, 1]), cube) == pytest.approx(0, abs=1e-6)
    assert distance_to_hull(np.array([5.0, 1, 1]), cube) == pytest.approx(3, abs=1e-6)
    assert distance_to_hull(np.array([3.0, 3, 3]), cube) == pytest.approx(np.sqrt(3), abs=1e-6)
    line = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    assert distance_to_hull(np.array([2.0, 0.5, 0]), line) == pytest.approx(0.5, abs=1e-6)
    assert distance_to_hull(np.array([2000.0, 500, 0]), 1000 * line) == pytest.approx(500, abs=1e-3)


def test_cameras_at_one_place_are_as_far_from_others_as_one():
    scene = make_scene()
    cameras = [scene.tracks[name].at(0) for name in scene.inputs]
    away = dataclasses.replace(cameras[0], t=cameras[0].t + 100)
    once, twice = describe_view(away, cameras), describe_view(away, [*cameras, *cameras])
    assert once["is_outside"] and once["spacing"] > 0
    assert twice["spacing"] == once["spacing"] and twice["reason"] == once["reason"]


def test_views_far_from_the_cameras_are_flagged():
    scene = make_scene()
    view = virtual_view(scene, "film", trajectory_from_mapping({"kind": "arc"}, "film"), None)
    inside = describe_path(view, scene)
    assert inside["num_outside"] == 0 and [f["frame"] for f in inside["frames"]] == list(range(6))
    assert {f["nearest"] for f in inside["frames"]} <= set(scene.inputs)
    near = trajectory_from_mapping({"kind": "dolly", "closer": 0.8, "ease": False}, "film")
    flags = [f["is_outside"] for f in describe_path(virtual_view(scene, "film", near, None), scene)["frames"]]
    assert flags == sorted(flags) and flags[-1] and not flags[0]
    cameras = [scene.tracks[name].at(0) for name in scene.inputs]
    back = dataclasses.replace(cameras[0], R=np.diag([-1.0, 1, -1]) @ cameras[0].R)
    back = dataclasses.replace(back, t=-back.R @ cameras[0].center)
    facts = describe_view(back, cameras)
    assert facts["is_outside"] and "turned" in facts["reason"] and facts["hull_distance"] < 1e-6
