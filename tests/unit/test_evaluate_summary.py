"""Mean, deviation and interval: closed forms, and how often the interval has the truth in it."""

import math

import numpy as np
import pytest

from fourd.evaluate.summary import (
    bootstrap_interval,
    differences,
    summarize,
    summarize_all,
    summarize_rows,
    summary_rows,
)

NUM_SIMULATIONS = 300


def rows_of(
    values: dict[str, list[str]], method: str = "ours", metric: str = "psnr_db"
) -> list[dict[str, str]]:
    return [
        {
            "view": view,
            "frame": str(frame),
            "method": method,
            "region": "full",
            "metric": metric,
            "value": value,
            "note": "" if value else "why",
        }
        for view, frames in values.items()
        for frame, value in enumerate(frames)
    ]


def test_summary_is_mean_and_sample_deviation():
    assert summarize([1.0, 2.0, 6.0]) == pytest.approx((3.0, math.sqrt(7)))
    assert summarize([4.0]) == (4.0, 0.0)
    mean, deviation = summarize([1.0, math.inf])
    assert mean == math.inf and math.isnan(deviation)


@pytest.mark.parametrize("num_cameras", [1, 2, 3, 8])
def test_the_interval_covers_the_truth_as_often_as_it_says(num_cameras):
    rng = np.random.default_rng(num_cameras)
    truth, covered = 25.0, 0
    for _ in range(NUM_SIMULATIONS):
        # One camera's own level is what its interval is about; of several, the level of all cameras.
        levels = truth + (0 if num_cameras == 1 else 1.5) * rng.standard_normal(num_cameras)
        low, high = bootstrap_interval([level + rng.standard_normal(12) for level in levels])
        covered += low <= truth <= high
    assert 0.88 <= covered / NUM_SIMULATIONS <= 0.99


def test_the_interval_shrinks_with_cameras_and_moves_with_the_values():
    rng = np.random.default_rng(3)
    groups = [rng.normal(20, 1, 10) + rng.normal(0, 1) for _ in range(20)]
    few, many = bootstrap_interval(groups[:4]), bootstrap_interval(groups)
    assert many[1] - many[0] < 0.5 * (few[1] - few[0])
    moved = bootstrap_interval([group + 5 for group in groups])
    assert np.subtract(moved, many) == pytest.approx([5, 5])
    assert bootstrap_interval(groups) == many


def test_constants_have_an_interval_of_no_width_and_one_value_none():
    assert bootstrap_interval([np.full(4, 3.0), np.full(4, 3.0)]) == (3.0, 3.0)
    assert all(math.isnan(value) for value in bootstrap_interval([np.array([3.0])]))
    assert all(math.isnan(value) for value in bootstrap_interval([]))


def test_rows_are_grouped_by_camera_and_bounded_by_what_can_be():
    found = summarize_rows(rows_of({"a": ["0.9", "0.95"], "b": ["0.2", ""]}, metric="ssim"), "ssim")
    assert found is not None
    assert (found.num_frames, found.num_views) == (3, 2)
    assert found.mean == pytest.approx(2.05 / 3)
    assert -1 <= found.low < found.mean < found.high == 1
    infinite = summarize_rows(rows_of({"a": ["inf", "30.0"]}), "psnr_db")
    assert infinite is not None and infinite.mean == math.inf and math.isnan(infinite.low)
    assert summarize_rows(rows_of({"a": ["", ""]}), "psnr_db") is None


def test_rows_without_a_value_keep_their_reason():
    rows = rows_of({"a": ["30.0", ""]}) + rows_of({"a": ["", ""]}, "sfm")
    summaries = summarize_all(rows)
    assert summaries["full", "ours", "psnr_db"][1] == ""
    assert summaries["full", "sfm", "psnr_db"] == (None, "why")
    written = {row["method"]: row for row in summary_rows(summaries)}
    assert (written["sfm"]["mean"], written["sfm"]["note"], written["sfm"]["num_frames"]) == ("", "why", "0")
    assert (written["ours"]["mean"], written["ours"]["low"]) == ("30.0", "")


def test_differences_compare_frame_by_frame():
    rows = rows_of({"a": ["30.0", "20.0", "inf"], "b": ["25.0"]}) + rows_of(
        {"a": ["29.0", "18.5", "19.0"], "b": ["", "9.0"]}, "paste"
    )
    found = differences(rows, "paste", "ours")
    assert [(row["view"], row["frame"], float(row["value"])) for row in found] == [
        ("a", "0", -1.0),
        ("a", "1", -1.5),
    ]
