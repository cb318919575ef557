"""An edit of a small event, called as a user calls it."""

import re
import shutil
import struct
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pytest
import yaml

from fourd.demo.cameras import camera_at, clip_times
from fourd.demo.options import DemoOptions
from fourd.demo.render import FrozenScene
from fourd.edit.compose import INFERRED, SAME_TIME, UNTOUCHED
from fourd.edit.films import COLUMNS
from fourd.ingest import open_camera
from fourd.io import Archive, read_csv, read_image, read_json, write_json, write_png
from fourd.video import probe_video
from tests.conftest import Workspace, tiny_scene

NUM_FRAMES, SIZE = 6, (160, 90)
NAMES = ("cam00", "cam01", "cam02", "cam03")
# Both walkers have left by then, out of every view.
GONE = (4, 5)
NOT_PLACED = "its film shows another place"


def small_scene() -> dict:
    """The tiny event at a slower clock, so that whoever walks leaves the place where they stood."""
    scene = tiny_scene(len(NAMES), NUM_FRAMES) | {"fps": 5, "size": list(SIZE), "heldout": []}
    scene["settings"] |= {
        # Neighbours 11 degrees apart, as in the demo.
        "demo": {"arc_deg": 33},
        "trajectories": {"hold_view": {"kind": "hold"}},
        "fuse": {"min_pairs": 2},
        "composition": {"num_filters": [4, 4, 4], "epochs": 1},
    }
    return scene


def let_walkers_leave(workspace: Workspace) -> dict:
    """The scene of films in which both are gone from some frame on, and of one without a camera."""
    options = DemoOptions(len(NAMES), NUM_FRAMES, 5.0, *SIZE, arc_deg=33.0)
    films = workspace.folder / "films"
    shutil.copytree(workspace.folder / "data" / "demo" / "frames", films)
    for frame in GONE:
        time_s = float(clip_times(options)[frame])
        empty = FrozenScene(time_s, options, (1, 2))
        for name in NAMES:
            write_png(films / name / f"{frame:06d}.png", empty.render(camera_at(name, time_s, options))[0])
    shutil.copytree(films / NAMES[0], films / "lost")
    cameras = read_json(workspace.folder / "data" / "demo" / "cameras.json")
    cameras["cameras"]["lost"] = cameras["cameras"][NAMES[0]] | {"status": NOT_PLACED}
    write_json(films / "cameras.json", cameras)
    sources = {name: {"source": f"films/{name}"} for name in (*NAMES, "lost")}
    return small_scene() | {"cameras": sources, "calibration": ["films/cameras.json"]}


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
    """The first walker has been taken out of a camera's film and of a trajectory, and has left at the end."""
    workspace = Workspace(tmp_path_factory.mktemp("edited"))
    workspace.write_scene("demo", small_scene())
    footage = [f"data/demo/frames/{name}" for name in NAMES]
    result = workspace.snakemake(
        "--cores", "2", "data/demo/truth/labels/cam01", "data/demo/cameras.json", *footage
    )
    assert result.returncode == 0, result.stdout[-4000:]
    workspace.write_scene("demo", let_walkers_leave(workspace))
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
            if frame in GONE:
                continue
            before = read_image(edited.folder / f"films/cam01/{frame:06d}.png")
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


def test_frames_that_the_marked_one_has_left_are_the_same_by_a_bit(
    edited: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the log says which frames these are. In so small pictures a speck of noise may stay for a frame."""
    event = results(edited).parents[1]
    log = (edited.folder / "logs/demo/edit_masks/gone.log").read_text()
    assert re.search(r"was found in no view at [12] of 6 frames \((4 to )?5\), so nothing is done to it", log)
    # Paths of sources start where the workflow ran.
    monkeypatch.chdir(edited.folder)
    with open_camera(event / "frames" / "cameras" / "cam01.npz") as film:
        for frame in GONE[1:]:
            name, chunk = f"{frame:06d}.png", "000003-000005"
            rendered = read_image(event / "render" / "hold_view" / chunk / name)
            for view, before in (("cam01", film.read(frame)), ("hold_view", rendered)):
                folder = results(edited) / view / chunk
                assert (read_image(folder / name) == before).all()
                assert (read_image(folder / "provenance" / name)[..., 0] == UNTOUCHED).all()


def write_bomb(path: Path) -> None:
    """A PNG of a few bytes that unfolds into gigabytes."""
    parts = ((b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)), (b"IDAT", bytes(64)))
    chunks = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))


@pytest.fixture(scope="module")
def refused(edited: Workspace) -> subprocess.CompletedProcess[str]:
    """One run of edits that cannot be made, wholly or in part, beside the one that is finished."""
    folder = edited.folder / "config" / "edits"
    write_bomb(edited.folder / "bomb.png")
    box = {"view": "cam01", "frame": 2, "box": box_around(edited, "cam01", 2, 1)}
    marks = {
        "lost_mark": [box | {"view": "lost"}],
        # Larger than anything in it.
        "lost_view": [box | {"box": [0, 0, *SIZE]}],
        "bomb": [{"view": "cam01", "frame": 2, "mask": "bomb.png"}],
        "outside": [box | {"box": [200, 5, 230, 20]}],
        "conflict": [box, box | {"box": [int(n) for n in box["box"]], "is_part": False}],
        "ground": [box | {"box": [95, 62, 130, 84]}],
        # What one camera alone sees has no depth.
        "hole": [box | {"box": [152, 60, 159, 80]}],
    }
    for name, its_marks in marks.items():
        views = ["lost", "cam02"] if name == "lost_view" else ["cam02"]
        write_edit(edited, name, operation="remove", views=views, marks=its_marks)
    try:
        return edited.snakemake("--cores", "2", "--keep-going", "--show-failed-logs", "edit_all")
    finally:
        for name in marks:
            (folder / f"{name}.yaml").unlink()


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        ("lost_mark", f"camera lost was left out of the calibration ({NOT_PLACED}), .*: mark another camera"),
        ("lost_view", f"view lost was left out of the calibration ({NOT_PLACED}), .*: choose another view"),
        ("bomb", "expected a PNG mask of 160 x 90 px at bomb.png, got 60000 x 60000 px: draw the mask"),
        ("outside", "the box on frame 2 of cam01 lies outside the picture of 160 x 90 px: .* draw it again"),
        ("conflict", "contradict each other on .* px: .*; change one of them"),
        ("ground", "the box on frame 2 of cam01 lies on the background: .*; mark something that moves"),
        ("hole", "the box on frame 2 of cam01 lies on a hole: .*; mark the thing on another frame or camera"),
    ],
)
def test_an_edit_that_cannot_be_made_says_why_in_a_sentence(
    refused: subprocess.CompletedProcess[str], edit: str, message: str
) -> None:
    assert refused.returncode != 0 and "Traceback" not in refused.stdout
    pattern = f"error: config/edits/{edit}.yaml: .*" + message.replace("(", r"\(").replace(")", r"\)")
    assert re.search(pattern, refused.stdout), refused.stdout[-4000:]


def test_other_views_of_the_same_edit_are_finished(
    edited: Workspace, refused: subprocess.CompletedProcess[str]
) -> None:
    """A box over the whole picture means what moves in it, which is said."""
    folder = edited.folder / "results" / "demo" / "edits"
    films = sorted(str(path.relative_to(folder)) for path in folder.glob("*/*.mp4"))
    assert films == ["gone/cam01.mp4", "gone/hold_view.mp4", "lost_view/cam02.mp4"]
    assert len(probe_video(folder / "lost_view" / "cam02.mp4").pts_s) == NUM_FRAMES
    log = (edited.folder / "logs/demo/edit_masks/lost_view.log").read_text()
    assert "the box on frame 2 of cam01 is larger than the thing" in log
    with Archive(folder / "lost_view" / "masks.npz") as masks:
        mask = masks["000002/cam01"] > 0
    truth = read_image(edited.folder / "data/demo/truth/labels/cam01/000002.png")[:, :, 0]
    assert (truth[mask] > 0).mean() > 0.7 and mask[truth == 1].mean() > 0.6
