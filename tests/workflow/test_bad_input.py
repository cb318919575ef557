"""What a user sees for input that cannot be used: one sentence before the first job."""

import json
from pathlib import Path

import pytest

from tests.conftest import Workspace, tiny_scene

RENDER = ("--cores", "1", "--show-failed-logs", "render_all")


def sentence(output: str) -> str:
    """Printed text in one line, as the terminal's width does not matter."""
    return " ".join(output.split())


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"cameras": {}}, "cameras is {}"),
        (
            {"cameras": {"cam00": {"source": "a"}}, "heldout": []},
            "expected at least 2 cameras that are not held out, got 1",
        ),
        ({"heldout": ["cam11"]}, "heldout names 'cam11', which is no camera; cameras are cam00"),
        ({"num_frames": "six"}, "num_frames is 'six', expected type integer"),
        ({"fps": 0}, "fps is 0, expected more than 0"),
        ({"calibration": ["none.json"]}, "calibration file 1: expected a file or folder at none.json"),
        ({"settings": {"fuse": {"min_pairs": 0}}}, "fuse.min_pairs is 0, expected at least 1"),
        ({"settings": {"trajectories": {"cam01": {}}}}, "trajectories"),
    ],
)
def test_faults_of_the_scene_file_stop_before_the_first_job(
    workspace: Workspace, change: dict, expected: str
) -> None:
    workspace.write_scene("demo", {**tiny_scene(), **change})
    result = workspace.snakemake(*RENDER)
    assert result.returncode != 0
    assert expected in sentence(result.stdout)
    assert "Traceback" not in result.stdout
    assert not (workspace.folder / "results").exists()


def test_unknown_scene_names_the_known_ones(workspace: Workspace) -> None:
    workspace.write_scene("demo", tiny_scene())
    result = workspace.snakemake(*RENDER, "--config", "scene=wedding")
    assert result.returncode != 0
    assert "known scenes are demo" in sentence(result.stdout)


def test_missing_video_is_named(workspace: Workspace) -> None:
    scene = tiny_scene()
    scene["cameras"]["cam03"]["source"] = "videos/gone.mp4"
    workspace.write_scene("demo", scene)
    result = workspace.snakemake(*RENDER)
    assert result.returncode != 0
    assert "camera cam03: expected a file or folder at videos/gone.mp4" in sentence(result.stdout)


def footage(workspace: Workspace, num_cameras: int = 4) -> dict:
    """Tiny demo footage, made by the workflow, as a scene of the user's own."""
    scene = tiny_scene(num_cameras)
    workspace.write_scene("demo", scene)
    targets = [f"data/demo/frames/{name}" for name in scene["cameras"]]
    result = workspace.snakemake("--cores", "2", *targets, "data/demo/cameras.json")
    assert result.returncode == 0, result.stdout
    return scene


def break_camera(path: Path, key: str, value: object) -> None:
    document = json.loads(path.read_text())
    for frame in document["cameras"]["cam01"]["frames"]:
        frame[key] = value
    path.write_text(json.dumps(document))


@pytest.fixture(scope="module")
def footage_workspace(tmp_path_factory: pytest.TempPathFactory) -> tuple[Workspace, dict]:
    workspace = Workspace(tmp_path_factory.mktemp("footage"))
    return workspace, footage(workspace)


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("K", [[float("nan"), 0, 48], [0, 80, 27], [0, 0, 1]], "must be finite numbers"),
        ("K", [[0, 0, 48], [0, 80, 27], [0, 0, 1]], "positive focal lengths"),
        ("R", [[1, 0, 0], [0, 1, 0], [0, 0, 2]], "R must be a rotation"),
    ],
)
def test_broken_calibration_stops_with_camera_and_file(
    footage_workspace: tuple[Workspace, dict], key: str, value: object, expected: str
) -> None:
    workspace, scene = footage_workspace
    broken = workspace.folder / "broken.json"
    broken.write_text((workspace.folder / "data/demo/cameras.json").read_text())
    break_camera(broken, key, value)
    workspace.write_scene("demo", {**scene, "calibration": ["broken.json"]})
    result = workspace.snakemake("--cores", "2", "--keep-going", "--show-failed-logs", "render_all")
    assert result.returncode != 0
    printed = sentence(result.stdout)
    assert expected in printed and "broken.json" in printed and "cam01" in printed
    assert "Traceback" not in printed
    # What was finished before stays.
    assert (workspace.folder / "results/demo/ingest/cam00.json").is_file()


def test_camera_that_did_not_film_every_frame_is_left_out_and_named(
    footage_workspace: tuple[Workspace, dict],
) -> None:
    workspace, scene = footage_workspace
    shorter = workspace.folder / "shorter"
    shorter.mkdir(exist_ok=True)
    for frame in range(3):
        source = workspace.folder / f"data/demo/frames/cam00/{frame:06d}.png"
        (shorter / source.name).write_bytes(source.read_bytes())
    cameras = {**scene["cameras"], "cam00": {"source": "shorter"}}
    workspace.write_scene("demo", {**scene, "cameras": cameras})
    result = workspace.snakemake("--cores", "2", "--show-failed-logs", "render_all")
    assert result.returncode == 0, result.stdout[-4000:]
    printed = sentence(result.stdout)
    assert "1 of 4 cameras were left out: cam00: " in printed
    assert "shows scene frames 0.0 to 2.0 (30 fps): it ends too early for frame 5" in printed
    assert "Traceback" not in printed
