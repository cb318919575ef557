import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fourd import cli, views
from fourd.camera import Camera, CameraTrack
from fourd.errors import InputError
from fourd.geometry import look_at
from fourd.sfm.cameras import SceneCameras, write_cameras
from fourd.trajectory import DEFAULT_TRAJECTORIES

SIZE = (160, 90)


def make_scene(num_frames: int = 6) -> SceneCameras:
    rng = np.random.default_rng(0)
    tracks = {}
    for i, azimuth in enumerate(np.radians([-30, -10, 10, 30])):
        cameras = []
        for _ in range(num_frames):
            center = np.array([5 * np.cos(azimuth), 5 * np.sin(azimuth), 1.5]) + rng.normal(0, 0.02, 3)
            R, t = look_at(center, np.array([0.0, 0, 1]), np.array([0.0, 0, 1]))
            K = np.array([[150.0, 0, 79.5], [0, 150, 44.5], [0, 0, 1]])
            cameras.append(Camera(K, R, t, SIZE, np.array([-0.1, 0.02, 0, 0, 0])))
        tracks[f"cam{i:02d}"] = CameraTrack(f"cam{i:02d}", tuple(cameras), 1.0, 9.0)
    return SceneCameras(
        fps=30,
        num_frames=num_frames,
        inputs=("cam00", "cam01", "cam03"),
        heldout=("cam02",),
        tracks=tracks,
        origin=np.zeros(3),
        scale=1.0,
        up=np.array([0.0, 0, 1]),
        depth_range_from={name: "given" for name in tracks},
    )


@pytest.fixture
def cameras_path(tmp_path):
    path = tmp_path / "cameras.json"
    write_cameras(path, make_scene())
    return path


def test_physical_view_is_the_cameras_own_pinhole():
    scene = make_scene()
    view = views.physical_view(scene, "cam02", [4, 0, 4], None)
    assert (view.role, view.size, [f.frame for f in view.frames]) == ("heldout", SIZE, [0, 4])
    for entry in view.frames:
        own = scene.tracks["cam02"].at(entry.scene_frame)
        assert entry.scene_frame == entry.frame
        assert not entry.camera.is_distorted
        assert all(np.array_equal(getattr(entry.camera, k), getattr(own, k)) for k in ("K", "R", "t"))


def test_resized_view_sees_the_same_rays():
    scene = make_scene()
    small = views.physical_view(scene, "cam00", [1], (80, 45)).frames[0].camera
    full = scene.tracks["cam00"].at(1).without_distortion()
    corner_small, corner_full = np.array([-0.5, -0.5]), np.array([-0.5, -0.5])
    np.testing.assert_allclose(small.rays(corner_small), full.rays(corner_full), rtol=1e-12)
    assert views.physical_view(scene, "cam00", [1], (80, 45)).role == "input"


@pytest.mark.parametrize("size", [(90, 90), (160, 40), (45, 90)])
def test_view_of_another_aspect_is_the_middle_of_the_picture(size):
    full = make_scene().tracks["cam00"].at(0).without_distortion()
    part = views.physical_view(make_scene(), "cam00", [0], size).frames[0].camera
    width, height = size
    corners = np.array([[-0.5, -0.5], [width - 0.5, height - 0.5]])
    seen = full.pixels_from_normalized(part.rays(corners)[:, :2])
    assert (seen >= -0.5 - 1e-9).all() and (seen <= [159.5 + 1e-9, 89.5 + 1e-9]).all()
    extent = seen[1] - seen[0]
    assert extent[0] == pytest.approx(160) or extent[1] == pytest.approx(90)
    np.testing.assert_allclose(seen.mean(axis=0), [79.5, 44.5], atol=1e-9)
    assert extent[0] / extent[1] == pytest.approx(width / height)


def test_view_file_round_trip(tmp_path, cameras_path):
    output = tmp_path / "views" / "freeze_time.json"
    spec = json.dumps(DEFAULT_TRAJECTORIES["freeze_time"])
    views.main(
        [
            "--cameras",
            str(cameras_path),
            "--view",
            "freeze_time",
            "--trajectory",
            spec,
            "--output",
            str(output),
        ]
    )
    view = views.read_view(output)
    assert (view.name, view.role, view.size) == ("freeze_time", "virtual", SIZE)
    assert [f.frame for f in view.frames] == list(range(6))
    assert [f.scene_frame for f in view.frames] == [3] * 6
    again = tmp_path / "freeze_time.json"
    views.write_view(again, view)
    assert again.read_bytes() == output.read_bytes()
    assert view.at(2) is view.frames[2]
    with pytest.raises(InputError, match="got 77"):
        view.at(77)


def test_command_line_writes_a_physical_view(tmp_path, cameras_path):
    output = tmp_path / "cam01.json"
    views.main(
        ["--cameras", str(cameras_path), "--view", "cam01", "--frames", "0", "3", "--size", "320", "180"]
        + ["--output", str(output)]
    )
    view = views.read_view(output)
    assert view.size == (320, 180)
    assert [f.frame for f in view.frames] == [0, 3]
    assert view.frames[0].camera.K[0, 0] == 300


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--view", "cam09", "--frames", "0"], "expected a camera of cam00"),
        (["--view", "cam00"], "expected frames to look at, got none"),
        (["--view", "cam00", "--frames", "6"], "expected frames in 0..5, got 6"),
        (["--view", "cam00", "--frames", "0", "--size", "100"], "expected width and height"),
        (["--view", "film", "--trajectory", "{"], "expected JSON"),
        (["--view", "film", "--trajectory", "[1]"], "expected a JSON object"),
        (["--view", "film", "--trajectory", '{"knid": 1}'], "unknown key 'knid'"),
        (["--view", "cam00", "--trajectory", "{}"], "a camera has this name"),
    ],
)
def test_bad_requests_end_in_one_sentence(tmp_path, cameras_path, capsys, arguments, message):
    output = tmp_path / "out.json"
    status = cli.run_stage(views.main, ["--cameras", str(cameras_path), *arguments, "--output", str(output)])
    error = capsys.readouterr().err
    assert status == 2
    assert message in error and error.count("\n") == 1
    assert not output.exists()


@pytest.mark.parametrize(
    "change",
    [
        {"role": "other"},
        {"size": [0, 3]},
        {"frames": [{"frame": 0}]},
        {"schema_version": 9},
        {"size": 3},
        {"size": [8, 1e99]},
    ],
)
def test_damaged_view_files_are_named(tmp_path, change):
    path = tmp_path / "cam00.json"
    views.write_view(path, views.physical_view(make_scene(), "cam00", [0], None))
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(InputError, match="cam00.json"):
        views.read_view(path)


@given(st.integers(1, 40), st.integers(1, 40))
def test_spread_is_even_and_has_the_ends(num_frames, count):
    frames = list(range(100, 100 + num_frames))
    chosen = views.spread(frames, count)
    assert len(chosen) == len(set(chosen)) == min(count, num_frames)
    assert chosen == sorted(chosen) and set(chosen) <= set(frames)
    if min(count, num_frames) > 1:
        assert chosen[0] == frames[0] and chosen[-1] == frames[-1]
        assert np.diff(chosen).max() - np.diff(chosen).min() <= 1
