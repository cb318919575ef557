"""Recovered cameras and clocks against true ones."""

from pathlib import Path

import numpy as np
import pytest

from fourd import io
from fourd.camera import Camera
from fourd.errors import InputError
from fourd.geometry import look_at
from fourd.report.__main__ import main
from fourd.report.truth import collect_truth
from fourd.sfm.compare import WorldSimilarity
from tests.unit.report_scene import NAMES, write_benchmarks, write_results, write_scores

SIZE = (96, 64)
TURN_DEG = 0.2


def true_films() -> dict[str, list[Camera]]:
    films = {}
    for i, name in enumerate(NAMES):
        K = np.array([[90.0, 0, 47.5], [0, 90, 31.5], [0, 0, 1]])
        films[name] = [
            Camera(
                K,
                *look_at(np.array([i - 1.0, -3.0 + 0.01 * n, 1.5]), np.zeros(3), np.array([0, 0, 1.0])),
                SIZE,
            )
            for n in range(6)
        ]
    return films


def write_truth(path: Path) -> Path:
    phones = {
        name: {"start_time_s": 0.1 * i, "frames": [camera.to_dict() for camera in film]}
        for i, (name, film) in enumerate(true_films().items())
    }
    io.write_json(path, {"phones": phones})
    return path


def write_recovered(results: Path) -> None:
    """The true cameras in another world, the last one turned by 0.2 degrees, clocks late by 2 s but one."""
    turn, _ = look_at(np.array([1.0, 2, 3]), np.zeros(3), np.array([0, 0, 1.0]))
    world = WorldSimilarity(turn, 0.3, np.zeros(3), np.array([5.0, 6, 7]))
    angle = np.radians(TURN_DEG)
    roll = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    cameras = {}
    for name, film in true_films().items():
        found = [world.apply(camera) for camera in film]
        if name == NAMES[2]:
            found = [Camera(c.K, roll @ c.R, roll @ c.t, c.size) for c in found]
        frames = [{"frame": n, **camera.to_dict()} for n, camera in enumerate(found) if n != 2]
        cameras[name] = {"size": list(SIZE), "status": "ok", "frames": frames}
    cameras["cam09"] = {"size": list(SIZE), "status": "too few points", "frames": []}
    io.write_json(results / "sfm" / "film_cameras.json", {"up": [0, 0, 1], "cameras": cameras})
    starts = {name: {"offset_s": 0.1 * i + 2, "status": "ok"} for i, name in enumerate(NAMES)}
    starts[NAMES[1]]["offset_s"] += 0.005
    io.write_json(results / "align" / "offsets.json", {"cameras": starts})


def test_errors_are_those_after_the_best_similarity_and_shift(tmp_path: Path) -> None:
    write_recovered(tmp_path)
    found = collect_truth(tmp_path, write_truth(tmp_path / "phones.json"))
    assert found is not None
    cameras = {row["name"]: row for row in found["cameras"]}
    assert list(cameras) == list(NAMES)
    # The similarity takes a part of the one camera's turn upon itself, and so turns the others.
    turns = [cameras[name]["rotation_deg"] for name in NAMES]
    assert turns[0] == pytest.approx(turns[1], rel=1e-3)
    assert turns[0] + turns[2] == pytest.approx(TURN_DEG, rel=0.01) and 0 < turns[0] < TURN_DEG / 3
    assert all(row["center"] < 0.02 and abs(row["focal_share"]) < 1e-9 for row in cameras.values())
    clocks = {row["name"]: row["error_s"] for row in found["clocks"]}
    assert clocks == pytest.approx({NAMES[0]: 0, NAMES[1]: 0.005, NAMES[2]: 0}, abs=1e-9)


def test_without_truth_there_is_none_and_another_file_is_refused(tmp_path: Path) -> None:
    assert collect_truth(tmp_path, None) is None
    path = write_truth(tmp_path / "phones.json")
    assert collect_truth(tmp_path, path) == {"cameras": [], "clocks": []}
    io.write_json(tmp_path / "other.json", {"phones": {"cam00": {"frames": []}}})
    with pytest.raises(InputError, match=r"expected true films in .*other.json .* lacks 'start_time_s'"):
        collect_truth(tmp_path, tmp_path / "other.json")


@pytest.fixture
def results(tmp_path: Path) -> Path:
    folder = tmp_path / "results" / "event"
    write_results(folder, tmp_path / "footage")
    write_scores(folder / "evaluate" / "metrics.csv")
    write_benchmarks(tmp_path / "benchmarks" / "event")
    return folder


def test_the_page_shows_truth_and_validation(results: Path, tmp_path: Path) -> None:
    write_recovered(results)
    io.write_png(results / "composition" / "0" / "validation.png", np.full((20, 60, 3), 90, np.uint8))
    command = ["--results", str(results), "--benchmarks", str(tmp_path / "benchmarks" / "event")]
    main(
        [*command, "--truth", str(write_truth(tmp_path / "phones.json")), "--output", str(tmp_path / "page")]
    )
    page = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    assert "Against the truth" in page and "Level 0, samples kept apart" in page
    document = io.read_json(tmp_path / "page" / "report.json")
    assert [row["name"] for row in document["truth"]["cameras"]] == list(NAMES)


def test_a_forecast_stands_beside_what_was_taken(results: Path, tmp_path: Path) -> None:
    rule = {"jobs": 2, "cpu_s": 3.0, "cpu_s_done": 0.5}
    foreseen = {"minutes": 4.2, "num_cores": 2, "rules": {"render_frames": rule, "never_run": rule}}
    io.write_json(results / "plan" / "plan.json", {"first_forecast": foreseen})
    command = ["--results", str(results), "--benchmarks", str(tmp_path / "benchmarks" / "event")]
    main([*command, "--output", str(tmp_path / "page")])
    found = io.read_json(tmp_path / "page" / "report.json")["forecast"]
    taken = {row["rule"]: (row["forecast_cpu_s"], row["cpu_s"], row["num_jobs"]) for row in found["rules"]}
    assert taken == {"render_frames": (3.5, 1.0, 1), "never_run": (3.5, None, 0)}
    page = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    assert "Before the run 4.2 minutes on 2 cores were foreseen" in page
