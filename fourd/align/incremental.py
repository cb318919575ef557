"""Cameras one by one: pairs, agreement of triplets, the best triple, then the rest.

A wrong camera in a joint solve bends the trajectories of all others. Therefore clocks grow from the three
cameras that agree best round the loop, and a camera that does not fit waits at the end of the queue.
"""

import dataclasses
import itertools

import numpy as np

from fourd.align.clock import PairDelay
from fourd.align.clock_group import Problem, solve_group
from fourd.align.trajectory_fit import Clocks


@dataclasses.dataclass(frozen=True, eq=False)
class Delays:
    """Offsets between cameras, measured pair by pair. delay_s, sigma_s: (C, C), [i, j] is offset j minus i.

    sigma_s is infinite where a pair says nothing;  reasons: (i, j), i < j -> why
    """

    delay_s: np.ndarray
    sigma_s: np.ndarray
    inliers: np.ndarray
    reasons: dict[tuple[int, int], str]

    def to_pairs(self, names: tuple[str, ...]) -> tuple[PairDelay, ...]:
        """The evidence for align/offsets.json."""
        pairs = []
        for i, j in itertools.combinations(range(len(names)), 2):
            reason = self.reasons.get((i, j), "ok")
            is_known = bool(np.isfinite(self.sigma_s[i, j]))
            pairs.append(
                PairDelay(
                    left=names[i],
                    right=names[j],
                    delay_s=float(self.delay_s[i, j]),
                    sigma_s=float(self.sigma_s[i, j]) if is_known else 0.0,
                    score=float(self.inliers[i, j]) if is_known else 0.0,
                    method="vision",
                    status=reason,
                )
            )
        return tuple(pairs)


def measure_delays(problem: Problem, clocks: Clocks) -> Delays:
    """Each pair of cameras on its own, with few points: enough to say which pairs agree."""
    num = len(problem.frame_s)
    delay_s = clocks.offset_s[None, :] - clocks.offset_s[:, None]
    sigma_s = np.full((num, num), np.inf)
    inliers = np.zeros((num, num))
    reasons = {}
    for i, j in itertools.combinations(range(num), 2):
        group = solve_group(problem, clocks, np.array([i, j]), i, problem.options.pair_points)
        if group.fit is None or group.reasons:
            reasons[i, j] = "; ".join(dict.fromkeys(group.reasons.values()))
            continue
        offset_s = group.fit.clocks.offset_s
        delay_s[i, j] = offset_s[j] - offset_s[i]
        delay_s[j, i] = -delay_s[i, j]
        sigma_s[i, j] = sigma_s[j, i] = group.sigma_s[j]
        inliers[i, j] = inliers[j, i] = min(group.inliers[i], group.inliers[j])
    return Delays(delay_s, sigma_s, inliers, reasons)


def triplet_errors(delays: Delays) -> np.ndarray:
    """(C, C, C) how far three delays are from closing, with their own doubt added; infinite where unknown."""
    delay, variance = delays.delay_s, delays.sigma_s**2
    loop = delay[:, :, None] + delay[None, :, :] - delay[:, None, :]
    doubt = variance[:, :, None] + variance[None, :, :] + variance[:, None, :]
    error = np.sqrt(loop**2 + doubt)
    num = len(delay)
    index = np.arange(num)
    for a, b in ((0, 1), (1, 2), (0, 2)):
        same = np.expand_dims(index, tuple(k for k in range(3) if k != a)) == np.expand_dims(
            index, tuple(k for k in range(3) if k != b)
        )
        error[np.broadcast_to(same, error.shape)] = np.inf
    return error


def edge_errors(delays: Delays) -> np.ndarray:
    """(C, C) median error of the triplets that a pair belongs to; its own doubt where there are none."""
    errors = np.where(np.isfinite(loops := triplet_errors(delays)), loops, np.nan)
    known = np.isfinite(errors).any(axis=1)
    median = np.full(known.shape, np.inf)
    for i, j in np.argwhere(known):
        median[i, j] = np.nanmedian(errors[i, :, j])
    return np.where(known, median, delays.sigma_s)


def seed_cameras(delays: Delays) -> list[int]:
    """The triple whose delays close best, the best pair where no triple closes, else nothing."""
    errors = triplet_errors(delays)
    if np.isfinite(errors).any():
        return sorted(int(cam) for cam in np.unravel_index(np.argmin(errors), errors.shape))
    if np.isfinite(delays.sigma_s).any():
        return sorted(int(cam) for cam in np.unravel_index(np.argmin(delays.sigma_s), delays.sigma_s.shape))
    return []


def grow(problem: Problem, clocks: Clocks, delays: Delays) -> tuple[Clocks, list[int], dict[int, str]]:
    """Clocks of all cameras that fit together, from the best triple outwards.

    Returns the clocks, the cameras in the group, and the reason of each camera that stayed outside.
    """
    group = seed_cameras(delays)
    if not group:
        return clocks, [], {}
    errors = edge_errors(delays)
    clocks = _placed(clocks, delays, errors, group[:1], group[1:])
    result = solve_group(problem, clocks, np.array(group), group[0], problem.options.group_points)
    group = [cam for cam in group if cam not in result.reasons]
    if result.fit is None or len(group) < 2:
        return clocks, [], result.reasons
    clocks = result.fit.clocks
    queue = [cam for cam in range(len(problem.frame_s)) if cam not in group]
    reasons: dict[int, str] = {}
    failed = 0
    while queue and failed < len(queue):
        if failed == 0:
            queue.sort(key=lambda cam: float(errors[cam, group].min()))
        cam = queue.pop(0)
        trial = _placed(clocks, delays, errors, group, [cam])
        result = solve_group(problem, trial, np.array([*group, cam]), group[0], problem.options.group_points)
        if result.fit is not None and not result.reasons:
            clocks, failed = result.fit.clocks, 0
            group.append(cam)
            reasons.pop(cam, None)
        else:
            reasons[cam] = result.reasons.get(cam, "no offset makes it agree with the other cameras")
            queue.append(cam)
            failed += 1
    return clocks, sorted(group), reasons


def _placed(clocks: Clocks, delays: Delays, errors: np.ndarray, group: list[int], added: list[int]) -> Clocks:
    """Clocks with cameras put where their delays to the group say, the best pair first."""
    offset_s = clocks.offset_s.copy()
    for cam in added:
        known = [other for other in group if np.isfinite(delays.sigma_s[other, cam])]
        if known:
            best = min(known, key=lambda other: float(errors[other, cam]))
            offset_s[cam] = offset_s[best] + delays.delay_s[best, cam]
    return dataclasses.replace(clocks, offset_s=offset_s)
