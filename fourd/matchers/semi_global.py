"""Semi-global choice among hypotheses: costs of neighbours are added along paths, steps are penalised.

Hypotheses are disparities of a rectified pair, or planes of a sweep.

Source: H. Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI 2008.
"""

import numba
import numpy as np

_FAR = np.int16(20000)
_i16 = np.int16


def aggregate(cost: np.ndarray, small: int, large: int | np.ndarray) -> np.ndarray:
    """Costs summed along eight paths that end in each pixel (semi-global matching).

    cost: (H, W, D) uint8, or int16 of at most 4000 less the larger penalty
    small, large: penalty for a step of one hypothesis, and of more; the latter may be (4, H, W) int16,
    between each pixel and the one left of it, above, above to the left and above to the right
    Returns (H, W, D) int16
    """
    height, width = cost.shape[:2]
    jumps = large if isinstance(large, np.ndarray) else np.full((4, height, width), large, np.int16)
    return _aggregate(cost, _i16(small), jumps)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _aggregate(cost: np.ndarray, step: np.int16, jumps: np.ndarray) -> np.ndarray:
    """Arguments and result as `aggregate`."""
    height, width, count = cost.shape
    total = np.zeros((height, width, count), np.int16)
    # Paths of two rows, from up-left, up and up-right, with a blank column and hypothesis at both ends.
    paths = np.empty((3, 2, width + 2, count + 2), np.int16)
    line = np.empty((2, count + 2), np.int16)
    least = np.empty((3, 2, width + 2), np.int16)
    for forward in (True, False):
        paths[:] = 0
        least[:] = 0
        for array in (paths[..., 0], paths[..., count + 1]):
            array[:] = _FAR
        for i in range(height):
            y = i if forward else height - 1 - i
            _path_along(forward, cost[y], step, jumps[0, y], line, total[y])
            a, b = i % 2, (i + 1) % 2
            for k in range(3):
                # In the second pass the row before is the one below, and its up-left is down-right.
                shift = k - 1 if forward else 1 - k
                # A price stands at the lower one of two pixels.
                jump = jumps[1 if k == 1 else 2 + k // 2, y if forward else min(y + 1, height - 1)]
                _path_down(
                    paths[k, a],
                    least[k, a],
                    shift,
                    cost[y],
                    step,
                    jump,
                    0 if forward else shift,
                    paths[k, b],
                    least[k, b],
                    total[y],
                )
    return total


# Sums are cast to 16 bits at every step, or the compiler would calculate with 64.
@numba.njit(cache=True, nogil=True, error_model="numpy")
def _path_down(
    before: np.ndarray,
    least_before: np.ndarray,
    shift: int,
    cost: np.ndarray,
    small: np.int16,
    jumps: np.ndarray,
    jump_shift: int,
    path: np.ndarray,
    least: np.ndarray,
    total: np.ndarray,
) -> None:
    """A row of paths, from the row before and columns off by `shift`, to `path`, and added to `total`.

    jumps: (W,) penalties of columns off by `jump_shift`
    """
    width, count = cost.shape
    for x in range(width):
        from_column = x + 1 + shift
        lowest = least_before[from_column]
        jump = _i16(lowest + jumps[min(max(x + jump_shift, 0), width - 1)])
        least_here = _i16(32000)
        for d in range(count):
            step = _i16(min(before[from_column, d], before[from_column, d + 2]) + small)
            best = min(min(before[from_column, d + 1], jump), step)
            value = _i16(_i16(cost[x, d]) + _i16(best - lowest))
            path[x + 1, d + 1] = value
            total[x, d] = _i16(total[x, d] + value)
            least_here = min(least_here, value)
        least[x + 1] = least_here


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _path_along(
    forward: bool, cost: np.ndarray, small: np.int16, jumps: np.ndarray, line: np.ndarray, total: np.ndarray
) -> None:
    """A path along a row, added to `total`."""
    width, count = cost.shape
    line[:] = 0
    line[:, 0] = _FAR
    line[:, count + 1] = _FAR
    lowest = _i16(0)
    for i in range(width):
        x = i if forward else width - 1 - i
        here, there = i % 2, (i + 1) % 2
        jump = _i16(lowest + jumps[x if forward else min(x + 1, width - 1)])
        least = _i16(32000)
        for d in range(count):
            step = _i16(min(line[here, d], line[here, d + 2]) + small)
            best = min(min(line[here, d + 1], jump), step)
            value = _i16(_i16(cost[x, d]) + _i16(best - lowest))
            line[there, d + 1] = value
            total[x, d] = _i16(total[x, d] + value)
            least = min(least, value)
        lowest = least


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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def least_index(total: np.ndarray) -> np.ndarray:
    """(H, W) int16 index of the least cost, the first of equal ones."""
    height, width, count = total.shape
    best = np.zeros((height, width), np.int16)
    for y in range(height):
        for x in range(width):
            least = total[y, x, 0]
            for d in range(count):
                least = min(least, total[y, x, d])
            for d in range(count):
                if total[y, x, d] == least:
                    best[y, x] = d
                    break
    return best
