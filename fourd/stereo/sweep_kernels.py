"""Compiled loops of the plane sweep: warp by a plane, refinement on the surface's plane, reprojection.

Geometry as in `fourd.stereo.sweep_frame`: P(x, s) = A @ [x, y, 1] + s * b.
"""

import math

import numba
import numpy as np

_FIT_RADIUS_PX = 5
_FIT_MIN_SAMPLES = 20
_MAX_SLOPE = 1.5
"""Steepest surface, units of disparity per px: beyond it two neighbours are two surfaces."""
_TRIALS = 3


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look(
    image: np.ndarray, x: float, y: float, z: float, lens: tuple[float, ...], bounds: tuple[float, ...]
) -> np.float32:
    """Bilinear sample of a picture where its camera sees the direction (x, y, z); NaN where it does not."""
    if z <= 0:
        return np.float32(np.nan)
    x /= z
    y /= z
    low_x, low_y, high_x, high_y = bounds
    if x < low_x or x > high_x or y < low_y or y > high_y:
        return np.float32(np.nan)
    fx, skew, cx, fy, cy, k1, k2, p1, p2, k3 = lens
    if k1 != 0 or k2 != 0 or p1 != 0 or p2 != 0 or k3 != 0:
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x = bent_x
    u = fx * x + skew * y + cx
    v = fy * y + cy
    last_row, last_column = image.shape[0] - 1, image.shape[1] - 1
    if u < 0 or u > last_column or v < 0 or v > last_row:
        return np.float32(np.nan)
    left, top = min(int(u), last_column - 1), min(int(v), last_row - 1)
    across, down = np.float32(u - left), np.float32(v - top)
    above = image[top, left] + across * (image[top, left + 1] - image[top, left])
    below = image[top + 1, left] + across * (image[top + 1, left + 1] - image[top + 1, left])
    return above + down * (below - above)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def warp_by_plane(
    image: np.ndarray,
    A: np.ndarray,
    b: np.ndarray,
    inverse_depth: float,
    lens: tuple[float, ...],
    bounds: tuple[float, ...],
    warped: np.ndarray,
) -> None:
    """The other camera's picture on one plane, bilinear, its lens applied on the way.

    image: (h, w) float32 grey of the other camera;  A (3, 3), b (3,): to its frame at z = 1
    lens: fx, skew, cx, fy, cy, k1, k2, p1, p2, k3;  bounds: lowest x, y and highest x, y of its pixels
    at z = 1: past them the lens polynomial may fold back into the image
    warped: (H, W) float32, written; NaN where the other camera does not look
    """
    height, width = warped.shape
    for row in range(height):
        from_row = A[:, 1] * row + A[:, 2] + inverse_depth * b
        for column in range(width):
            x = A[0, 0] * column + from_row[0]
            y = A[1, 0] * column + from_row[1]
            z = A[2, 0] * column + from_row[2]
            warped[row, column] = _look(image, x, y, z, lens, bounds)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_planes(disparity: np.ndarray) -> np.ndarray:
    """Disparity and its slope by a plane through what is near, in the image and in depth.

    disparity: (H, W) float32, NaN where none
    Returns (H, W, 3) float32: value at the pixel, slope along x, slope along y; NaN where none
    """
    height, width = disparity.shape
    planes = np.full((height, width, 3), np.float32(np.nan), np.float32)
    for row in range(_FIT_RADIUS_PX, height - _FIT_RADIUS_PX):
        for column in range(_FIT_RADIUS_PX, width - _FIT_RADIUS_PX):
            center = disparity[row, column]
            if np.isnan(center):
                continue
            n = sx = sy = sxx = sxy = syy = sd = sxd = syd = 0.0
            for y in range(-_FIT_RADIUS_PX, _FIT_RADIUS_PX + 1):
                for x in range(-_FIT_RADIUS_PX, _FIT_RADIUS_PX + 1):
                    d = disparity[row + y, column + x] - center
                    # NaN fails the comparison.
                    if abs(d) <= 1 + _MAX_SLOPE * max(abs(x), abs(y)):
                        n += 1
                        sx += x
                        sy += y
                        sxx += x * x
                        sxy += x * y
                        syy += y * y
                        sd += d
                        sxd += x * d
                        syd += y * d
            sxx, sxy, syy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
            sxd, syd = sxd - sx * sd / n, syd - sy * sd / n
            determinant = sxx * syy - sxy * sxy
            if n >= _FIT_MIN_SAMPLES and determinant > 0.1 * sxx * syy:
                slope_x = (sxd * syy - syd * sxy) / determinant
                slope_y = (syd * sxx - sxd * sxy) / determinant
                planes[row, column, 0] = center + (sd - slope_x * sx - slope_y * sy) / n
                planes[row, column, 1] = slope_x
                planes[row, column, 2] = slope_y
    return planes


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _correlate(
    reference: np.ndarray,
    image: np.ndarray,
    at: tuple[int, int],
    plane: tuple[float, float, float],
    A: np.ndarray,
    b: np.ndarray,
    lens: tuple[float, ...],
    bounds: tuple[float, ...],
    weights: np.ndarray,
    noise_variance: float,
) -> float:
    """Weighted correlation of a window with the other picture on a slanted plane; -1 if cut off."""
    row, column = at
    radius = weights.shape[0] // 2
    sr = so = srr = soo = sro = 0.0
    for i in range(-radius, radius + 1):
        for j in range(-radius, radius + 1):
            x, y = column + j, row + i
            s = plane[0] + j * plane[1] + i * plane[2]
            other = _look(
                image,
                A[0, 0] * x + A[0, 1] * y + A[0, 2] + s * b[0],
                A[1, 0] * x + A[1, 1] * y + A[1, 2] + s * b[1],
                A[2, 0] * x + A[2, 1] * y + A[2, 2] + s * b[2],
                lens,
                bounds,
            )
            if np.isnan(other):
                return -1.0
            own, weight = reference[y, x], weights[i + radius, j + radius]
            sr += weight * own
            so += weight * other
            srr += weight * own * own
            soo += weight * other * other
            sro += weight * own * other
    variance = max(srr - sr * sr, 0.0) + noise_variance
    other_variance = max(soo - so * so, 0.0) + noise_variance
    return float((sro - sr * so) / math.sqrt(variance * other_variance))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def refine_on_planes(
    disparity: np.ndarray,
    planes: np.ndarray,
    per_px: float,
    step: float,
    reference: np.ndarray,
    image: np.ndarray,
    A: np.ndarray,
    b: np.ndarray,
    lens: tuple[float, ...],
    bounds: tuple[float, ...],
    weights: np.ndarray,
    noise_variance: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Disparities at the best correlation of windows that lie on the surface's own plane.

    Windows that face the camera pull a slanted surface, such as the ground, into steps.
    disparity: (H, W) float32;  planes: of `fit_planes`;  per_px: inverse depth of one unit
    step: between trials, units;  the rest as in `warp_by_plane`;  weights: (k, k), sum 1
    Returns (H, W) float32 disparity, by climbing, as it was where that leads to the outermost trial;
    and (H, W) float32 the best correlation, 0 where there is none
    """
    refined, correlation = disparity.copy(), np.zeros(disparity.shape, np.float32)
    height, width = disparity.shape
    radius = weights.shape[0] // 2
    scores = np.empty(2 * _TRIALS + 1)
    for row in range(radius, height - radius):
        for column in range(radius, width - radius):
            value, slope_x, slope_y = planes[row, column]
            if np.isnan(value):
                continue
            scores[:] = -2.0
            best, k = _TRIALS, _TRIALS
            while True:
                s = (value + (k - _TRIALS) * step) * per_px
                plane = (s, slope_x * per_px, slope_y * per_px)
                scores[k] = _correlate(
                    reference, image, (row, column), plane, A, b, lens, bounds, weights, noise_variance
                )
                if scores[k] > scores[best]:
                    best = k
                if best in (0, 2 * _TRIALS):
                    break
                if scores[best - 1] == -2.0:
                    k = best - 1
                elif scores[best + 1] == -2.0:
                    k = best + 1
                else:
                    break
            correlation[row, column] = max(scores[best], 0.0)
            if 0 < best < 2 * _TRIALS and min(scores[best - 1], scores[best + 1]) > -1:
                before, after = scores[best - 1], scores[best + 1]
                curvature = 2 * scores[best] - before - after
                shift = (after - before) / (2 * curvature) if curvature > 0 else 0.0
                refined[row, column] = value + (best - _TRIALS + shift) * step
    return refined, correlation


@numba.njit(cache=True, nogil=True, error_model="numpy")
def reproject(
    inverse_depth: np.ndarray,
    there: np.ndarray,
    A: np.ndarray,
    b: np.ndarray,
    A_back: np.ndarray,
    b_back: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Into the other side, and back by what that side found there.

    inverse_depth: (H, W) float32 of one side, there: (h, w) of the other, NaN where none
    A, b: pixels of one side to those of the other;  A_back, b_back: the reverse
    Returns (H, W) float32 px between start and end, infinite where either side has none; and
    (H, W) float32 px that the point moves in the other image per unit of inverse depth
    """
    height, width = inverse_depth.shape
    other_height, other_width = there.shape
    missed = np.full((height, width), np.float32(np.inf), np.float32)
    motion = np.zeros((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            s = inverse_depth[row, column]
            if np.isnan(s):
                continue
            z = A[2, 0] * column + A[2, 1] * row + A[2, 2] + s * b[2]
            if z <= 0:
                continue
            x = (A[0, 0] * column + A[0, 1] * row + A[0, 2] + s * b[0]) / z
            y = (A[1, 0] * column + A[1, 1] * row + A[1, 2] + s * b[1]) / z
            motion[row, column] = np.hypot(b[0] - x * b[2], b[1] - y * b[2]) / z
            if not (-0.5 < x < other_width - 0.5 and -0.5 < y < other_height - 0.5):
                continue
            found = there[int(np.rint(y)), int(np.rint(x))]
            if np.isnan(found):
                continue
            back_z = A_back[2, 0] * x + A_back[2, 1] * y + A_back[2, 2] + found * b_back[2]
            if back_z <= 0:
                continue
            back_x = (A_back[0, 0] * x + A_back[0, 1] * y + A_back[0, 2] + found * b_back[0]) / back_z
            back_y = (A_back[1, 0] * x + A_back[1, 1] * y + A_back[1, 2] + found * b_back[1]) / back_z
            missed[row, column] = np.hypot(back_x - column, back_y - row)
    return missed, motion
