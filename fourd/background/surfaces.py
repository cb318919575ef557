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
from fourd.fuse.geometry import DisparityMap, PairFrame, maps_of_pair, source_rows
from fourd.fuse.options import MAX_CAMERAS, FuseOptions
from fourd.fuse.reduce_kernels import merge_maps
from fourd.fuse.splat_kernels import splat_map

# Surfaces kept per pixel and time: what moves, what stands still, and one wrong match.
NUM_SURFACES = 3

_LOW_BITS = np.uint32(0xFFFFFFFF)


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
    width, height = target.size
    layers = np.zeros((len(pairs), rows[1] - rows[0], width), np.int64)
    keys = np.zeros((2, *layers.shape[1:]), np.int64)
    tolerance = np.float32(options.tolerance)
    masks = []
    for pair, layer in zip(pairs, layers, strict=True):
        for side, disparity_map in enumerate(maps_of_pair(pair, target)):
            _splat(disparity_map, rows, height, options.footprint, keys[side])
        merge_maps(keys[0], keys[1], tolerance, layer)
        masks.append(1 << names.index(pair.left) | 1 << names.index(pair.right))
    cluster_layers(
        layers, np.array(masks, np.uint64), tolerance, into.inverse_depth[time], into.variance[time],
        into.cameras[time], into.num_pairs[time],
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


def _splat(m: DisparityMap, rows: tuple[int, int], height: int, footprint: float, keys: np.ndarray) -> None:
    scalars = np.array([m.disparity_at_infinity, m.inverse_depth_per_px, m.sigma_px], np.float32)
    splat_map(
        m.disparity, m.confidence, m.A, m.b, scalars, source_rows(m, rows, height), rows[0],
        np.float32(footprint), keys,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _gather(layers, y, x, masks, keys, t, variance, cameras):
    """Samples of one pixel, the closest first: inverse depth, squared sigma, cameras. Returns their number.

    A key holds the inverse depth in its upper half and the complement of sigma in the lower
    (fuse/splat_kernels.py); 0 is blank.
    """
    count = 0
    for p in range(layers.shape[0]):
        key = layers[p, y, x]
        if key == 0:
            continue
        at = count
        while at > 0 and keys[at - 1] < key:
            keys[at], cameras[at] = keys[at - 1], cameras[at - 1]
            at -= 1
        keys[at], cameras[at] = key, masks[p]
        count += 1
    for i in range(count):
        t[i] = np.uint32(keys[i] >> 32).view(np.float32)
        sigma = np.uint32(_LOW_BITS - np.uint32(keys[i])).view(np.float32)
        variance[i] = sigma * sigma
    return count


@njit(cache=True, nogil=True)
def _best_supported(t, variance, count, squared):
    """Sample that most of the samples agree with, the closest of equals; -1 if none is left."""
    best, most, left = -1, 0, 0
    for i in range(count):
        left += t[i] >= 0
    for i in range(count):
        if t[i] < 0 or most == left:
            continue
        number = 0
        for j in range(count):
            difference = t[j] - t[i]
            agree = difference * difference <= squared * (variance[i] + variance[j])
            number += agree & (t[j] >= 0)
        if number > most:
            best, most = i, number
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def cluster_layers(layers, masks, tolerance, inverse_depth, variance, cameras, num_pairs):
    """The surfaces of every pixel from the layers of all pairs of one time.

    layers: (P, h, W) int64 keys;  masks: (P,) uint64 cameras of each pair
    tolerance: float32, largest difference within a surface, in combined sigmas
    inverse_depth, variance, cameras, num_pairs: (K, h, W), changed, as in `Surfaces`; start blank

    Surfaces are taken in turn, the best supported first, with all samples that agree with it. Its
    variance is that of one typical sample: errors of pairs that share cameras are not independent.
    """
    longest = layers.shape[0]
    keys, near = np.empty(longest, np.int64), np.empty(longest, np.uint64)
    t, spread = np.empty(longest, np.float32), np.empty(longest, np.float32)
    squared = tolerance * tolerance
    for y in range(layers.shape[1]):
        for x in range(layers.shape[2]):
            count = _gather(layers, y, x, masks, keys, t, spread, near)
            for k in range(inverse_depth.shape[0]):
                seed = _best_supported(t, spread, count, squared)
                if seed < 0:
                    break
                here, width = t[seed], spread[seed]
                number, union = 0, np.uint64(0)
                total, weights = np.float32(0), np.float32(0)
                for j in range(count):
                    difference = t[j] - here
                    if t[j] >= 0 and difference * difference <= squared * (width + spread[j]):
                        total += width / spread[j] * difference
                        weights += width / spread[j]
                        number += 1
                        union |= near[j]
                        t[j] = np.float32(-1)
                inverse_depth[k, y, x] = max(here + total / weights, np.float32(0))
                variance[k, y, x] = width * np.float32(number) / weights
                cameras[k, y, x] = union
                num_pairs[k, y, x] = np.uint8(min(number, 255))
