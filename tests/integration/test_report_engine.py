"""The page about a scene within the report of the workflow engine, made from a small finished run."""

import zipfile
from pathlib import Path

import pytest

from tests.conftest import Workspace, tiny_scene

PAGE = "report/index.html"


def write_scene(workspace: Workspace, trajectories: dict) -> None:
    scene = tiny_scene(2, num_frames=2) | {"heldout": [], "labels": None}
    scene["settings"] |= {"demo": {"arc_deg": 11}, "trajectories": trajectories}
    workspace.write_scene("demo", scene)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Two cameras, one pair, one film of two frames, with its page."""
    workspace = Workspace(tmp_path_factory.mktemp("engine"))
    write_scene(workspace, {"hold_view": {"kind": "hold", "num_frames": 2}})
    result = workspace.snakemake("--cores", "2", "report_all", timeout_s=1800)
    assert result.returncode == 0, result.stdout[-4000:]
    return workspace


def test_the_page_is_in_the_engines_report(finished: Workspace, tmp_path: Path) -> None:
    result = finished.snakemake("--report", str(tmp_path / "run.zip"), "report_all")
    assert result.returncode == 0, result.stdout[-4000:]
    page = (finished.folder / "results" / "demo" / PAGE).read_bytes()
    with zipfile.ZipFile(tmp_path / "run.zip") as archive:
        pages = [name for name in archive.namelist() if name.endswith(".html")]
        (own,) = [name for name in pages if archive.read(name) == page]
        front = archive.read("run/report.html").decode("utf-8")
    assert own.startswith("run/data/") and own.removeprefix("run/") in front
    assert "One page about the scene" in front


def test_another_film_leaves_no_trace_of_the_first(finished: Workspace) -> None:
    write_scene(finished, {"other_way": {"kind": "hold", "num_frames": 2, "position": 0.2}})
    result = finished.snakemake("--cores", "2", "report_all", timeout_s=1800)
    assert result.returncode == 0, result.stdout[-4000:]
    results = finished.folder / "results" / "demo"
    assert (results / "render" / "hold_view.mp4").is_file()
    for name in ("index.html", "report.json", "costs.csv"):
        text = (results / "report" / name).read_text(encoding="utf-8")
        assert "hold_view" not in text and "hold view" not in text, name
    assert "other way" in (results / "report" / "index.html").read_text(encoding="utf-8")
