"""The page of a scene: complete, valid, escaped, the same twice, and honest about what is not there."""

import dataclasses
import json
import shutil
import time
from html.parser import HTMLParser
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml

from fourd import io
from fourd.cli import run_stage
from fourd.errors import InputError
from fourd.report import ReportOptions, pictures
from fourd.report.__main__ import main, parse_settings
from fourd.report.current import read_current
from fourd.report.document import SCHEMA, check_document
from fourd.report.html import VOID_TAGS
from fourd.report.map import draw_map
from fourd.report.page import CHAPTERS
from fourd.report.scene import ground_axes
from tests.conftest import REPOSITORY
from tests.unit import report_scene


class Checker(HTMLParser):
    """Tags that are closed as they were opened, ids, links and addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.sources: list[str] = []

    def handle_startendtag(self, tag: str, attrs: list) -> None:
        self._note(dict(attrs))

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self._note(dict(attrs))
        if tag not in VOID_TAGS:
            self.open.append(tag)

    def _note(self, attributes: dict) -> None:
        self.ids += [attributes["id"]] if "id" in attributes else []
        self.links += [attributes["href"]] if "href" in attributes else []
        self.sources += [attributes[key] for key in ("src", "poster") if key in attributes]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished scene and its report."""
    folder = tmp_path_factory.mktemp("report")
    report_scene.write_results(folder / "results", folder / "footage")
    report_scene.write_scores(folder / "results" / "evaluate" / "metrics.csv")
    report_scene.write_benchmarks(folder / "benchmarks")
    make(folder, "page", "--settings", '{"composition": {"seed": 7}}')
    return folder


def make(folder: Path, output: str, *arguments: str) -> Path:
    command = ["--results", str(folder / "results"), "--benchmarks", str(folder / "benchmarks")]
    main([*command, "--output", str(folder / output), *arguments])
    return folder / output


def read_page(folder: Path) -> str:
    return (folder / "page" / "index.html").read_text(encoding="utf-8")


def test_schema_is_a_schema_and_the_document_keeps_it(folder: Path) -> None:
    schema = json.loads(SCHEMA.read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    document = io.read_json(folder / "page" / "report.json")
    check_document(document)
    assert set(document) == set(schema["properties"])
    with pytest.raises(ValueError, match="cameras/0"):
        check_document({**document, "cameras": [{"name": "x"}]})


def test_options_and_their_schema_agree() -> None:
    path = REPOSITORY / "config" / "schemas" / "report.schema.yaml"
    properties = yaml.safe_load(path.read_text())["properties"]
    defaults = {key: entry["default"] for key, entry in properties.items()}
    assert defaults == dataclasses.asdict(ReportOptions())


def test_figures_are_those_of_the_files(folder: Path) -> None:
    document = io.read_json(folder / "page" / "report.json")
    ours = [r for r in document["scores"]["rows"] if r["method"] == "ours" and r["metric"] == "mse"]
    assert [row["mean"] for row in ours] == [21.5, 21.5]
    assert {(e["kind"], e["name"]) for e in document["left_out"]} == {
        ("camera", "cam09"),
        ("pair", "cam00-cam09"),
        ("frame", "cam01, 2"),
        ("stage", "silhouettes and visual hull"),
    }
    assert document["renders"][0]["max_hole_share"] == pytest.approx(0.03)
    assert document["environment"]["seeds"] == {"composition.seed": 7}
    assert {p["method"] for p in document["error_time"]["points"]} == {"inst", "ours"}
    assert document["error_time"]["unknown_methods"] == ["another program"]
    rows = io.read_csv(folder / "page" / "scores.csv")
    assert len(rows) == 3 * 3 * 2


def test_page_is_well_formed_and_asks_for_nothing(folder: Path) -> None:
    checker = Checker()
    checker.feed(read_page(folder))
    assert checker.open == []
    assert len(checker.ids) == len(set(checker.ids))
    assert set(CHAPTERS) <= set(checker.ids)
    assert {link.removeprefix("#") for link in checker.links} <= set(checker.ids)
    assert checker.sources and all(source.startswith("data:image/") for source in checker.sources)


def test_data_are_escaped(folder: Path) -> None:
    page = read_page(folder)
    assert "&lt;62&gt; degrees" in page and "<62>" not in page
    assert "&lt;static&gt; points" in page


def test_names_that_no_list_knows_are_shown(folder: Path) -> None:
    page = read_page(folder)
    assert "another program" in page and "new distance" in page


def test_same_files_give_the_same_page(folder: Path) -> None:
    again = make(folder, "again", "--settings", '{"composition": {"seed": 7}}')
    for name in ("index.html", "report.json", "scores.csv", "costs.csv"):
        assert (again / name).read_bytes() == (folder / "page" / name).read_bytes()


def test_what_is_gone_is_said(folder: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(folder / "results", bare / "results")
    for name in ("foreground", "background", "disparity", "evaluate", "composition", "align", "views"):
        shutil.rmtree(bare / "results" / name)
    shutil.copytree(folder / "results" / "views", bare / "results" / "views")
    page = (make(bare, "page") / "index.html").read_text(encoding="utf-8")
    assert "was removed after its last use" in page
    assert "Nothing is scored" in page
    assert "The clocks were not looked for" in page
    assert "Scores or run times are missing" in page


def test_truth_that_is_gone_is_said(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "results"
    shutil.copytree(folder / "results", path)
    for film in (path / "frames" / "cameras").glob("*.npz"):
        film.unlink()
    current = read_current(path, None, None, None)
    shows = pictures.collect_pictures(path, current, None, ReportOptions(max_frames=1))
    assert shows[0].truth is None and shows[0].rendered is not None
    assert any(p.title == "truth" and p.image is None and "cam01" in p.caption for p in shows[0].pictures)


def test_frames_are_the_worst_and_the_best(folder: Path) -> None:
    page = read_page(folder)
    assert "cam01, frame 0 <small>the worst by score" in page
    assert "cam01, frame 3 <small>the best by score" in page


def test_without_cameras_a_sentence_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--results", str(tmp_path), "--benchmarks", str(tmp_path), "--output", str(tmp_path / "x")]
    assert run_stage(main, arguments) == 2
    assert "cameras.json" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("text", ["{", "[1]"])
def test_settings_that_are_no_object_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="--settings: expected a JSON object"):
        parse_settings(text)


def test_colour_map_shows_blanks_grey_and_near_bright() -> None:
    ramp = np.tile(np.linspace(0, 1, 50), (4, 1))
    ramp[0] = np.nan
    picture = pictures.colour_map(ramp)
    assert (picture[0] == pictures.BLANK).all()
    luma = picture[1].astype(float).mean(axis=1)
    assert luma[-1] > luma[0] + 50
    assert (pictures.colour_map(np.full((2, 2), np.nan)) == pictures.BLANK).all()


def test_ground_has_right_hand_axes_even_without_a_direction() -> None:
    right, ahead = ground_axes(np.array([0, 0, 2.0]), np.array([0.0, 3, -1]))
    assert np.allclose(right, [1, 0, 0]) and np.allclose(ahead, [0, 1, 0])
    axes = ground_axes(np.array([0, 1.0, 0]), np.array([0, -1.0, 0]))
    assert np.allclose(axes @ axes.T, np.eye(2)) and np.allclose(axes @ [0, 1, 0], 0)


def test_map_bears_one_camera_and_none() -> None:
    camera = {"name": "a", "role": "input", "path": [[0, 0]], "heading": [0, 1], "height": 1, "fov_deg": 60}
    assert "<polygon" in draw_map({"cameras": [camera], "trajectories": [], "points": []}, 2.0)
    assert "there is no map" in draw_map({"cameras": [], "trajectories": [], "points": []}, None)


def test_long_events_are_reported_in_seconds(folder: Path, tmp_path: Path) -> None:
    """15 cameras, 300 frames: 27000 rows here; the time goes with the rows."""
    shutil.copytree(folder / "results", tmp_path / "results")
    table = tmp_path / "results" / "evaluate" / "metrics.csv"
    report_scene.write_scores(
        table, num_views=15, num_frames=300, methods=("ours", "inst", "x"), metrics=("mse",)
    )
    report_scene.hold_out(tmp_path / "results", 15)
    start = time.process_time()
    make(tmp_path, "page", "--max-views", "0")
    assert time.process_time() - start < 10
    page = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    assert "4500 frames" in page and "cam15" in page
