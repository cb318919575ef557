"""An edit of a small event, called as a user calls it."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from fourd.edit.compose import INFERRED, SAME_TIME, UNTOUCHED
from fourd.edit.films import COLUMNS
from fourd.io import read_csv, read_image, read_json
from fourd.video import probe_video
from tests.conftest import Workspace, tiny_scene

NUM_FRAMES, SIZE = 6, (160, 90)


def small_scene() -> dict:
    """The tiny event at a slower clock, so that whoever walks leaves the place where they stood."""
    scene = tiny_scene(num_cameras=4, num_frames=NUM_FRAMES) | {"fps": 5, "size": list(SIZE), "heldout": []}
    scene["settings"] |= {
        # Neighbours 11 degrees apart, as in the demo.
        "demo": {"arc_deg": 33},
        "trajectories": {"hold_view": {"kind": "hold"}},
        "fuse": {"min_pairs": 2},
        "composition": {"num_filters": [4, 4, 4], "epochs": 1},
    }
    return scene


def write_edit(workspace: Workspace, name: str, **document: object) -> None:
    folder = workspace.folder / "config" / "edits"
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.yaml").write_text(yaml.safe_dump({"scene": "demo", **document}))


def box_around(workspace: Workspace, camera: str, frame: int, label: int) -> list[float]:
    truth = read_image(workspace.folder / f"data/demo/truth/labels/{camera}/{frame:06d}.png")[:, :, 0]
    y, x = np.nonzero(truth == label)
    return [float(x.min() - 2), float(y.min() - 2), float(x.max() + 2), float(y.max() + 2)]


@pytest.fixture(scope="module")
def edited(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A workspace in which the first walker has been taken out of a camera's film and of a trajectory."""
    workspace = Workspace(tmp_path_factory.mktemp("edited"))
    workspace.write_scene("demo", small_scene())
    result = workspace.snakemake("--cores", "2", "data/demo/truth/labels/cam01")
    assert result.returncode == 0, result.stdout[-4000:]
    mark = {"view": "cam01", "frame": 2, "box": box_around(workspace, "cam01", 2, 1)}
    write_edit(workspace, "gone", operation="remove", views=["cam01", "hold_view"], marks=[mark])
    result = workspace.snakemake("--cores", "2", "edit_all", timeout_s=1500)
    assert result.returncode == 0, result.stdout[-4000:]
    return workspace


def results(workspace: Workspace) -> Path:
    return workspace.folder / "results" / "demo" / "edits" / "gone"


def planned(workspace: Workspace, *arguments: str) -> set[str]:
    """Rules that a dry run would run."""
    output = workspace.snakemake("edit_all", "-n", "--quiet", "rules", "host", *arguments).stdout
    if "Nothing to be done" in output:
        return set()
    table = output.split("Job stats:")[1].split("total")[0]
    return set(re.findall(r"^(\w+)\s+\d+$", table, re.MULTILINE)) - {"edit_all"}


def test_edited_films_are_whole(edited: Workspace) -> None:
    for view in ("cam01", "hold_view"):
        info = probe_video(results(edited) / f"{view}.mp4")
        assert info.size == SIZE and len(info.pts_s) == NUM_FRAMES


def test_the_walker_is_gone_and_the_rest_is_untouched(edited: Workspace) -> None:
    covered, changed = 0, 0
    for folder in sorted(results(edited).glob("cam01/*")):
        for path in sorted(folder.glob("0*.png")):
            frame = int(path.stem)
            before = read_image(edited.folder / f"data/demo/frames/cam01/{frame:06d}.png")
            truth = read_image(edited.folder / f"data/demo/truth/labels/cam01/{frame:06d}.png")[:, :, 0]
            origin = read_image(folder / "provenance" / path.name)
            untouched = origin[..., 0] == UNTOUCHED
            assert np.abs(read_image(path).astype(int) - before)[untouched].max() <= 5
            assert untouched[truth == 0].mean() > 0.8
            covered += (truth == 1).sum()
            changed += (~untouched & (truth == 1)).sum()
    assert changed > 0.6 * covered


def test_every_edited_pixel_says_where_it_came_from(edited: Workspace) -> None:
    for folder in sorted(results(edited).glob("*/0*")):
        legend = read_json(folder / "provenance.json")
        for path in sorted((folder / "provenance").glob("*.png")):
            kind, camera, frame = np.moveaxis(read_image(path), -1, 0)
            nobody = (kind == UNTOUCHED) | (kind == INFERRED)
            assert (camera[~nobody] < len(legend["cameras"])).all()
            assert (frame[~nobody] < len(legend["frames"])).all()
            assert (frame[kind == SAME_TIME] < NUM_FRAMES).all()
        rows = read_csv(folder / "edit.csv")
        assert tuple(rows[0]) == COLUMNS and all(0 <= float(row["changed_share"]) < 0.6 for row in rows)


def test_second_run_does_nothing(edited: Workspace) -> None:
    assert planned(edited) == set()


def test_a_soft_edge_renders_the_edited_views_only(edited: Workspace) -> None:
    changed = planned(edited, "--config", "edit={feather_px: 2.0}")
    assert changed == {"edit_view", "edit_film"}


def test_another_operation_runs_nothing_above_the_edit(edited: Workspace) -> None:
    document = yaml.safe_load((edited.folder / "config/edits/gone.yaml").read_text())
    write_edit(edited, "behind", **(document | {"operation": "see_behind", "order": 2}))
    try:
        assert planned(edited) == {"edit_masks", "edit_view", "edit_film"}
    finally:
        (edited.folder / "config/edits/behind.yaml").unlink()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"views": ["cam77"]}, "view 'cam77' is neither a camera"),
        ({"marks": [{"view": "cam01", "frame": 99, "box": [1, 1, 9, 9]}]}, "outside its frames 0 to 5"),
        ({"operation": "paint"}, "operation is 'paint'"),
    ],
)
def test_a_wrong_edit_stops_before_the_first_job(edited: Workspace, change: dict, message: str) -> None:
    document = yaml.safe_load((edited.folder / "config/edits/gone.yaml").read_text())
    write_edit(edited, "wrong", **(document | change))
    try:
        result = edited.snakemake("edit_all", "-n")
        assert result.returncode != 0 and message in result.stdout and "Traceback" not in result.stdout
    finally:
        (edited.folder / "config/edits/wrong.yaml").unlink()
