"""The static background at its ends: few times, none, equal ones, nothing but movers, nothing but sky."""

import time
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from fourd.background import BackgroundOptions
from fourd.background.estimate import Samples, estimate_backgrounds
from fourd.fuse import PairFrame
from fourd.fuse.files import Progress
from fourd.stability import fusion, rig
from fourd.stability.case import Outcome, elementwise_difference, judge, judge_refusal, make_cases, reason_of
from fourd.stability.world import film_event

Pairs = Sequence[PairFrame]
Arrays = dict[str, np.ndarray]


def estimate(times: Sequence[Pairs], pictures: dict[str, np.ndarray] | None = None, count: int = 4) -> Arrays:
    """The background at the middle of the arc from the pairs of some times; the pictures do not change."""
    images, cameras = pictures or fusion.images_of(count), fusion.cameras_of(count)
    names = [f"{pair.left}-{pair.right}" for pair in times[0]]
    disparities: Any = SimpleNamespace(pairs=names, at=lambda frame, memory_mb: times[frame])
    films: Any = SimpleNamespace(names=tuple(images), at=lambda frame: (images, cameras))
    samples = Samples(tuple(range(len(times))), (cameras,) * len(times), disparities, films)
    progress = Progress("sample", len(times), time.monotonic)
    (found,) = estimate_backgrounds([fusion.TARGET], samples, fusion.OPTIONS, BackgroundOptions(), progress)
    return found


def _is_clean(found: Arrays) -> bool:
    """Every pixel of the farthest has a depth above 0, all others are blank in colour and depth."""
    known, depth = found["farthest_valid"], found["depth"]
    return (
        bool((depth[known] > 0).all() and np.isnan(depth[~known]).all())
        and not found["farthest_rgb"][~known].any()
    )


def _are_equal(a: Arrays, b: Arrays, keys: Sequence[str]) -> bool:
    return all(np.array_equal(a[key], b[key], equal_nan=a[key].dtype.kind == "f") for key in keys)


def _pictures_and_depth(found: Arrays) -> list[str]:
    return [key for key in found if key.endswith(("_rgb", "_valid")) or key == "depth"]


def _describe(found: Arrays) -> str:
    return f"covers {found['farthest_valid'].mean():.0%}, up to {found['num_samples'].max()} times"


def _same_as_once(count: int) -> Outcome:
    """Times that all show the same give what one of them gives."""
    once, often = estimate([fusion.exact_pairs()]), estimate([fusion.exact_pairs()] * count)
    both = once["farthest_valid"] & often["farthest_valid"] & np.isfinite(once["depth"])
    error = elementwise_difference(often["depth"][both], once["depth"][both])
    levels = int(np.abs(often["farthest_rgb"].astype(int) - once["farthest_rgb"])[both].max())
    same = np.array_equal(once["farthest_valid"], often["farthest_valid"])
    got = f"{_describe(often)}, depth within {error:.1g}, {levels} levels"
    return judge(_is_clean(often) and same and error < 1e-5 and levels <= 1, got)


def odd_number_of_times() -> Outcome:
    """Where nothing moves, what one of the times gives."""
    return _same_as_once(5)


def even_number_of_times() -> Outcome:
    """Where nothing moves, what one of the times gives."""
    return _same_as_once(4)


def one_time() -> Outcome:
    """Measured depth within 0.5 % of the truth in the median, clean."""
    found, truth = estimate([fusion.exact_pairs()]), rig.true_depth(fusion.TARGET)
    both = np.isfinite(truth) & np.isfinite(found["depth"]) & ~found["filled"]
    error = float(np.median(np.abs(found["depth"] - truth)[both] / truth[both]))
    return judge(_is_clean(found) and error < 5e-3, f"{_describe(found)}, depth within {error:.1e}")


def one_pair() -> Outcome:
    """A background from two cameras, clean."""
    found = estimate([fusion.exact_pairs()[:1]] * 3)
    return judge(_is_clean(found) and found["farthest_valid"].mean() > 0.5, _describe(found))


def all_holes() -> Outcome:
    """All blank, no NaN in a colour."""
    found = estimate([[rig.with_maps(pair, np.nan) for pair in fusion.exact_pairs()]] * 3)
    blank = not found["farthest_valid"].any() and not found["median_valid"].any()
    return judge(blank and _is_clean(found) and not found["num_samples"].any(), _describe(found))


def holes_at_some_of_the_times() -> Outcome:
    """A camera that starts late: the same as without these times."""
    full = [fusion.exact_pairs()] * 3
    holes = [[rig.with_maps(pair, np.nan) for pair in fusion.exact_pairs()]] * 2
    found, other = estimate([*holes, *full]), estimate(full)
    depth = _are_equal(found, other, ["depth", "farthest_valid", "median_valid"])
    known = found["farthest_valid"]
    levels = int(np.abs(found["farthest_rgb"].astype(int) - other["farthest_rgb"])[known].max())
    return judge(depth and levels <= 1, f"{_describe(found)}, {levels} levels")


def nothing_but_sky() -> Outcome:
    """Infinite depth with the colours of the cameras, no NaN."""
    pairs = [rig.with_maps(pair, pair.disparity_at_infinity[0]) for pair in fusion.exact_pairs()]
    found = estimate([pairs] * 3)
    depth = found["depth"][found["farthest_valid"]]
    share = float(np.isposinf(depth).mean()) if depth.size else 0.0
    return judge(_is_clean(found) and share == 1, f"{_describe(found)}, {share:.0%} of it infinite")


def sky_behind_the_event() -> Outcome:
    """Where the truth is sky, infinite depth or none."""
    found, sky = estimate([fusion.exact_pairs()] * 3), np.isposinf(rig.true_depth(fusion.TARGET))
    # A pixel on the outline belongs to what stands before the sky as much as to the sky.
    known = sky & found["farthest_valid"] & ~_grown(~sky)
    share = float(np.isposinf(found["depth"][known]).mean()) if known.any() else 0.0
    return judge(bool(known.any()) and share == 1, f"{known.mean():.0%} of the picture, {share:.0%} infinite")


def _grown(mask: np.ndarray) -> np.ndarray:
    padded = np.pad(mask, 2)
    height, width = mask.shape
    shifts = [padded[y : y + height, x : x + width] for y in range(5) for x in range(5)]
    return np.any(shifts, axis=0)


def everything_moves() -> Outcome:
    """At every pixel one of the depths that were seen, no NaN."""
    distances = np.array([4.0, 5.0, 6.5, 8.0, 10.0])
    times = [[rig.with_plane(p, fusion.TARGET, d) for p in fusion.exact_pairs()] for d in distances]
    found = estimate(times)
    unit = rig.plane_depth(fusion.TARGET, fusion.TARGET, 1.0)
    ratio = found["depth"][found["farthest_valid"]] / unit[found["farthest_valid"]]
    error = float(np.abs(ratio[:, None] / distances - 1).min(axis=1).max(initial=0))
    return judge(
        _is_clean(found) and ratio.size > 0 and error < 0.01, f"{_describe(found)}, within {error:.1e}"
    )


def mover_at_one_of_the_times() -> Outcome:
    """What stands behind it, as if it had not been there."""
    still = [rig.with_plane(p, fusion.TARGET, 8.0) for p in fusion.exact_pairs()]
    near = [rig.with_plane(p, fusion.TARGET, 4.0) for p in fusion.exact_pairs()]
    found, other = estimate([still, near, still, still, still]), estimate([still] * 4)
    both = found["farthest_valid"] & other["farthest_valid"]
    error = elementwise_difference(found["depth"][both], other["depth"][both])
    return judge(_is_clean(found) and error < 1e-5, f"{_describe(found)}, depth within {error:.1e}")


def order_of_the_times() -> Outcome:
    """Does not matter, bit for bit."""
    distances = (8.0, 4.0, 8.0, 8.0, 5.0)
    times = [[rig.with_plane(p, fusion.TARGET, d) for p in fusion.exact_pairs()] for d in distances]
    a, b = estimate(times), estimate([times[i] for i in (4, 2, 0, 1, 3)])
    return judge(_are_equal(a, b, _pictures_and_depth(a)), _describe(b))


def black_and_saturated_pictures() -> Outcome:
    """Black and white where depth is known: colours are no blanks."""
    verdicts = []
    for level in (0, 255):
        flat = {name: np.full_like(image, level) for name, image in fusion.images_of().items()}
        found = estimate([fusion.exact_pairs()] * 3, flat)
        verdicts.append(
            found["farthest_valid"].any() and (found["farthest_rgb"][found["farthest_valid"]] == level).all()
        )
    return judge(all(map(bool, verdicts)), "0 and 255")


def depth_in_single_precision() -> Outcome:
    """Depth in float32 as the float64 closed form of a plane, within 1e-5."""
    pairs = [rig.with_plane(pair, fusion.TARGET, 6.0) for pair in fusion.exact_pairs()]
    found = estimate([pairs] * 3)
    known = found["farthest_valid"] & ~found.get("filled", np.zeros_like(found["farthest_valid"]))
    error = elementwise_difference(
        found["depth"][known], rig.plane_depth(fusion.TARGET, fusion.TARGET, 6.0)[known]
    )
    return judge(bool(known.any()) and error < 1e-5, f"plane within {error:.1e}", error)


def sixty_five_cameras() -> Outcome:
    """Refused: 64 cameras fit into a mask."""
    many = {f"cam{i:02d}": fusion.images_of()["cam00"] for i in range(65)}
    return judge_refusal(reason_of(estimate, [fusion.exact_pairs()], many), "64")


def background_of_two_frames() -> Outcome:
    """Every valid pixel has a depth above 0, every other is blank, through all stages."""
    filmed = film_event()
    bad = 0
    for name, depth in filmed.depth_m.items():
        valid = filmed.valid[f"{name.removesuffix(' depth')} farthest"]
        if name.startswith("background"):
            bad += int((valid & ~(depth > 0)).sum() + (~valid & ~np.isnan(depth)).sum())
    return judge(bad == 0, f"{bad} pixels with a colour and no depth, or the other way round")


CASES = make_cases(
    "background",
    one_time,
    odd_number_of_times,
    even_number_of_times,
    one_pair,
    all_holes,
    holes_at_some_of_the_times,
    nothing_but_sky,
    sky_behind_the_event,
    everything_moves,
    mover_at_one_of_the_times,
    order_of_the_times,
    black_and_saturated_pictures,
    depth_in_single_precision,
    sixty_five_cameras,
    background_of_two_frames,
)
