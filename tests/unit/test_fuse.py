"""Projection and fusion: backends against the reference, closed forms, properties."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.fuse import ESTIMATES, FuseOptions, fuse_view
from fourd.fuse.cpu import CpuBackend
from fourd.fuse.geometry import make_sources, maps_of_pair, source_rows
from fourd.fuse.options import FusionRules
from fourd.fuse.reduce_kernels import reduce_layers
from fourd.fuse.reference import F, bicubic, keys_weights, reduce_pixel
from fourd.geometry import look_at
from tests.unit.fuse_scene import (
    OPTIONS,
    SIZE,
    all_pairs,
    assert_equal_views,
    edge_cases,
    make_camera,
    make_cameras,
    make_images,
    pair_from_plane,
    random_pair,
)


@pytest.mark.parametrize("device", ["cpu", "torch:cpu"])
@pytest.mark.parametrize("seed", [0, 1])
def test_backends_make_the_choices_of_the_reference(device, seed):
    rng = np.random.default_rng(seed)
    cameras = make_cameras(3)
    lens = np.array([-0.1, 0.02, 1e-3, -2e-3, 0.01])
    cameras["cam01"] = dataclasses.replace(cameras["cam01"], distortion=lens)
    pairs = all_pairs(cameras, random_pair, rng)
    images = make_images(cameras)
    options = FuseOptions(min_pairs=2)
    target = make_camera(0.1, 0.05, focal=30.0 if seed else 18.0)
    expected = fuse_view(target, pairs, images, cameras, options, farthest_min_pairs=2, device="reference")
    view = fuse_view(target, pairs, images, cameras, options, farthest_min_pairs=2, device=device)
    assert_equal_views(view, expected)
    assert 0.02 < view.valid["consensus"].mean() < 1
    assert view.num_points == expected.num_points > 0


@pytest.mark.parametrize("name", edge_cases(make_cameras(3)))
@pytest.mark.parametrize("device", ["cpu", "torch:cpu"])
def test_backends_agree_on_edge_cases(name, device):
    cameras = make_cameras(3)
    pairs = edge_cases(cameras)[name]
    target = dataclasses.replace(make_camera(0.1), t=make_camera(0.1).t - [0, 0, 0.6])
    arguments = (target, pairs, make_images(cameras), cameras, OPTIONS)
    view = fuse_view(*arguments, device=device)
    assert_equal_views(view, fuse_view(*arguments, device="reference"))
    assert not any(np.isnan(view.depths[e][view.valid[e]]).any() for e in ESTIMATES)


def test_opposite_camera_sees_nothing_of_the_front():
    cameras = make_cameras(3)
    R, t = look_at(np.array([0.0, 0.0, 8.0]), np.array([0.0, 0.0, 4.0]), np.array([0.0, -1.0, 0.0]))
    target = Camera(make_camera(0.0).K, R, t, SIZE)
    pairs = all_pairs(cameras, pair_from_plane, 4.0)
    view = fuse_view(target, pairs, make_images(cameras), cameras, OPTIONS)
    assert not any(valid.any() for valid in view.valid.values())


def test_upside_down_target_sees_the_plane():
    cameras = make_cameras(3)
    upright = make_camera(0.0)
    turn = np.diag([-1.0, -1.0, 1.0])
    target = Camera(upright.K, turn @ upright.R, turn @ upright.t, SIZE)
    pairs = all_pairs(cameras, pair_from_plane, 4.0)
    view = fuse_view(target, pairs, make_images(cameras), cameras, OPTIONS)
    straight = fuse_view(upright, pairs, make_images(cameras), cameras, OPTIONS)
    np.testing.assert_allclose(view.depths["closest"][::-1, ::-1], straight.depths["closest"], rtol=1e-5)


@pytest.mark.parametrize("depth", [1.5, 4.0, 40.0])
def test_identical_planes_give_the_plane(depth):
    cameras = make_cameras(4)
    target = make_camera(0.1, 0.1)
    pairs = all_pairs(cameras, pair_from_plane, depth)
    view = fuse_view(target, pairs, make_images(cameras), cameras, OPTIONS)
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float64)
    truth = depth / (target.rays(np.stack([x, y], -1)) @ target.R)[..., 2]
    for estimate in ESTIMATES:
        assert view.valid[estimate][4:-4, 6:-6].all()
        valid = view.valid[estimate]
        np.testing.assert_allclose(view.depths[estimate][valid], truth[valid], rtol=2e-5)


def test_support_counts_pairs_not_maps_and_distinct_cameras():
    cameras = make_cameras(4)
    view = fuse_view(
        make_camera(0.0), all_pairs(cameras, pair_from_plane, 4.0), make_images(cameras), cameras, OPTIONS
    )
    center = SIZE[1] // 2, SIZE[0] // 2
    assert view.support[center] == 6 and view.num_cameras[center] == 4
    assert view.support[~view.valid["consensus"]].max(initial=0) == 0


def test_colours_are_those_of_the_original_image():
    cameras = make_cameras(3)
    image = np.full((SIZE[1], SIZE[0], 3), (200, 100, 7), np.uint8)
    view = fuse_view(
        make_camera(0.1),
        all_pairs(cameras, pair_from_plane, 4.0),
        dict.fromkeys(cameras, image),
        cameras,
        OPTIONS,
    )
    assert (view.rgb["consensus"][view.valid["consensus"]] == (200, 100, 7)).all()
    assert (view.rgb["consensus"][~view.valid["consensus"]] == 0).all()


def test_view_from_a_source_camera_is_its_image():
    cameras = make_cameras(3)
    images = make_images(cameras, seed=3)
    pairs = all_pairs(cameras, pair_from_plane, 4.0)
    view = fuse_view(cameras["cam01"], pairs, images, cameras, FuseOptions(num_sources=1))
    inner = np.s_[2:-2, 2:-2]
    assert view.valid["closest"][inner].mean() > 0.9
    assert (view.source[inner][view.valid["consensus"][inner]] == 1).all()
    difference = np.abs(view.rgb["closest"].astype(int) - images["cam01"])[view.valid["closest"]]
    assert difference.max() <= 1


def test_no_cracks_where_the_target_magnifies():
    cameras = make_cameras(3)
    target = make_camera(0.1, size=(96, 72), focal=110.0)
    view = fuse_view(target, all_pairs(cameras, pair_from_plane, 4.0), make_images(cameras), cameras, OPTIONS)
    assert view.valid["closest"][8:-8, 8:-8].all()


def test_silhouettes_do_not_grow():
    cameras = make_cameras(2)
    pair = pair_from_plane(cameras, "cam00", "cam01", 4.0)
    near = pair_from_plane(cameras, "cam00", "cam01", 2.0)
    maps = {}
    for side in ("left", "right"):
        maps[f"{side}_disparity"] = np.full_like(pair.left_disparity, np.nan)
        maps[f"{side}_disparity"][6:12, 8:16] = getattr(near, f"{side}_disparity")[6:12, 8:16]
    one = dataclasses.replace(pair, **maps, right_confidence=np.zeros_like(pair.right_confidence))
    target = Camera(one.K_left, one.R_left, -one.R_left @ one.center_left, SIZE)
    view = fuse_view(target, [one], make_images(cameras), cameras, OPTIONS)
    expected = np.zeros_like(view.valid["closest"])
    expected[6:12, 8:16] = True
    np.testing.assert_array_equal(np.isfinite(view.depths["closest"]), expected)


@pytest.mark.parametrize("memory_rows", [1, 5])
def test_tiles_do_not_change_the_result(memory_rows, monkeypatch):
    cameras = make_cameras(3)
    pairs = all_pairs(cameras, random_pair, np.random.default_rng(5))
    arguments = (make_camera(0.1, 0.2), pairs, make_images(cameras), cameras, OPTIONS)
    whole = fuse_view(*arguments)
    tiles = [(y, min(y + memory_rows, SIZE[1])) for y in range(0, SIZE[1], memory_rows)]
    monkeypatch.setattr("fourd.fuse.view._tiles", lambda *_: tiles)
    assert_equal_views(fuse_view(*arguments), whole)


def test_source_rows_keep_every_row_that_lands_in_the_tile():
    cameras = make_cameras(3)
    target = make_camera(0.1, 0.2, size=(24, 200), focal=60.0)
    m = maps_of_pair(random_pair(cameras, "cam00", "cam02", np.random.default_rng(1)), target)[0]
    first, last = source_rows(m, (85, 95), 200)
    assert last - first < SIZE[1]
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    s = (m.disparity - m.disparity_at_infinity) * m.inverse_depth_per_px
    P = np.stack([x, y, np.ones_like(x)], -1) @ m.A.T + s[..., None] * m.b
    v = P[..., 1] / P[..., 2]
    lands = np.isfinite(m.disparity) & (s >= 0) & (P[..., 2] > 0) & (v > 84) & (v < 95)
    assert lands.any() and set(np.flatnonzero(lands.any(axis=1))) <= set(range(first, last))


def test_sigma_grows_with_the_square_of_depth_and_falls_with_confidence():
    cameras = make_cameras(2)
    target = cameras["cam00"]
    pair = pair_from_plane(cameras, "cam00", "cam01", 4.0)
    rotated = Camera(pair.K_left, pair.R_left, -pair.R_left @ pair.center_left, SIZE)
    sources = make_sources(target, cameras, make_images(cameras))
    backend = CpuBackend(sources, OPTIONS, SIZE, 1, SIZE[1])
    half = dataclasses.replace(
        pair, left_confidence=pair.left_confidence / 2, right_confidence=pair.right_confidence * 0
    )
    backend.layer(0, maps_of_pair(half, rotated), (0, SIZE[1]))
    keys = backend.layers[0]
    sigma = (0xFFFFFFFF - (keys[keys > 0] & 0xFFFFFFFF)).astype(np.uint32).view(np.float32)
    expected = 0.25 / 0.5 * pair.inverse_depth_per_px[0]
    assert sigma.size
    np.testing.assert_allclose(sigma, expected, rtol=1e-5)


RULES = FusionRules(2.0, 3, 2, 0.4, 1, ESTIMATES)
SAMPLES = st.lists(
    st.tuples(st.integers(1, 400).map(lambda i: F(i / 100)), st.sampled_from([F(0.01), F(0.05)])), max_size=8
)


def reduce_with_kernel(samples, rules):
    bits = np.array([[t for t, *_ in samples], [s for _, s, _ in samples]], np.float32).view(np.uint32)
    layers = (bits[0].astype(np.int64) << 32 | (0xFFFFFFFF - bits[1]).astype(np.int64))[:, None, None]
    masks = np.array([mask for *_, mask in samples], np.uint64)
    chosen, cameras = np.empty((4, 1, 1), np.float32), np.empty((4, 1, 1), np.uint64)
    counts = np.empty((2, 1, 1), np.uint8)
    limits = np.float32(rules.tolerance), np.float32(rules.max_front)
    arguments = masks, *limits, rules.numbers(), rules.wanted(), chosen, cameras, counts
    reduce_layers(layers, *arguments)
    return chosen[:, 0, 0], cameras[:, 0, 0], counts[:, 0, 0]


def with_masks(samples):
    return [(t, s, 0b11 << i) for i, (t, s) in enumerate(samples)]


@settings(max_examples=150, deadline=None)
@given(SAMPLES, st.randoms(use_true_random=False))
def test_order_of_pairs_changes_nothing(samples, random):
    if not samples:
        return
    given_order = with_masks(samples)
    shuffled = list(given_order)
    random.shuffle(shuffled)
    for a, b in zip(reduce_with_kernel(given_order, RULES), reduce_with_kernel(shuffled, RULES), strict=True):
        np.testing.assert_array_equal(a, b)


@settings(max_examples=150, deadline=None)
@given(SAMPLES)
def test_a_farther_sample_never_changes_a_consensus(samples):
    samples = with_masks([(t + F(1), s) for t, s in samples])
    if not samples:
        return
    farther = [*samples, (F(0.01), F(0.01), 1 << 40)]
    before, after = reduce_with_kernel(samples, RULES), reduce_with_kernel(farther, RULES)
    assert before[0][0] == after[0][0] and before[1][0] == after[1][0]


@settings(max_examples=150, deadline=None)
@given(SAMPLES)
def test_samples_of_closest_median_farthest_are_ordered(samples):
    if not samples:
        return
    no_consensus = dataclasses.replace(RULES, min_pairs=100)
    consensus, closest, median, farthest = reduce_with_kernel(with_masks(samples), no_consensus)[0]
    depths = sorted((t for t, _ in samples), reverse=True)
    assert (consensus, closest, farthest) == (-1, depths[0], depths[-1])
    assert median == depths[(len(depths) - 1) // 2]


@settings(max_examples=150, deadline=None)
@given(SAMPLES)
def test_kernel_reduces_a_pixel_as_the_reference(samples):
    if not samples:
        return
    chosen, cameras, counts = reduce_with_kernel(with_masks(samples), RULES)
    expected = reduce_pixel(sorted(with_masks(samples), key=lambda i: (-i[0], i[1])), RULES)
    assert [(t, m) for t, m, _ in expected] == [(t, int(m)) for t, m in zip(chosen, cameras, strict=True)]
    assert counts[0] == expected[0][2]


def test_estimates_on_the_surface_of_the_consensus_take_its_depth():
    samples = with_masks([(F(v), F(0.01)) for v in (2.01, 2.0, 1.99, 1.0)])
    consensus, closest, median, farthest = reduce_with_kernel(samples, RULES)[0]
    assert consensus == closest == median and farthest == 1
    np.testing.assert_allclose(consensus, 2.0, rtol=1e-6)


def test_median_of_an_even_number_is_the_closer_of_the_middle_two():
    samples = with_masks([(F(v), F(0.01)) for v in (4, 3, 2, 1)])
    assert reduce_with_kernel(samples, RULES)[0][2] == 3


def test_consensus_is_the_precision_weighted_mean_of_the_closest_supported_depth():
    samples = [(3.0, 0.01), (2.0, 0.01), (2.004, 0.02), (1.996, 0.02), (1.0, 0.01), (1.0, 0.01), (1.0, 0.01)]
    chosen, _, counts = reduce_with_kernel(with_masks([(F(t), F(s)) for t, s in samples]), RULES)
    assert counts[0] == 3
    np.testing.assert_allclose(chosen[0], (2 + 2.004 / 4 + 1.996 / 4) / 1.5, rtol=1e-6)


def test_more_pairs_do_not_draw_the_consensus_towards_the_camera():
    noise = np.random.default_rng(2).normal(0, 0.01, 60)
    rules = dataclasses.replace(RULES, tolerance=2.0)
    chosen, _, counts = reduce_with_kernel(with_masks([(F(2 + n), F(0.01)) for n in noise]), rules)
    assert chosen[0] == pytest.approx(2 + noise.mean(), abs=1e-5) and counts[0] == len(noise)


def test_consensus_behind_too_many_other_samples_is_blank():
    behind = [(F(1), F(0.01))] * 3
    front = [(F(2), F(0.01)), (F(3), F(0.01))]
    assert reduce_with_kernel(with_masks([front[0], *behind]), RULES)[0][0] == 1
    assert reduce_with_kernel(with_masks([*front, *behind]), RULES)[0][0] == -1
    paper = dataclasses.replace(RULES, max_front=1000.0)
    assert reduce_with_kernel(with_masks([*front, *behind]), paper)[0][0] == 1


def test_farthest_needs_support_when_asked_for():
    samples = with_masks([(F(v), F(0.01)) for v in (2, 2, 1)])
    assert reduce_with_kernel(samples, RULES)[0][3] == 1
    assert reduce_with_kernel(samples, dataclasses.replace(RULES, farthest_min_pairs=2))[0][3] == 2
    assert reduce_with_kernel(samples[1:], dataclasses.replace(RULES, farthest_min_pairs=2))[0][3] == 1


def test_min_cameras_counts_cameras_of_the_supporting_pairs():
    samples = [(F(2), F(0.01), mask) for mask in (0b011, 0b101, 0b110)]
    assert reduce_with_kernel(samples, dataclasses.replace(RULES, min_cameras=3))[0][0] == 2
    assert reduce_with_kernel(samples, dataclasses.replace(RULES, min_cameras=4))[0][0] == -1


@settings(max_examples=12, deadline=None)
@given(st.integers(-12, 12), st.integers(0, 3))
def test_world_scaled_by_powers_of_two_scales_depth_and_no_colour(exponent, seed):
    scale = 2.0**exponent
    cameras = make_cameras(3)
    pairs = all_pairs(cameras, random_pair, np.random.default_rng(seed))
    scaled_cameras = {n: dataclasses.replace(c, t=c.t * scale) for n, c in cameras.items()}
    scaled_pairs = [
        dataclasses.replace(
            p,
            center_left=p.center_left * scale,
            center_right=p.center_right * scale,
            inverse_depth_per_px=tuple(x / scale for x in p.inverse_depth_per_px),
        )
        for p in pairs
    ]
    target = make_camera(0.1, 0.05)
    images = make_images(cameras)
    view = fuse_view(target, pairs, images, cameras, OPTIONS)
    scaled_target = dataclasses.replace(target, t=target.t * scale)
    scaled = fuse_view(scaled_target, scaled_pairs, images, scaled_cameras, OPTIONS)
    for estimate in ESTIMATES:
        np.testing.assert_array_equal(scaled.rgb[estimate], view.rgb[estimate])
        np.testing.assert_array_equal(scaled.depths[estimate], view.depths[estimate] * np.float32(scale))


@given(st.floats(0, 1, width=32))
def test_bicubic_weights_sum_to_one_and_hold_quadratics(f):
    weights = np.array(keys_weights(F(f)), np.float64)
    at = np.arange(-1, 3) - f
    np.testing.assert_allclose([weights.sum(), weights @ at, weights @ at**2], [1, 0, 0], atol=1e-5)


def test_bicubic_at_a_pixel_is_the_pixel_and_edges_repeat():
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    for y, x in ((0, 0), (2, 3), (4, 6)):
        np.testing.assert_array_equal(bicubic(image, F(x), F(y)), image[y, x])


def test_fewer_pairs_than_asked_for_lower_the_bar():
    cameras = make_cameras(2)
    view = fuse_view(
        make_camera(0.1), all_pairs(cameras, pair_from_plane, 4.0), make_images(cameras), cameras, OPTIONS
    )
    assert view.min_pairs == 1 and view.num_pairs == 1 and view.valid["consensus"].any()


def test_no_pair_is_blank_with_a_reason():
    cameras = make_cameras(2)
    view = fuse_view(make_camera(0.1), [], make_images(cameras), cameras, OPTIONS)
    assert view.status == "no usable pair"
    assert not any(valid.any() for valid in view.valid.values())
    assert (view.source == 255).all() and np.isnan(view.depths["consensus"]).all()


def test_more_than_64_cameras_are_refused():
    cameras = {f"c{i}": make_camera(0.1 * i) for i in range(65)}
    with pytest.raises(InputError, match="64 cameras.*65"):
        fuse_view(make_camera(0.1), [], make_images(cameras), cameras, OPTIONS)


def test_the_64th_camera_is_usable():
    cameras = {f"c{i:02d}": make_camera(0.02 * i) for i in range(64)}
    pair = pair_from_plane(cameras, "c00", "c63", 4.0)
    view = fuse_view(make_camera(1.2), [pair], make_images(cameras), cameras, OPTIONS)
    assert (view.source == 63).any()


def test_errors_name_the_camera():
    cameras = make_cameras(2)
    images = make_images(cameras)
    pairs = all_pairs(cameras, pair_from_plane, 4.0)
    bent = dataclasses.replace(make_camera(0.0), distortion=np.array([0.1, 0, 0, 0, 0]))
    with pytest.raises(InputError, match="ideal pinhole"):
        fuse_view(bent, pairs, images, cameras, OPTIONS)
    with pytest.raises(InputError, match="cam01"):
        fuse_view(make_camera(0.0), pairs, {"cam00": images["cam00"]}, cameras, OPTIONS)
    with pytest.raises(InputError, match="cam01.*calibrate"):
        fuse_view(make_camera(0.0), pairs, images | {"cam01": images["cam01"][:-1]}, cameras, OPTIONS)
    with pytest.raises(InputError, match="nearest"):
        fuse_view(make_camera(0.0), pairs, images, cameras, OPTIONS, ["nearest"])
