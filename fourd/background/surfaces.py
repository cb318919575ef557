"""What one sampled time says about a target: the surfaces that its pairs see at every pixel.

The layers of all pairs would take memory with their number. A pixel keeps the few surfaces that most
pairs agree on.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numba import njit

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.fuse.cpu import CpuBackend
from fourd.fuse.geometry import PairFrame, make_sources, maps_of_pair
from fourd.fuse.options import MAX_CAMERAS, FuseOptions
from fourd.fuse.reduce_kernels import LANES, gather_sorted, support

# Surfaces kept per pixel and time: what moves, what stands still, and one wrong match.
NUM_SURFACES = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Surfaces:
    """Surfaces of S times in rows of a target; K per pixel and time, the best supported first.

    inverse_depth, variance: (S, K, h, W) float32, target frame; inverse depth -1 = none
    cameras: (S, K, h, W) uint64 cameras that see it, by bit;  num_pairs: (S, K, h, W) uint8
    """

    inverse_depth: np.ndarray
    variance: np.ndarray
    cameras: np.ndarray
    num_pairs: np.ndarray

    @classmethod
    def blank(cls, num_times: int, rows: int, width: int) -> "Surfaces":
        shape = (num_times, NUM_SURFACES, rows, width)
        return cls(
            np.full(shape, -1, np.float32), np.zeros(shape, np.float32),
            np.zeros(shape, np.uint64), np.zeros(shape, np.uint8),
        )  # fmt: skip


# Of all the arrays above.
BYTES_PER_TIME = NUM_SURFACES * (4 + 4 + 8 + 1)


def find_surfaces(
    target: Camera,
    pairs: Sequence[PairFrame],
    names: Sequence[str],
    options: FuseOptions,
    rows: tuple[int, int],
    into: Surfaces,
    time: int,
) -> None:
    """Surfaces of one time in rows [first, last) of the target, into entry `time`.

    names: cameras in the order of their bits
    Raises InputError for more than 64 cameras, or a pair with another camera.
    """
    _check_cameras(pairs, names)
    backend = CpuBackend(make_sources(target, {}, {}), options, target.size, len(pairs), rows[1] - rows[0])
    masks = []
    for i, pair in enumerate(pairs):
        backend.layer(i, maps_of_pair(pair, target), rows)
        masks.append(1 << names.index(pair.left) | 1 << names.index(pair.right))
    cluster_layers(
        backend.layers, np.array(masks, np.uint64), np.float32(options.tolerance), into.inverse_depth[time],
        into.variance[time], into.cameras[time], into.num_pairs[time],
    )  # fmt: skip


def _check_cameras(pairs: Sequence[PairFrame], names: Sequence[str]) -> None:
    if len(names) > MAX_CAMERAS:
        raise InputError(
            f"a mask holds {MAX_CAMERAS} cameras per pixel, got {len(names)} cameras: leave cameras out of "
            "the scene"
        )
    for pair in pairs:
        for name in (pair.left, pair.right):
            if name not in names:
                raise InputError(
                    f"pair {pair.left}-{pair.right}: expected pictures of {name}, got those of "
                    f"{', '.join(names)}: give every camera of the pairs with --films"
                )


@njit(cache=True, nogil=True, error_model="numpy")
def cluster_layers(layers, masks, tolerance, inverse_depth, variance, cameras, num_pairs):
    """The surfaces of every pixel from the layers of all pairs of one time.

    layers: (P, h, W) int64 keys;  masks: (P,) uint64 cameras of each pair
    tolerance: float32, largest difference within a surface, in combined sigmas
    inverse_depth, variance, cameras, num_pairs: (K, h, W), changed, as in `Surfaces`; start blank

    Surfaces are taken in turn, the best supported first, with all samples that agree with it. Its
    variance is that of one typical sample: errors of pairs that share cameras are not independent.
    """
    longest = layers.shape[0] + 2 * LANES
    keys, near = np.empty(longest, np.int64), np.empty(longest, np.uint64)
    t, spread = np.empty(longest, np.float32), np.empty(longest, np.float32)
    squared = tolerance * tolerance
    for y in range(layers.shape[1]):
        for x in range(layers.shape[2]):
            count = gather_sorted(layers, y, x, masks, keys, t, spread, near)
            left = count
            for k in range(inverse_depth.shape[0] if count else 0):
                best, number, union = -1, 0, np.uint64(0)
                for i in range(count):
                    # What is taken has no variance, and agrees with nothing.
                    if number == left or np.isnan(spread[i]):
                        continue
                    agreeing, cameras_of = support(t, spread, near, count, i, squared)
                    if agreeing > number:
                        best, number, union = i, agreeing, cameras_of
                here, width = t[best], spread[best]
                total, weights = np.float32(0), np.float32(0)
                for j in range(count):
                    difference = t[j] - here
                    if difference * difference <= squared * (width + spread[j]):
                        total += width / spread[j] * difference
                        weights += width / spread[j]
                        spread[j] = np.nan
                inverse_depth[k, y, x] = max(here + total / weights, np.float32(0))
                variance[k, y, x] = width * np.float32(number) / weights
                cameras[k, y, x] = union
                num_pairs[k, y, x] = np.uint8(min(number, 255))
                left -= number
                if left == 0:
                    break
