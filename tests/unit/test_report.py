"""The figures of the report: means, run time, fronts, numbers as text."""

import math
import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fourd import io
from fourd.errors import InputError
from fourd.report import charts, costs, environment, extras, html, numbers, progress, scores
from tests.conftest import REPOSITORY
from tests.unit.report_scene import write_scores


def table_of(path: Path, rows: list[tuple[str, int, str, str, str, str]]) -> scores.Scores:
    columns = ("view", "frame", "method", "region", "region_source", "metric", "value")
    full = [dict(zip(columns, (v, f, m, r, "truth", k, x), strict=True)) for v, f, m, r, k, x in rows]
    io.write_csv(path, columns, full)
    return scores.read_scores(path)


def test_means_leave_out_infinite_and_empty_values_and_count_them(tmp_path: Path) -> None:
    read = table_of(
        tmp_path / "metrics.csv",
        [
            ("a", 0, "ours", "full", "psnr_db", "20"),
            ("a", 1, "ours", "full", "psnr_db", "inf"),
            ("b", 0, "ours", "full", "psnr_db", "26"),
            ("a", 0, "ours", "full", "mse", ""),
            ("a", 0, "inst", "full", "psnr_db", "11"),
        ],
    )
    ours, empty, inst = scores.summarize(read, ("method", "metric"))
    assert (ours["mean"], ours["sd"]) == (23.0, pytest.approx(np.std([20, 26], ddof=1)))
    assert (ours["num_values"], ours["num_infinite"], ours["num_empty"]) == (2, 1, 0)
    assert (empty["metric"], empty["mean"], empty["sd"], empty["num_empty"]) == ("mse", None, None, 1)
    assert (inst["mean"], inst["sd"]) == (11.0, 0.0)


def test_a_table_without_a_column_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text("view,frame,method,region,metric,value\n")
    with pytest.raises(InputError, match=r"column region_source in .*metrics.csv"):
        scores.read_scores(path)


def test_a_table_without_rows_has_no_means(tmp_path: Path) -> None:
    assert scores.summarize(table_of(tmp_path / "metrics.csv", []), ("method",)) == []


def test_curves_average_views_and_leave_gaps(tmp_path: Path) -> None:
    rows = [(v, f, "ours", "full", "mse", str(10 * f + i)) for i, v in enumerate("ab") for f in (0, 5)]
    rows.append(("a", 3, "inst", "full", "mse", "4"))
    inst_or_ours = scores.curves(table_of(tmp_path / "metrics.csv", rows), "full", "mse")
    ours, inst = inst_or_ours
    assert ours.x == [0, 3, 5] and ours.y == [0.5, None, 50.5] and ours.is_ours
    assert inst.y == [None, 4.0, None] and not inst.is_ours


def test_long_curves_are_averaged_in_runs(tmp_path: Path) -> None:
    write_scores(tmp_path / "metrics.csv", num_frames=1000, methods=("ours",), metrics=("mse",))
    (line,) = scores.curves(scores.read_scores(tmp_path / "metrics.csv"), "full", "mse")
    assert len(line.x) == scores.MAX_CURVE_POINTS
    assert line.y[0] == pytest.approx(20 + 2.0) and line.x[0] == 2.0


def test_frames_are_ranked_from_the_worst(tmp_path: Path) -> None:
    write_scores(tmp_path / "metrics.csv")
    read = scores.read_scores(tmp_path / "metrics.csv")
    assert [frame for frame, _ in scores.ranked_frames(read, "cam01")] == [0, 1, 2, 3]
    assert scores.ranked_frames(read, "cam77") == []


def test_intervals_and_notes_come_from_the_summary(tmp_path: Path) -> None:
    path = tmp_path / "summary.csv"
    columns = ("region", "method", "metric", "low", "high", "note")
    io.write_csv(path, columns, [dict(zip(columns, ("full", "ours", "mse", "1", "2.5", "why"), strict=True))])
    rows = [{"region": "full", "method": m, "metric": "mse"} for m in ("ours", "inst")]
    scores.add_summary(rows, path)
    assert rows[0] | {"low": 1.0, "high": 2.5, "note": "why"} == rows[0]
    assert rows[1] | {"low": None, "high": None, "note": None} == rows[1]


@pytest.mark.parametrize(
    ("metric", "higher"),
    [("psnr_db", True), ("ssim", True), ("ms_ssim", True), ("dssim", False), ("mse", False), ("fid", False)],
)
def test_direction_of_metrics(metric: str, higher: bool) -> None:
    assert scores.is_higher_better(metric) is higher


def job(end_s: float, seconds: float, rule: str = "disparity", *words: str) -> costs.Job:
    return costs.Job(rule, words, seconds, seconds, None, end_s)


def test_run_time_counts_parallel_jobs_once_and_no_pauses() -> None:
    clock = costs.Clock([job(10, 10), job(8, 4), job(12, 4), job(1000, 5)])
    assert clock.total_s == pytest.approx(17)
    assert clock.at(10) == pytest.approx(10)
    assert clock.at(500) == pytest.approx(12)
    assert clock.at(998) == pytest.approx(15)
    assert clock.at(-3) == 0
    assert costs.Clock([]).total_s == 0


@given(st.lists(st.tuples(st.floats(0, 100), st.floats(0, 20)), min_size=1, max_size=8))
def test_run_time_never_falls_and_never_exceeds_the_work(spans: list[tuple[float, float]]) -> None:
    clock = costs.Clock([job(end, seconds) for end, seconds in spans])
    times = [clock.at(t) for t in np.linspace(-30, 130, 50)]
    assert all(b >= a - 1e-9 for a, b in zip(times, times[1:], strict=False))
    assert clock.total_s <= sum(seconds for _, seconds in spans) + 1e-9


def test_benchmarks_are_read_in_the_order_of_the_flow(tmp_path: Path) -> None:
    header = "s\tmax_rss\tcpu_time\n"
    for name, line in {
        "train_level/0": "30\t800\t60\n",
        "disparity/a-b/000000-000009": "5\t200\t4\n",
        "disparity/a-b/samples": "1\t-\t-\n",
        "unknown_rule": "2\t10\t1\n",
        "report_page": "9\t9\t9\n",
        "demo_frames/cam00": "9\t9\t9\n",
    }.items():
        path = tmp_path / "benchmarks" / f"{name}.tsv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(header + line)
        os.utime(path, (100, 100))
    results = tmp_path / "results"
    (results / "disparity").mkdir(parents=True)
    (results / "disparity" / "x.npz").write_bytes(b"12345")
    found = costs.collect_costs(results, costs.read_jobs(tmp_path / "benchmarks"))
    assert [row["rule"] for row in found["rules"]] == ["disparity", "train_level", "unknown_rule"]
    disparity = found["stages"][0]
    assert (disparity["seconds"], disparity["cpu_seconds"], disparity["num_bytes"]) == (6.0, 4.0, 5)
    assert disparity["peak_bytes"] == 200 * 2**20
    assert found["stages"][-1]["cumulative_seconds"] == found["total"]["seconds"] == 38.0
    assert found["total"]["run_time_s"] == 30.0


def test_a_method_is_ready_when_its_last_rule_is_done_for_a_heldout_camera() -> None:
    jobs = [
        job(10, 1, "fuse_foreground", "held"),
        job(20, 1, "fuse_foreground", "film"),
        job(15, 1, "estimate_background", "held"),
    ]
    assert progress.ready_at(jobs, "inst", ["held"]) == 10
    assert progress.ready_at(jobs, "paste", ["held"]) == 15
    assert progress.ready_at(jobs, "ours", ["held"]) is None
    assert progress.ready_at(jobs, "another program", ["held"]) is None


points = st.lists(st.tuples(st.floats(0, 9), st.floats(0, 9)), max_size=12)


@given(points)
def test_front_is_what_nothing_beats(points: list[tuple[float, float]]) -> None:
    front = extras.find_front(points)
    for i, (x, y) in enumerate(points):
        beaten = any((a <= x and b < y) or (a < x and b <= y) for a, b in points)
        # Of equal points one stands for all.
        assert beaten == (i not in front) or any(points[j] == (x, y) for j in front)
    assert front == sorted(front, key=lambda i: points[i])


def test_sweeps_need_errors_and_times(tmp_path: Path) -> None:
    columns = ("setting", "error", "cpu_seconds")
    rows = [("fast", 2, 1), ("lost", "nan", 1)]
    io.write_csv(tmp_path / "a.csv", columns, [dict(zip(columns, row, strict=True)) for row in rows])
    io.write_csv(tmp_path / "speed.csv", ("setting", "seconds"), [{"setting": "x", "seconds": 1}])
    (bench,) = extras.collect_benches(tmp_path)
    assert bench["points"] == [{"name": "fast", "error": 2.0, "seconds": 1.0}]
    assert extras.collect_benches(None) == [] and extras.collect_stability(tmp_path / "none.csv") is None


def test_ablations_are_scored_at_their_last_mark(tmp_path: Path) -> None:
    columns = ("variant", "mark_s", "view", "psnr_db", "seconds")
    rows = [
        ("paste", 0, "a", 20, ""),
        ("l1", 10, "a", 21, 10),
        ("l1", 60, "a", 23, 61),
        ("l1", 60, "b", 25, 63),
    ]
    io.write_csv(tmp_path / "c.csv", columns, [dict(zip(columns, row, strict=True)) for row in rows])
    (table,) = extras.collect_ablations(tmp_path)
    assert table["points"] == [{"name": "l1", "value": 24.0, "seconds": 62.0}]
    assert table["rows"][0] == ["paste", 0.0, "a", 20.0, ""]


def test_packages_are_the_dependencies_of_the_project() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    named = {pin.split("==")[0] for pin in project["dependencies"]}
    assert set(environment.PACKAGES) | {"snakemake-logger-plugin-rich"} == named


def test_seeds_are_found_at_any_depth() -> None:
    settings = {"seed": 1, "demo": {"seed": 2, "seeds": 3}, "a": {"b": {"seed": 4}}}
    assert dict(environment.find_seeds(settings)) == {"seed": 1, "demo.seed": 2, "a.b.seed": 4}


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "-"), (0, "0"), (math.inf, "∞"), (26.354, "26.4"), (4215.8, "4216"), (0.0123, "0.0123"),
     (-0.5, "-0.500"), (3e-6, "3.00e-06"), (2e9, "2.00e+09")],
)  # fmt: skip
def test_numbers_as_text(value: float | None, text: str) -> None:
    assert numbers.show(value) == text


def test_times_and_sizes_as_text() -> None:
    assert [numbers.show_seconds(v) for v in (None, 1.26, 61, 3700)] == [
        "-",
        "1.3 s",
        "1 min 1 s",
        "1 h 1 min",
    ]
    assert [numbers.show_bytes(v) for v in (None, 0, 999, 1500, 2.5e11)] == [
        "-",
        "0 B",
        "999 B",
        "1.5 kB",
        "250 GB",
    ]
    assert numbers.finite(math.nan) is None and numbers.parse("NA") is None and numbers.parse("2") == 2


@given(st.text(), st.text())
def test_text_and_attributes_are_escaped(text: str, value: str) -> None:
    made = html.tag("p", text, title=value)
    assert made.count("<") == 2 and made.count(">") == 2
    assert html.tag("p", html.Markup("<b>x</b>"), None, [1, 2.5]) == "<p><b>x</b>12.5</p>"


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_ticks_are_within_the_axis_and_few(low: float, span: float) -> None:
    ticks = charts.nice_ticks(low, low + span)
    slack = 1e-6 * max(abs(low), span, 1)
    assert all(low - slack <= tick <= low + span + slack for tick in ticks)
    assert len(ticks) <= 7


def test_log_ticks_are_at_least_two() -> None:
    for low, high in ((1, 1000), (2, 30), (0.41, 0.6), (3, 3.3)):
        assert len(charts.log_ticks(low, high)) >= 2


def test_charts_bear_gaps_single_points_and_nothing() -> None:
    gap = charts.line_chart([charts.Series("a", [0, 1, 2, 3], [1.0, None, 2.0, 3.0])], "x", "y", "chart")
    assert gap.count("<polyline") == 1 and "nan" not in gap
    assert "Nothing to draw" in charts.line_chart([charts.Series("a", [0], [None])], "x", "y", "chart")
    assert "<circle" in charts.scatter_chart([("a", 2.0, 5.0)], [0], "x", "y", "chart", is_log=True)


def test_equal_lines_differ_by_more_than_colour() -> None:
    looks = {
        (charts.look(i, charts.Series("", [], []))["stroke_dasharray"], charts.MARKS[i % len(charts.MARKS)])
        for i in range(20)
    }
    assert len(looks) == 20
