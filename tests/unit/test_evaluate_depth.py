"""Estimated depth against true depth: closed forms, files, and rows of a scored camera."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.evaluate import summary, table
from fourd.evaluate.__main__ import main
from fourd.evaluate.depth import CONSENSUS, SURFACE, compare_depth, fit_scale, read_true_depth, score_depth
from tests.unit.baseline_evidence import VIEW, make_evidence
from tests.unit.test_evaluate import HELDOUT, camera_command, make_estimates, make_scene, read_rows

SHAPE = (64, 96)


def write_depth(path: Path, depth: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, z=depth)


def test_median_shares_and_coverage_are_those_of_the_pixels_that_both_know():
    true = np.full((10, 10), 4.0)
    true[0], true[1] = np.inf, np.nan
    found = np.full((10, 10), 4.0)
    found[2], found[3], found[4], found[5] = 4.03, 3.9, 4.4, np.inf
    found[6], found[0] = np.nan, 7.0
    values = compare_depth(found, true, np.ones((10, 10), bool))
    assert values["depth_coverage"] == (70 / 80, 80)
    # Errors: 0 three times, 0.0075, 0.025, 0.1 and infinity.
    assert values["depth_error"] == (pytest.approx(0.0075), 70)
    assert values["depth_within_1"] == (pytest.approx(4 / 7), 70)
    assert values["depth_within_5"] == (pytest.approx(5 / 7), 70)


def test_a_region_without_truth_or_estimate_has_no_value():
    nothing, true = np.full((4, 4), np.nan), np.full((4, 4), 2.0)
    region = np.ones((4, 4), bool)
    values = compare_depth(nothing, true, region)
    assert values["depth_coverage"] == (0.0, 16)
    assert np.isnan(values["depth_error"][0]) and values["depth_error"][1] == 0
    assert np.isnan(compare_depth(true, nothing, region)["depth_coverage"][0])
    assert np.isnan(compare_depth(true, true, ~region)["depth_coverage"][0])


def test_consensus_and_the_surface_behind_it_are_scored_apart():
    near = np.zeros(SHAPE, bool)
    near[:32] = True
    evidence = make_evidence(near=near)
    true = np.where(near, evidence.depth * 1.02, evidence.depth / 1.1)
    rows = {
        (method, metric): (value, count)
        for method, _, metric, value, count in score_depth(evidence, true, {"full": np.ones(SHAPE, bool)})
    }
    assert rows[CONSENSUS, "depth_coverage"][0] == 0.5 and rows[SURFACE, "depth_coverage"][0] == 1
    assert rows[CONSENSUS, "depth_error"] == (pytest.approx(1 - 1 / 1.02, rel=1e-5), 32 * 96)
    assert rows[SURFACE, "depth_within_5"] == (0.5, 64 * 96)


def test_the_scale_is_the_median_ratio_over_all_frames():
    found = np.random.default_rng(0).uniform(1, 5, (50, 40))
    true = 2.5 * found
    true[:10], true[10] = 99.0, np.inf
    holed = found.copy()
    holed[11] = np.nan
    assert fit_scale([(holed, true), (found, 2.5 * found)]) == pytest.approx(2.5)
    assert np.isnan(fit_scale([])) and np.isnan(fit_scale([(np.full((2, 2), np.nan), np.ones((2, 2)))]))


def test_true_depth_is_seen_by_a_turned_pinhole_of_another_size(tmp_path):
    # A wall 10 units ahead of the film's camera.
    write_depth(tmp_path / "000003.npz", np.full(SHAPE, 10, np.float16))
    same = read_true_depth(tmp_path, 3, VIEW, VIEW)
    np.testing.assert_array_equal(same, np.full(SHAPE, 10, np.float32))
    R = Rotation.from_euler("y", 12, degrees=True).as_matrix()
    turned = dataclasses.replace(VIEW, R=R, t=-R @ VIEW.center).resized((48, 32))
    seen = read_true_depth(tmp_path, 3, VIEW, turned)
    assert seen is not None and seen.shape == (32, 48)
    known = np.isfinite(seen)
    assert 0.5 < known.mean() < 1
    grid = np.stack(np.meshgrid(np.arange(48.0), np.arange(32.0)), axis=-1)
    np.testing.assert_allclose(turned.unproject(grid, seen)[known][:, 2], 10, rtol=1e-5)


def test_each_pixel_takes_one_true_depth_and_no_mean(tmp_path):
    depth = np.full(SHAPE, 2.0)
    depth[:, 48:] = np.inf
    write_depth(tmp_path / "000000.npz", depth)
    seen = read_true_depth(tmp_path, 0, VIEW, VIEW.resized((480, 320)))
    assert seen is not None and set(np.unique(seen)) == {2.0, np.inf}
    assert read_true_depth(tmp_path, 1, VIEW, VIEW) is None


def test_another_file_is_refused_with_a_sentence(tmp_path):
    np.savez(tmp_path / "000000.npz", depth=np.ones(SHAPE))
    with pytest.raises(InputError, match="expected an array `z` of true depth in .*000000.npz"):
        read_true_depth(tmp_path, 0, VIEW, VIEW)
    (tmp_path / "000001.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match="expected an array `z`"):
        read_true_depth(tmp_path, 1, VIEW, VIEW)
    write_depth(tmp_path / "000002.npz", np.ones((10, 10)))
    with pytest.raises(InputError, match=r"96 x 64 px in .*000002.npz, got an array of shape \(10, 10\)"):
        read_true_depth(tmp_path, 2, VIEW, VIEW)


@pytest.mark.parametrize("is_recovered", [False, True])
def test_rows_of_a_camera_and_their_table(tmp_path, is_recovered):
    make_scene(tmp_path)
    make_estimates(tmp_path)
    unit = 3.0 if is_recovered else 1.0
    # The background is at 5, the consensus at 4.8 where it is: 2 percent too near there.
    near = np.zeros(SHAPE, bool)
    near[16:40, 8:72] = True
    true = unit * np.where(near, 4.8 / 0.98, 5.0)
    write_depth(tmp_path / "depths" / HELDOUT / "000001.npz", true)
    command = camera_command(tmp_path, tmp_path, labels=None, points=None, depths=tmp_path / "depths")
    main([*command, *(["--recovered"] if is_recovered else [])])
    rows = [row for row in read_rows(tmp_path / "cam01.csv") if row["method"] in (CONSENSUS, SURFACE)]
    # Of the frame that has true depth only.
    assert {row["frame"] for row in rows} == {"1"}
    full = {(row["method"], row["metric"]): row for row in rows if row["region"] == "full"}
    assert float(full[CONSENSUS, "depth_error"]["value"]) == pytest.approx(0.02, rel=1e-3)
    assert float(full[CONSENSUS, "depth_coverage"]["value"]) == near.mean()
    assert float(full[SURFACE, "depth_error"]["value"]) == pytest.approx(0, abs=1e-6)
    assert all(row["value"] or row["note"] for row in rows)
    text = table.draw_table(
        read_rows(tmp_path / "cam01.csv"), summary.summarize_all(read_rows(tmp_path / "cam01.csv"))
    )
    assert "| consensus | Full frame | 25.0% | 2.00% | 0.0% | 100.0% |" in text
    assert text.count("| depth_") == 0


def test_true_depth_of_a_lens_with_distortion_reaches_the_pinhole(tmp_path):
    bent = Camera(VIEW.K, VIEW.R, VIEW.t, VIEW.size, np.array([-0.2, 0.05, 0, 0, 0]))
    write_depth(tmp_path / "000000.npz", np.full(SHAPE, 3.0))
    seen = read_true_depth(tmp_path, 0, bent, VIEW)
    assert seen is not None and set(np.unique(seen[np.isfinite(seen)])) == {np.float32(3)}
