"""Static background: medians over time, poses, and the stage on files."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fourd.background import (
    BackgroundOptions,
    Votes,
    estimate_background,
    find_equal_poses,
    main,
    median_over_time,
    spread,
)
from fourd.errors import InputError
from fourd.io import Archive, read_json, write_json
from fourd.views import read_view
from tests.unit.fuse_scene import SIZE, pair_from_plane, stage_words, write_pair, write_scene


@given(
    arrays(np.uint8, (5, 3, 4, 3)),
    arrays(np.bool_, (5, 3, 4)),
)
def test_median_is_that_of_the_valid_votes(votes, valid):
    expected = np.ma.median(np.ma.array(votes, mask=~np.broadcast_to(valid[..., None], votes.shape)), axis=0)
    result = median_over_time(votes, valid)
    np.testing.assert_array_equal(np.isnan(result), np.ma.getmaskarray(expected))
    known = ~np.isnan(result)
    np.testing.assert_array_equal(result[known], np.asarray(expected)[known])


def test_median_of_a_constant_is_the_constant_and_of_two_their_mean():
    one = np.full((4, 2, 2), np.float32(2.5))
    np.testing.assert_array_equal(median_over_time(one, np.ones((4, 2, 2), bool)), one[0])
    two = np.array([[[10.0]], [[20.0]], [[99.0]]])
    assert median_over_time(two, np.array([[[True]], [[True]], [[False]]]))[0, 0] == 15


def make_votes(values, valid) -> Votes:
    rgb = [np.full((1, 1, 3), value, np.uint8) for value in values]
    flags = [np.full((1, 1), flag) for flag in valid]
    depth = [np.full((1, 1), value, np.float32) for value in values]
    return Votes({"farthest": rgb, "median": rgb}, {"farthest": flags, "median": flags}, depth)


def test_blanks_do_not_vote():
    found = estimate_background(make_votes([10, 30, 200], [True, True, False]), 1)
    assert found["farthest_rgb"][0, 0, 0] == 20 and found["num_samples"][0, 0] == 2
    assert found["depth"][0, 0] == 20


def test_too_few_votes_are_blank():
    found = estimate_background(make_votes([10, 30, 200], [True, False, False]), 2)
    assert not found["farthest_valid"][0, 0] and np.isnan(found["depth"][0, 0])
    assert (found["farthest_rgb"] == 0).all()


@given(st.integers(1, 40), st.integers(1, 40))
def test_spread_is_even_and_has_the_ends(num_frames, count):
    frames = list(range(100, 100 + num_frames))
    chosen = spread(frames, count)
    assert len(chosen) == len(set(chosen)) == min(count, num_frames)
    assert chosen == sorted(chosen) and set(chosen) <= set(frames)
    if min(count, num_frames) > 1:
        assert chosen[0] == frames[0] and chosen[-1] == frames[-1]
        assert np.diff(chosen).max() - np.diff(chosen).min() <= 1


def run_stage_on(folder: Path, *words: str, view: str = "orbit", frames: str = "0 1") -> Archive:
    output = folder / "background.npz"
    main([*stage_words(folder, view, frames), "--device", "cpu", "--output", str(output), *words])
    return Archive(output)


def test_stage_writes_the_contract_and_equal_poses_once(tmp_path):
    write_scene(tmp_path, num_frames=3)
    archive = run_stage_on(tmp_path, "--num-samples", "2")
    assert archive.frames() == [0]
    assert archive.meta["same_as"] == {"0": 0, "1": 0}
    assert archive.meta["sample_frames"] == [0, 2] and archive.meta["status"] == "ok"
    found = archive.frame(0)
    names = {"farthest_rgb", "farthest_valid", "median_rgb", "median_valid", "depth", "num_samples"}
    assert set(found) == names
    assert found["farthest_rgb"].shape == (SIZE[1], SIZE[0], 3) and found["depth"].dtype == np.float32
    assert found["num_samples"].max() == 2 and found["farthest_valid"].mean() > 0.8


def test_poses_that_differ_in_the_last_bit_are_not_equal(tmp_path):
    write_scene(tmp_path)
    path = tmp_path / "views" / "orbit.json"
    document = read_json(path)
    document["frames"][1]["t"][0] = float(np.nextafter(document["frames"][1]["t"][0], 9))
    write_json(path, document)
    assert find_equal_poses(read_view(path), [0, 1]) == {0: 0, 1: 1}


def test_what_moves_is_not_in_the_background(tmp_path):
    cameras = write_scene(tmp_path, num_frames=5)
    for name in ("cam00-cam01", "cam00-cam02", "cam01-cam02"):
        left, right = name.split("-")
        wall = pair_from_plane(cameras, left, right, 4.0)
        mover = pair_from_plane(cameras, left, right, 2.5)
        frames = [wall, wall, mover, wall, mover]
        write_pair(tmp_path / "disparity" / f"{name}.npz", frames, range(5))
    depth = run_stage_on(tmp_path, "--num-samples", "5", frames="0").frame(0)["depth"]
    np.testing.assert_allclose(depth[4:-4, 4:-4], 4.0, atol=0.05)


def test_batches_do_not_change_the_result(tmp_path, monkeypatch):
    write_scene(tmp_path)
    path = tmp_path / "views" / "orbit.json"
    document = read_json(path)
    document["frames"][1]["t"][0] += 0.05
    write_json(path, document)
    whole = run_stage_on(tmp_path)
    monkeypatch.setattr("fourd.background._batches", lambda frames, *_: [[frame] for frame in frames])
    split = run_stage_on(tmp_path)
    assert whole.frames() == split.frames() == [0, 1]
    for key, array in whole.frame(1).items():
        np.testing.assert_array_equal(array, split.frame(1)[key])


def test_no_usable_pair_is_blank_with_a_reason(tmp_path):
    cameras = write_scene(tmp_path)
    pair = pair_from_plane(cameras, "cam00", "cam02", 4.0)
    write_pair(tmp_path / "disparity" / "cam00-cam02.npz", pair, (), status="too wide: 91 degrees")
    archive = run_stage_on(tmp_path, view="cam01", frames="0")
    assert archive.meta["status"] == "no usable pair" and archive.meta["sample_frames"] == []
    assert not archive.frame(0)["farthest_valid"].any()


def test_settings_below_one_are_refused(tmp_path):
    write_scene(tmp_path)
    with pytest.raises(InputError, match="1 or more"):
        run_stage_on(tmp_path, "--num-samples", "0")


def test_options_equal_the_schema():
    path = Path(__file__).resolve().parents[2] / "config" / "schemas" / "background.schema.yaml"
    schema = yaml.safe_load(path.read_text(encoding="utf-8"))
    defaults = {key: entry["default"] for key, entry in schema["properties"].items()}
    assert defaults == dataclasses.asdict(BackgroundOptions())
