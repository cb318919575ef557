"""Compiled kernels of projection and fusion: one core, float32, no fast-math.

Inverse depth below zero stands for a blank: comparisons with it need no test for NaN. Every sum is
taken in an order that the data fix, so a result depends neither on threads nor on the order of pairs.
"""

import numpy as np
from numba import njit

from fourd.fuse.options import INFINITY_SIGMAS, MAX_REACH_PX, MAX_STEP_PX, SIGMA_FLOOR

BLANK = np.float32(-1)
_ONE = np.float32(1)
_ZERO = np.float32(0)
_LOW_BITS = np.uint32(0xFFFFFFFF)
_HALF = np.float32(0.5)
_STEP = np.float32(MAX_STEP_PX)
_REACH = np.float32(MAX_REACH_PX)
_INFINITY_SIGMAS = np.float32(INFINITY_SIGMAS)
_SIGMA_FLOOR = np.float32(SIGMA_FLOOR)


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
def _key(t, tu, tv, du, dv, xu, xv, yu, yv, footprint, low):
    """What a patch offers to a pixel (du, dv) from its centre; 0 outside the patch.

    Positive floats are ordered as their bits are: the greater key is the greater inverse depth, and
    at equal depth the smaller sigma. One unsigned maximum is the whole z-test.
    """
    here = np.float32(max(t + (tu * du + tv * dv), _ZERO))
    inside = (abs(xu * du + xv * dv) <= footprint) & (abs(yu * du + yv * dv) <= footprint)
    key = (np.uint64(here.view(np.uint32)) << np.uint64(32)) | low
    return key if inside else np.uint64(0)


@njit(cache=True, nogil=True)
def _splat_row(patches, count, first_row, footprint, keys):
    """z-test the patches of a row into the tile."""
    height, width = keys.shape
    last_row = first_row + height - 1
    right, top, bottom = np.float32(width - 1), np.float32(first_row), np.float32(last_row)
    for i in range(count):
        t = patches[2, i]
        u, v = patches[0, i], patches[1, i]
        reach_u, reach_v = patches[4, i], patches[5, i]
        inside = (u + reach_u >= _ZERO) & (u - reach_u <= right)
        if not ((t >= _ZERO) & inside & (v + reach_v >= top) & (v - reach_v <= bottom)):
            continue
        xu, xv, yu, yv = patches[6, i], patches[7, i], patches[8, i], patches[9, i]
        tu, tv = patches[10, i], patches[11, i]
        low = np.uint64(_LOW_BITS - np.float32(patches[3, i]).view(np.uint32))
        left, upper = np.ceil(u - reach_u), np.ceil(v - reach_v)
        x0, y0 = int(left), int(upper)
        small = (reach_u < _ONE) & (reach_v < _ONE)
        if small & (x0 >= 0) & (x0 + 1 < width) & (y0 >= first_row) & (y0 < last_row):
            # The usual case, without loops whose length nobody can predict.
            du, dv, y = left - u, upper - v, y0 - first_row
            key = _key(t, tu, tv, du, dv, xu, xv, yu, yv, footprint, low)
            keys[y, x0] = max(keys[y, x0], key)
            key = _key(t, tu, tv, du + _ONE, dv, xu, xv, yu, yv, footprint, low)
            keys[y, x0 + 1] = max(keys[y, x0 + 1], key)
            key = _key(t, tu, tv, du, dv + _ONE, xu, xv, yu, yv, footprint, low)
            keys[y + 1, x0] = max(keys[y + 1, x0], key)
            key = _key(t, tu, tv, du + _ONE, dv + _ONE, xu, xv, yu, yv, footprint, low)
            keys[y + 1, x0 + 1] = max(keys[y + 1, x0 + 1], key)
            continue
        x1, y1 = int(min(right, np.floor(u + reach_u))), int(min(bottom, np.floor(v + reach_v)))
        for y in range(max(first_row, y0), y1 + 1):
            for x in range(max(0, x0), x1 + 1):
                du, dv = np.float32(x) - u, np.float32(y) - v
                key = _key(t, tu, tv, du, dv, xu, xv, yu, yv, footprint, low)
                keys[y - first_row, x] = max(keys[y - first_row, x], key)


@njit(cache=True, nogil=True)
def splat_map(disparity, confidence, A, b, scalars, rows, first_row, footprint, keys):
    """Project rows of a disparity map and z-test them into a tile of the target.

    disparity, confidence: (H, W) float32, px and 0..1;  A: (3, 3), b: (3,) float32 (geometry.py)
    scalars: (3,) float32 disparity at infinity, inverse depth per px, sigma_px
    rows: first and last row of the map to read;  first_row: the tile's first row
    keys: (h, W_target) uint64 `_key`, changed in place; starts 0 = blank

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
        _splat_row(patches, count, first_row, footprint, keys)
        total += count
    return total


@njit(cache=True, nogil=True)
def _unpack(key):
    """Inverse depth (BLANK for 0) and sigma of a key."""
    t = np.uint32(key >> np.uint64(32)).view(np.float32)
    low = np.uint32(key & np.uint64(0xFFFFFFFF))
    return (t if key > np.uint64(0) else BLANK), np.uint32(_LOW_BITS - low).view(np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def merge_maps(left, right, tolerance, inverse_depth, sigma):
    """One layer from the two maps of a pair.

    left, right: (h, W) uint64 keys;  inverse_depth, sigma: (h, W) float32, changed in place
    Where both see one surface: their precision-weighted mean, with the smaller sigma, because one
    image pair made both. Elsewhere the closer.
    """
    height, width = left.shape
    squared = tolerance * tolerance
    for y in range(height):
        for x in range(width):
            a, sa = _unpack(left[y, x])
            b, sb = _unpack(right[y, x])
            va, vb = sa * sa, sb * sb
            agree = (a >= _ZERO) & (b >= _ZERO) & ((a - b) * (a - b) <= squared * (va + vb))
            mean = b + (a - b) * (vb / (va + vb))
            left_wins = left[y, x] > right[y, x]
            inverse_depth[y, x] = mean if agree else (a if left_wins else b)
            sigma[y, x] = min(sa, sb) if agree else (sa if left_wins else sb)


@njit(cache=True, nogil=True)
def _gather_sorted(inverse_depths, sigmas, y, x, t, sigma, pair):
    """Samples of one pixel, closest first (equal depth: smaller sigma first). Returns their number."""
    count = 0
    for p in range(inverse_depths.shape[0]):
        value = inverse_depths[p, y, x]
        if value < _ZERO:
            continue
        spread = sigmas[p, y, x]
        i = count
        while i > 0 and (t[i - 1] < value or (t[i - 1] == value and sigma[i - 1] > spread)):
            t[i], sigma[i], pair[i] = t[i - 1], sigma[i - 1], pair[i - 1]
            i -= 1
        t[i], sigma[i], pair[i] = value, spread, p
        count += 1
    return count


@njit(cache=True, nogil=True)
def _agree(t, sigma, i, j, squared):
    """Whether two samples differ by no more than the tolerance, squared, times their variance."""
    difference = t[j] - t[i]
    return difference * difference <= squared * (sigma[i] * sigma[i] + sigma[j] * sigma[j])


@njit(cache=True, nogil=True)
def _support(t, sigma, pair, count, index, squared, masks):
    """Samples that agree with one: how many, how many of them are closer, the cameras of their pairs."""
    number = closer = 0
    cameras = np.uint64(0)
    for j in range(count):
        if _agree(t, sigma, index, j, squared):
            number += 1
            closer += j < index
            cameras |= masks[pair[j]]
    return number, closer, cameras


@njit(cache=True, nogil=True)
def _num_bits(mask):
    number = 0
    while mask != np.uint64(0):
        mask &= mask - np.uint64(1)
        number += 1
    return number


@njit(cache=True, nogil=True, error_model="numpy")
def _fused(t, sigma, count, index, squared):
    """Precision-weighted mean of the samples that agree with one, summed closest first."""
    total, weights = _ZERO, _ZERO
    variance = sigma[index] * sigma[index]
    for j in range(count):
        if _agree(t, sigma, index, j, squared):
            weight = variance / (sigma[j] * sigma[j])
            total += weight * (t[j] - t[index])
            weights += weight
    return max(t[index] + total / weights, _ZERO)


@njit(cache=True, nogil=True)
def _find_consensus(t, sigma, pair, count, squared, max_front, rules, masks):
    """The closest sample that enough pairs and cameras support, -1 if there is none or it is hidden.

    Returns its index, the number of pairs and their cameras.
    """
    for i in range(count if count >= rules[0] else 0):
        number, closer, cameras = _support(t, sigma, pair, count, i, squared, masks)
        if number >= rules[0] and _num_bits(cameras) >= rules[1]:
            in_front = np.float32(i - closer)
            return (-1 if in_front > max_front * np.float32(number) else i), number, cameras
    return -1, 0, np.uint64(0)


@njit(cache=True, nogil=True)
def _find_farthest(t, sigma, pair, count, squared, rules, masks):
    """The farthest sample that enough pairs support; the farthest of all if there is none."""
    for i in range(count - 1, -1, -1):
        if rules[2] == 1 or _support(t, sigma, pair, count, i, squared, masks)[0] >= rules[2]:
            return i
    return count - 1


@njit(cache=True, nogil=True)
def reduce_layers(
    inverse_depths, sigmas, masks, tolerance, max_front, rules, wanted, chosen, cameras, counts
):
    """The four estimates of every pixel from the layers of all pairs.

    inverse_depths, sigmas: (P, h, W) float32, blank < 0;  masks: (P,) uint64 cameras of each pair
    tolerance: float32, combined sigmas;  max_front: float32, samples in front per supporter
    wanted: (4,) bool consensus, closest, median, farthest
    rules: (3,) int64 min_pairs, min_cameras, pairs that the farthest needs
    chosen: (4, h, W) float32 inverse depth;  cameras: (4, h, W) uint64 of the pairs that agree with it
    counts: (2, h, W) uint8 pairs and distinct cameras of the consensus (0 = blank); all three changed

    A sample that agrees with the consensus is a measurement of the same surface, so closest, median
    and farthest take the consensus' depth and cameras there. Elsewhere they are the sample itself.
    """
    num_pairs, height, width = inverse_depths.shape
    t, sigma = np.empty(num_pairs, np.float32), np.empty(num_pairs, np.float32)
    pair = np.empty(num_pairs, np.int64)
    squared = tolerance * tolerance
    for y in range(height):
        for x in range(width):
            count = _gather_sorted(inverse_depths, sigmas, y, x, t, sigma, pair)
            for e in range(4):
                chosen[e, y, x] = BLANK
                cameras[e, y, x] = np.uint64(0)
            counts[0, y, x] = counts[1, y, x] = np.uint8(0)
            if count == 0:
                continue
            seed, number, shared_mask = _find_consensus(
                t, sigma, pair, count, squared, max_front, rules, masks
            )
            shared = BLANK
            if seed >= 0:
                shared = _fused(t, sigma, count, seed, squared)
                if wanted[0]:
                    chosen[0, y, x], cameras[0, y, x] = shared, shared_mask
                    counts[0, y, x], counts[1, y, x] = np.uint8(min(number, 255)), _num_bits(shared_mask)
            for e in range(1, 4):
                if not wanted[e]:
                    continue
                index = 0 if e == 1 else (count - 1) // 2
                if e == 3:
                    index = _find_farthest(t, sigma, pair, count, squared, rules, masks)
                if seed >= 0 and _agree(t, sigma, index, seed, squared):
                    chosen[e, y, x], cameras[e, y, x] = shared, shared_mask
                else:
                    chosen[e, y, x] = t[index]
                    cameras[e, y, x] = _support(t, sigma, pair, count, index, squared, masks)[2]
