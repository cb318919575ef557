"""Properties of fusion and of the median over time that hold for any disparities."""

import dataclasses

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd.background.colour import Opinions, settle_colours
from fourd.fuse import ESTIMATES, PairFrame, fuse_view
from tests.unit.fuse_scene import (
    OPTIONS,
    SIZE,
    all_pairs,
    assert_equal_views,
    make_camera,
    make_cameras,
    make_images,
    pair_from_plane,
    random_pair,
)

CAMERAS = make_cameras(4)
IMAGES = make_images(CAMERAS)
TARGET = make_camera(0.1, 0.05)
seeds = st.integers(0, 10**6)


def noisy_pairs(seed):
    return all_pairs(CAMERAS, random_pair, np.random.default_rng(seed))


def planes_with_holes(seed):
    """Exact pairs of one plane, with so little noise that twice its depth is far beyond any tolerance."""
    rng = np.random.default_rng(seed)
    pairs = []
    for pair in all_pairs(CAMERAS, pair_from_plane, rng.uniform(2, 6)):
        holes = {
            f"{side}_disparity": np.where(
                rng.random(SIZE[::-1]) < 0.3, np.float32(np.nan), getattr(pair, f"{side}_disparity")
            )
            for side in ("left", "right")
        }
        pairs.append(dataclasses.replace(pair, sigma_px=0.01, **holes))
    return pairs


def fuse(pairs, target=TARGET, cameras=None, images=None, **settings_):
    options = dataclasses.replace(OPTIONS, **settings_)
    return fuse_view(target, pairs, images or IMAGES, cameras or CAMERAS, options)


def farther_than(pair: PairFrame, factor: float) -> PairFrame:
    """A pair of the same cameras that sees everything at `factor` times the depth."""
    maps = {}
    for i, side in enumerate(("left", "right")):
        zero = pair.disparity_at_infinity[i]
        disparity = getattr(pair, f"{side}_disparity")
        maps[f"{side}_disparity"] = (zero + (np.maximum(disparity, zero) - zero) / factor).astype(np.float32)
    return dataclasses.replace(pair, **maps)


@settings(max_examples=25, deadline=None)
@given(seeds, st.randoms(use_true_random=False))
def test_order_of_pairs_changes_no_depth_and_no_support(seed, random):
    pairs = noisy_pairs(seed)
    shuffled = list(pairs)
    random.shuffle(shuffled)
    a, b = fuse(pairs), fuse(shuffled)
    for estimate in ESTIMATES:
        np.testing.assert_array_equal(a.valid[estimate], b.valid[estimate])
        # The mean over the supporters is summed in the order of depth, of equals in that of the pairs.
        np.testing.assert_allclose(a.depths[estimate], b.depths[estimate], rtol=1e-6)
        assert np.abs(a.rgb[estimate].astype(int) - b.rgb[estimate]).max() <= 1
    np.testing.assert_array_equal(a.support, b.support)
    np.testing.assert_array_equal(a.num_cameras, b.num_cameras)


@settings(max_examples=20, deadline=None)
@given(seeds, st.integers(0, 5), st.floats(2, 1e6))
def test_a_far_pair_never_changes_a_consensus(seed, which, factor):
    pairs = planes_with_holes(seed)
    # With the visibility test it would contradict what is before it.
    far = farther_than(pairs[which], factor)
    a, b = fuse(pairs, visibility=False), fuse([*pairs, far], visibility=False)
    known = a.valid["consensus"]
    assert known.mean() > 0.3
    np.testing.assert_array_equal(a.depths["consensus"][known], b.depths["consensus"][known])
    np.testing.assert_array_equal(a.rgb["consensus"][known], b.rgb["consensus"][known])
    np.testing.assert_array_equal(a.support[known], b.support[known])
    assert b.valid["consensus"][known].all()


@settings(max_examples=15, deadline=None)
@given(seeds, st.integers(-24, 24))
def test_scale_of_the_world_scales_depth_and_changes_no_colour(seed, exponent):
    scale = 2.0**exponent
    pairs = noisy_pairs(seed)
    larger = [
        dataclasses.replace(
            pair,
            center_left=pair.center_left * scale,
            center_right=pair.center_right * scale,
            inverse_depth_per_px=tuple(unit / scale for unit in pair.inverse_depth_per_px),
        )
        for pair in pairs
    ]
    cameras = {name: dataclasses.replace(c, t=c.t * scale) for name, c in CAMERAS.items()}
    a, b = fuse(pairs), fuse(larger, dataclasses.replace(TARGET, t=TARGET.t * scale), cameras)
    for estimate in ESTIMATES:
        np.testing.assert_array_equal(a.depths[estimate] * np.float32(scale), b.depths[estimate])
        np.testing.assert_array_equal(a.rgb[estimate], b.rgb[estimate])


@settings(max_examples=15, deadline=None)
@given(seeds, st.permutations(list(CAMERAS)))
def test_permuted_cameras_permute_the_sources(seed, order):
    pairs = noisy_pairs(seed)
    # All cameras are blended: of two that tie for the last place the scene's order takes the first.
    images = ({name: IMAGES[name] for name in names} for names in (CAMERAS, order))
    views = [fuse(pairs, images=in_order, num_sources=len(CAMERAS)) for in_order in images]
    a, b = views
    for estimate in ESTIMATES:
        np.testing.assert_array_equal(a.depths[estimate], b.depths[estimate])
        np.testing.assert_array_equal(a.valid[estimate], b.valid[estimate])
        assert np.abs(a.rgb[estimate].astype(int) - b.rgb[estimate]).max() <= 1
    names = [np.append(view.cameras, "none")[np.minimum(view.source, 4)] for view in views]
    assert (names[0] == names[1]).mean() > 0.98


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_a_pair_without_disparities_changes_nothing_but_the_number_of_pairs(seed):
    pairs = noisy_pairs(seed)
    empty = {f"{s}_disparity": np.full_like(pairs[0].left_disparity, np.nan) for s in ("left", "right")}
    assert_equal_views(fuse(pairs), fuse([*pairs, dataclasses.replace(pairs[0], **empty)]))


@settings(max_examples=15, deadline=None)
@given(seeds, st.integers(1, 6), st.floats(0.5, 6))
def test_estimates_are_ordered_and_blank_together_with_their_depth(seed, min_pairs, tolerance):
    view = fuse(noisy_pairs(seed), min_pairs=min_pairs, tolerance=tolerance)
    some = np.isfinite(view.depths["closest"])
    closest, median, farthest = (view.depths[e][some] for e in ("closest", "median", "farthest"))
    assert (median >= closest * (1 - 1e-6)).sum() > 0.9 * some.sum()
    assert (farthest >= median * (1 - 1e-6)).sum() > 0.9 * some.sum()
    for estimate in ESTIMATES:
        assert not np.isnan(view.depths[estimate][view.valid[estimate]]).any()
        assert not view.rgb[estimate][~view.valid[estimate]].any()


def opinions(colours, weights):
    """What pictures say about M points: colours (S, M, 3), weights (S, M), one camera per time."""
    colours, weights = np.array(colours, np.uint8), np.array(weights, np.float32)
    cameras = np.zeros((1, colours.shape[1]), np.uint8)
    return Opinions(cameras, np.ones(cameras.shape, np.float32), colours[:, None], weights[:, None])


# Weights whose sums are exact in any order.
weights_of_votes = st.sampled_from([0.0, 0.25, 0.5, 1.0])
votes = st.integers(1, 9).flatmap(
    lambda count: st.tuples(
        st.lists(st.integers(0, 255), min_size=12 * count, max_size=12 * count),
        st.lists(weights_of_votes, min_size=4 * count, max_size=4 * count),
    ).map(lambda lists: (np.reshape(lists[0], (-1, 4, 3)), np.reshape(lists[1], (-1, 4))))
)


def assert_equal_settled(a, b):
    for found, expected in zip(settle_colours(opinions(*a)), settle_colours(opinions(*b)), strict=True):
        np.testing.assert_array_equal(found, expected)


@given(votes, st.randoms(use_true_random=False))
def test_order_of_the_times_does_not_matter(given_votes, random):
    colours, weights = given_votes
    order = list(range(len(colours)))
    random.shuffle(order)
    assert_equal_settled((colours[order], weights[order]), given_votes)


@given(votes, st.integers(2, 4))
def test_every_time_twice_gives_the_same_median(given_votes, count):
    repeated = [np.repeat(array, count, axis=0) for array in given_votes]
    assert_equal_settled(repeated, given_votes)


@given(votes)
def test_a_vote_above_and_one_below_all_others_change_nothing(given_votes):
    colours, weights = given_votes
    seen = 0.5 * (weights > 0).any(axis=0)
    ends = [np.zeros_like(colours[:1]), np.full_like(colours[:1], 255)]
    wide = np.concatenate([colours, *ends]), np.concatenate([weights, seen[None], seen[None]])
    assert_equal_settled(wide, given_votes)


@given(votes, st.integers(-10, 10))
def test_scaled_weights_change_nothing(given_votes, exponent):
    colours, weights = given_votes
    assert_equal_settled((colours, weights * 2.0**exponent), given_votes)


@given(votes)
def test_the_median_is_one_of_the_votes_with_half_the_weight_on_either_side(given_votes):
    colours, weights = given_votes
    found, valid = settle_colours(opinions(colours, weights))
    np.testing.assert_array_equal(valid, (weights > 0).any(axis=0))
    assert not found[~valid].any()
    for m, channel in np.argwhere(np.repeat(valid[:, None], 3, axis=1)):
        own, weight = colours[:, m, channel], weights[:, m]
        assert found[m, channel] in own[weight > 0]
        assert 2 * weight[own < found[m, channel]].sum() <= weight.sum()
        assert 2 * weight[own > found[m, channel]].sum() <= weight.sum()
