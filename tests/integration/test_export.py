"""Films along stated paths, and the scene for other programs, called as a user calls them."""

from pathlib import Path

import numpy as np
import pytest

from fourd.export import EVENT_FORMATS
from fourd.export.formats import read_format
from fourd.io import read_json, write_json
from fourd.sfm.cameras import read_cameras
from fourd.video import probe_video, read_video_frames
from fourd.views import read_view
from tests.conftest import Workspace, tiny_scene

PATH_FILE = {"kind": "orbit", "time": "there_and_back", "num_frames": 4, "size": [80, 46]}
TRAJECTORIES = {"deep": {"kind": "hold", "num_frames": 2, "stereo": 0.02}, "own": {"file": "path.json"}}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A workspace in which films along stated paths were rendered, and every format was exported."""
    workspace = Workspace(tmp_path_factory.mktemp("export"))
    scene = tiny_scene(num_cameras=3, num_frames=3) | {"heldout": [], "labels": None}
    scene["settings"] |= {"trajectories": TRAJECTORIES, "film": {"master": "ffv1", "fps": 15}}
    # Neighbours 11 degrees apart, as in the demo.
    scene["settings"] |= {"demo": {"arc_deg": 22}}
    workspace.write_scene("demo", scene)
    write_json(workspace.folder / "path.json", PATH_FILE)
    result = workspace.snakemake("--cores", "2", "render_all", "export", timeout_s=1500)
    assert result.returncode == 0, result.stdout[-4000:]
    return workspace


def results(workspace: Workspace) -> Path:
    return workspace.folder / "results" / "demo"


def test_films_are_as_their_paths_state(finished: Workspace) -> None:
    folder = results(finished) / "render"
    sizes = {"deep": ((192, 54), 2), "deep_right": ((96, 54), 2), "own": ((80, 46), 4)}
    for name, (size, count) in sizes.items():
        for film in (folder / f"{name}.mp4", folder / f"{name}.mkv"):
            info = probe_video(film)
            assert (info.size, len(info.pts_s)) == (size, count)
            assert info.fps == pytest.approx(15, rel=1e-3)
        described = read_json(folder / f"{name}.json")
        assert len(described["frames"]) == count and described["view"] == name
    shown = [entry.scene_frame for entry in read_view(results(finished) / "views" / "own.json").frames]
    assert shown == [0, 1, 1, 0]


def test_eyes_of_a_stereo_film_stand_side_by_side(finished: Workspace) -> None:
    folder = results(finished) / "render"
    [(_, both)] = read_video_frames(folder / "deep.mkv", [0])
    [(_, right)] = read_video_frames(folder / "deep_right.mkv", [0])
    assert np.array_equal(both[:, 96:], right)
    assert not np.array_equal(both[:, :96], right)


def test_another_path_renders_its_own_views_only(finished: Workspace) -> None:
    assert finished.planned("render_all") == {}
    path = finished.folder / "path.json"
    write_json(path, {**PATH_FILE, "turn_deg": 10})
    try:
        changed = finished.planned("render_all")
    finally:
        write_json(path, PATH_FILE)
    # Four frames in two chunks.
    one_view = {"place_view": 1, "fuse_foreground": 2, "estimate_background": 2, "render_frames": 2}
    assert changed == {**one_view, "encode_film": 1, "encode_master": 1}
    assert finished.planned("render_all", "--config", "film={codec: hevc, master: ffv1, fps: 15}") == {
        "encode_film": 3
    }


def test_every_format_is_there_with_all_frames(finished: Workspace) -> None:
    folder = results(finished) / "export"
    for name in EVENT_FORMATS:
        facts = read_json(folder / name / "export.json")
        assert list(facts["cameras"]) == ["cam00", "cam01", "cam02"]
    assert len(list((folder / "colmap" / "images").glob("*/*.png"))) == 9
    assert len(list((folder / "ply").glob("*.ply"))) == 3
    for name, count in (("deep", 2), ("own", 4)):
        assert len(list((folder / "exr" / name).glob("*.exr"))) == count
        assert len(list((folder / "png16" / name).glob("*_depth.png"))) == count


def test_exported_cameras_are_those_of_the_calibration(finished: Workspace) -> None:
    """The demo's given calibration: what the import did to its world is undone."""
    truth = read_json(finished.folder / "data" / "demo" / "cameras.json")["cameras"]
    scene = read_cameras(results(finished) / "sfm" / "cameras.json")
    assert abs(scene.scale - 1) > 1e-3 or np.abs(scene.origin).max() > 1e-3
    folder = results(finished) / "export"
    for path, name in (
        (folder / "colmap", "colmap"),
        (folder / "nerfstudio" / "transforms.json", "nerfstudio"),
    ):
        read = read_format(path, name)
        points = np.random.default_rng(0).normal(size=(50, 3)) * 0.3 * scene.scale + scene.origin
        for camera, poses in read.items():
            for frame, pose in enumerate(poses):
                given = truth[camera]["frames"][frame if len(truth[camera]["frames"]) > 1 else 0]
                local = points @ np.array(given["R"]).T + np.array(given["t"])
                pixels = (local / local[:, 2:]) @ np.array(given["K"]).T
                # Centres are kept to a millionth of the scene at import.
                np.testing.assert_allclose(pose.project(points)[0], pixels[:, :2], atol=0.01)


def test_an_unknown_format_is_named(finished: Workspace) -> None:
    result = finished.snakemake("export", "-n", "--config", "format=colmp")
    assert result.returncode != 0 and "format is 'colmp', expected all" in result.stdout
