"""Sub-pixel disparity: local planes, and where the images fit best along the row.

A semi-global matcher decides between whole disparities; what it interpolates crowds around them
(pixel locking) and jumps on slanted surfaces. Neighbours on the same surface know better: a plane
is fitted to those of nearly the same disparity, the images say by how much it should move, and the
moved disparities are fitted once more. No pixel gains or loses a disparity here.

Source: B. Lucas, T. Kanade, "An iterative image registration technique with an application to stereo
vision", IJCAI 1981.
"""

import numba
import numpy as np

PLANE_OFFSETS_PX = (-3, -1, 1, 3)
"""Every second neighbour says the same as all of them: a matcher smooths over more than a pixel."""
PLANE_REACH_PX = np.float32(1.5)
_SHIFT_REACH_PX = np.float32(1)
_ALL_OFFSETS_PX = (-2, -1, 0, 1, 2)
_MAX_SHIFT_PX = np.float32(0.7)
_DAMPING = np.float32(4)
"""Variance of the gradient, (grey levels per px)^2, that noise alone produces."""
_MIN_SAMPLES = 5
_MORE_SPREAD_PX2 = np.float32(0.02)


def refine(disparity: np.ndarray, grey: np.ndarray, other: np.ndarray, direction: int) -> np.ndarray:
    """Move disparities by fractions of a pixel to where surface and images agree.

    disparity: (H, W) float32 px of the first image, NaN where there is none
    grey, other: (H, W) float32 grey levels of both images, rows correspond
    direction: -1 if the other image is the right one (x_right = x - disparity), +1 if the left
    Returns (H, W) float32 px, NaN in the same places
    """
    planar = fit_planes(disparity, PLANE_OFFSETS_PX, PLANE_REACH_PX)
    residual, gradient = _residuals(planar, grey, other, direction)
    moved = _shift(planar, residual, gradient, _ALL_OFFSETS_PX)
    return fit_planes(moved, _ALL_OFFSETS_PX, _SHIFT_REACH_PX)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_planes(disparity: np.ndarray, offsets: tuple[int, ...], reach: np.float32) -> np.ndarray:
    """Value at each pixel of the plane through its neighbours of nearly the same disparity.

    disparity: (H, W) float32 px, NaN where there is none
    offsets: of the neighbours, px, rows and columns alike, rising and symmetric about 0
    reach: largest difference between a pixel and a neighbour that counts, px
    Returns (H, W) float32, NaN in the same places; fewer than 5 neighbours leave a pixel as it is
    """
    height, width = disparity.shape
    half = offsets[-1]
    padded = _pad(disparity, half)
    fitted = np.empty_like(disparity)
    sums, of_row = np.empty((9, width), np.float32), np.empty((5, width), np.float32)
    # Whole rows at a time, because the loop over a row is the one that uses wide registers.
    for y in range(height):
        sums[:] = 0
        for v in offsets:
            of_row[:] = 0
            for u in offsets:
                there = padded[y + half + v, half + u : half + u + width]
                _add_neighbours(there, disparity[y], np.float32(u), reach, of_row)
            _add_row(of_row, np.float32(v), sums)
        _solve_planes(disparity[y], sums, fitted[y])
    return fitted


@numba.njit(cache=True, nogil=True)
def _pad(array: np.ndarray, half: int) -> np.ndarray:
    """The array with a border of NaN, so that windows need no bounds."""
    height, width = array.shape
    padded = np.full((height + 2 * half, width + 2 * half), np.float32(np.nan), np.float32)
    padded[half : half + height, half : half + width] = array
    return padded


@numba.njit(cache=True, nogil=True)
def _add_neighbours(
    there: np.ndarray, here: np.ndarray, u: np.float32, reach: np.float32, sums: np.ndarray
) -> None:
    """One neighbour of every pixel of a row, u columns away: added to the sums of 1, u, u^2, z, u z."""
    n, su, suu, sz, suz = sums[0], sums[1], sums[2], sums[3], sums[4]
    one, nothing = np.float32(1), np.float32(0)
    for x in range(here.size):
        apart = there[x] - here[x]
        # NaN fails the comparison.
        near = abs(apart) <= reach
        counts, z = (one, apart) if near else (nothing, nothing)
        n[x] += counts
        su[x] += u * counts
        suu[x] += u * u * counts
        sz[x] += z
        suz[x] += u * z


@numba.njit(cache=True, nogil=True)
def _add_row(of_row: np.ndarray, v: np.float32, sums: np.ndarray) -> None:
    """Sums over a row of the windows, v rows away, to those over the windows."""
    n, su, suu, sz, suz = of_row[0], of_row[1], of_row[2], of_row[3], of_row[4]
    for x in range(n.size):
        sums[0, x] += n[x]
        sums[1, x] += su[x]
        sums[2, x] += v * n[x]
        sums[3, x] += suu[x]
        sums[4, x] += v * su[x]
        sums[5, x] += v * v * n[x]
        sums[6, x] += sz[x]
        sums[7, x] += suz[x]
        sums[8, x] += v * sz[x]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _solve_planes(here: np.ndarray, sums: np.ndarray, fitted: np.ndarray) -> None:
    """Least squares for a row of pixels, written to `fitted`."""
    sn, sx, sy, sxx, sxy, syy = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    sz, sxz, syz = sums[6], sums[7], sums[8]
    for x in range(here.size):
        n, u, v, z = sn[x], sx[x], sy[x], sz[x]
        # A little more spread keeps a line of samples from tilting the plane.
        more = _MORE_SPREAD_PX2 * n
        a, b, c = sxx[x] - u * u / n + more, sxy[x] - u * v / n, syy[x] - v * v / n + more
        p, q = sxz[x] - u * z / n, syz[x] - v * z / n
        determinant = a * c - b * b
        slope_x, slope_y = (p * c - q * b) / determinant, (a * q - b * p) / determinant
        value = here[x] + (z - slope_x * u - slope_y * v) / n
        fitted[x] = value if n >= _MIN_SAMPLES else here[x]


@numba.njit(cache=True, nogil=True)
def _residuals(
    disparity: np.ndarray, grey: np.ndarray, other: np.ndarray, direction: int
) -> tuple[np.ndarray, np.ndarray]:
    """Grey level minus that of the match, and by how much a px of disparity would change the latter."""
    height, width = disparity.shape
    residual = np.full((height, width), np.float32(np.nan), np.float32)
    gradient = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            if np.isnan(disparity[y, x]):
                continue
            place = x + direction * disparity[y, x]
            left = int(np.floor(place))
            if left < 1 or left + 2 >= width:
                continue
            f = np.float32(place - left)
            one, two = other[y, left], other[y, left + 1]
            slope = (two - other[y, left - 1]) * (1 - f) + (other[y, left + 2] - one) * f
            residual[y, x] = grey[y, x] - (one * (1 - f) + two * f)
            gradient[y, x] = np.float32(0.5) * direction * slope
    return residual, gradient


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shift(
    disparity: np.ndarray, residual: np.ndarray, gradient: np.ndarray, offsets: tuple[int, ...]
) -> np.ndarray:
    """Disparities moved by one Gauss-Newton step; neighbours move along and may differ in brightness."""
    height, width = disparity.shape
    half = offsets[-1]
    # A neighbour that the other image does not show has a residual of NaN.
    padded = _pad(disparity + np.float32(0) * residual, half)
    errors, slopes = _pad(residual, half), _pad(gradient, half)
    moved = disparity.copy()
    sums = np.empty((5, width), np.float32)
    for y in range(height):
        here = disparity[y]
        sums[:] = 0
        for v in offsets:
            row = y + half + v
            for u in offsets:
                columns = slice(half + u, half + u + width)
                _add_samples(padded[row, columns], here, errors[row, columns], slopes[row, columns], sums)
        for x in range(width):
            n, sg, se, sgg, sge = sums[:, x]
            if n < _MIN_SAMPLES:
                continue
            step = (sge - sg * se / n) / (sgg - sg * sg / n + _DAMPING * n)
            if abs(step) <= _MAX_SHIFT_PX:
                moved[y, x] = here[x] + step
    return moved


@numba.njit(cache=True, nogil=True)
def _add_samples(
    there: np.ndarray, here: np.ndarray, errors: np.ndarray, slopes: np.ndarray, sums: np.ndarray
) -> None:
    """One neighbour of every pixel of a row: added to the sums of 1, g, e, g^2, g e."""
    n, sg, se, sgg, sge = sums[0], sums[1], sums[2], sums[3], sums[4]
    one, nothing = np.float32(1), np.float32(0)
    for x in range(here.size):
        near = abs(there[x] - here[x]) <= _SHIFT_REACH_PX
        counts, e, g = (one, errors[x], slopes[x]) if near else (nothing, nothing, nothing)
        n[x] += counts
        sg[x] += g
        se[x] += e
        sgg[x] += g * g
        sge[x] += g * e
