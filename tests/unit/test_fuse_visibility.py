"""The visibility test of the consensus: what cameras confirm, contradict, or cannot say."""

import dataclasses

import numpy as np
import pytest

from fourd.fuse import FuseOptions, PairFrame, fuse_view
from fourd.fuse.visibility import apply_visibility, count_cameras
from tests.unit.fuse_scene import (
    SIZE,
    all_pairs,
    assert_equal_views,
    make_camera,
    make_cameras,
    make_images,
    pair_from_plane,
)

PLANE, NEAR = 4.0, 2.5
MIDDLE = np.s_[5:13, 8:16]
PIXEL = 9, 15
TARGET = make_camera(0.1)
OPTIONS = FuseOptions(min_pairs=2)


def _plane_depth(depth: float) -> np.ndarray:
    """(H, W) z of a world plane in the target."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float64)
    return depth / (TARGET.rays(np.stack([x, y], -1)) @ TARGET.R)[..., 2]


def _scene(*, is_seen_through: bool) -> tuple[dict, list[PairFrame]]:
    """Three cameras see a plane; two others a surface before it, in the middle, that one pair alone has.

    Where that surface is, the three know nothing, or see the plane.
    """
    cameras = make_cameras(5)
    first = {name: cameras[name] for name in ("cam00", "cam01", "cam02")}
    pairs = all_pairs(first, pair_from_plane, PLANE)
    if not is_seen_through:
        pairs = [_without_surface(pair) for pair in pairs]
    behind, before = (pair_from_plane(cameras, "cam03", "cam04", depth) for depth in (PLANE, NEAR))
    maps = {}
    for side in ("left_disparity", "right_disparity"):
        maps[side] = getattr(behind, side).copy()
        maps[side][MIDDLE] = getattr(before, side)[MIDDLE]
    return cameras, [*pairs, dataclasses.replace(behind, **maps)]


def _without_surface(pair: PairFrame) -> PairFrame:
    """Blank where the maps would have to show the near surface, not where they show what is behind it."""
    maps = {}
    for side in ("left", "right"):
        center, R = getattr(pair, f"center_{side}"), getattr(pair, f"R_{side}")
        y, x = (part.ravel() for part in np.mgrid[3:15, 6:18])
        rays = TARGET.rays(np.stack([x, y], -1).astype(np.float64)) @ TARGET.R
        points = TARGET.center + rays * (NEAR - TARGET.center[2]) / rays[:, 2:]
        seen = (points - center) @ R.T @ getattr(pair, f"K_{side}").T
        column, row = np.rint(seen[:, :2] / seen[:, 2:]).astype(int).T
        inside = (column >= 0) & (column < SIZE[0]) & (row >= 0) & (row < SIZE[1])
        maps[f"{side}_disparity"] = getattr(pair, f"{side}_disparity").copy()
        maps[f"{side}_disparity"][row[inside], column[inside]] = np.nan
    return dataclasses.replace(pair, **maps)


def _fuse(scene: tuple[dict, list[PairFrame]], visibility: bool = True, **changes):
    cameras, pairs = scene
    options = dataclasses.replace(OPTIONS, visibility=visibility)
    return fuse_view(TARGET, pairs, make_images(cameras), cameras, options, **changes)


def test_a_surface_of_one_pair_counts_where_no_camera_sees_through_it():
    view = _fuse(_scene(is_seen_through=False))
    assert view.depths["consensus"][PIXEL] == pytest.approx(_plane_depth(NEAR)[PIXEL], rel=1e-3)
    assert view.support[PIXEL] == 1 and view.num_cameras[PIXEL] == 2
    assert view.cameras[view.source[PIXEL]] in ("cam03", "cam04")
    assert view.support[view.valid["consensus"]].min() >= 1


def test_a_sample_that_cameras_see_through_stays_a_mistake():
    view = _fuse(_scene(is_seen_through=True))
    assert view.depths["closest"][PIXEL] == pytest.approx(_plane_depth(NEAR)[PIXEL], rel=1e-3)
    assert view.depths["consensus"][PIXEL] == pytest.approx(_plane_depth(PLANE)[PIXEL], rel=1e-3)


def test_without_the_test_pairs_decide_alone():
    for is_seen_through in (False, True):
        view = _fuse(_scene(is_seen_through=is_seen_through), visibility=False)
        assert not (np.abs(view.depths["consensus"] / _plane_depth(NEAR) - 1) < 0.05).any()
        assert view.support[view.valid["consensus"]].min() >= OPTIONS.min_pairs


@pytest.mark.parametrize("device", ["reference", "torch:cpu"])
def test_backends_agree(device):
    scene = _scene(is_seen_through=False)
    assert_equal_views(_fuse(scene, device=device), _fuse(scene))


def test_the_other_estimates_and_what_is_asked_for_do_not_matter():
    scene = _scene(is_seen_through=False)
    view, alone, without = _fuse(scene), _fuse(scene, estimates=["consensus"]), _fuse(scene, visibility=False)
    assert list(alone.rgb) == ["consensus"]
    np.testing.assert_array_equal(alone.depths["consensus"], view.depths["consensus"])
    np.testing.assert_array_equal(alone.rgb["consensus"], view.rgb["consensus"])
    for estimate in ("closest", "median", "farthest"):
        np.testing.assert_array_equal(view.rgb[estimate], without.rgb[estimate])


def test_order_of_pairs_and_tiles_change_nothing():
    cameras, pairs = _scene(is_seen_through=False)
    view = _fuse((cameras, pairs))
    assert_equal_views(_fuse((cameras, pairs[::-1])), view)
    depths = view.depths["consensus"][None]
    wanted = np.isfinite(depths)
    names = list(cameras)
    whole = count_cameras(TARGET, pairs, names, 0, 1 / depths, wanted)
    tile = count_cameras(TARGET, pairs, names, 6, 1 / depths[:, 6:], wanted[:, 6:])
    for a, b in zip(whole, tile, strict=True):
        np.testing.assert_array_equal(a[:, 6:], b)


@pytest.mark.parametrize(("depth", "expected"), [(PLANE, (4, 0)), (NEAR, (0, 4)), (8.0, (0, 0))])
def test_cameras_see_a_plane_what_is_before_it_and_not_what_is_behind(depth, expected):
    cameras = make_cameras(4)
    pairs = all_pairs(cameras, pair_from_plane, PLANE)
    s = (1 / _plane_depth(depth)).astype(np.float32)[None]
    found = count_cameras(TARGET, pairs, list(cameras), 0, s, np.ones(s.shape, bool))
    assert tuple(int(votes[0][PIXEL]) for votes in found) == expected
    blank = count_cameras(TARGET, pairs, list(cameras), 0, s, np.zeros(s.shape, bool))
    assert not any(votes.any() for votes in blank)


@pytest.mark.parametrize(("num_cameras", "gives_way"), [(4, True), (2, False)])
def test_a_consensus_that_three_cameras_see_through_gives_way_to_the_median(num_cameras, gives_way):
    cameras = make_cameras(num_cameras)
    pairs = all_pairs(cameras, pair_from_plane, PLANE)
    near, plane = ((1 / _plane_depth(depth)).astype(np.float32) for depth in (NEAR, PLANE))
    chosen = np.stack([near, near, plane, plane])
    masks = np.full(chosen.shape, 0b11, np.uint64)
    masks[2] = 0b111
    counts = np.full((2, *near.shape), 2, np.uint8)
    apply_visibility(TARGET, pairs, list(cameras), 0, chosen, masks, counts)
    assert chosen[0][PIXEL] == (plane if gives_way else near)[PIXEL]
    assert (masks[0][PIXEL], counts[0][PIXEL], counts[1][PIXEL]) == ((7, 1, 3) if gives_way else (3, 2, 2))
