"""Static background: surfaces, votes, holes, colours, and the stage on files."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from fourd.background import BackgroundOptions
from fourd.background.__main__ import find_equal_poses, main
from fourd.background.colour import Opinions, settle_colours
from fourd.background.fill import drop_ghosts, drop_speckles, fill_holes
from fourd.background.surfaces import Surfaces, find_surfaces
from fourd.background.visibility import find_hidden
from fourd.background.vote import StaticDepth, vote_depth
from fourd.errors import InputError
from fourd.fuse.geometry import pack_cameras
from fourd.io import Archive, read_json, write_json
from fourd.views import read_view
from tests.unit.fuse_scene import (
    OPTIONS,
    SIZE,
    all_pairs,
    make_camera,
    make_cameras,
    make_images,
    pair_from_plane,
    random_pair,
    stage_words,
    write_pair,
    write_scene,
)

ABC = 0b111
AB, BC = 0b011, 0b110
DEPTH_KEYS = ("inverse_depth", "variance", "cameras", "num_pairs")


def find(pairs, names, rows=(0, SIZE[1])) -> Surfaces:
    found = Surfaces.blank(1, rows[1] - rows[0], SIZE[0])
    find_surfaces(make_camera(0.1), pairs, names, OPTIONS, rows, found, 0)
    return found


def world_z(inverse_depth: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float64)
    return make_camera(0.1).unproject(np.stack([x, y], -1), 1 / inverse_depth)[..., 2]


def test_pairs_of_one_plane_are_one_surface_at_its_depth():
    cameras = make_cameras(3)
    found = find(all_pairs(cameras, pair_from_plane, 4.0), list(cameras))
    np.testing.assert_allclose(world_z(found.inverse_depth[0, 0])[6:-6, 6:-6], 4.0, rtol=1e-4)
    middle = np.s_[0, :, 6:-6, 6:-6]
    assert (found.inverse_depth[middle][1:] == -1).all()
    assert (found.cameras[middle][0] == ABC).all() and (found.num_pairs[middle][0] == 3).all()


def test_the_best_supported_surface_comes_first():
    cameras = make_cameras(3)
    pairs = [pair_from_plane(cameras, "cam00", "cam01", d) for d in (2.5, 4.0)]
    found = find([*pairs, pair_from_plane(cameras, "cam01", "cam02", 4.0)], list(cameras))
    middle = np.s_[7:-7, 9:-9]
    for surface, depth in enumerate((4.0, 2.5)):
        np.testing.assert_allclose(
            world_z(found.inverse_depth[0, surface])[middle], depth, rtol=1e-3, err_msg=str(surface)
        )
    assert (found.cameras[0, 1][middle] == AB).all()


def test_surfaces_depend_neither_on_the_order_of_pairs_nor_on_tiles():
    cameras = make_cameras(4)
    pairs = all_pairs(cameras, random_pair, np.random.default_rng(3))
    whole = find(pairs, list(cameras))
    turned = find(pairs[::-1], list(cameras))
    upper, lower = find(pairs, list(cameras), (0, 7)), find(pairs, list(cameras), (7, SIZE[1]))
    for key in DEPTH_KEYS:
        np.testing.assert_array_equal(getattr(whole, key), getattr(turned, key), err_msg=key)
        halves = np.concatenate([getattr(upper, key), getattr(lower, key)], axis=2)
        np.testing.assert_array_equal(getattr(whole, key), halves, err_msg=key)


def test_a_pair_without_pictures_is_refused():
    cameras = make_cameras(3)
    with pytest.raises(InputError, match=r"expected pictures of cam02"):
        find([pair_from_plane(cameras, "cam01", "cam02", 4.0)], ["cam00", "cam01"])


def test_more_cameras_than_bits_are_refused():
    cameras = make_cameras(2)
    names = [f"cam{i:02d}" for i in range(65)]
    with pytest.raises(InputError, match="64 cameras"):
        find([pair_from_plane(cameras, "cam00", "cam01", 4.0)], names)


def vote(*times: list[tuple[float, int, int]], persistence: float = 0.8, num_pairs: int = 3) -> StaticDepth:
    """One pixel; per time a list of depth, cameras and number of pairs."""
    surfaces = Surfaces.blank(len(times), 1, 1)
    for s, found in enumerate(times):
        for k, (depth, cameras, pairs) in enumerate(found):
            surfaces.inverse_depth[s, k], surfaces.variance[s, k] = 1 / depth, 1e-6
            surfaces.cameras[s, k], surfaces.num_pairs[s, k] = cameras, pairs
    result = StaticDepth.blank(len(times), 1, 1)
    vote_depth(surfaces, 3.0, persistence, num_pairs, (0, 1), result)
    return result


def depth_of(result: StaticDepth, estimate: int = 0) -> float:
    return float(1 / result.inverse_depth[estimate, 0, 0])


WALL, MOVER, POLE = (8.0, ABC, 3), (3.0, ABC, 3), (4.0, ABC, 2)


def test_what_moves_hides_the_wall_and_does_not_win():
    result = vote([MOVER], [MOVER], [MOVER], [WALL], [WALL])
    assert depth_of(result) == pytest.approx(8)
    assert result.num_times[0, 0] == 2
    assert result.seen_by[0, :, 0, 0].tolist() == [0, 0, 0, ABC, ABC]


def test_what_persists_hides_the_wall_that_leaks_around_it():
    assert depth_of(vote(*[[WALL, POLE]] * 5)) == pytest.approx(4)
    assert depth_of(vote(*[[WALL, (4.0, AB, 1)]] * 5)) == pytest.approx(8), "one pair is no proof"
    assert depth_of(vote(*[[(8.0, ABC, 9), POLE]] * 5)) == pytest.approx(8), "mostly seen through"


@pytest.mark.parametrize(("still", "expected"), [(7, 8.0), (8, 3.0)])
def test_a_mover_becomes_background_once_it_persists(still, expected):
    result = vote(*[[MOVER]] * still, *[[WALL]] * (10 - still))
    assert depth_of(result) == pytest.approx(expected)


def test_persistence_counts_times_that_know_something():
    assert depth_of(vote([WALL, POLE], [WALL, POLE], [], [], [])) == pytest.approx(4)


def test_one_pair_is_enough_where_there_is_no_other():
    one = [(8.0, AB, 1), (4.0, AB, 1)]
    assert depth_of(vote(*[one] * 3, num_pairs=1)) == pytest.approx(4)


def test_nothing_seen_is_unknown():
    result = vote([], [])
    assert (result.inverse_depth == -1).all() and not result.seen_by.any() and not result.num_times.any()


def test_agreeing_surfaces_are_averaged_by_their_precision_and_pairs():
    result = vote([(1 / 0.25, ABC, 1)], [(1 / 0.253, BC, 2)])
    assert result.inverse_depth[0, 0, 0] == pytest.approx((0.25 + 2 * 0.253) / 3, rel=1e-5)
    assert result.seen_by[0, :, 0, 0].tolist() == [ABC, BC]


def test_median_is_the_middle_of_all_samples():
    result = vote([(3.0, AB, 1)], [(5.0, AB, 1)], [WALL])
    assert depth_of(result, 1) == pytest.approx(8)
    assert depth_of(vote([(3.0, AB, 2)], [(5.0, AB, 1)], [(8.0, AB, 2)]), 1) == pytest.approx(5)


@given(st.permutations(range(6)))
def test_votes_do_not_depend_on_the_order_of_times(order):
    times = [[WALL], [MOVER], [POLE, WALL], [WALL, POLE], [MOVER, (9.0, AB, 1)], []]
    expected, found = vote(*times), vote(*[times[i] for i in order])
    np.testing.assert_allclose(found.inverse_depth, expected.inverse_depth, rtol=1e-6)
    np.testing.assert_array_equal(found.num_times, expected.num_times)


def fill(rows, widest_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    depth = np.array(rows, np.float32)
    seen_by = np.arange(depth.size, dtype=np.uint64).reshape(1, *depth.shape)
    return depth, seen_by, fill_holes(depth, seen_by, widest_px)


def test_a_hole_in_a_plane_takes_the_plane():
    depth, _, filled = fill([[0.50, -1, -1, 0.53]], 4)
    np.testing.assert_allclose(depth, [[0.50, 0.51, 0.52, 0.53]], rtol=1e-6)
    assert filled.tolist() == [[False, True, True, False]]


def test_a_hole_beside_an_edge_belongs_to_what_is_behind_and_seen_by_the_same_cameras():
    depth, seen_by, filled = fill([[0.5, -1, 0.2]], 4)
    assert depth[0, 1] == np.float32(0.2) and filled[0, 1]
    assert seen_by[0].tolist() == [[0, 2, 2]]


@pytest.mark.parametrize("rows", [[[0.5, -1, -1]], [[0.5, -1, -1, -1, 0.5]], [[-1, -1], [-1, -1]]])
def test_holes_stay_that_are_too_wide_or_known_on_one_side_only(rows):
    depth, _, filled = fill(rows, 2)
    np.testing.assert_array_equal(depth, np.array(rows, np.float32))
    assert not filled.any()


def test_speckles_are_dropped_and_thin_surfaces_stay():
    depth = np.full((21, 21), 0.2, np.float32)
    depth[:, 10:12] = 0.5
    depth[4, 4] = 0.4
    seen_by = np.ones((2, 21, 21), np.uint64)
    drop_speckles(depth, seen_by)
    assert depth[4, 4] == -1 and not seen_by[:, 4, 4].any()
    assert (depth < 0).sum() == 1 and (seen_by == 0).sum() == 2


def test_noise_around_infinity_is_no_speckle():
    depth = np.full((20, 20), 0.2, np.float32)
    depth[:9] = np.random.default_rng(0).choice(np.array([0, 1e-3], np.float32), (9, 20))
    expected = depth.copy()
    drop_speckles(depth, np.ones((1, 20, 20), np.uint64))
    np.testing.assert_array_equal(depth, expected)


def scene_with_patch(depth: float, num_seen: int) -> tuple[np.ndarray, np.ndarray]:
    """A wall at inverse depth 0.2 seen at all of 7 times, in it a patch seen at some of them."""
    inverse_depth = np.full((20, 30), 0.2, np.float32)
    inverse_depth[5:12, 8:15] = depth
    seen_by = np.full((7, 20, 30), ABC, np.uint64)
    seen_by[num_seen:, 5:12, 8:15] = 0
    return inverse_depth, seen_by


@pytest.mark.parametrize(
    ("depth", "num_seen", "is_ghost"),
    [(0.5, 2, True), (0.1, 2, True), (0.5, 3, False), (0.201, 1, False)],
)
def test_what_is_seen_rarely_and_continues_nothing_is_a_ghost(depth, num_seen, is_ghost):
    inverse_depth, seen_by = scene_with_patch(depth, num_seen)
    expected = inverse_depth.copy()
    assert drop_ghosts(inverse_depth, seen_by) == (49 if is_ghost else 0)
    if is_ghost:
        expected[5:12, 8:15] = -1
    np.testing.assert_array_equal(inverse_depth, expected)
    assert np.array_equal(seen_by.any(axis=0), expected >= 0)


def test_a_ghost_against_a_wall_seen_as_rarely_does_not_take_the_wall_with_it():
    inverse_depth, seen_by = scene_with_patch(0.5, 2)
    seen_by[1:, 5:12, 4:8] = 0
    drop_ghosts(inverse_depth, seen_by)
    assert (inverse_depth[5:12, 8:15] == -1).all() and (inverse_depth < 0).sum() == 49


def test_what_is_seen_rarely_stays_where_nothing_else_is_known():
    inverse_depth, seen_by = scene_with_patch(0.5, 1)
    inverse_depth[seen_by[1] > 0] = -1
    assert drop_ghosts(inverse_depth, seen_by) == 0


def test_a_known_surface_hides_what_is_behind_it_from_the_other_side():
    cameras = {"cam00": make_camera(-1.0), "cam01": make_camera(1.0)}
    target = make_camera(0.0)
    x, y = np.meshgrid(np.arange(9, 15, dtype=np.float32), np.arange(6, 12, dtype=np.float32))
    near = x.ravel(), y.ravel(), np.full(x.size, 1 / 2.5, np.float32)
    far_x = np.arange(24, dtype=np.float32)
    far = far_x, np.full(24, 8.5, np.float32), np.full(24, 1 / 4.0, np.float32)
    hidden = find_hidden(*far, near, pack_cameras(target, list(cameras.values())), [SIZE, SIZE])
    from_left, from_right = hidden & np.uint64(1) > 0, hidden & np.uint64(2) > 0
    # Looking from the left, what is to the right of the block lies behind it.
    assert far_x[from_left].mean() > 12 > far_x[from_right].mean()
    assert 3 <= from_left.sum() <= 9 and 3 <= from_right.sum() <= 9
    assert not find_hidden(*near, near, pack_cameras(target, list(cameras.values())), [SIZE, SIZE]).any()


def test_no_width_fills_nothing():
    assert not fill([[0.5, -1, 0.5]], 0)[2].any()


def test_colour_is_the_weighted_median_and_blank_without_opinions():
    camera = np.array([[0, 255], [1, 255]], np.uint8)
    rgb = np.zeros((3, 2, 2, 3), np.uint8)
    rgb[:, 0, 0], rgb[:, 1, 0] = [[10], [200], [12]], [[14], [210], [16]]
    weight = np.zeros((3, 2, 2), np.float32)
    weight[:, :, 0] = 1
    opinions = Opinions(camera, np.ones((2, 2), np.float32), rgb, weight)
    colours, valid = settle_colours(opinions)
    assert colours.tolist() == [[14, 14, 14], [0, 0, 0]] and valid.tolist() == [True, False]
    weight[1, :, 0] = 5
    assert settle_colours(opinions)[0][0].tolist() == [200, 200, 200]


def run_stage_on(folder: Path, *words: str, view: str = "orbit", frames: str = "0 1") -> Archive:
    output = folder / "background.npz"
    main([*stage_words(folder, view, frames), "--output", str(output), *words])
    return Archive(output)


def test_stage_writes_the_contract_and_equal_poses_once(tmp_path):
    write_scene(tmp_path, num_frames=3)
    archive = run_stage_on(tmp_path, "--num-samples", "2")
    assert archive.frames() == [0]
    assert archive.meta["same_as"] == {"0": 0, "1": 0}
    assert archive.meta["sample_frames"] == [0, 2] and archive.meta["status"] == "ok"
    found = archive.frame(0)
    names = {"farthest_rgb", "farthest_valid", "median_rgb", "median_valid", "depth", "num_samples", "filled"}
    assert set(found) == names
    assert found["farthest_rgb"].shape == (SIZE[1], SIZE[0], 3) and found["depth"].dtype == np.float32
    assert found["num_samples"].max() == 2 and found["farthest_valid"].mean() > 0.8
    assert archive.meta["holes"]["0"]["hole_share"] == pytest.approx(1 - found["farthest_valid"].mean())


def test_a_pixel_at_a_cameras_own_pose_has_its_colour(tmp_path):
    cameras = write_scene(tmp_path, num_frames=1)
    path = tmp_path / "views" / "orbit.json"
    document = read_json(path)
    document["frames"][0] |= cameras["cam01"].to_dict()
    write_json(path, document)
    found = run_stage_on(tmp_path, "--num-sources", "1", frames="0").frame(0)
    image = make_images(cameras, seed=1)["cam01"]
    part = np.s_[2:-2, 4:-4]
    np.testing.assert_allclose(found["farthest_rgb"][part], image[part], atol=1)
    np.testing.assert_array_equal(found["median_rgb"][part], found["farthest_rgb"][part])


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
        frames = [wall, mover, wall, mover, mover]
        write_pair(tmp_path / "disparity" / f"{name}.npz", frames, range(5))
    depth = run_stage_on(tmp_path, "--num-samples", "5", frames="0").frame(0)["depth"]
    np.testing.assert_allclose(depth[4:-4, 4:-4], 4.0, atol=0.05)


def test_neither_batches_nor_tiles_change_the_result(tmp_path, monkeypatch):
    write_scene(tmp_path)
    path = tmp_path / "views" / "orbit.json"
    document = read_json(path)
    document["frames"][1]["t"][0] += 0.05
    write_json(path, document)
    whole = run_stage_on(tmp_path)
    monkeypatch.setattr("fourd.background.__main__.bytes_per_target", lambda *_: 2**40)
    monkeypatch.setattr(
        "fourd.background.estimate._split", lambda count, *_: [(i, i + 1) for i in range(0, count)]
    )
    split = run_stage_on(tmp_path)
    assert whole.frames() == split.frames() == [0, 1]
    for key, array in whole.frame(1).items():
        np.testing.assert_array_equal(array, split.frame(1)[key], err_msg=key)


def test_no_usable_pair_is_blank_with_a_reason(tmp_path):
    cameras = write_scene(tmp_path)
    pair = pair_from_plane(cameras, "cam00", "cam02", 4.0)
    write_pair(tmp_path / "disparity" / "cam00-cam02.npz", pair, (), status="too wide: 91 degrees")
    archive = run_stage_on(tmp_path, view="cam01", frames="0")
    assert archive.meta["status"] == "no usable pair" and archive.meta["sample_frames"] == []
    assert not archive.frame(0)["farthest_valid"].any()
    assert archive.meta["holes"]["0"] == {"hole_share": 1.0, "filled_share": 0.0}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--num-samples", "0"), "1 or more"),
        (("--fill-px", "-1"), "0 or more"),
        (("--persistence", "0"), "persistence above 0"),
    ],
)
def test_settings_without_meaning_are_refused(tmp_path, words, message):
    write_scene(tmp_path)
    with pytest.raises(InputError, match=message):
        run_stage_on(tmp_path, *words)


def test_options_equal_the_schema():
    path = Path(__file__).resolve().parents[2] / "config" / "schemas" / "background.schema.yaml"
    schema = yaml.safe_load(path.read_text(encoding="utf-8"))
    defaults = {key: entry["default"] for key, entry in schema["properties"].items()}
    assert defaults == dataclasses.asdict(BackgroundOptions())
