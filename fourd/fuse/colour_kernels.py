"""Compiled sampling of colours from the original images through a fused depth; one core, float32.

As in `reduce_kernels`, what is called per pixel does not call others with arrays inside a loop.
"""

from collections.abc import Sequence

import numpy as np
from numba import njit

from fourd.fuse.options import MIN_SINE_SQUARED, MIN_WEIGHT

NO_SOURCE = np.uint8(255)
# Bytes that sampling may read beyond the last image.
_READ_BEYOND = 16
_ZERO = np.float32(0)
_ONE = np.float32(1)
_HALF = np.float32(0.5)
_NEVER = np.float32(np.inf)
_MIN_WEIGHT = np.float32(MIN_WEIGHT)
_MIN_SINE = np.float32(MIN_SINE_SQUARED)


def packed_size(images: Sequence[np.ndarray]) -> int:
    """Bytes that `pack_images` fills."""
    return sum(3 * (image.shape[0] + 3) * (image.shape[1] + 3) for image in images) + _READ_BEYOND


def pack_images(images: Sequence[np.ndarray], packed: np.ndarray) -> np.ndarray:
    """All images into one flat uint8 buffer of `packed_size`. Returns (C,) int64: where each begins.

    Edges repeat once above and to the left, twice below and to the right, as bicubic sampling needs.
    Sixteen bytes more may be read after the last.
    """
    starts = []
    start = 0
    for image in images:
        height, width = image.shape[:2]
        starts.append(start)
        stop = start + 3 * (height + 3) * (width + 3)
        padded = packed[start:stop].reshape(height + 3, width + 3, 3)
        padded[1:-2, 1:-2] = image
        padded[1:-2, 0] = image[:, 0]
        padded[1:-2, -2:] = image[:, -1:]
        padded[0] = padded[1]
        padded[-2:] = padded[-3]
        start = stop
    packed[start:] = 0
    return np.array(starts, np.int64)


@njit(forceinline=True, nogil=True, error_model="numpy")
def place_point(p, u, v, t):
    """Where a source sees pixel (u, v) of the target at inverse depth t.

    p: (26,) float32, a row of `pack_cameras`
    Returns its place in the source's picture, px, the cost of using it, and its inverse depth there. The
    cost is infinite where it cannot be used: behind the source, outside its picture, or more than 90
    degrees away. No branches: loops over this run in vector registers.
    """
    d0, d1, d2 = p[0] * u + (p[1] * v + p[2]), p[3] * u + (p[4] * v + p[5]), p[6] * u + (p[7] * v + p[8])
    e0, e1, e2 = t * p[9], t * p[10], t * p[11]
    q0, q1, q2 = d0 + e0, d1 + e1, d2 + e2
    inverse = _ONE / q2
    x, y = q0 * inverse, q1 * inverse
    xx, xy, yy = x * x, x * y, y * y
    r2 = xx + yy
    k1, k2, p1, p2, k3 = p[21], p[22], p[23], p[24], p[25]
    radial = _ONE + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + (p1 + p1) * xy + p2 * (r2 + (xx + xx))
    yd = y * radial + p1 * (r2 + (yy + yy)) + (p2 + p2) * xy
    at_x, at_y = p[12] * xd + p[13] * yd + p[14], p[15] * yd + p[16]
    c0, c1, c2 = e1 * d2 - e2 * d1, e2 * d0 - e0 * d2, e0 * d1 - e1 * d0
    squares = (q0 * q0 + q1 * q1 + q2 * q2) * (d0 * d0 + d1 * d1 + d2 * d2)
    sine_squared = (c0 * c0 + c1 * c1 + c2 * c2) / squares
    coarser = max(p[18] * q2, _ONE)
    right, bottom = p[19], p[20]
    # A pixel is an area: half of one beyond the outer centres is still the image.
    inside = (at_x >= -_HALF) & (at_x <= right + _HALF) & (at_y >= -_HALF) & (at_y <= bottom + _HALF)
    facing = q0 * d0 + q1 * d1 + q2 * d2 > _ZERO
    usable = inside & facing & (q2 > _ZERO) & (r2 <= p[17])
    cost = np.sqrt(sine_squared + _MIN_SINE) * coarser if usable else _NEVER
    return min(max(at_x, _ZERO), right), min(max(at_y, _ZERO), bottom), cost, t * inverse


@njit(cache=True, nogil=True, error_model="numpy")
def place_points(p, us, vs, ts, px, py, cost):
    """`place_point` of N points into px, py and cost, (N,) float32.

    us, vs, ts: (N,) column, row, inverse depth in the target
    """
    for i in range(us.shape[0]):
        px[i], py[i], cost[i], _ = place_point(p, us[i], vs[i], ts[i])


@njit(cache=True, nogil=True)
def _keys(f, a):
    """Weights of four samples at -1, 0, 1, 2 for a point at f in 0..1 (Keys 1981, equation 4)."""
    g = _ONE - f
    two, three = a + np.float32(2), a + np.float32(3)
    return (
        a * f * g * g,
        (two * f - three) * f * f + _ONE,
        (two * g - three) * g * g + _ONE,
        a * g * f * f,
    )


@njit(cache=True, nogil=True)
def sample_bicubic(image, start, width, px, py, a, columns):
    """Bicubic r, g, b at (px, py) of an image of `pack_images`, `width` columns wide before padding.

    columns: (16,) float32 scratch. The four pixels of a row are twelve adjacent bytes, so one loop
    mixes the four rows; it reads sixteen, a multiple of the length of vector registers.
    """
    x, y = int(px), int(py)
    wx, wy = _keys(px - np.float32(x), a), _keys(py - np.float32(y), a)
    stride = 3 * (width + 3)
    r0 = np.uint64(start + stride * y + 3 * x)
    r1, r2, r3 = r0 + np.uint64(stride), r0 + np.uint64(2 * stride), r0 + np.uint64(3 * stride)
    for k in range(np.uint64(columns.shape[0])):
        upper = wy[0] * np.float32(image[r0 + k]) + wy[1] * np.float32(image[r1 + k])
        lower = wy[2] * np.float32(image[r2 + k]) + wy[3] * np.float32(image[r3 + k])
        columns[k] = upper + lower
    return (
        (wx[0] * columns[0] + wx[1] * columns[3]) + (wx[2] * columns[6] + wx[3] * columns[9]),
        (wx[0] * columns[1] + wx[1] * columns[4]) + (wx[2] * columns[7] + wx[3] * columns[10]),
        (wx[0] * columns[2] + wx[1] * columns[5]) + (wx[2] * columns[8] + wx[3] * columns[11]),
    )


@njit(cache=True, nogil=True)
def rank(mask, cost, x, keep, best):
    """The `keep` cameras of a mask of least finite cost, in order. Returns their number."""
    found = 0
    for c in range(cost.shape[0]):
        price = cost[c, x]
        if ((mask >> np.uint64(c)) & np.uint64(1) == np.uint64(0)) | (price == _NEVER):
            continue
        i = found
        while i > 0 and cost[best[i - 1], x] > price:
            best[i] = best[i - 1]
            i -= 1
        best[i] = c
        found = min(found + 1, keep)
    return found


@njit(cache=True, nogil=True)
def to_byte(value):
    """Nearest of 0..255, halves to even."""
    return np.uint8(min(max(np.rint(value), _ZERO), np.float32(255)))


@njit(forceinline=True, nogil=True, error_model="numpy")
def weigh(cost, left_out):
    """Weight of a source, given the cost of the best that is left out; infinite if none is."""
    w = _ONE / cost
    return w * max(_ONE - cost / left_out, _MIN_WEIGHT) if left_out < _NEVER else w


@njit(cache=True, nogil=True)
def _collect_points(chosen, cameras, e, y, us, ts, twins):
    """Points of a row that need a colour of their own, into us, ts. Returns their number.

    twins: (W,) int64, changed: an earlier estimate with the same depth and cameras, hence the same
    colour; -1 for a point that was collected, -2 for a blank
    """
    count = 0
    for x in range(chosen.shape[2]):
        twins[x] = -2
        if chosen[e, y, x] < _ZERO:
            continue
        twins[x] = -1
        for f in range(e):
            if chosen[f, y, x] == chosen[e, y, x] and cameras[f, y, x] == cameras[e, y, x]:
                twins[x] = f
                break
        if twins[x] == -1:
            us[count], ts[count] = np.float32(x), chosen[e, y, x]
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def sample_colours(chosen, cameras, params, image, starts, first_row, num_sources, a, columns, rgb, source):
    """Colours of chosen depths from the cameras that may have seen them.

    chosen: (E, h, W) float32 inverse depth, blank < 0;  cameras: (E, h, W) uint64
    params: (C, 26) float32, `pack_cameras`;  image, starts: `pack_images`
    a: Keys' parameter, float32;  columns: (16,) float32 scratch
    rgb: (E, h, W, 3) uint8, source: (E, h, W) uint8 camera of least cost, 255 where there is no
    colour; both changed in place, both start as blank (0, 255)

    The `num_sources` cameras of least cost are blended with weights (1 - cost / next) / cost, where
    `next` is the cost of the best that is left out: weights are continuous where the ranking changes.
    """
    num_estimates, height, width = chosen.shape
    num_cameras = params.shape[0]
    best, widths = np.empty(num_sources + 2, np.int64), params[:, 19].astype(np.int64) + 1
    twins = np.empty(width, np.int64)
    us, vs, ts = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    px = np.empty((num_cameras, width), np.float32)
    py, cost = np.empty_like(px), np.empty_like(px)
    for e in range(num_estimates):
        for y in range(height):
            count = _collect_points(chosen, cameras, e, y, us, ts, twins)
            vs[:count] = np.float32(y + first_row)
            for c in range(num_cameras):
                place_points(params[c], us[:count], vs[:count], ts[:count], px[c], py[c], cost[c])
            i = -1
            for x in range(width):
                if twins[x] == -2:
                    continue
                if twins[x] >= 0:
                    source[e, y, x] = source[twins[x], y, x]
                    for j in range(3):
                        rgb[e, y, x, j] = rgb[twins[x], y, x, j]
                    continue
                i += 1
                found = rank(cameras[e, y, x], cost, i, num_sources + 1, best)
                if found == 0:
                    continue
                left_out = cost[best[num_sources], i] if found > num_sources else _NEVER
                red, green, blue, weights = _ZERO, _ZERO, _ZERO, _ZERO
                for k in range(min(found, num_sources)):
                    c = best[k]
                    w = weigh(cost[c, i], left_out)
                    r, g, b = sample_bicubic(image, starts[c], widths[c], px[c, i], py[c, i], a, columns)
                    red += w * r
                    green += w * g
                    blue += w * b
                    weights += w
                source[e, y, x] = np.uint8(best[0])
                rgb[e, y, x, 0], rgb[e, y, x, 1] = to_byte(red / weights), to_byte(green / weights)
                rgb[e, y, x, 2] = to_byte(blue / weights)
