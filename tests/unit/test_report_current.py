"""What the scene no longer has leaves no trace in the report; films and edits that it has are told."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from fourd import io
from fourd.report.__main__ import main
from fourd.report.costs import Job
from fourd.report.current import Current, read_current
from fourd.report.films import collect_edits, describe_runs, paint_origins
from tests.unit.report_scene import CHUNK, HELDOUT, picture, write_benchmarks, write_results, write_scores

SETTINGS = '{"trajectories": {"orbit": {}}, "chunk_frames": 4}'
CODES = {"untouched": 0, "inserted": 40, "same_time": 80, "other_time": 160, "inferred": 255}


def write_film(results: Path, name: str) -> None:
    """A placed and rendered film that leaves the cameras for two frames."""
    view = io.read_json(results / "views" / f"{HELDOUT}.json")
    io.write_json(results / "views" / f"{name}.json", {**view, "name": name, "role": "virtual"})
    shutil.copytree(results / "render" / HELDOUT, results / "render" / name)
    (results / "render" / f"{name}.mp4").write_bytes(b"film")
    facts = [(0, 0.0, ""), (1, 1.5, "0.75 camera spacings outside"), (2, 1.8, "0.9 camera spacings outside")]
    frames = [
        {
            "frame": i,
            "hull_distance": d,
            "spacing": 2.0,
            "turn_deg": 4.0 + i,
            "is_outside": d > 0,
            "reason": r,
        }
        for i, d, r in facts
    ]
    document = {"view": name, "num_outside": 2, "spacing": 2.0, "frames": frames}
    io.write_json(results / "render" / f"{name}.json", document)


def write_edit(results: Path, edit: str, view: str) -> None:
    """Four edited frames, the third of which is changed most."""
    folder = results / "edits" / edit / view / CHUNK
    rows = []
    for frame in range(4):
        share = 0.2 if frame == 2 else 0.1
        io.write_png(folder / f"{frame:06d}.png", picture(frame))
        kind = np.zeros((64, 96, 3), np.uint8)
        kind[:10, :, 0] = CODES["other_time"]
        io.write_png(folder / "provenance" / f"{frame:06d}.png", kind)
        shares = {"same_time": 0.0, "other_time": share, "inferred": 0.0, "inserted": 0.0}
        rows.append({"frame": frame, "changed_share": share, **shares, "seconds": 1.0})
    io.write_json(folder / "provenance.json", {"cameras": ["cam00"], "frames": [0], **CODES})
    io.write_csv(folder / "edit.csv", list(rows[0]), rows)
    (results / "edits" / edit / f"{view}.mp4").write_bytes(b"film")


@pytest.fixture
def event(tmp_path: Path) -> Path:
    results = tmp_path / "results" / "event"
    write_results(results, tmp_path / "footage")
    write_film(results, "orbit")
    write_edit(results, "without_ball", HELDOUT)
    write_scores(results / "evaluate" / "metrics.csv")
    write_benchmarks(tmp_path / "benchmarks")
    return tmp_path


def make(event: Path, name: str) -> tuple[str, dict]:
    """The page and the document, without what depends on the disk and the moment."""
    command = ["--results", str(event / "results" / "event"), "--benchmarks", str(event / "benchmarks")]
    command += ["--settings", SETTINGS, "--num-levels", "1", "--edits", "without_ball"]
    main([*command, "--output", str(event / name)])
    document = io.read_json(event / name / "report.json")
    for stage in document["costs"]["stages"]:
        # What lies on the disk is counted as it is.
        del stage["num_bytes"], stage["num_files"]
    del document["costs"]["total"]["num_bytes"]
    return (event / name / "index.html").read_text(encoding="utf-8"), document


def leave_stale_results(event: Path) -> None:
    """Of a camera, a film, an edit, a level, a chunk and a held-out camera that the scene had before."""
    results = event / "results" / "event"
    for kind in ("foreground", "background", "render"):
        shutil.copytree(results / kind / HELDOUT, results / kind / "gone")
        old = results / kind / HELDOUT / CHUNK
        if kind == "render":
            shutil.copytree(old, old.with_name("000000-000001"))
            io.write_png(old.with_name("000000-000001") / "000000.png", np.zeros((64, 96, 3), np.uint8))
        else:
            shutil.copy(f"{old}.npz", old.with_name("000000-000001.npz"))
    view = io.read_json(results / "views" / f"{HELDOUT}.json")
    io.write_json(results / "views" / "gone.json", {**view, "name": "gone"})
    write_film(results, "old_film")
    write_edit(results, "old_edit", HELDOUT)
    write_edit(results, "without_ball", "gone")
    shutil.copytree(results / "composition" / "0", results / "composition" / "1")
    io.write_png(results / "composition" / "1" / "validation.png", picture(3))
    pairs = results / "rectification"
    for name in ("cam00-gone", f"cam00-{HELDOUT}"):
        shutil.copy(pairs / "cam00-cam02.npz", pairs / f"{name}.npz")
        shutil.copytree(results / "disparity" / "cam00-cam02", results / "disparity" / name)
    table = results / "evaluate" / "metrics.csv"
    rows = io.read_csv(table)
    io.write_csv(table, list(rows[0]), rows + [{**row, "view": "gone", "value": "0.5"} for row in rows])
    job = event / "benchmarks" / "render_frames" / HELDOUT / "0.tsv"
    for word in ("render_frames/gone/0", "disparity/cam00-gone/samples", "train_level/1"):
        path = event / "benchmarks" / f"{word}.tsv"
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(job, path)


def test_nothing_stale_changes_the_report(event: Path) -> None:
    page, document = make(event, "page")
    leave_stale_results(event)
    stale_page, stale_document = make(event, "again")
    assert stale_document == document
    for word in ("gone", "old film", "old_film", "old edit", "Level 1"):
        assert word not in page and word not in stale_page, word
    # Only what is said of the disk differs.
    before, after = (
        re.sub("on disk</dt><dd>[^<]*", "", text).split('<section id="costs">')[0]
        for text in (page, stale_page)
    )
    assert after == before


def test_outside_the_workflow_everything_that_lies_there_is_read(event: Path) -> None:
    results = event / "results" / "event"
    leave_stale_results(event)
    current = read_current(results, None, None, None)
    assert set(current.views) == {HELDOUT, "orbit", "old_film"}
    assert len(current.chunks_in(results / "foreground" / HELDOUT, HELDOUT)) == 2
    assert {edit["edit"] for edit in collect_edits(results, current)} == {"without_ball", "old_edit"}


def test_films_say_where_they_leave_the_cameras(event: Path) -> None:
    page, document = make(event, "page")
    (film,) = document["films"]
    assert (film["name"], film["num_frames"], film["num_outside"]) == ("orbit", 3, 2)
    assert film["max_distance_spacings"] == pytest.approx(0.9) and film["max_turn_deg"] == 6
    assert film["outside"] == [{"first": 1, "last": 2, "reason": "0.9 camera spacings outside"}]
    assert "1 to 2: 0.9 camera spacings outside" in page


def test_edits_say_where_their_pixels_come_from(event: Path) -> None:
    page, document = make(event, "page")
    (edit,) = document["edits"]
    assert (edit["edit"], edit["view"], edit["num_frames"]) == ("without_ball", HELDOUT, 4)
    assert edit["other_time"] == edit["changed_share"] == pytest.approx(0.125)
    assert "without ball, cam01" in page and "frame 2, edited" in page
    assert "edits/without_ball/cam01.mp4" in page


def test_runs_end_at_gaps() -> None:
    runs = describe_runs([(3, "a"), (4, "b"), (5, "c"), (9, "d")])
    assert runs == [{"first": 3, "last": 5, "reason": "b"}, {"first": 9, "last": 9, "reason": "d"}]
    assert describe_runs([]) == []


def test_origins_are_painted_and_the_rest_is_grey() -> None:
    kind = np.array([[0, 80], [160, 255]], np.uint8)
    painted = paint_origins(np.full((2, 2, 3), 100, np.uint8), kind, CODES)
    assert painted[0, 0].tolist() == [100, 100, 100]
    assert len({tuple(colour) for colour in painted.reshape(4, 3).tolist()}) == 4


def test_jobs_of_training_backgrounds_are_told_by_their_groups() -> None:
    cameras = frozenset({"cam00", "cam01", "cam02"})
    views = {"cam00": [1, 4, 7, 10], "cam02": [2, 6], "film": list(range(30))}
    current = Current(cameras, cameras - {"cam02"}, frozenset({"cam02"}), views, 12, 2, 1, frozenset())

    def has(rule: str, *words: str) -> bool:
        return current.has_job(Job(rule, words, 1.0, 1.0, None, 0.0))

    assert has("estimate_background", "cam00", "000001-000004")
    assert has("estimate_background", "cam00", "000007-000010")
    assert not has("estimate_background", "cam00", "000004-000007")
    assert has("estimate_background", "film", "000028-000029") and not has("disparity", "cam00-cam02", "x")
    assert has("disparity", "cam00-cam01", "000010-000011") and has("disparity", "cam00-cam01", "samples")
    assert not has("disparity", "cam00-cam01", "000028-000029")
    assert has("render_frames", "film", "000028-000029") and not has(
        "render_frames", "other", "000000-000001"
    )
    assert has("evaluate_camera", "cam02") and not has("evaluate_camera", "cam00")
    assert has("encode_master", "film.mov") and not has("encode_master", "gone.mov")
    assert has("polish", "gone") and has("listen") and not has("train_level", "1")
    assert has("encode_film", "film") and not has("encode_film", "cam09")
