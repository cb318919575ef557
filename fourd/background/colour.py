"""Colours of the background from the original pictures of all sampled times."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numba import njit

from fourd.fuse.colour_kernels import (
    pack_images,
    packed_size,
    place_points,
    rank,
    sample_bicubic,
    to_byte,
    weigh,
)
from fourd.fuse.options import KEYS_A

# Weight of a picture whose camera sees the surface at another time, not at this one: something may
# stand before it, or matching failed.
SEEN_ANOTHER_TIME = 0.4
# A camera that never sees it counts as this much worse: it may be hidden by what stands still.
NEVER_SEEN = 0.5
# And one to which a known surface hides it as this much worse: for want of any other.
HIDDEN = 0.01

_NO_CAMERA = np.uint8(255)
_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
# Points that are placed, or settled, at once.
_BLOCK = 512


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
def _choose(xs, ys, ts, seen_by, hidden_from, params, camera, weight):
    num_times, num_cameras = params.shape[:2]
    num_sources, count = camera.shape
    costs = np.empty((num_cameras, _BLOCK), np.float32)
    times, ever = np.empty(_BLOCK, np.int64), np.empty(_BLOCK, np.uint64)
    best = np.empty(num_sources + 2, np.int64)
    place = np.empty((3, _BLOCK), np.float32)
    for first in range(0, count, _BLOCK):
        last = min(first + _BLOCK, count)
        us, vs, inverse_depths = xs[first:last], ys[first:last], ts[first:last]
        px, py, cost = place[0], place[1], place[2]
        ever[:] = 0
        for s in range(num_times):
            for i in range(last - first):
                ever[i] |= seen_by[s, first + i]
        for c in range(num_cameras):
            bit = np.uint64(1) << np.uint64(c)
            total = costs[c]
            total[:], times[:] = 0, 0
            for s in range(num_times):
                if s == 0 or (params[s, c] != params[s - 1, c]).any():
                    place_points(params[s, c], us, vs, inverse_depths, px, py, cost)
                for i in range(last - first):
                    is_inside = cost[i] < np.inf
                    total[i] += cost[i] if is_inside else np.float32(0)
                    times[i] += is_inside
            for i in range(last - first):
                trust = np.float32(1)
                if ever[i] & bit == np.uint64(0):
                    is_hidden = hidden_from[first + i] & bit != np.uint64(0)
                    trust = np.float32(HIDDEN) if is_hidden else np.float32(NEVER_SEEN)
                total[i] = total[i] / (trust * np.float32(times[i])) if times[i] else np.float32(np.inf)
        for i in range(last - first):
            found = rank(_ALL, costs, i, num_sources + 1, best)
            left_out = costs[best[num_sources], i] if found > num_sources else np.float32(np.inf)
            for k in range(min(found, num_sources)):
                camera[k, first + i] = best[k]
                weight[k, first + i] = weigh(costs[best[k], i], left_out)


@njit(cache=True, nogil=True, error_model="numpy")
def _sample(xs, ys, ts, seen_now, ever, params, packed, starts, a, camera, camera_weight, rgb, weight):
    num_cameras = params.shape[0]
    num_sources, count = camera.shape
    widths = params[:, 19].astype(np.int64) + 1
    px, columns = np.empty((num_cameras, _BLOCK), np.float32), np.empty(16, np.float32)
    py, cost = np.empty_like(px), np.empty_like(px)
    for first in range(0, count, _BLOCK):
        last = min(first + _BLOCK, count)
        for c in range(num_cameras):
            place_points(params[c], xs[first:last], ys[first:last], ts[first:last], px[c], py[c], cost[c])
        for i in range(first, last):
            for k in range(num_sources):
                c = camera[k, i]
                if c == _NO_CAMERA:
                    break
                if cost[c, i - first] == np.inf:
                    continue
                bit = np.uint64(1) << np.uint64(c)
                elsewhere = (ever[i] & bit != np.uint64(0)) & (seen_now[i] & bit == np.uint64(0))
                weight[k, i] = camera_weight[k, i] * (
                    np.float32(SEEN_ANOTHER_TIME) if elsewhere else np.float32(1)
                )
                red, green, blue = sample_bicubic(
                    packed, starts[c], widths[c], px[c, i - first], py[c, i - first], a, columns
                )
                rgb[k, i, 0], rgb[k, i, 1], rgb[k, i, 2] = to_byte(red), to_byte(green), to_byte(blue)


@njit(cache=True, nogil=True)
def _settle(rgb, weight, out, valid):
    """The least value up to which half of the weight lies, by bisection of all points of a block at once."""
    num_times, num_sources, count = weight.shape
    values = np.empty((num_times * num_sources, _BLOCK), np.int32)
    weights = np.empty(values.shape, np.float32)
    total, summed = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    low, high = np.empty(_BLOCK, np.int32), np.empty(_BLOCK, np.int32)
    for first in range(0, count, _BLOCK):
        size = min(_BLOCK, count - first)
        total[:] = 0
        for n in range(len(values)):
            for i in range(size):
                weights[n, i] = weight[n // num_sources, n % num_sources, first + i]
                total[i] += weights[n, i]
        for j in range(3):
            for n in range(len(values)):
                for i in range(size):
                    values[n, i] = rgb[n // num_sources, n % num_sources, first + i, j]
            low[:], high[:] = 0, 255
            for _ in range(8):
                summed[:] = 0
                for n in range(len(values)):
                    for i in range(size):
                        is_below = values[n, i] <= (low[i] + high[i]) >> 1
                        summed[i] += weights[n, i] if is_below else np.float32(0)
                for i in range(size):
                    middle, is_enough = (low[i] + high[i]) >> 1, summed[i] + summed[i] >= total[i]
                    low[i], high[i] = (low[i], middle) if is_enough else (middle + 1, high[i])
            for i in range(size):
                out[first + i, j] = np.uint8(low[i])
        for i in range(size):
            valid[first + i] = total[i] > 0
