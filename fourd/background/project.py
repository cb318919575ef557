"""From points of a target to the pictures of the input cameras."""

from collections.abc import Mapping

import numpy as np
from numba import njit

from fourd.camera import Camera
from fourd.fuse.colour_kernels import pack_sources
from fourd.fuse.geometry import make_sources
from fourd.fuse.options import MIN_SINE_SQUARED


def pack_cameras(target: Camera, cameras: Mapping[str, Camera]) -> np.ndarray:
    """(C, 26) float32: the cameras of one time as the kernels read them, seen from the target."""
    return pack_sources(make_sources(target, dict(cameras), dict.fromkeys(cameras, np.empty(0, np.uint8))))


@njit(forceinline=True, nogil=True, error_model="numpy")
def place_point(p, u, v, t):
    """Where a source sees pixel (u, v) of the target at inverse depth t: x, y, cost, inverse depth.

    p: (26,) float32, one of `pack_cameras`
    The cost is infinite where it does not see it: behind it, outside its picture, or more than 90 degrees
    away. Else it is the squared sine of the angle between its ray and the target's, times the square of
    how much coarser it sees.
    """
    d0, d1, d2 = p[0] * u + p[1] * v + p[2], p[3] * u + p[4] * v + p[5], p[6] * u + p[7] * v + p[8]
    e0, e1, e2 = t * p[9], t * p[10], t * p[11]
    q0, q1, q2 = d0 + e0, d1 + e1, d2 + e2
    x, y = q0 / q2, q1 / q2
    xx, xy, yy = x * x, x * y, y * y
    r2 = xx + yy
    radial = np.float32(1) + r2 * (p[21] + r2 * (p[22] + r2 * p[25]))
    xd = x * radial + np.float32(2) * p[23] * xy + p[24] * (r2 + np.float32(2) * xx)
    yd = y * radial + p[23] * (r2 + np.float32(2) * yy) + np.float32(2) * p[24] * xy
    px, py = p[12] * xd + p[13] * yd + p[14], p[15] * yd + p[16]
    c0, c1, c2 = e1 * d2 - e2 * d1, e2 * d0 - e0 * d2, e0 * d1 - e1 * d0
    squares = (q0 * q0 + q1 * q1 + q2 * q2) * (d0 * d0 + d1 * d1 + d2 * d2)
    coarser = max(p[18] * q2, np.float32(1))
    half = np.float32(0.5)
    inside = (px >= -half) & (px <= p[19] + half) & (py >= -half) & (py <= p[20] + half)
    facing = (q0 * d0 + q1 * d1 + q2 * d2 > 0) & (q2 > 0) & (r2 <= p[17])
    cost = ((c0 * c0 + c1 * c1 + c2 * c2) / squares + np.float32(MIN_SINE_SQUARED)) * coarser * coarser
    zero = np.float32(0)
    return (
        min(max(px, zero), p[19]),
        min(max(py, zero), p[20]),
        cost if inside & facing else np.float32(np.inf),
        t / q2,
    )
