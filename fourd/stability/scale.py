"""The same event in worlds of other units and origins, from its calibration file to its background."""

import numpy as np

from fourd.stability.case import Outcome, judge, judge_refusal, make_cases, reason_of
from fourd.stability.world import film_event

MAX_LEVELS = 1
MAX_DEPTH = 1e-4


def _compare(scale: float, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Outcome:
    """Against the event in metres around its own origin: largest differences of all pixels."""
    here, there = film_event(), film_event(scale, origin)
    levels = max(int(np.abs(here.rgb[name].astype(int) - there.rgb[name]).max()) for name in here.rgb)
    blanks = max(float((here.valid[name] != there.valid[name]).mean()) for name in here.valid)
    depth = np.concatenate([array.ravel() for array in here.depth_m.values()])
    other = np.concatenate([array.ravel() for array in there.depth_m.values()])
    same = (depth == other) | (np.isnan(depth) & np.isnan(other))
    with np.errstate(invalid="ignore"):
        error = np.where(same, 0.0, np.nan_to_num(np.abs(other - depth) / depth, nan=np.inf))
    beyond = float((error > MAX_DEPTH).mean())
    got = f"{levels}/255, depth within {error.max():.1e}, beyond {MAX_DEPTH:g} at {beyond:.3%} of the pixels"
    return judge(levels <= MAX_LEVELS and blanks == 0 and beyond == 0, got, float(error.max()))


def world_scaled_by_a_millionth() -> Outcome:
    """Images within 1/255, depth within 1e-4."""
    return _compare(1e-6)


def world_scaled_by_a_million() -> Outcome:
    """Images within 1/255, depth within 1e-4."""
    return _compare(1e6)


def origin_ten_million_units_away() -> Outcome:
    """Images within 1/255, depth within 1e-4."""
    return _compare(1.0, (1e7, -1e7, 1e7))


def scaled_and_moved_together() -> Outcome:
    """Images within 1/255, depth within 1e-4."""
    return _compare(1e6, (1e13, 0.0, 0.0))


def world_smaller_than_the_rounding_of_its_origin() -> Outcome:
    """Refused: positions in double precision hold nothing of the scene."""
    return judge_refusal(reason_of(film_event, 1e-6, (1e12, 1e12, 1e12)))


CASES = make_cases(
    "scale",
    world_scaled_by_a_millionth,
    world_scaled_by_a_million,
    origin_ten_million_units_away,
    scaled_and_moved_together,
    world_smaller_than_the_rounding_of_its_origin,
)
