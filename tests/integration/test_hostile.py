"""Names that a stranger may have given to files and folders: nothing in them is run, and nothing leaves."""

import os
import shutil
from pathlib import Path

import pytest

from tests.conftest import Workspace
from tests.small_event import digests, small_scene, whole_run

# A folder of each camera's pictures; 255 bytes are the most that file systems allow.
SOURCES = {
    "cam00": 'it\'s a "film" of $(touch pwned) `touch pwned`; touch pwned & #1 !*?[a]~ |touch pwned',
    "cam01": "ünï\u00a0çødé 日本 \U0001f600 \u202egnp",
    "cam02": "-rf --output=pwned %d %s \\n ..",
    "cam03": "long" + "x" * 251,
}


@pytest.fixture
def stranger(tmp_path: Path) -> Workspace:
    """The footage of the small event below a folder, and in folders, with such names."""
    made = whole_run().folder / "data" / "demo"
    workspace = Workspace(tmp_path / "a 'home' of $(touch pwned) ü")
    films = workspace.folder / "films; touch pwned"
    for camera, name in SOURCES.items():
        shutil.copytree(made / "frames" / camera, films / name)
    shutil.copy(made / "cameras.json", films / "cameras $(touch pwned) 'é'.json")
    shutil.copytree(made / "truth" / "labels", films / 'labels "of" `touch pwned`')
    scene = small_scene()
    for camera, name in SOURCES.items():
        scene["cameras"][camera]["source"] = f"{films.name}/{name}"
    # One of them through a link and upwards.
    (workspace.folder / "link").symlink_to(films)
    scene["cameras"]["cam01"]["source"] = f"link/../link/{SOURCES['cam01']}"
    scene["calibration"] = [f"{films.name}/cameras $(touch pwned) 'é'.json"]
    scene["labels"] = f'{films.name}/labels "of" `touch pwned`'
    workspace.write_scene("demo", scene)
    return workspace


def test_films_are_the_same_whatever_files_are_called(stranger: Workspace, tmp_path: Path) -> None:
    films = {path: path.stat().st_mtime_ns for path in stranger.folder.glob("films*/**/*")}
    result = stranger.snakemake("--cores", "2", "--show-failed-logs", "render_all")
    assert result.returncode == 0, result.stdout[-4000:]
    assert list(tmp_path.rglob("pwned*")) == []
    assert [path.name for path in tmp_path.iterdir()] == [stranger.folder.name]
    made = {path.name for path in stranger.folder.iterdir()}
    assert made <= {"films; touch pwned", "link", "config", "results", "logs", "benchmarks", ".snakemake"}
    assert {path: path.stat().st_mtime_ns for path in films} == films
    ours, plain = digests(stranger.folder), digests(whole_run().folder)
    for file in ("render/time_and_view.mp4", "evaluate/metrics.csv", "foreground/cam00/000000-000001.npz"):
        assert ours[f"results/demo/{file}"] == plain[f"results/demo/{file}"]


@pytest.mark.parametrize(
    "name",
    [
        "../cam",
        "/tmp/cam",
        "a b",
        "cam'",
        "$(touch pwned)",
        "a;b",
        "ü",
        "x" * 33,
        "-rf",
        "",
        ".",
        "CAM",
        "a-b",
    ],
)
@pytest.mark.parametrize("where", ["camera", "trajectory", "scene"])
def test_names_that_become_files_are_plain_words(workspace: Workspace, name: str, where: str) -> None:
    """Names of cameras, films and scenes are parts of paths and commands: small letters, digits and _."""
    from fourd.config import load_config, load_scene
    from fourd.errors import InputError

    scene = small_scene()
    if where == "camera":
        scene["cameras"][name] = {"source": "a.mp4"}
    workspace.write_scene("demo", scene)
    settings = {"trajectories": {name: {}}} if where == "trajectory" else {}
    with pytest.raises(InputError, match="expected|unknown|does not match"):
        load_scene("demo", workspace.folder / "config" / "scenes")
        load_config({"scene": name} if where == "scene" else {}, settings, "demo")


def test_link_out_of_the_results_folder_is_not_written_through(tmp_path: Path) -> None:
    """A file is put in place by a rename: a link under its name is replaced, what it points to stays."""
    from fourd.io import atomic_folder, write_json

    outside = tmp_path / "outside.json"
    outside.write_text("mine")
    results = tmp_path / "results"
    results.mkdir()
    os.symlink(outside, results / "cameras.json")
    write_json(results / "cameras.json", {"a": 1})
    assert outside.read_text() == "mine"
    assert not (results / "cameras.json").is_symlink()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "kept").touch()
    os.symlink(tmp_path / "elsewhere", results / "frames")
    with pytest.raises(OSError), atomic_folder(results / "frames") as folder:
        (folder / "000000.png").touch()
    assert (tmp_path / "elsewhere" / "kept").exists()
