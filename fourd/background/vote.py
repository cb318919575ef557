"""The depth of what stands still, voted by the surfaces of all sampled times."""

import dataclasses

import numpy as np
from numba import njit

from fourd.background.options import ESTIMATES
from fourd.background.surfaces import Surfaces

# A sample behind a surface says that nothing stood there at its time; one in front says nothing.
SEEN_THROUGH = 2.0
# A surface hides what lies behind if it has this share of the samples behind it: edges leak farther ones.
LEAST_SUPPORT = 0.3
# Two pairs have at least three cameras.
LEAST_CAMERAS = 3


@dataclasses.dataclass(frozen=True, eq=False)
class StaticDepth:
    """Depth of the background of one target, and who saw it. Of estimates farthest and median.

    inverse_depth: (2, H, W) float32, -1 = unknown
    seen_by: (2, S, H, W) uint64 cameras whose disparities agree with it at each time, by bit
    num_times: (H, W) uint8 times at which the farthest was seen
    """

    inverse_depth: np.ndarray
    seen_by: np.ndarray
    num_times: np.ndarray

    @classmethod
    def blank(cls, num_times: int, height: int, width: int) -> "StaticDepth":
        return cls(
            np.full((len(ESTIMATES), height, width), -1, np.float32),
            np.zeros((len(ESTIMATES), num_times, height, width), np.uint64),
            np.zeros((height, width), np.uint8),
        )


def bytes_per_pixel(num_times: int) -> int:
    """Memory of a `StaticDepth`."""
    return len(ESTIMATES) * (4 + 8 * num_times) + 1


def vote_depth(
    surfaces: Surfaces,
    tolerance: float,
    persistence: float,
    num_pairs: int,
    rows: tuple[int, int],
    into: StaticDepth,
) -> None:
    """Vote on rows [first, last) of the background from the surfaces of these rows.

    tolerance: combined sigmas;  persistence: see options;  num_pairs: of the scene

    farthest: the closest surface that persists: seen at `persistence` of the times that know anything
    here, by two pairs or more, and not mostly seen through. Where none does, the one of most votes: a
    sample that agrees counts 1, one behind -2, one in front nothing, because what moves only hides.
    median: the middle of all samples, and what agrees with it.
    """
    part = slice(*rows)
    _vote(
        surfaces.inverse_depth, surfaces.variance, surfaces.cameras, surfaces.num_pairs,
        np.float32(tolerance), persistence, LEAST_CAMERAS if num_pairs > 1 else 2,
        into.inverse_depth[:, part], into.seen_by[:, :, part], into.num_times[part],
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _num_bits(mask):
    count = 0
    while mask != np.uint64(0):
        mask &= mask - np.uint64(1)
        count += 1
    return count


@njit(cache=True, nogil=True)
def _gather(depths, variances, cameras, pairs, y, x, t, variance, mask, weight, time):
    """Surfaces of one pixel, ordered by time. Returns their number and how many times have any."""
    count, num_times = 0, 0
    for s in range(depths.shape[0]):
        before = count
        for k in range(depths.shape[1]):
            if depths[s, k, y, x] < 0:
                break
            t[count], variance[count] = depths[s, k, y, x], variances[s, k, y, x]
            mask[count], weight[count], time[count] = cameras[s, k, y, x], pairs[s, k, y, x], s
            count += 1
        num_times += count > before
    return count, num_times


@njit(cache=True, nogil=True)
def _poll(t, variance, mask, weight, time, count, index, squared):
    """Votes for one surface, votes behind it, times that see it, cameras that see it."""
    agreeing, behind, num_times, union, last = 0, 0, 0, np.uint64(0), -1
    for j in range(count):
        difference = t[j] - t[index]
        if difference * difference <= squared * (variance[j] + variance[index]):
            agreeing += weight[j]
            union |= mask[j]
            num_times += time[j] != last
            last = time[j]
        elif difference < 0:
            behind += weight[j]
    return agreeing, behind, num_times, union


@njit(cache=True, nogil=True)
def _choose(t, variance, mask, weight, time, count, rules, squared):
    """Index of the background's surface. rules: times it has to be seen at, and cameras."""
    persistent, winner, most = -1, -1, -np.inf
    for i in range(count):
        agreeing, behind, num_times, union = _poll(t, variance, mask, weight, time, count, i, squared)
        score = agreeing - SEEN_THROUGH * behind
        if score > most or (score == most and t[i] < t[winner]):
            winner, most = i, score
        persists = num_times >= rules[0] and _num_bits(union) >= rules[1]
        persists &= agreeing >= LEAST_SUPPORT * behind
        if persists and (persistent < 0 or t[i] > t[persistent]):
            persistent = i
    return persistent if persistent >= 0 else winner


@njit(cache=True, nogil=True)
def _middle(t, weight, count, order):
    """Index of the weighted median, the closer of two. order: scratch."""
    total = 0
    for i in range(count):
        at = i
        while at > 0 and t[order[at - 1]] < t[i]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = i
        total += weight[i]
    summed = 0
    for i in range(count):
        summed += weight[order[i]]
        if 2 * summed >= total:
            return order[i]
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def _vote(depths, variances, cameras, pairs, tolerance, persistence, least_cameras, out, seen, num_times):
    """See `vote_depth`; the last three are changed."""
    longest = depths.shape[0] * depths.shape[1]
    t, variance = np.empty(longest, np.float32), np.empty(longest, np.float32)
    mask, weight = np.empty(longest, np.uint64), np.empty(longest, np.int64)
    time, order = np.empty(longest, np.int64), np.empty(longest, np.int64)
    squared = tolerance * tolerance
    for y in range(depths.shape[2]):
        for x in range(depths.shape[3]):
            count, known = _gather(depths, variances, cameras, pairs, y, x, t, variance, mask, weight, time)
            if count == 0:
                continue
            rules = (persistence * known - 1e-6, least_cameras)
            for e in range(2):
                if e == 0:
                    chosen = _choose(t, variance, mask, weight, time, count, rules, squared)
                else:
                    chosen = _middle(t, weight, count, order)
                total, weights, last = np.float32(0), np.float32(0), -1
                for j in range(count):
                    difference = t[j] - t[chosen]
                    if difference * difference <= squared * (variance[j] + variance[chosen]):
                        share = np.float32(weight[j]) * variance[chosen] / variance[j]
                        total += share * difference
                        weights += share
                        seen[e, time[j], y, x] |= mask[j]
                        if e == 0 and time[j] != last:
                            num_times[y, x] = min(num_times[y, x] + 1, 255)
                        last = time[j]
                out[e, y, x] = max(t[chosen] + total / weights, np.float32(0))
