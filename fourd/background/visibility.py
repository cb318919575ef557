"""Which cameras cannot see a point of the background because another part of it stands before it."""

from collections.abc import Sequence

import numpy as np
from numba import njit

from fourd.fuse.colour_kernels import place_point

# Inverse depths that differ by a smaller share are one surface.
ONE_SURFACE = 0.05


def find_hidden(
    x: np.ndarray,
    y: np.ndarray,
    inverse_depth: np.ndarray,
    occluders: tuple[np.ndarray, np.ndarray, np.ndarray],
    params: np.ndarray,
    sizes: Sequence[tuple[int, int]],
) -> np.ndarray:
    """(M,) uint64 cameras, by bit, in which a known surface covers each of M points.

    x, y, inverse_depth: (M,) float32 points of the target;  occluders: the same of known surfaces
    params: (C, 26) float32, `pack_cameras`;  sizes: (width, height) px of the cameras
    Known surfaces are z-tested into every picture, four pixels each so that no crack is left.
    """
    hidden = np.zeros(len(x), np.uint64)
    for c, (width, height) in enumerate(sizes):
        nearest = np.zeros((height, width), np.float32)
        _draw(*occluders, params[c], nearest)
        _test(x, y, inverse_depth, params[c], nearest, np.uint64(1 << c), hidden)
    return hidden


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(xs, ys, inverse_depth, p, nearest):
    for i in range(xs.shape[0]):
        px, py, cost, here = place_point(p, xs[i], ys[i], inverse_depth[i])
        if cost == np.inf:
            continue
        u, v = int(px), int(py)
        for row in range(v, min(v + 2, nearest.shape[0])):
            for column in range(u, min(u + 2, nearest.shape[1])):
                nearest[row, column] = max(nearest[row, column], here)


@njit(cache=True, nogil=True, error_model="numpy")
def _test(xs, ys, inverse_depth, p, nearest, bit, hidden):
    for i in range(xs.shape[0]):
        px, py, cost, here = place_point(p, xs[i], ys[i], inverse_depth[i])
        if cost == np.inf:
            continue
        covering = nearest[int(py + np.float32(0.5)), int(px + np.float32(0.5))]
        if covering * np.float32(1 - ONE_SURFACE) > here:
            hidden[i] |= bit
