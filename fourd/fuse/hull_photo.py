"""Compiled photo-consistency inside the hull: patches of the sources compared along each ray, smoothed.

Levels are inverse depths, level k at s = top - k * step. Every pixel has its own range of levels, the
costs of all pixels lie one after the other.
"""

import numpy as np
from numba import njit

from fourd.fuse.hull_kernels import MAX_INTERVALS, pixel_in_source, rank_cameras, ray_in_source

# Sources compared at a pixel.
NUM_COMPARED = 3
# Half the side of a patch, target px.
REACH = 2
SAMPLES = (2 * REACH + 1) ** 2
_ZERO = np.float32(0)
_ONE = np.float32(1)
_HALF = np.float32(0.5)
# A patch whose grey levels deviate by less says nothing.
_MIN_DEVIATION = np.float32(2.0)
# Cost of a level about which no two sources say anything, and of one outside the hull.
_NEUTRAL = np.float32(0.5)
_OUTSIDE = np.float32(1.5)


@njit(inline="always")
def _place(views, c, u, v, s):
    """Where a source sees a point, px, and whether that is in its picture."""
    d0, d1, d2 = ray_in_source(views, c, u, v)
    q2 = d2 + s * views[c, 11]
    inverse = _ONE / max(q2, np.float32(1e-12))
    px, py, r2 = pixel_in_source(
        views, c, (d0 + s * views[c, 9]) * inverse, (d1 + s * views[c, 10]) * inverse
    )
    inside = (px >= _ZERO) & (px <= views[c, 19]) & (py >= _ZERO) & (py <= views[c, 20])
    return px, py, inside & (q2 > _ZERO) & (r2 <= views[c, 17])


@njit(inline="always")
def _bilinear(greys, start, width, height, px, py):
    """Grey level at (px, py), clamped to the picture."""
    px = min(max(px, _ZERO), np.float32(width - 1) - np.float32(1e-3))
    py = min(max(py, _ZERO), np.float32(height - 1) - np.float32(1e-3))
    x, y = int(px), int(py)
    fx, fy = px - np.float32(x), py - np.float32(y)
    at = start + y * width + x
    upper = greys[at] + fx * (greys[at + 1] - greys[at])
    lower = greys[at + width] + fx * (greys[at + width + 1] - greys[at + width])
    return upper + fy * (lower - upper)


@njit(cache=True, nogil=True, error_model="numpy")
def _take_patch(views, c, greys, start, u, v, s, patch):
    """Fill a patch (SAMPLES,) parallel to the target's image, mean 0 and norm 1. Returns whether it says
    anything."""
    px, py, inside = _place(views, c, u, v, s)
    if not inside:
        return False
    right_x, right_y, _ = _place(views, c, u + _ONE, v, s)
    down_x, down_y, _ = _place(views, c, u, v + _ONE, s)
    ux, uy, vx, vy = right_x - px, right_y - py, down_x - px, down_y - py
    width, height = int(views[c, 19]) + 1, int(views[c, 20]) + 1
    total = _ZERO
    at = 0
    for j in range(-REACH, REACH + 1):
        for i in range(-REACH, REACH + 1):
            fi, fj = np.float32(i), np.float32(j)
            patch[at] = _bilinear(greys, start, width, height, px + fi * ux + fj * vx, py + fi * uy + fj * vy)
            total += patch[at]
            at += 1
    mean = total / np.float32(SAMPLES)
    squares = _ZERO
    for at in range(SAMPLES):
        patch[at] -= mean
        squares += patch[at] * patch[at]
    if squares < np.float32(SAMPLES) * _MIN_DEVIATION * _MIN_DEVIATION:
        return False
    scale = _ONE / np.sqrt(squares)
    for at in range(SAMPLES):
        patch[at] *= scale
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _find_alike(centers, chosen, ray, s, min_cosine, alike):
    """Which pairs of the chosen sources see a point from directions so near that patches look alike.

    centers: (C, 3) and ray: (3,) in the target frame;  alike: (NUM_COMPARED, NUM_COMPARED) bool, filled
    """
    for i in range(len(chosen)):
        a0, a1, a2 = (
            ray[0] - s * centers[chosen[i], 0],
            ray[1] - s * centers[chosen[i], 1],
            ray[2] - s * centers[chosen[i], 2],
        )
        for j in range(i):
            b0, b1, b2 = (
                ray[0] - s * centers[chosen[j], 0],
                ray[1] - s * centers[chosen[j], 1],
                ray[2] - s * centers[chosen[j], 2],
            )
            lengths = np.sqrt((a0 * a0 + a1 * a1 + a2 * a2) * (b0 * b0 + b1 * b1 + b2 * b2))
            alike[i, j] = a0 * b0 + a1 * b1 + a2 * b2 >= min_cosine * lengths


@njit(cache=True, nogil=True, error_model="numpy")
def _cost_of_point(views, greys, starts, chosen, alike, u, v, s, patches, says):
    """Least 1 - ZNCC over pairs of the chosen sources, cut at 1; `_NEUTRAL` where none can be compared."""
    for i in range(len(chosen)):
        says[i] = _take_patch(views, chosen[i], greys, starts[chosen[i]], u, v, s, patches[i])
    best = -_ONE
    compared = False
    for i in range(len(chosen)):
        for j in range(i):
            if alike[i, j] & says[i] & says[j]:
                compared = True
                correlation = _ZERO
                for at in range(SAMPLES):
                    correlation += patches[i, at] * patches[j, at]
                best = max(best, correlation)
    return min(_ONE - best, _ONE) if compared else _NEUTRAL


@njit(cache=True, nogil=True, error_model="numpy")
def compare_sources(
    views, grey_views, classes, starts, greys, grey_starts, centers, rays, pixels, intervals, levels,
    first, offsets, rules, costs,
):  # fmt: skip
    """Costs of all levels of all pixels of the hull.

    views, classes, starts: silhouettes;  grey_views, greys, grey_starts: pictures, in the same order
    centers: (C, 3) from the target to the sources, target frame;  rays: (N, 3) of the pixels, z = 1
    pixels: (N, 2) column and row;  intervals: (N, MAX_INTERVALS, 2);  levels: top, step
    first: (N,) first level;  offsets: (N + 1,) where the costs of a pixel begin;  costs: flat float32
    rules: least cosine of the angle between two sources that are compared; cost of lying behind the
        front of the hull, per share of the depth there
    """
    sources = len(views)
    order, angles = np.empty(sources, np.int64), np.empty(sources, np.float32)
    alike = np.zeros((NUM_COMPARED, NUM_COMPARED), np.bool_)
    patches, says = np.empty((NUM_COMPARED, SAMPLES), np.float32), np.empty(NUM_COMPARED, np.bool_)
    top, step = levels
    min_cosine, behind = rules
    for n in range(len(pixels)):
        u, v = np.float32(pixels[n, 0]), np.float32(pixels[n, 1])
        pixel = u, v, rays[n, 0], rays[n, 1], rays[n, 2]
        count = rank_cameras(views, classes, starts, centers, pixel, intervals[n, 0, 0], order, angles)
        chosen = order[: min(count, NUM_COMPARED)]
        _find_alike(centers, chosen, rays[n], intervals[n, 0, 0], min_cosine, alike)
        interval = 0
        for k in range(offsets[n + 1] - offsets[n]):
            s = top - np.float32(first[n] + k) * step
            while interval < MAX_INTERVALS - 1 and s < intervals[n, interval, 1] - _HALF * step:
                if not intervals[n, interval + 1, 0] >= _ZERO:
                    break
                interval += 1
            inside = (s <= intervals[n, interval, 0] + _HALF * step) & (
                s >= intervals[n, interval, 1] - _HALF * step
            )
            if inside:
                cost = _cost_of_point(grey_views, greys, grey_starts, chosen, alike, u, v, s, patches, says)
                costs[offsets[n] + k] = cost + behind * (_ONE - s / intervals[n, 0, 0])
            else:
                costs[offsets[n] + k] = _OUTSIDE


@njit(cache=True, nogil=True)
def _pass_on(costs, offsets, first, here, before, small, large, path, total):
    """One step of semi-global matching: path costs of a pixel from those of the one before (or -1)."""
    begin, stop = offsets[here], offsets[here + 1]
    if before < 0:
        for k in range(begin, stop):
            path[k] = costs[k]
            total[k] += path[k]
        return
    other, other_stop = offsets[before], offsets[before + 1]
    lowest = path[other]
    for k in range(other + 1, other_stop):
        lowest = min(lowest, path[k])
    shift = first[here] - first[before]
    for k in range(begin, stop):
        same = other + (k - begin) + shift
        least = lowest + large
        if other <= same < other_stop:
            least = min(least, path[same])
        if other <= same - 1 < other_stop:
            least = min(least, path[same - 1] + small)
        if other <= same + 1 < other_stop:
            least = min(least, path[same + 1] + small)
        path[k] = costs[k] + least - lowest
        total[k] += path[k]


@njit(cache=True, nogil=True)
def aggregate(costs, offsets, first, pixels, index, small, large, total):
    """Sum of path costs from left, right, above and below, over neighbours that are in the hull.

    index: (H + 2, W + 2) int32, number of the pixel, -1 = none, with a border of -1
    small, large: penalties for a change by one level, by more;  total: flat float32, starts 0
    Source: H. Hirschmueller, Stereo processing by semiglobal matching and mutual information, 2008.
    """
    path = np.empty_like(costs)
    count = len(pixels)
    for direction in range(4):
        backward = direction % 2
        for i in range(count):
            here = count - 1 - i if backward else i
            column, row = pixels[here, 0] + 1, pixels[here, 1] + 1
            if direction == 0:
                before = index[row, column - 1]
            elif direction == 1:
                before = index[row, column + 1]
            elif direction == 2:
                # Two is a forward pass from above, three a backward one from below.
                before = index[row - 1, column]
            else:
                before = index[row + 1, column]
            _pass_on(costs, offsets, first, here, before, small, large, path, total)


@njit(cache=True, nogil=True, error_model="numpy")
def choose_levels(total, offsets, tie, level, spread):
    """Best level of every pixel, between levels by a parabola, and how many levels are about as good.

    tie: cost by which a level may exceed the best and still be about as good
    level, spread: (N,) float32, filled; the level counts from the pixel's first
    """
    for n in range(len(level)):
        begin, stop = offsets[n], offsets[n + 1]
        best = begin
        for k in range(begin, stop):
            if total[k] < total[best]:
                best = k
        good, mean = 0, 0.0
        for k in range(begin, stop):
            if total[k] <= total[best] + tie:
                good += 1
                mean += k - begin
        shift = _ZERO
        if begin < best < stop - 1:
            left, right = total[best - 1] - total[best], total[best + 1] - total[best]
            shift = _HALF * (left - right) / max(left + right, np.float32(1e-6))
        level[n] = np.float32(best - begin) + shift
        spread[n] = np.float32(good)
