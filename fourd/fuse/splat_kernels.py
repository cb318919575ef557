"""Compiled projection of disparity maps with a z-test: one core, float32, no fast-math.

A row of a map passes through three loops. The first packs its valid pixels, the second computes in
vector registers what every point offers to the target pixels around it, the third is the z-test.
"""

import numpy as np
from numba import njit

from fourd.fuse.options import INFINITY_SIGMAS, MAX_REACH_PX, MAX_STEP_PX, SIGMA_FLOOR

_ONE = np.float32(1)
_ZERO = np.float32(0)
_HALF = np.float32(0.5)
_TWO = np.float32(2)
_THREE = np.float32(3)
_LOW_BITS = np.uint32(0xFFFFFFFF)
_STEP = np.float32(MAX_STEP_PX)
_REACH = np.float32(MAX_REACH_PX)
_INFINITY_SIGMAS = np.float32(INFINITY_SIGMAS)
_SIGMA_FLOOR = np.float32(SIGMA_FLOOR)
# What `windows` holds for a point: nothing to draw, two by two pixels, four by two, anything else.
_NONE, _SMALL, _WIDE, _OTHER = np.int32(0), np.int32(1), np.int32(2), np.int32(3)


@njit(cache=True, nogil=True, error_model="numpy")
def _find_valid(disparity, confidence, flags, columns):
    """Columns of the valid pixels of a row, into `columns`. Returns their number.

    flags: zeros, uint8, at least as long as the row and a multiple of eight;  columns: 8 longer
    """
    for x in range(disparity.shape[0]):
        flags[x] = (abs(disparity[x]) < np.inf) & (confidence[x] > _ZERO)
    count = np.uint64(0)
    eights = flags.view(np.uint64)
    for i in range(eights.shape[0]):
        if eights[i] == np.uint64(0):
            continue
        for x in range(8 * i, 8 * i + 8):
            columns[count] = x
            count += np.uint64(flags[x])
    return np.int64(count)


@njit(cache=True, nogil=True)
def _pack_points(columns, count, padded, above, below, confidence, points):
    """Rows of points: column, disparity, confidence, disparities to the left, right, above and below.

    columns: uint32, the first `count`;  padded: (W + 2,) disparities between NaN
    """
    for i in range(count):
        x = columns[i]
        points[0, i] = np.float32(x)
        points[1, i] = padded[x + np.uint32(1)]
        points[2, i] = confidence[x]
        points[3, i] = padded[x]
        points[4, i] = padded[x + np.uint32(2)]
        points[5, i] = above[x]
        points[6, i] = below[x]


@njit(forceinline=True, nogil=True)
def _slope(before, here, after):
    """Slope from the neighbours that lie on the same surface (module options, MAX_STEP_PX)."""
    backward, forward = here - before, after - here
    has_before, has_after = abs(backward) <= _STEP, abs(forward) <= _STEP
    one_sided = forward if has_after else (backward if has_before else _ZERO)
    return (after - before) * _HALF if has_before & has_after else one_sided


@njit(cache=True, nogil=True, error_model="numpy")
def _measure_row(points, count, scalars):
    """Change points[1:5] to s, sigma of s, ds/dx, ds/dy. Returns how many are not beyond infinity.

    scalars: disparity at infinity, inverse depth per px, sigma_px.  Beyond infinity: s < 0
    """
    at_infinity, per_px, sigma_px = scalars
    total = 0
    for i in range(count):
        d = points[1, i]
        s = (d - at_infinity) * per_px
        sigma = sigma_px * per_px / points[2, i]
        counts = s >= -_INFINITY_SIGMAS * sigma
        total += counts
        across = _slope(points[3, i], d, points[4, i]) * per_px
        along = _slope(points[5, i], d, points[6, i]) * per_px
        points[1, i] = max(s, _ZERO) if counts else -_ONE
        points[2, i] = sigma
        points[3, i] = across
        points[4, i] = along
    return total


@njit(forceinline=True, nogil=True, error_model="numpy")
def _project(points, i, row, A, b, footprint):
    """Patch of one point: place (4), inverse Jacobian (4), t and its slope (3), sigma, whether drawn.

    place: u, v and its half extents
    """
    a00, a10, a20, a01, a11, a21 = A
    b0, b1, b2 = b
    x, s, sigma, sx, sy = points[0, i], points[1, i], points[2, i], points[3, i], points[4, i]
    z_ratio = a20 * x + row[2]
    w = z_ratio + s * b2
    inverse_w = _ONE / w
    u = (a00 * x + row[0] + s * b0) * inverse_w
    v = (a10 * x + row[1] + s * b1) * inverse_w
    t = s * inverse_w
    wx, wy = a20 + sx * b2, a21 + sy * b2
    ux = (a00 + sx * b0 - u * wx) * inverse_w
    vx = (a10 + sx * b1 - v * wx) * inverse_w
    tx = (sx - t * wx) * inverse_w
    uy = (a01 + sy * b0 - u * wy) * inverse_w
    vy = (a11 + sy * b1 - v * wy) * inverse_w
    ty = (sy - t * wy) * inverse_w
    determinant = ux * vy - uy * vx
    inverse = _ONE / determinant
    xu, xv, yu, yv = vy * inverse, -uy * inverse, -vx * inverse, ux * inverse
    reach_u = min(footprint * (abs(ux) + abs(uy)), _REACH)
    reach_v = min(footprint * (abs(vx) + abs(vy)), _REACH)
    spread = sigma * inverse_w * max(abs(z_ratio) * inverse_w, _SIGMA_FLOOR)
    drawn = (s >= _ZERO) & (w > _ZERO) & (determinant > _ZERO)
    plane = t, tx * xu + ty * yu, tx * xv + ty * yv
    return (u, v, reach_u, reach_v), (xu, xv, yu, yv), plane, spread, drawn


@njit(forceinline=True, nogil=True)
def _offer(du, dv, inverse_jacobian, plane, footprint):
    """Inverse depth of a patch at a pixel (du, dv) from its centre; -1 outside the patch."""
    xu, xv, yu, yv = inverse_jacobian
    t, tu, tv = plane
    here = max(t + (tu * du + tv * dv), _ZERO)
    inside = (abs(xu * du + xv * dv) <= footprint) & (abs(yu * du + yv * dv) <= footprint)
    return here if inside else -_ONE


@njit(cache=True, nogil=True, error_model="numpy")
def _project_row(points, count, row, A, b, footprint, tile, windows, places, offers):
    """What the points of a row offer to the target pixels around them. Returns how many count.

    tile: first row, columns and rows of the tile, float32
    windows: (W,) int32, changed: which pixels a patch can touch, as named above
    places: (W,) int32, changed: index in the tile of the first of these pixels
    offers: (9, W) float32, changed: inverse depths at the first two pixels of a row, at those below,
    at the next two of the row, at those below; sigma. No branches: a loop in vector registers.
    """
    first_row, width, height = tile
    for i in range(count):
        place, jacobian, plane, spread, drawn = _project(points, i, row, A, b, footprint)
        u, v, reach_u, reach_v = place
        left, right = np.ceil(u - reach_u), np.floor(u + reach_u)
        upper, lower = np.ceil(v - reach_v), np.floor(v + reach_v)
        y = upper - first_row
        touches = (right >= _ZERO) & (left < width) & (lower >= first_row) & (y < height)
        touches &= (left <= right) & (upper <= lower) & drawn
        two_rows = (y >= _ZERO) & (y + _ONE < height) & (lower <= upper + _ONE) & (left >= _ZERO)
        small = two_rows & (left + _ONE < width) & (right <= left + _ONE)
        wide = two_rows & (left + _THREE < width) & (right <= left + _THREE)
        window = _SMALL if small else (_WIDE if wide else _OTHER)
        windows[i] = window if touches else _NONE
        inside = touches & (small | wide)
        places[i] = np.int32(y if inside else _ZERO) * np.int32(width) + np.int32(left if inside else _ZERO)
        du, dv = left - u, upper - v
        offers[0, i] = _offer(du, dv, jacobian, plane, footprint)
        offers[1, i] = _offer(du + _ONE, dv, jacobian, plane, footprint)
        offers[2, i] = _offer(du, dv + _ONE, jacobian, plane, footprint)
        offers[3, i] = _offer(du + _ONE, dv + _ONE, jacobian, plane, footprint)
        offers[4, i] = _offer(du + _TWO, dv, jacobian, plane, footprint)
        offers[5, i] = _offer(du + _THREE, dv, jacobian, plane, footprint)
        offers[6, i] = _offer(du + _TWO, dv + _ONE, jacobian, plane, footprint)
        offers[7, i] = _offer(du + _THREE, dv + _ONE, jacobian, plane, footprint)
        offers[8, i] = spread


@njit(forceinline=True, nogil=True)
def _key(offer, sigma):
    """int64 from the bits of an offer and its sigma: greater for the greater inverse depth, and at
    equal depth for the smaller sigma; negative for no offer.

    Positive floats are ordered as their bits are, so one maximum of integers is the whole z-test.
    """
    return np.int64(offer) << 32 | np.int64(_LOW_BITS - np.uint32(sigma))


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_patch(points, i, row, A, b, footprint, first_row, keys):
    """z-test one patch that is large or crosses the border of the tile."""
    height, width = keys.shape
    place, jacobian, plane, spread, _ = _project(points, i, row, A, b, footprint)
    u, v, reach_u, reach_v = place
    bottom = np.float32(first_row + height - 1)
    x0, x1 = max(int(np.ceil(u - reach_u)), 0), int(min(np.floor(u + reach_u), np.float32(width - 1)))
    y0, y1 = max(int(np.ceil(v - reach_v)), first_row), int(min(np.floor(v + reach_v), bottom))
    sigma = np.float32(spread).view(np.int32)
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            offer = _offer(np.float32(x) - u, np.float32(y) - v, jacobian, plane, footprint)
            key = _key(np.float32(offer).view(np.int32), sigma)
            keys[y - first_row, x] = max(keys[y - first_row, x], key)


@njit(forceinline=True, nogil=True)
def _test_four(keys, at, width, offers, first, i, sigma):
    """z-test two pixels of a row and the two below. Unsigned, so that no index can wrap."""
    under, one = at + width, np.uint64(1)
    keys[at] = max(keys[at], _key(offers[first, i], sigma))
    keys[at + one] = max(keys[at + one], _key(offers[first + 1, i], sigma))
    keys[under] = max(keys[under], _key(offers[first + 2, i], sigma))
    keys[under + one] = max(keys[under + one], _key(offers[first + 3, i], sigma))


@njit(cache=True, nogil=True)
def _test_row(windows, places, bits, count, points, row, A, b, footprint, first_row, keys, flat):
    """z-test the points of a row. bits: offers, as int32;  flat: keys as one row."""
    width = np.uint64(keys.shape[1])
    for i in range(count):
        window = windows[i]
        if window == _NONE:
            continue
        if window == _OTHER:
            _draw_patch(points, i, row, A, b, footprint, first_row, keys)
            continue
        at = np.uint64(places[i])
        _test_four(flat, at, width, bits, 0, i, bits[8, i])
        if window == _WIDE:
            _test_four(flat, at + np.uint64(2), width, bits, 4, i, bits[8, i])


@njit(cache=True, nogil=True)
def splat_map(disparity, confidence, A, b, scalars, rows, first_row, footprint, keys):
    """Project rows of a disparity map and z-test them into a tile of the target.

    disparity, confidence: (H, W) float32, px and 0..1;  A: (3, 3), b: (3,) float32 (geometry.py)
    scalars: (3,) float32 disparity at infinity, inverse depth per px, sigma_px
    rows: first and last row of the map to read;  first_row: the tile's first row
    keys: (h, W_target) int64 `_key`, changed in place; starts 0 = blank

    A source pixel is a planar patch `2 * footprint` wide. Its slope comes from the neighbours on
    the same surface. Inverse depth is linear on the image of a plane, so the target pixels inside
    the patch get their own exact inverse depth. Patches that face away are not drawn.

    sigma: with a the z in the target frame of the source ray (z = 1 in its own frame) and
    P2 = z_target / z_source = a + s b2, t = s / P2 gives dt/ds = a / P2^2 =
    (z_source / z_target)^2 dz_target/dz_source. |a| / P2 is kept above SIGMA_FLOOR.
    Returns the number of points that were projected.
    """
    height, width = disparity.shape
    columns, flags = np.empty(width + 8, np.uint32), np.zeros((width + 7) // 8 * 8, np.uint8)
    blank, padded = np.full(width, np.float32(np.nan)), np.full(width + 2, np.float32(np.nan))
    points, offers = np.empty((7, width), np.float32), np.empty((9, width), np.float32)
    windows, places = np.empty(width, np.int32), np.empty(width, np.int32)
    bits, flat = offers.view(np.int32), keys.reshape(keys.size)
    slopes, shift = (A[0, 0], A[1, 0], A[2, 0], A[0, 1], A[1, 1], A[2, 1]), (b[0], b[1], b[2])
    units = scalars[0], scalars[1], scalars[2]
    tile = np.float32(first_row), np.float32(keys.shape[1]), np.float32(keys.shape[0])
    total = 0
    for y in range(rows[0], rows[1]):
        count = _find_valid(disparity[y], confidence[y], flags, columns)
        padded[1 : width + 1] = disparity[y]
        above = disparity[y - 1] if y > 0 else blank
        below = disparity[y + 1] if y + 1 < height else blank
        _pack_points(columns, count, padded, above, below, confidence[y], points)
        total += _measure_row(points, count, units)
        v = np.float32(y)
        row = A[0, 1] * v + A[0, 2], A[1, 1] * v + A[1, 2], A[2, 1] * v + A[2, 2]
        _project_row(points, count, row, slopes, shift, footprint, tile, windows, places, offers)
        _test_row(windows, places, bits, count, points, row, slopes, shift, footprint, first_row, keys, flat)
    return total
