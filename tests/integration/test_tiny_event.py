"""The whole workflow on a tiny event, called as a user calls it."""

from pathlib import Path

import pytest

from fourd.io import read_csv, read_json
from fourd.video import probe_video
from tests.conftest import Workspace, tiny_scene

FILMS = ("freeze_time", "hold_view", "time_and_view")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A workspace in which the tiny event has been rendered once."""
    workspace = Workspace(tmp_path_factory.mktemp("tiny"))
    workspace.write_scene("demo", tiny_scene())
    result = workspace.snakemake("--cores", "2", "render_all")
    assert result.returncode == 0, result.stdout[-4000:]
    return workspace


def results(workspace: Workspace) -> Path:
    return workspace.folder / "results" / "demo"


def test_films_have_every_frame_at_the_right_size_and_rate(finished: Workspace) -> None:
    for film in FILMS:
        info = probe_video(results(finished) / "render" / f"{film}.mp4")
        assert info.size == (96, 54)
        assert len(info.pts_s) == 6
        assert info.pts_s[1] - info.pts_s[0] == pytest.approx(1 / 30, abs=1e-3)


def test_every_result_is_finite_and_complete(finished: Workspace) -> None:
    rows = read_csv(results(finished) / "evaluate" / "metrics.csv")
    assert {row["method"] for row in rows} >= {"ours", "inst", "paste", "nn_same_time"}
    assert {int(row["frame"]) for row in rows} == {1, 4}
    assert read_json(results(finished) / "sfm" / "cameras.json")["heldout"] == ["cam02"]


def test_no_file_is_half_written(finished: Workspace) -> None:
    assert [path for path in results(finished).rglob("*") if ".tmp" in path.name] == []


def test_demo_gives_phones_and_truth(finished: Workspace) -> None:
    result = finished.snakemake("--cores", "2", "demo_all")
    assert result.returncode == 0, result.stdout[-4000:]
    demo = finished.folder / "data" / "demo"
    starts = {
        name: phone["start_time_s"] for name, phone in read_json(demo / "truth/phones.json")["phones"].items()
    }
    assert len(set(starts.values())) == 5
    for name in starts:
        info = probe_video(demo / "phones" / f"{name}.mp4")
        assert info.codec == "h264" and info.has_audio
    assert len(list((demo / "truth" / "orbit").glob("*.png"))) == 12
    assert len(list((demo / "truth" / "depth").glob("*/*.npz"))) == 5 * 3


@pytest.mark.parametrize("num_cameras", [2, 3])
def test_few_cameras_without_a_disk_budget(finished: Workspace, tmp_path: Path, num_cameras: int) -> None:
    """Two cameras are one pair, three are three: a film all the same, and no intermediate is left."""
    workspace = Workspace(tmp_path)
    scene = tiny_scene(num_cameras, num_frames=2)
    scene |= {"heldout": [], "labels": None}
    # Neighbours 11 degrees apart, as in the demo.
    scene["settings"] |= {
        "keep_gb": 0,
        "demo": {"arc_deg": 11 * (num_cameras - 1)},
        "trajectories": {"hold_view": {"kind": "hold", "num_frames": 2}},
    }
    workspace.write_scene("demo", scene)
    result = workspace.snakemake("--cores", "2", "render_all")
    assert result.returncode == 0, result.stdout[-4000:]
    assert (results(workspace) / "render" / "hold_view.mp4").is_file()
    for stage in ("disparity", "foreground", "background"):
        assert not list(results(workspace).glob(f"{stage}/*/*.npz"))
    assert results(finished).joinpath("foreground").is_dir()


def test_second_run_does_nothing(finished: Workspace) -> None:
    result = finished.snakemake("--cores", "2", "render_all")
    assert "Nothing to be done" in result.stdout


@pytest.mark.parametrize(
    ("setting", "rules"),
    [
        (
            "render={min_hole_share: 0.5}",
            {"encode_film", "render_frames", "evaluate_camera", "collect_metrics"},
        ),
        (
            "composition={epochs: 3}",
            {"train_level", "render_frames", "encode_film", "evaluate_camera", "collect_metrics"},
        ),
        ("evaluate={sheet_frames: 2}", {"evaluate_camera", "collect_metrics"}),
    ],
)
def test_a_setting_runs_exactly_what_is_below_it(finished: Workspace, setting: str, rules: set[str]) -> None:
    assert set(finished.planned("render_all", "--config", setting)) == rules


def test_another_trajectory_runs_for_itself_only(finished: Workspace) -> None:
    extra = "trajectories={freeze_time: {kind: arc, time: frozen}, low: {kind: hold, position: 0.2}}"
    assert set(finished.planned("render_all", "--config", extra)) == {
        "place_view",
        "fuse_foreground",
        "estimate_background",
        "render_frames",
        "encode_film",
    }


def test_truncated_footage_stops_with_a_sentence_and_keeps_finished_work(
    finished: Workspace, tmp_path: Path
) -> None:
    workspace = Workspace(tmp_path)
    scene = tiny_scene()
    film = results(finished) / "render" / "hold_view.mp4"
    (tmp_path / "cut.mp4").write_bytes(film.read_bytes()[:900])
    scene["cameras"]["cam01"]["source"] = "cut.mp4"
    workspace.write_scene("demo", scene)
    result = workspace.snakemake("--cores", "2", "--keep-going", "--show-failed-logs", "render_all")
    assert result.returncode != 0
    assert "error: " in result.stdout
    assert "cut.mp4" in result.stdout
    assert "Traceback" not in result.stdout
    assert (tmp_path / "results" / "demo" / "ingest" / "cam00.json").is_file()
