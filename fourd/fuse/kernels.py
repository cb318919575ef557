"""Compiled kernels of projection and fusion: one core, float32, no fast-math.

Inverse depth below zero stands for a blank: comparisons with it need no test for NaN. Every sum is
taken in an order that the data fix, so a result depends neither on threads nor on the order of pairs.
"""

import numpy as np
from numba import njit

from fourd.fuse.options import (
    INFINITY_SIGMAS,
    MAX_REACH_PX,
    MAX_STEP_PX,
    MIN_SINE_SQUARED,
    SIGMA_FLOOR,
)

BLANK = np.float32(-1)
_ONE = np.float32(1)
_ZERO = np.float32(0)
_HALF = np.float32(0.5)
_STEP = np.float32(MAX_STEP_PX)
_REACH = np.float32(MAX_REACH_PX)
_INFINITY_SIGMAS = np.float32(INFINITY_SIGMAS)
_SIGMA_FLOOR = np.float32(SIGMA_FLOOR)
_MIN_SINE = np.float32(MIN_SINE_SQUARED)


@njit(cache=True, nogil=True)
def _slope(before, here, after):
    """Slope from the neighbours that lie on the same surface (module options, MAX_STEP_PX)."""
    has_before = abs(here - before) <= _STEP
    has_after = abs(after - here) <= _STEP
    if has_before and has_after:
        return (after - before) * _HALF
    if has_after:
        return after - here
    if has_before:
        return here - before
    return _ZERO


@njit(cache=True, nogil=True)
def _collect_row(disparity, confidence, y, scalars, points):
    """Valid points of a row into points[0:5]: x, s, ds/dx, ds/dy, sigma of s. Returns their number."""
    height, width = disparity.shape
    at_infinity, per_px, sigma_px = scalars[0], scalars[1], scalars[2]
    missing = np.float32(np.nan)
    count = 0
    for x in range(width):
        d = disparity[y, x]
        c = confidence[y, x]
        if not (abs(d) < np.inf and c > _ZERO):
            continue
        s = (d - at_infinity) * per_px
        sigma = sigma_px * per_px / c
        if s < _ZERO:
            if s < -_INFINITY_SIGMAS * sigma:
                continue
            s = _ZERO
        left = disparity[y, x - 1] if x > 0 else missing
        right = disparity[y, x + 1] if x + 1 < width else missing
        above = disparity[y - 1, x] if y > 0 else missing
        below = disparity[y + 1, x] if y + 1 < height else missing
        points[0, count] = np.float32(x)
        points[1, count] = s
        points[2, count] = _slope(left, d, right) * per_px
        points[3, count] = _slope(above, d, below) * per_px
        points[4, count] = sigma
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _project_row(points, count, y, A, b, footprint, patches):
    """Patches of a row: u, v, t, sigma, half extents, inverse Jacobian (4), slope of t (2)."""
    row0, row1, row2 = A[0, 1] * y + A[0, 2], A[1, 1] * y + A[1, 2], A[2, 1] * y + A[2, 2]
    a00, a10, a20 = A[0, 0], A[1, 0], A[2, 0]
    a01, a11, a21 = A[0, 1], A[1, 1], A[2, 1]
    b0, b1, b2 = b[0], b[1], b[2]
    for i in range(count):
        x, s, sx, sy = points[0, i], points[1, i], points[2, i], points[3, i]
        z_ratio = a20 * x + row2
        w = z_ratio + s * b2
        inverse_w = _ONE / w
        u = (a00 * x + row0 + s * b0) * inverse_w
        v = (a10 * x + row1 + s * b1) * inverse_w
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
        usable = (w > _ZERO) & (determinant > _ZERO)
        patches[0, i] = u
        patches[1, i] = v
        patches[2, i] = t if usable else BLANK
        patches[3, i] = points[4, i] * inverse_w * max(abs(z_ratio) * inverse_w, _SIGMA_FLOOR)
        patches[4, i] = min(footprint * (abs(ux) + abs(uy)), _REACH)
        patches[5, i] = min(footprint * (abs(vx) + abs(vy)), _REACH)
        patches[6, i], patches[7, i], patches[8, i], patches[9, i] = xu, xv, yu, yv
        patches[10, i] = tx * xu + ty * yu
        patches[11, i] = tx * xv + ty * yv


@njit(cache=True, nogil=True)
def _splat_row(patches, count, first_row, footprint, inverse_depth, sigma):
    """z-test the patches of a row into the tile. Equal depths: the smaller sigma stays."""
    height, width = inverse_depth.shape
    for i in range(count):
        t = patches[2, i]
        if not t >= _ZERO:
            continue
        u, v = patches[0, i], patches[1, i] - first_row
        reach_u, reach_v = patches[4, i], patches[5, i]
        inside = (u + reach_u >= _ZERO) and (u - reach_u <= np.float32(width - 1))
        if not (inside and v + reach_v >= _ZERO and v - reach_v <= np.float32(height - 1)):
            continue
        x0, x1 = max(0, int(np.ceil(u - reach_u))), min(width - 1, int(np.floor(u + reach_u)))
        y0, y1 = max(0, int(np.ceil(v - reach_v))), min(height - 1, int(np.floor(v + reach_v)))
        xu, xv, yu, yv = patches[6, i], patches[7, i], patches[8, i], patches[9, i]
        tu, tv, s = patches[10, i], patches[11, i], patches[3, i]
        for y in range(y0, y1 + 1):
            dv = np.float32(y) - v
            for x in range(x0, x1 + 1):
                du = np.float32(x) - u
                if abs(xu * du + xv * dv) > footprint or abs(yu * du + yv * dv) > footprint:
                    continue
                here = max(t + (tu * du + tv * dv), _ZERO)
                there = inverse_depth[y, x]
                if here > there or (here == there and s < sigma[y, x]):
                    inverse_depth[y, x] = here
                    sigma[y, x] = s


@njit(cache=True, nogil=True)
def splat_map(disparity, confidence, A, b, scalars, rows, first_row, footprint, inverse_depth, sigma):
    """Project rows of a disparity map and z-test them into a tile of the target.

    disparity, confidence: (H, W) float32, px and 0..1;  A: (3, 3), b: (3,) float32 (geometry.py)
    scalars: (3,) float32 disparity at infinity, inverse depth per px, sigma_px
    rows: first and last row of the map to read;  first_row: the tile's first row
    inverse_depth, sigma: (h, W_target) float32, changed in place; inverse_depth starts BLANK

    A source pixel is a planar patch `2 * footprint` wide. Its slope comes from the neighbours on
    the same surface. Inverse depth is linear on the image of a plane, so the target pixels inside
    the patch get their own exact inverse depth. Patches that face away are not drawn.

    sigma: with a the z in the target frame of the source ray (z = 1 in its own frame) and
    P2 = z_target / z_source = a + s b2, t = s / P2 gives dt/ds = a / P2^2 =
    (z_source / z_target)^2 dz_target/dz_source. |a| / P2 is kept above SIGMA_FLOOR.
    Returns the number of points that were projected.
    """
    width = disparity.shape[1]
    points = np.empty((5, width), np.float32)
    patches = np.empty((12, width), np.float32)
    total = 0
    for y in range(rows[0], rows[1]):
        count = _collect_row(disparity, confidence, y, scalars, points)
        _project_row(points, count, np.float32(y), A, b, footprint, patches)
        _splat_row(patches, count, np.float32(first_row), footprint, inverse_depth, sigma)
        total += count
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def merge_maps(left, left_sigma, right, right_sigma, tolerance, inverse_depth, sigma):
    """One layer from the two maps of a pair, all (h, W) float32; results in the last two.

    Where both see one surface: their precision-weighted mean, with the smaller sigma, because one
    image pair made both. Elsewhere the closer.
    """
    height, width = left.shape
    squared = tolerance * tolerance
    for y in range(height):
        for x in range(width):
            a, b = left[y, x], right[y, x]
            sa, sb = left_sigma[y, x], right_sigma[y, x]
            va, vb = sa * sa, sb * sb
            agree = (a >= _ZERO) & (b >= _ZERO) & ((a - b) * (a - b) <= squared * (va + vb))
            mean = b + (a - b) * (vb / (va + vb))
            a_wins = a > b or (a == b and sa < sb)
            inverse_depth[y, x] = mean if agree else (a if a_wins else b)
            sigma[y, x] = min(sa, sb) if agree else (sa if a_wins else sb)
