"""Sub-pixel disparity: local planes, and where the images fit best along the row.

A semi-global matcher decides between whole disparities; what it interpolates crowds around them
(pixel locking) and jumps on slanted surfaces. Neighbours on the same surface know better: a plane
is fitted to those of nearly the same disparity, the images say by how much it should move, and the
moved disparities are fitted once more. No pixel gains or loses a disparity here.

Source: B. Lucas, T. Kanade, "An iterative image registration technique with an application to stereo
vision", IJCAI 1981.
"""

import cv2
import numba
import numpy as np

_PLANE_HALF_PX = 3
_PLANE_REACH_PX = np.float32(1.5)
_SHIFT_HALF_PX = 2
_SHIFT_REACH_PX = np.float32(1)
_SMOOTHING_HALF_PX = 2
_MAX_SHIFT_PX = np.float32(0.7)
_DAMPING = np.float32(4)
"""Variance of the gradient, (grey levels per px)^2, that noise alone produces."""
_MIN_SAMPLES = 5


def refine(disparity: np.ndarray, image: np.ndarray, other: np.ndarray, direction: int) -> np.ndarray:
    """Move disparities by fractions of a pixel to where surface and images agree.

    disparity: (H, W) float32 px of `image`, NaN where there is none
    image, other: (H, W, 3) uint8 RGB, rows correspond
    direction: -1 if the other image is the right one (x_right = x - disparity), +1 if the left
    Returns (H, W) float32 px, NaN in the same places
    """
    grey, other_grey = (cv2.cvtColor(i, cv2.COLOR_RGB2GRAY).astype(np.float32) for i in (image, other))
    planar = fit_planes(disparity, _PLANE_HALF_PX, _PLANE_REACH_PX)
    residual, gradient = _residuals(planar, grey, other_grey, direction)
    moved = _shift(planar, residual, gradient, _SHIFT_HALF_PX)
    return fit_planes(moved, _SMOOTHING_HALF_PX, _SHIFT_REACH_PX)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_planes(disparity: np.ndarray, half: int, reach: np.float32) -> np.ndarray:
    """Value at each pixel of the plane through its neighbours of nearly the same disparity.

    disparity: (H, W) float32 px, NaN where there is none;  half: of the window's side, px
    reach: largest difference between a pixel and a neighbour that counts, px
    Returns (H, W) float32, NaN in the same places; fewer than 5 neighbours leave a pixel as it is
    """
    height, width = disparity.shape
    fitted = disparity.copy()
    one, nothing = np.float32(1), np.float32(0)
    for y in range(height):
        for x in range(width):
            here = disparity[y, x]
            if np.isnan(here):
                continue
            n = su = sv = sz = suu = suv = svv = suz = svz = nothing
            first = max(x - half, 0)
            for row in range(max(y - half, 0), min(y + half + 1, height)):
                row_n = row_u = row_uu = row_z = row_uz = nothing
                u = np.float32(first - x)
                # A slice, because indices that may be negative keep the loop from being unrolled.
                for there in disparity[row, first : x + half + 1]:
                    near = abs(there - here) <= reach
                    counts, z = (one, there - here) if near else (nothing, nothing)
                    row_n += counts
                    row_u += counts * u
                    row_uu += counts * u * u
                    row_z += z
                    row_uz += z * u
                    u += one
                v = np.float32(row - y)
                n, su, sv, sz = n + row_n, su + row_u, sv + v * row_n, sz + row_z
                suu, suv, svv = suu + row_uu, suv + v * row_u, svv + v * v * row_n
                suz, svz = suz + row_uz, svz + v * row_z
            if n < _MIN_SAMPLES:
                continue
            # One px^2 more of spread keeps a line of samples from tilting the plane.
            a, b, c = suu - su * su / n + one, suv - su * sv / n, svv - sv * sv / n + one
            p, q = suz - su * sz / n, svz - sv * sz / n
            determinant = a * c - b * b
            slope_x, slope_y = (p * c - q * b) / determinant, (a * q - b * p) / determinant
            fitted[y, x] = here + (sz - slope_x * su - slope_y * sv) / n
    return fitted


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
def _shift(disparity: np.ndarray, residual: np.ndarray, gradient: np.ndarray, half: int) -> np.ndarray:
    """Disparities moved by one Gauss-Newton step; neighbours move along and may differ in brightness."""
    height, width = disparity.shape
    moved = disparity.copy()
    one, nothing = np.float32(1), np.float32(0)
    for y in range(height):
        for x in range(width):
            here = disparity[y, x]
            if np.isnan(here):
                continue
            n = sg = se = sgg = sge = nothing
            columns = slice(max(x - half, 0), x + half + 1)
            for row in range(max(y - half, 0), min(y + half + 1, height)):
                there, errors, slopes = (
                    disparity[row, columns],
                    residual[row, columns],
                    gradient[row, columns],
                )
                for i in range(there.size):
                    near = abs(there[i] - here) <= _SHIFT_REACH_PX and errors[i] == errors[i]
                    counts, e, g = (one, errors[i], slopes[i]) if near else (nothing, nothing, nothing)
                    n += counts
                    sg += g
                    se += e
                    sgg += g * g
                    sge += g * e
            if n < _MIN_SAMPLES:
                continue
            step = (sge - sg * se / n) / (sgg - sg * sg / n + _DAMPING * n)
            if abs(step) <= _MAX_SHIFT_PX:
                moved[y, x] = here + step
    return moved
