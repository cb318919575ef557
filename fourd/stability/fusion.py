"""Few pairs, many pairs, disparities at both ends, pictures without holes and of nothing but holes."""

import dataclasses
import functools

import numpy as np

from fourd.camera import Camera
from fourd.fuse import ESTIMATES, FusedView, FuseOptions, PairFrame, fuse_view
from fourd.stability import rig
from fourd.stability.case import (
    Outcome,
    elementwise_difference,
    judge,
    judge_refusal,
    make_cases,
    reason_of,
)

OPTIONS = FuseOptions()
SIZE = (64, 36)
ANGLES = (-18.0, -6.0, 6.0, 18.0)
TARGET = rig.on_arc(0.0, SIZE, 52.0)


@functools.cache
def cameras_of(count: int = 4) -> dict[str, Camera]:
    """So many cameras along one arc."""
    angles = np.linspace(ANGLES[0], ANGLES[-1], count)
    return {f"cam{i:02d}": rig.on_arc(float(angle), SIZE, 52.0) for i, angle in enumerate(angles)}


@functools.cache
def images_of(count: int = 4) -> dict[str, np.ndarray]:
    """What they see."""
    return {name: rig.render(camera) for name, camera in cameras_of(count).items()}


@functools.cache
def exact_pairs() -> tuple[PairFrame, ...]:
    """All pairs of four cameras, with the true disparities."""
    return tuple(rig.true_pairs(cameras_of()))


def fuse(pairs: list[PairFrame], count: int = 4, **settings: float) -> FusedView:
    """All four images at the middle of the arc."""
    options = dataclasses.replace(OPTIONS, **settings)
    return fuse_view(TARGET, pairs, images_of(count), cameras_of(count), options)


def _is_clean(view: FusedView) -> bool:
    """Every pixel has a depth above 0 and a colour, or is blank in both."""
    for estimate in view.rgb:
        depth, valid = view.depths[estimate], view.valid[estimate]
        if np.isnan(depth[valid]).any() or (depth[valid] <= 0).any() or view.rgb[estimate][~valid].any():
            return False
    return True


def _depth_error(view: FusedView, estimate: str = "consensus") -> float:
    """Median relative error of depth against the truth, where both are finite."""
    truth, depth = rig.true_depth(TARGET), view.depths[estimate].astype(np.float64)
    both = np.isfinite(truth) & np.isfinite(depth)
    return float(np.median(np.abs(depth - truth)[both] / truth[both])) if both.any() else float("inf")


def _describe(view: FusedView) -> str:
    cover = view.valid["consensus"].mean()
    return f"{view.status}, {view.num_pairs} pairs, consensus covers {cover:.0%}"


def exact_pairs_of_four_cameras() -> Outcome:
    """The true depth within 0.5 % in the median, all four images clean."""
    view = fuse(list(exact_pairs()))
    error = _depth_error(view)
    return judge(_is_clean(view) and error < 5e-3, f"{_describe(view)}, depth within {error:.1e}")


def one_pair() -> Outcome:
    """One pair is its own consensus; all four images agree."""
    view = fuse(list(exact_pairs()[:1]))
    same = all(np.array_equal(view.depths["consensus"], view.depths[e], equal_nan=True) for e in ESTIMATES)
    is_right = view.min_pairs == 1 and same and _is_clean(view) and _depth_error(view) < 5e-3
    return judge(is_right, f"{_describe(view)}, min_pairs {view.min_pairs}")


def no_pair() -> Outcome:
    """All blank, with the reason in the status."""
    view = fuse([])
    blank = not any(valid.any() for valid in view.valid.values())
    return judge_refusal(view.status if blank else None, "no usable pair")


def two_cameras() -> Outcome:
    """Two cameras see the depth of their pair."""
    pairs = rig.true_pairs(cameras_of(2))
    view = fuse(pairs, 2)
    error = _depth_error(view)
    return judge(_is_clean(view) and error < 5e-3, f"{_describe(view)}, depth within {error:.1e}")


def thirty_cameras() -> Outcome:
    """Hundreds of pairs give the depth that a few give, at most twice as far off."""
    pairs = rig.true_pairs(cameras_of(30))
    view = fuse(pairs, 30)
    error, few = _depth_error(view), _depth_error(fuse(list(exact_pairs())))
    got = f"{_describe(view)}, depth within {error:.1e}, of 4 cameras {few:.1e}"
    return judge(_is_clean(view) and error < 2 * few, got)


def hundreds_of_pairs_in_one_pixel() -> Outcome:
    """Support counts up to 255 and no further; it never wraps to few."""
    view = fuse(list(exact_pairs()) * 50)
    high, few = int(view.support.max()), int(fuse(list(exact_pairs())).support.max())
    return judge(high >= min(50 * few, 255), f"{50 * few} pairs agree, support says {high}")


def sixty_five_cameras() -> Outcome:
    """Refused: 64 cameras fit into a mask."""
    images = {f"cam{i:02d}": images_of()["cam00"] for i in range(65)}
    cameras = {name: cameras_of()["cam00"] for name in images}
    return judge_refusal(reason_of(fuse_view, TARGET, exact_pairs()[:1], images, cameras, OPTIONS), "64")


def all_holes() -> Outcome:
    """All blank, with the reason in the status."""
    view = fuse([rig.with_maps(pair, np.nan) for pair in exact_pairs()])
    blank = not any(valid.any() for valid in view.valid.values())
    return judge_refusal(view.status if blank else None, "no valid disparity")


def some_pairs_all_holes() -> Outcome:
    """The same images as without these pairs."""
    pairs = list(exact_pairs())
    view = fuse([*pairs, rig.with_maps(pairs[0], np.nan), rig.with_maps(pairs[1], np.nan, 0.0)])
    other = fuse(pairs)
    same = all(np.array_equal(view.rgb[e], other.rgb[e]) for e in ESTIMATES)
    return judge(same and _is_clean(view), _describe(view))


def everything_at_infinity() -> Outcome:
    """Infinite depth with the colours of the cameras, no NaN."""
    pairs = [rig.with_maps(pair, pair.disparity_at_infinity[0]) for pair in exact_pairs()]
    view = fuse(pairs)
    depth = view.depths["consensus"][view.valid["consensus"]]
    is_right = depth.size > 0 and bool(np.isposinf(depth).all()) and _is_clean(view)
    return judge(is_right, f"{_describe(view)}, {np.isposinf(depth).mean():.0%} of it infinite")


def disparity_below_that_of_infinity() -> Outcome:
    """Nothing there: a point behind infinity is no point."""
    view = fuse([rig.with_maps(pair, pair.disparity_at_infinity[0] - 20) for pair in exact_pairs()])
    return judge(not view.valid["closest"].any() and view.num_points == 0, _describe(view))


def disparity_of_noise_around_infinity() -> Outcome:
    """Infinity: what is within two sigma of it is not thrown away."""
    pairs = [rig.with_maps(pair, pair.disparity_at_infinity[0] - pair.sigma_px) for pair in exact_pairs()]
    view = fuse(pairs)
    depth = view.depths["consensus"][view.valid["consensus"]]
    return judge(depth.size > 0 and bool(np.isposinf(depth).all()), _describe(view))


def points_in_front_of_the_lens() -> Outcome:
    """Blank: surfaces nearer than the target camera are behind it."""
    view = fuse([rig.with_maps(pair, 1e5) for pair in exact_pairs()])
    return judge(_is_clean(view), f"{_describe(view)}, {view.num_points} points")


def infinite_disparities() -> Outcome:
    """Nothing there, as with holes."""
    view = fuse([rig.with_maps(pair, np.inf) for pair in exact_pairs()])
    return judge(not view.valid["closest"].any() and _is_clean(view), _describe(view))


def confidence_that_is_no_number() -> Outcome:
    """The pixels are left out, as with confidence 0."""
    broken = [dataclasses.replace(p, left_confidence=p.left_confidence * np.nan) for p in exact_pairs()]
    absent = [dataclasses.replace(p, left_confidence=p.left_confidence * 0) for p in exact_pairs()]
    view, other = fuse(broken), fuse(absent)
    same = all(np.array_equal(view.rgb[e], other.rgb[e]) for e in ESTIMATES)
    return judge(same and _is_clean(view), _describe(view))


def tiny_confidence() -> Outcome:
    """Samples of almost no weight give no NaN."""
    view = fuse([dataclasses.replace(p, left_confidence=p.left_confidence * 1e-20) for p in exact_pairs()])
    return judge(_is_clean(view) and _depth_error(view) < 5e-3, _describe(view))


def no_noise_at_all() -> Outcome:
    """Noise of 0 px: only equal depths agree, no division by 0."""
    view = fuse([dataclasses.replace(p, sigma_px=0.0) for p in exact_pairs()])
    return judge(_is_clean(view), _describe(view))


def target_that_is_a_camera_of_the_pairs() -> Outcome:
    """The camera's own picture where depth is known."""
    camera = cameras_of()["cam01"]
    view = fuse_view(camera, exact_pairs(), images_of(), cameras_of(), OPTIONS)
    valid = view.valid["consensus"]
    error = np.abs(view.rgb["consensus"].astype(int) - images_of()["cam01"])[valid]
    return judge(float(np.median(error)) <= 2, f"{_describe(view)}, median {np.median(error):.0f} levels off")


def target_that_looks_away() -> Outcome:
    """All blank: nothing known is in view."""
    turned = np.diag([-1.0, 1.0, -1.0]) @ TARGET.R
    away = dataclasses.replace(TARGET, R=turned, t=-turned @ TARGET.center)
    view = fuse_view(away, exact_pairs(), images_of(), cameras_of(), OPTIONS)
    return judge(not view.valid["closest"].any(), _describe(view))


def target_upside_down() -> Outcome:
    """The same picture turned by 180 degrees, within a level at 99 % of the pixels."""
    turned = np.diag([-1.0, -1.0, 1.0]) @ TARGET.R
    view = fuse_view(
        dataclasses.replace(TARGET, R=turned, t=-turned @ TARGET.center),
        exact_pairs(),
        images_of(),
        cameras_of(),
        OPTIONS,
    )
    other = fuse(list(exact_pairs()))
    same = np.abs(view.rgb["consensus"][::-1, ::-1].astype(int) - other.rgb["consensus"]).max(axis=2) <= 1
    return judge(same.mean() >= 0.99, f"{same.mean():.2%} of the pixels alike")


def target_of_one_pixel() -> Outcome:
    """A picture of 1 x 1 px, no error."""
    tiny = dataclasses.replace(TARGET, K=np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]), size=(1, 1))
    view = fuse_view(tiny, exact_pairs(), images_of(), cameras_of(), OPTIONS)
    return judge(view.rgb["consensus"].shape == (1, 1, 3) and _is_clean(view), _describe(view))


def depth_in_single_precision() -> Outcome:
    """Depth in float32 as the float64 closed form of a plane, within 1e-5."""
    normal_depth = 6.0
    pairs = [rig.with_plane(pair, TARGET, normal_depth) for pair in exact_pairs()]
    view = fuse(pairs)
    truth = rig.plane_depth(TARGET, TARGET, normal_depth)
    depth = np.where(view.valid["consensus"], view.depths["consensus"].astype(np.float64), np.nan)
    known = np.isfinite(depth)
    error = elementwise_difference(depth[known], truth[known])
    return judge(bool(known.any()) and error < 1e-5, f"plane within {error:.1e}", error)


CASES = make_cases(
    "fusion",
    exact_pairs_of_four_cameras,
    one_pair,
    no_pair,
    two_cameras,
    thirty_cameras,
    hundreds_of_pairs_in_one_pixel,
    sixty_five_cameras,
    all_holes,
    some_pairs_all_holes,
    everything_at_infinity,
    disparity_below_that_of_infinity,
    disparity_of_noise_around_infinity,
    points_in_front_of_the_lens,
    infinite_disparities,
    confidence_that_is_no_number,
    tiny_confidence,
    no_noise_at_all,
    target_that_is_a_camera_of_the_pairs,
    target_that_looks_away,
    target_upside_down,
    target_of_one_pixel,
    depth_in_single_precision,
)
