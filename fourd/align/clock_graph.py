"""Clocks of all cameras from delays between pairs: consistency of triplets, then one robust solve."""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from fourd.align.clock import PPM, CameraClock, PairDelay

SOUND_M_S = 343.0
# What is known of a phone's clock before it is compared: its rate, ppm.
PRIOR_RATE_PPM = 100.0
# Sound reaches the cameras of a pair at times that differ with its source; loops close to within that.
LOOP_TOLERANCE_S = 0.02
# A pair is never trusted more than this, whatever its windows say, s.
MIN_SIGMA_S = 2e-5
_ITERATIONS = 20


def solve_clocks(
    names: Sequence[str],
    pairs: Sequence[PairDelay],
    reference: str,
    tolerance_s: float = LOOP_TOLERANCE_S,
) -> tuple[dict[str, CameraClock], tuple[str, ...]]:
    """All clocks at once from the delays of pairs: offset 0 and rate 0 for the reference.

    names: the cameras to place, in the scene's order;  pairs: those with a status other than `ok`, or
    of other cameras, do not count;  tolerance_s: by how much the delays around a triplet may miss 0
    Pairs that contradict the others are dropped, the largest set of connected cameras is placed (of
    equal ones the first in the scene's order). If the reference is not in it, the first that is
    stands in for it, and a note says so.
    Returns a clock for every name, its status a reason where it is left out, and notes.
    """
    usable = [pair for pair in pairs if pair.status == "ok" and {pair.left, pair.right} <= set(names)]
    kept, notes = drop_inconsistent(usable, tolerance_s)
    group = largest_group(names, kept)
    method = kept[0].method if kept else "audio"
    clocks = {
        name: CameraClock(0.0, 0.0, 0.0, 0.0, method, _reason(name, pairs, kept, group)) for name in names
    }
    if len(group) < 2:
        return clocks, (*notes, "no two cameras could be placed against each other")
    if reference not in group:
        notes = (
            *notes,
            f"times are relative to {group[0]}: {reference} could not be placed ({clocks[reference].status})",
        )
        reference = group[0]
    inside = [pair for pair in kept if pair.left in group]
    clocks |= _solve_group(group, inside, {reference: CameraClock(0.0, method="reference")})
    return {name: clocks[name] for name in names}, notes


def attach_clock(
    name: str,
    pairs: Sequence[PairDelay],
    fixed: Mapping[str, CameraClock],
    tolerance_s: float = LOOP_TOLERANCE_S,
) -> CameraClock:
    """One more clock against finished ones, which stay as they are.

    pairs: between `name` and cameras of `fixed`, either way round;  fixed: only those that are `ok` count
    Returns the clock, its status a reason where no pair can be used or they contradict each other.
    """
    known = {other: clock for other, clock in fixed.items() if clock.status == "ok" and other != name}
    mine = [p for p in pairs if name in (p.left, p.right) and (p.left in known or p.right in known)]
    usable = [pair for pair in mine if pair.status == "ok"]
    method = mine[0].method if mine else "audio"
    if not usable:
        return CameraClock(0.0, 0.0, 0.0, 0.0, method, _reason(name, mine, (), ()))
    offsets = np.array([_offset_seen(pair, name, known) for pair in usable])
    agree = np.abs(offsets[:, None] - offsets) <= tolerance_s
    votes = (agree * np.array([pair.score for pair in usable])).sum(axis=1)
    best = agree[int(np.argmax(votes))]
    kept = [pair for pair, is_kept in zip(usable, best, strict=True) if is_kept]
    if len(usable) > 1 and 2 * len(kept) <= len(usable):
        why = f"its delays contradict each other: {len(kept)} of {len(usable)} agree within {tolerance_s:g} s"
        return CameraClock(0.0, 0.0, 0.0, 0.0, method, why)
    return _solve_group([name, *known], kept, known)[name]


def _offset_seen(pair: PairDelay, name: str, known: Mapping[str, CameraClock]) -> float:
    """Common time, minus its own, of an event that the camera `name` saw at the pair's time_s."""
    left_s = pair.delay_s + (1 + pair.rate_ppm * PPM) * pair.time_s
    if pair.right == name:
        return float(known[pair.left].common_time(np.array(left_s))) - pair.time_s
    return float(known[pair.right].common_time(np.array(pair.time_s))) - left_s


def drop_inconsistent(
    pairs: Sequence[PairDelay], tolerance_s: float = LOOP_TOLERANCE_S
) -> tuple[list[PairDelay], tuple[str, ...]]:
    """Drop pairs until the delays around every triplet of cameras add up to 0.

    Each time the pair goes that is in most loops that fail, less those that hold; of equals the one
    with the lowest score. Returns the kept pairs and a note per dropped one.
    """
    kept = list(pairs)
    notes: list[str] = []
    while failed := [loop for loop in _triplets(kept) if not _closes(loop, tolerance_s)]:
        balance = count_closing(kept, tolerance_s)
        suspects = {id(pair): pair for loop in failed for pair in loop}.values()
        worst = min(suspects, key=lambda pair: (balance[pair.left, pair.right], pair.score))
        misses = [abs(_loop_error_s(loop)) for loop in failed if worst in loop]
        kept.remove(worst)
        notes.append(
            f"the delay of {worst.left} and {worst.right} was dropped: {len(misses)} triplets of cameras do "
            f"not close with it, by {float(np.median(misses)):.3f} s"
        )
    return kept, tuple(notes)


def count_closing(
    pairs: Sequence[PairDelay], tolerance_s: float = LOOP_TOLERANCE_S
) -> dict[tuple[str, str], int]:
    """By (left, right): triplets of cameras around which the delays add up to 0, less those that fail."""
    balance = {(pair.left, pair.right): 0 for pair in pairs}
    for loop in _triplets(pairs):
        sign = 1 if _closes(loop, tolerance_s) else -1
        for pair in loop:
            balance[pair.left, pair.right] += sign
    return balance


def _closes(loop: tuple[PairDelay, PairDelay, PairDelay], tolerance_s: float) -> bool:
    return abs(_loop_error_s(loop)) <= tolerance_s + 4 * math.hypot(*(pair.sigma_s for pair in loop))


def _triplets(pairs: Sequence[PairDelay]) -> list[tuple[PairDelay, PairDelay, PairDelay]]:
    """All loops of three cameras: pairs (a, b), (b, c), (a, c), whichever way round each is."""
    by_cameras = {frozenset((pair.left, pair.right)): pair for pair in pairs}
    cameras = list(dict.fromkeys(name for pair in pairs for name in (pair.left, pair.right)))
    loops = []
    for a, b, c in itertools.combinations(cameras, 3):
        sides = [by_cameras.get(frozenset(side)) for side in ((a, b), (b, c), (a, c))]
        if all(side is not None for side in sides):
            loops.append(tuple(sides))
    return loops  # type: ignore[return-value]


def _loop_error_s(loop: tuple[PairDelay, PairDelay, PairDelay]) -> float:
    """By how much a time misses itself when it is carried once around a loop (a, b), (b, c), (a, c)."""
    one, two, three = loop
    (a,) = {one.left, one.right} & {three.left, three.right}
    (b,) = {one.left, one.right} & {two.left, two.right}
    (c,) = {two.left, two.right} & {three.left, three.right}
    start = three.time_s if three.right == a else three.delay_s + (1 + three.rate_ppm * PPM) * three.time_s
    time = start
    for pair, source, target in ((one, a, b), (two, b, c), (three, c, a)):
        scale = 1 + pair.rate_ppm * PPM
        is_forward = (pair.left, pair.right) == (target, source)
        time = pair.delay_s + scale * time if is_forward else (time - pair.delay_s) / scale
    return time - start


def largest_group(names: Sequence[str], pairs: Sequence[PairDelay]) -> tuple[str, ...]:
    """The largest set of cameras that pairs connect, in order; of equal ones the first in `names`."""
    group_of = {name: {name} for name in names}
    for pair in pairs:
        if group_of[pair.left] is not group_of[pair.right]:
            merged = group_of[pair.left] | group_of[pair.right]
            group_of |= dict.fromkeys(merged, merged)
    best = max((group_of[name] for name in names), key=len, default=set())
    return tuple(name for name in names if name in best)


def _reason(name: str, pairs: Sequence[PairDelay], kept: Sequence[PairDelay], group: Sequence[str]) -> str:
    """Why a camera is left out, or `ok`."""
    if name in group and len(group) > 1:
        return "ok"
    mine = [pair for pair in pairs if name in (pair.left, pair.right)]
    if any(name in (pair.left, pair.right) for pair in kept):
        return "it agrees only with cameras that are not connected to the larger group"
    if any(pair.status == "ok" for pair in mine):
        return "its delays to the other cameras contradict each other"
    if not mine:
        return "it was compared with no other camera"
    return f"it fits none of {len(mine)} other cameras: {max(mine, key=lambda pair: pair.score).status}"


def _solve_group(
    group: Sequence[str], pairs: Sequence[PairDelay], fixed: Mapping[str, CameraClock]
) -> dict[str, CameraClock]:
    """Offsets and rates of the cameras of a connected group that are not fixed.

    Unknowns are offset_s of each camera, and its rate where a pair measured one. Each pair says that
    two times are one event, (left_s, time_s); where its rate is told, also what their rates differ by.
    """
    free = [name for name in group if name not in fixed]
    rated = [n for n in free if any(p.rate_sigma_ppm is not None and n in (p.left, p.right) for p in pairs)]
    column = {name: index for index, name in enumerate(free)}
    rate_column = {name: len(free) + index for index, name in enumerate(rated)}
    system = _LinearSystem(len(free) + len(rated))
    for pair in pairs:
        left_s = pair.delay_s + (1 + pair.rate_ppm * PPM) * pair.time_s
        row = np.zeros(system.num_unknowns)
        right_side = left_s - pair.time_s
        rate_row = np.zeros(system.num_unknowns)
        rate_side = pair.rate_ppm
        for name, sign, own_s in ((pair.right, 1.0, pair.time_s), (pair.left, -1.0, left_s)):
            if name in fixed:
                right_side -= sign * (fixed[name].offset_s + fixed[name].rate_ppm * PPM * own_s)
                rate_side -= sign * fixed[name].rate_ppm
                continue
            row[column[name]] += sign
            if name in rate_column:
                row[rate_column[name]] += sign * PPM * own_s
                rate_row[rate_column[name]] += sign
        system.add(row, right_side, max(pair.sigma_s, MIN_SIGMA_S))
        if pair.rate_sigma_ppm is not None:
            system.add(rate_row, rate_side, max(pair.rate_sigma_ppm, 1e-3))
    for name in rated:
        row = np.zeros(system.num_unknowns)
        row[rate_column[name]] = 1
        system.add(row, 0.0, PRIOR_RATE_PPM, is_prior=True)
    values, covariance = system.solve()
    clocks = dict(fixed)
    for name in free:
        index, rate_index = column[name], rate_column.get(name)
        mine = [pair for pair in pairs if name in (pair.left, pair.right)]
        clocks[name] = CameraClock(
            offset_s=float(values[index]),
            rate_ppm=0.0 if rate_index is None else float(values[rate_index]),
            sigma_s=_time_sigma(covariance, index, rate_index, mine, name),
            score=_agreement_score(mine),
            method=mine[0].method if mine else "audio",
        )
    return clocks


def _time_sigma(
    covariance: np.ndarray, index: int, rate_index: int | None, mine: Sequence[PairDelay], name: str
) -> float:
    """Standard deviation of a camera's common time in the middle of what its pairs compared."""
    direction = np.zeros(len(covariance))
    direction[index] = 1
    if rate_index is not None and mine:
        own = [p.time_s if p.right == name else p.delay_s + p.time_s for p in mine]
        direction[rate_index] = PPM * float(np.mean(own))
    return math.sqrt(max(float((direction * (covariance * direction).sum(axis=1)).sum()), 0.0))


def _agreement_score(pairs: Sequence[PairDelay]) -> float:
    """Probability that a camera's place is right: its best pair, or several that confirm each other."""
    doubt = sorted(1 - pair.score for pair in pairs)
    return 1 - math.prod(doubt[:3]) if doubt else 0.0


class _LinearSystem:
    """Rows a . x = b with standard deviations, solved with weights that large errors lose (Cauchy)."""

    def __init__(self, num_unknowns: int) -> None:
        self.num_unknowns = num_unknowns
        self._rows: list[np.ndarray] = []
        self._sides: list[float] = []
        self._priors: list[bool] = []

    def add(self, row: np.ndarray, side: float, sigma: float, is_prior: bool = False) -> None:
        self._rows.append(row / sigma)
        self._sides.append(side / sigma)
        self._priors.append(is_prior)

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """Unknowns and their covariance, which is widened where rows disagree by more than they claim."""
        rows, sides, priors = np.array(self._rows), np.array(self._sides), np.array(self._priors)
        weight = np.ones(len(rows))
        values = errors = np.zeros(self.num_unknowns)
        inverse = np.zeros((self.num_unknowns, self.num_unknowns))
        for _ in range(_ITERATIONS):
            normal = (rows[:, :, None] * rows[:, None, :] * weight[:, None, None]).sum(axis=0)
            # Scaled to unit diagonal: seconds and ppm are far apart in size.
            scale = 1 / np.sqrt(np.diag(normal))
            inverse = np.linalg.inv(normal * scale[:, None] * scale) * scale[:, None] * scale
            values = (inverse * (rows * (sides * weight)[:, None]).sum(axis=0)).sum(axis=1)
            errors = sides - (rows * values).sum(axis=1)
            spread = max(1.0, 1.4826 * float(np.median(np.abs(errors[~priors]))))
            weight = np.where(priors, 1.0, 1 / (1 + (errors / (2 * spread)) ** 2))
        degrees = max(int((~priors).sum()) - self.num_unknowns, 1)
        excess = max(1.0, float((weight * errors**2)[~priors].sum()) / degrees)
        return values, inverse * excess


def correct_sound_travel(
    pairs: Sequence[PairDelay], centers_m: Mapping[str, np.ndarray], source_m: np.ndarray
) -> tuple[PairDelay, ...]:
    """Delays as they would be if sound took no time.

    centers_m: (3,) camera centres, metres;  source_m: (3,) where the sound comes from, metres
    A camera d metres away hears an event d / SOUND_M_S late, so its own times of sounds are late by
    that. Pairs with a camera whose centre is not given stay as they are.
    """
    late_s = {
        name: float(np.linalg.norm(np.asarray(center) - np.asarray(source_m))) / SOUND_M_S
        for name, center in centers_m.items()
    }
    return tuple(
        dataclasses.replace(pair, delay_s=pair.delay_s - late_s[pair.left] + late_s[pair.right])
        if pair.left in late_s and pair.right in late_s
        else pair
        for pair in pairs
    )
