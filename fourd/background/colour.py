"""Colours of the background from the original pictures of all sampled times."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numba import njit

from fourd.background.project import place_point
from fourd.fuse.colour_kernels import pack_images, packed_size
from fourd.fuse.options import KEYS_A, MIN_WEIGHT

# Weight of a picture whose camera sees the surface at another time, not at this one: something may
# stand before it, or matching failed.
SEEN_ANOTHER_TIME = 0.4
# A camera that never sees it counts as this much worse: it may be hidden by what stands still.
NEVER_SEEN = 0.03
# And one to which a known surface hides it as this much worse: for want of any other.
HIDDEN = 1e-6

_NO_CAMERA = np.uint8(255)


@dataclasses.dataclass(frozen=True, eq=False)
class Points:
    """Points of the background that need a colour; M points, S times.

    x, y: (M,) float32 target pixel;  inverse_depth: (M,) float32, target frame
    seen_by: (S, M) uint64 cameras whose disparities agree with it at each time, by bit
    hidden_from: (M,) uint64 cameras to which something else of the background hides it
    """

    x: np.ndarray
    y: np.ndarray
    inverse_depth: np.ndarray
    seen_by: np.ndarray
    hidden_from: np.ndarray

    def part(self, first: int, last: int) -> "Points":
        """Points [first, last)."""
        i = slice(first, last)
        return Points(self.x[i], self.y[i], self.inverse_depth[i], self.seen_by[:, i], self.hidden_from[i])


@dataclasses.dataclass(frozen=True, eq=False)
class Opinions:
    """What the best cameras say about points; N cameras per point, S times.

    camera: (N, M) uint8 index, 255 = none;  camera_weight: (N, M) float32
    rgb: (S, N, M, 3) uint8;  weight: (S, N, M) float32, 0 = no picture of it
    """

    camera: np.ndarray
    camera_weight: np.ndarray
    rgb: np.ndarray
    weight: np.ndarray


def bytes_per_point(num_sources: int, num_times: int) -> int:
    """Memory of `Points` and `Opinions`."""
    return 20 + 8 * num_times + num_sources * (5 + 7 * num_times)


def choose_cameras(points: Points, params: np.ndarray, num_sources: int) -> Opinions:
    """The cameras that see each point best, on average over time; no opinions yet.

    params: (S, C, 26) float32, `pack_cameras` of every time
    Cameras from which the point is hidden count only where no other has it. Weights fall to 0 where the
    ranking changes, as in fusion.
    """
    num_times, count = points.seen_by.shape
    opinions = Opinions(
        np.full((num_sources, count), _NO_CAMERA), np.zeros((num_sources, count), np.float32),
        np.zeros((num_times, num_sources, count, 3), np.uint8),
        np.zeros((num_times, num_sources, count), np.float32),
    )  # fmt: skip
    _choose(
        points.x, points.y, points.inverse_depth, points.seen_by, points.hidden_from, params, opinions.camera,
        opinions.camera_weight,
    )  # fmt: skip
    return opinions


def sample_pictures(
    points: Points, params: np.ndarray, packed: tuple[np.ndarray, np.ndarray], time: int, opinions: Opinions
) -> None:
    """Colours from the pictures of one time into entry `time` of `opinions`: bicubic, one resampling.

    params: (C, 26) of this time;  packed: `pack_pictures` of this time
    """
    ever = np.bitwise_or.reduce(points.seen_by, axis=0)
    _sample(
        points.x, points.y, points.inverse_depth, points.seen_by[time], ever, params, *packed,
        np.float32(KEYS_A), opinions.camera, opinions.camera_weight, opinions.rgb[time],
        opinions.weight[time],
    )  # fmt: skip


def pack_pictures(images: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """All pictures of one time in one buffer, and where each begins."""
    packed = np.empty(packed_size(images), np.uint8)
    return packed, pack_images(images, packed)


def settle_colours(opinions: Opinions) -> tuple[np.ndarray, np.ndarray]:
    """(M, 3) uint8 weighted median of all opinions, per channel, and (M,) bool where there are any."""
    count = opinions.camera.shape[1]
    rgb, valid = np.zeros((count, 3), np.uint8), np.zeros(count, bool)
    _settle(opinions.rgb, opinions.weight, rgb, valid)
    return rgb, valid


@njit(cache=True, nogil=True, error_model="numpy")
def _mean_costs(params, u, v, t, ever, hidden, costs):
    """Mean cost of every camera over the times at which it has the pixel in its picture, into costs."""
    for c in range(params.shape[1]):
        total, count = np.float32(0), 0
        for s in range(params.shape[0]):
            cost = place_point(params[s, c], u, v, t)[2]
            if cost < np.inf:
                total += cost
                count += 1
        bit = np.uint64(1) << np.uint64(c)
        trust = np.float32(1)
        if ever & bit == np.uint64(0):
            trust = np.float32(HIDDEN) if hidden & bit != np.uint64(0) else np.float32(NEVER_SEEN)
        costs[c] = total / (trust * np.float32(count)) if count else np.float32(np.inf)


@njit(cache=True, nogil=True, error_model="numpy")
def _choose(xs, ys, inverse_depth, seen_by, hidden_from, params, camera, weight):
    num_sources = camera.shape[0]
    costs, best = np.empty(params.shape[1], np.float32), np.empty(params.shape[1] + 1, np.int64)
    for i in range(inverse_depth.shape[0]):
        ever = np.uint64(0)
        for s in range(seen_by.shape[0]):
            ever |= seen_by[s, i]
        _mean_costs(params, xs[i], ys[i], inverse_depth[i], ever, hidden_from[i], costs)
        found = 0
        for c in range(costs.shape[0]):
            if costs[c] == np.inf:
                continue
            at = found
            while at > 0 and costs[best[at - 1]] > costs[c]:
                best[at] = best[at - 1]
                at -= 1
            best[at] = c
            found += 1
        for k in range(min(found, num_sources)):
            cost = costs[best[k]]
            share = np.float32(1)
            if found > num_sources:
                share = max(share - cost / costs[best[num_sources]], np.float32(MIN_WEIGHT))
            camera[k, i], weight[k, i] = best[k], share / cost


@njit(forceinline=True, nogil=True)
def _keys(f, a):
    """Weights of four samples at -1, 0, 1, 2 for a point at f in 0..1. Source: Keys 1981, equation 4."""
    g = np.float32(1) - f
    two, three = a + np.float32(2), a + np.float32(3)
    return (
        a * f * g * g,
        (two * f - three) * f * f + np.float32(1),
        (two * g - three) * g * g + np.float32(1),
        a * g * f * f,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _sample(
    xs, ys, inverse_depth, seen_now, ever, params, packed, starts, a, camera, camera_weight, rgb, weight
):
    for i in range(inverse_depth.shape[0]):
        for k in range(camera.shape[0]):
            c = camera[k, i]
            if c == _NO_CAMERA:
                break
            px, py, cost, _ = place_point(params[c], xs[i], ys[i], inverse_depth[i])
            if cost == np.inf:
                continue
            bit = np.uint64(1) << np.uint64(c)
            elsewhere = (ever[i] & bit != np.uint64(0)) & (seen_now[i] & bit == np.uint64(0))
            share = np.float32(SEEN_ANOTHER_TIME) if elsewhere else np.float32(1)
            weight[k, i] = camera_weight[k, i] * share
            column, row = int(px), int(py)
            wx, wy = _keys(px - np.float32(column), a), _keys(py - np.float32(row), a)
            # Packed pictures are three pixels wider (fuse/colour_kernels.py).
            stride = 3 * (int(params[c, 19]) + 4)
            first = starts[c] + stride * row + 3 * column
            for j in range(3):
                total = np.float32(0)
                for m in range(4):
                    at = first + m * stride + j
                    left = wx[0] * np.float32(packed[at]) + wx[1] * np.float32(packed[at + 3])
                    right = wx[2] * np.float32(packed[at + 6]) + wx[3] * np.float32(packed[at + 9])
                    total += wy[m] * (left + right)
                rgb[k, i, j] = np.uint8(min(max(np.rint(total), np.float32(0)), np.float32(255)))


@njit(cache=True, nogil=True)
def _settle(rgb, weight, out, valid):
    num_times, num_sources = weight.shape[:2]
    longest = num_times * num_sources
    values, weights = np.empty(longest, np.uint8), np.empty(longest, np.float32)
    for i in range(out.shape[0]):
        for j in range(3):
            count, total = 0, np.float32(0)
            for s in range(num_times):
                for k in range(num_sources):
                    share, value = weight[s, k, i], rgb[s, k, i, j]
                    if share == 0:
                        continue
                    at = count
                    while at > 0 and values[at - 1] > value:
                        values[at], weights[at] = values[at - 1], weights[at - 1]
                        at -= 1
                    values[at], weights[at] = value, share
                    count += 1
                    total += share
            if count == 0:
                break
            summed, middle = np.float32(0), 0
            for m in range(count):
                summed += weights[m]
                middle = m
                if 2 * summed >= total:
                    break
            out[i, j] = values[middle]
            valid[i] = True
