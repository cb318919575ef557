"""Compiled merge of the two maps of a pair, and reduction of all pairs: one core, no fast-math.

A sample is one int64 key (splat_kernels.py): inverse depth in the upper half, sigma in the lower, 0 =
blank; the greater key is the closer sample. Every sum is taken in the order of the keys, so a result
depends neither on threads nor on the order of pairs.
"""

import numpy as np
from numba import njit

BLANK = np.float32(-1)
_ZERO = np.float32(0)
_LOW_BITS = np.uint32(0xFFFFFFFF)


@njit(forceinline=True, nogil=True)
def _unpack(key):
    """Inverse depth (BLANK for 0) and sigma of a key."""
    t = np.uint32(key >> 32).view(np.float32)
    return (t if key > 0 else BLANK), np.uint32(_LOW_BITS - np.uint32(key)).view(np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def merge_maps(left, right, tolerance, layer):
    """One layer from the two maps of a pair.

    left, right: (h, W) int64 keys;  layer: as they, changed in place
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
            mean = np.float32(b + (a - b) * (vb / (va + vb)))
            # The smaller sigma is the greater lower half.
            low = max(np.uint32(left[y, x]), np.uint32(right[y, x]))
            merged = np.int64(mean.view(np.uint32)) << 32 | np.int64(low)
            layer[y, x] = merged if agree else max(left[y, x], right[y, x])


@njit(cache=True, nogil=True)
def _gather_sorted(layers, y, x, masks, keys, t, variance, cameras):
    """Samples of one pixel, the greatest key first: t, squared sigma, cameras. Returns their number.

    The last four are scratch, one longer than the layers. No branch depends on a sample, because
    nobody could predict it.
    """
    number = np.uint64(0)
    for p in range(layers.shape[0]):
        key = layers[p, y, x]
        keys[number] = key
        cameras[number] = masks[p]
        number += np.uint64(key > 0)
    count = np.int64(number)
    for i in range(1, count):
        key, mask = keys[i], cameras[i]
        for j in range(i):
            held, its_mask = keys[j], cameras[j]
            closer = key > held
            keys[j], cameras[j] = (key if closer else held), (mask if closer else its_mask)
            key, mask = (held if closer else key), (its_mask if closer else mask)
        keys[i], cameras[i] = key, mask
    for i in range(count):
        t[i], sigma = _unpack(keys[i])
        variance[i] = sigma * sigma
    return count


@njit(forceinline=True, nogil=True)
def _agree(t, variance, i, j, squared):
    """Whether two samples differ by no more than the tolerance, squared, times their variance."""
    difference = t[j] - t[i]
    return difference * difference <= squared * (variance[i] + variance[j])


@njit(cache=True, nogil=True)
def _support(t, variance, cameras, count, index, squared):
    """Samples that agree with one: how many, how many of them are closer, the cameras of their pairs."""
    number = closer = 0
    union = np.uint64(0)
    for j in range(count):
        agree = _agree(t, variance, index, j, squared)
        number += agree
        closer += agree & (j < index)
        union |= cameras[j] if agree else np.uint64(0)
    return number, closer, union


@njit(cache=True, nogil=True)
def _num_bits(mask):
    """Bits set, counted in pairs, fours and bytes. Source: H. Warren, Hacker's Delight, 5-1."""
    pairs, fours = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
    mask = (mask & pairs) + (mask >> np.uint64(1) & pairs)
    mask = (mask & fours) + (mask >> np.uint64(2) & fours)
    mask = (mask + (mask >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64(mask * np.uint64(0x0101010101010101) >> np.uint64(56))


@njit(cache=True, nogil=True, error_model="numpy")
def _fused(t, variance, count, index, squared):
    """Precision-weighted mean of the samples that agree with one, summed closest first."""
    total, weights = _ZERO, _ZERO
    for j in range(count):
        if _agree(t, variance, index, j, squared):
            weight = variance[index] / variance[j]
            total += weight * (t[j] - t[index])
            weights += weight
    return max(t[index] + total / weights, _ZERO)


@njit(cache=True, nogil=True)
def _find_consensus(t, variance, cameras, count, squared, max_front, rules):
    """The closest sample that enough pairs and cameras support, -1 if there is none or it is hidden.

    Returns its index, the number of pairs and their cameras.
    """
    for i in range(count if count >= rules[0] else 0):
        number, closer, union = _support(t, variance, cameras, count, i, squared)
        if number >= rules[0] and _num_bits(union) >= rules[1]:
            in_front = np.float32(i - closer)
            return (-1 if in_front > max_front * np.float32(number) else i), number, union
    return -1, 0, np.uint64(0)


@njit(cache=True, nogil=True)
def _find_farthest(t, variance, cameras, count, squared, rules):
    """The farthest sample that enough pairs support; the farthest of all if there is none."""
    if rules[2] == 1:
        return count - 1
    for i in range(count - 1, -1, -1):
        if _support(t, variance, cameras, count, i, squared)[0] >= rules[2]:
            return i
    return count - 1


@njit(cache=True, nogil=True)
def reduce_layers(layers, masks, tolerance, max_front, rules, wanted, chosen, cameras, counts):
    """The four estimates of every pixel from the layers of all pairs.

    layers: (P, h, W) int64 keys;  masks: (P,) uint64 cameras of each pair
    tolerance: float32, combined sigmas;  max_front: float32, samples in front per supporter
    wanted: (4,) bool consensus, closest, median, farthest
    rules: (3,) int64 min_pairs, min_cameras, pairs that the farthest needs
    chosen: (4, h, W) float32 inverse depth;  cameras: (4, h, W) uint64 of the pairs that agree with it
    counts: (2, h, W) uint8 pairs and distinct cameras of the consensus (0 = blank); all three changed

    A sample that agrees with the consensus is a measurement of the same surface, so closest, median
    and farthest take the consensus' depth and cameras there. Elsewhere they are the sample itself.
    """
    num_pairs, height, width = layers.shape
    keys, near = np.empty(num_pairs + 1, np.int64), np.empty(num_pairs + 1, np.uint64)
    t, variance = np.empty(num_pairs + 1, np.float32), np.empty(num_pairs + 1, np.float32)
    squared = tolerance * tolerance
    for y in range(height):
        for x in range(width):
            count = _gather_sorted(layers, y, x, masks, keys, t, variance, near)
            for e in range(4):
                chosen[e, y, x] = BLANK
                cameras[e, y, x] = np.uint64(0)
            counts[0, y, x] = counts[1, y, x] = np.uint8(0)
            if count == 0:
                continue
            seed, number, shared_mask = _find_consensus(t, variance, near, count, squared, max_front, rules)
            shared = BLANK
            if seed >= 0:
                shared = _fused(t, variance, count, seed, squared)
                if wanted[0]:
                    chosen[0, y, x], cameras[0, y, x] = shared, shared_mask
                    counts[0, y, x], counts[1, y, x] = np.uint8(min(number, 255)), _num_bits(shared_mask)
            for e in range(1, 4):
                if not wanted[e]:
                    continue
                index = 0 if e == 1 else (count - 1) // 2
                if e == 3:
                    index = _find_farthest(t, variance, near, count, squared, rules)
                if seed >= 0 and _agree(t, variance, index, seed, squared):
                    chosen[e, y, x], cameras[e, y, x] = shared, shared_mask
                else:
                    chosen[e, y, x] = t[index]
                    cameras[e, y, x] = _support(t, variance, near, count, index, squared)[2]
