"""Camera paths of other programs: what is written is read back, and their conventions are ours."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fourd.camera import Camera
from fourd.cli import run_stage
from fourd.errors import InputError
from fourd.io import read_json, write_json
from fourd.paths.__main__ import main
from fourd.paths.files import FORMATS, film_of_view, path_document, read_film, write_film
from fourd.sfm.cameras import SceneCameras, write_cameras
from fourd.trajectory import scene_frames, trajectory_from_mapping
from fourd.trajectory.presets import place_cameras
from fourd.views import View, virtual_view, write_view
from tests.unit.test_views import make_scene

SIZE = (320, 180)


@pytest.fixture
def scene() -> SceneCameras:
    """Cameras in a world that was moved and scaled at import."""
    given = make_scene(num_frames=12)
    return SceneCameras(**{**given.__dict__, "origin": np.array([13.0, -7.5, 2.25]), "scale": 6.1})


def a_view(scene: SceneCameras, **document) -> View:
    document = {"kind": "bullet_time", "time_frame": 5, "fov_deg": 41.3, **document}
    return virtual_view(scene, "film", trajectory_from_mapping(document, "film"), SIZE)


def largest_difference(a: Camera, b: Camera) -> float:
    return max(float(np.abs(getattr(a, k) - getattr(b, k)).max()) for k in ("K", "R", "t"))


def test_path_files_come_back_as_the_same_views(tmp_path: Path, scene: SceneCameras) -> None:
    view = a_view(scene)
    write_film(tmp_path / "path.json", "path", film_of_view(view, scene))
    spec = trajectory_from_mapping({"file": str(tmp_path / "path.json")}, "film")
    again = place_cameras(spec, scene, SIZE)
    assert spec.size == SIZE
    assert scene_frames(spec, scene.num_frames) == [entry.scene_frame for entry in view.frames]
    for camera, entry in zip(again, view.frames, strict=True):
        assert largest_difference(camera, entry.camera) < 1e-9 * max(1, entry.camera.K[0, 0])


@pytest.mark.parametrize("path_format", FORMATS)
def test_every_format_comes_back(tmp_path: Path, scene: SceneCameras, path_format: str) -> None:
    film = film_of_view(a_view(scene), scene)
    write_film(tmp_path / "film", path_format, film)
    read = read_film(tmp_path / "film", path_format, scene, SIZE)
    assert len(read.cameras) == 24
    assert read.scene_frames == (film.scene_frames if path_format in ("path", "csv") else None)
    for before, after in zip(film.cameras, read.cameras, strict=True):
        assert after.size == SIZE
        assert largest_difference(after, before) < 1e-9 * float(np.abs(before.K).max())


def test_convention_nerfstudio_path_is_opengl_in_the_calibrations_world(
    tmp_path: Path, scene: SceneCameras
) -> None:
    """nerfstudio's rule: x right, y up, z backward, the field of view over the height."""
    view = a_view(scene, num_frames=3)
    write_film(tmp_path / "path.json", "nerfstudio", film_of_view(view, scene))
    document = read_json(tmp_path / "path.json")
    point = np.array([0.2, -0.3, 1.1])
    for entry, written in zip(view.frames, document["camera_path"], strict=True):
        matrix = np.array(written["camera_to_world"]).reshape(4, 4)
        x, y, z = matrix[:3, :3].T @ (point * scene.scale + scene.origin - matrix[:3, 3])
        per_unit = document["render_height"] / 2 / np.tan(np.radians(written["fov"]) / 2)
        across = (
            document["render_width"] / 2 + per_unit * x / -z,
            document["render_height"] / 2 - per_unit * y / -z,
        )
        np.testing.assert_allclose(np.array(across) - 0.5, entry.camera.project(point)[0], atol=1e-9)


def test_paths_of_a_trained_nerfstudio_model_are_brought_back(tmp_path: Path, scene: SceneCameras) -> None:
    """Model coordinates are scale * (R data + t); the path's matrices are moved by hand here."""
    turn, shift, scale = Rotation.from_rotvec([0.4, -0.2, 1]).as_matrix(), np.array([1.0, -2, 0.5]), 0.07
    write_json(tmp_path / "d.json", {"transform": np.column_stack([turn, shift]).tolist(), "scale": scale})
    write_cameras(tmp_path / "cameras.json", scene)
    film = film_of_view(a_view(scene), scene)
    write_film(tmp_path / "data.json", "nerfstudio", film)
    document = read_json(tmp_path / "data.json")
    for entry in document["camera_path"]:
        matrix = np.array(entry["camera_to_world"]).reshape(4, 4)
        matrix[:3, :3], matrix[:3, 3] = turn @ matrix[:3, :3], scale * (turn @ matrix[:3, 3] + shift)
        entry["camera_to_world"] = matrix.ravel().tolist()
    write_json(tmp_path / "model.json", document)
    flags = ["--cameras", str(tmp_path / "cameras.json"), "--dataparser", str(tmp_path / "d.json")]
    command = ["convert", "--input", str(tmp_path / "model.json"), "--from", "nerfstudio", "--to", "csv"]
    main([*command, "--output", str(tmp_path / "back.csv"), *flags])
    for before, after in zip(
        film.cameras, read_film(tmp_path / "back.csv", "csv", scene, SIZE).cameras, strict=True
    ):
        assert largest_difference(after, before) < 1e-8
    command = ["convert", "--input", str(tmp_path / "back.csv"), "--from", "csv", "--to", "nerfstudio"]
    main([*command, "--output", str(tmp_path / "again.json"), *flags])
    again = read_json(tmp_path / "again.json")["camera_path"]
    for before, after in zip(document["camera_path"], again, strict=True):
        np.testing.assert_allclose(after["camera_to_world"], before["camera_to_world"], atol=1e-9)
    with pytest.raises(InputError, match="expected one of --from and --to"):
        main([*command[:-1], "csv", "--output", "x.csv", *flags])


def test_command_line_converts_and_describes(tmp_path: Path, scene: SceneCameras) -> None:
    write_cameras(tmp_path / "cameras.json", scene)
    write_view(tmp_path / "film.json", a_view(scene))
    common = ["--cameras", str(tmp_path / "cameras.json")]
    view, table = str(tmp_path / "film.json"), str(tmp_path / "film.csv")
    main(["convert", "--input", view, "--from", "view", "--to", "csv", "--output", table, *common])
    main(
        [
            "convert",
            "--input",
            table,
            "--from",
            "csv",
            "--to",
            "path",
            "--output",
            str(tmp_path / "p.json"),
            *common,
        ]
    )
    document = read_json(tmp_path / "p.json")
    assert (document["kind"], document["world"], document["num_frames"]) == ("keys", "source", 24)
    main(["describe", "--view-file", view, "--output", str(tmp_path / "d.json"), *common])
    described = read_json(tmp_path / "d.json")
    assert described["view"] == "film" and described["num_outside"] == 0 and len(described["frames"]) == 24


@pytest.mark.parametrize(
    ("path_format", "content", "message"),
    [
        ("nerfstudio", {"camera_path": []}, "render_width"),
        ("nerfstudio", {"camera_type": "fisheye"}, "perspective"),
        ("nerfstudio", {"render_width": 4, "render_height": 3, "camera_path": []}, "with poses"),
        ("csv", "frame,x\n1,2\n", "KeyError"),
        ("path", {"kind": "spiral"}, "kind is 'spiral'"),
    ],
)
def test_unusable_files_are_named(tmp_path: Path, scene, path_format, content, message, capsys) -> None:
    path = tmp_path / "file"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(InputError, match=message) as error:
        read_film(path, path_format, scene, SIZE)
    assert str(path) in str(error.value)
    write_cameras(tmp_path / "cameras.json", scene)
    command = ["convert", "--input", str(path), "--from", path_format, "--to", "csv", "--output", "x.csv"]
    assert run_stage(main, [*command, "--cameras", str(tmp_path / "cameras.json")]) == 2
    assert "error: " in capsys.readouterr().err


def test_one_picture_is_a_path_too(tmp_path: Path, scene: SceneCameras) -> None:
    film = film_of_view(a_view(scene, kind="hold", num_frames=1, time="frozen"), scene)
    write_json(tmp_path / "path.json", path_document(film))
    read = read_film(tmp_path / "path.json", "path", scene, SIZE)
    assert read.scene_frames == (5,) and largest_difference(read.cameras[0], film.cameras[0]) < 1e-9 * 400
    with pytest.raises(InputError, match="found nothing"):
        read_film(tmp_path / "nowhere", "csv", scene, SIZE)
