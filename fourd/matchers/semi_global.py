"""Semi-global choice among hypotheses: costs of neighbours are added along paths, steps are penalised.

Hypotheses are disparities of a rectified pair, or planes of a sweep.

Source: H. Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI 2008.
"""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _step_along_path(
    before: np.ndarray, cost: np.ndarray, small: int, large: int, path: np.ndarray, total: np.ndarray
) -> None:
    """One pixel of one path: `path` from the pixel before it, added to `total`.

    before, path: (D + 2,) int16 with a large number at both ends;  cost: (D,) uint8
    """
    count = cost.size
    least = before[1]
    for d in range(2, count + 1):
        least = min(least, before[d])
    jump = least + large
    for d in range(count):
        best = min(min(before[d + 1], jump), min(before[d], before[d + 2]) + small)
        path[d + 1] = cost[d] + best - least
        total[d] += path[d + 1]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def aggregate(cost: np.ndarray, small: int, large: int) -> np.ndarray:
    """Costs summed along eight paths that end in each pixel (semi-global matching).

    cost: (H, W, D) uint8;  small, large: penalty for a step of one hypothesis, and of more
    Returns (H, W, D) int16
    """
    height, width, count = cost.shape
    total = np.zeros((height, width, count), np.int16)
    far = np.int16(20000)
    for reverse in (False, True):
        # Paths of the row above, from up-left, up and up-right, with a blank column at both ends.
        above = np.zeros((3, width + 2, count + 2), np.int16)
        here = np.zeros((3, width + 2, count + 2), np.int16)
        along = np.zeros((2, count + 2), np.int16)
        for array in (above, here):
            array[:, :, 0] = far
            array[:, :, count + 1] = far
        along[:, 0] = far
        along[:, count + 1] = far
        for i in range(height):
            row = height - 1 - i if reverse else i
            along[:, 1 : count + 1] = 0
            for j in range(width):
                column = width - 1 - j if reverse else j
                at, sums = cost[row, column], total[row, column]
                _step_along_path(along[j % 2], at, small, large, along[(j + 1) % 2], sums)
                for path in range(3):
                    # Mirrored, up-left is down-right: the offset holds in scan order.
                    _step_along_path(above[path, j + path], at, small, large, here[path, j + 1], sums)
            above, here = here, above
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def best_hypothesis(total: np.ndarray) -> np.ndarray:
    """(H, W) float32 index of the least cost, a parabola through its neighbours; NaN at both ends."""
    height, width, count = total.shape
    best = np.full((height, width), np.float32(np.nan), np.float32)
    for row in range(height):
        for column in range(width):
            at = total[row, column]
            d = 0
            for i in range(1, count):
                if at[i] < at[d]:
                    d = i
            if 0 < d < count - 1:
                before, after = np.float32(at[d - 1]), np.float32(at[d + 1])
                curvature = before + after - 2 * np.float32(at[d])
                shift = (before - after) / (2 * curvature) if curvature > 0 else np.float32(0)
                best[row, column] = d + shift
    return best
