"""Compiled merge of the two maps of a pair, and reduction of all pairs: one core, no fast-math.

A sample is one int64 key (splat_kernels.py): inverse depth in the upper half, sigma in the lower, 0 =
blank; the greater key is the closer sample. Every sum is taken in the order of the keys, so a result
depends neither on threads nor on the order of pairs.

A function that is called per pixel must not call another with arrays inside a loop: numba then counts
references to them with atomic instructions, which took half the time of this module.
"""

import numpy as np
from numba import njit

BLANK = np.float32(-1)
_ZERO = np.float32(0)
# Samples are compared in groups of this many, which fill vector registers.
LANES = 8
_LOW_BITS = np.uint32(0xFFFFFFFF)


@njit(forceinline=True, nogil=True)
def _unpack(key):
    """Inverse depth (BLANK for 0) and sigma of a key."""
    t = np.uint32(key >> 32).view(np.float32)
    return (t if key > 0 else BLANK), np.uint32(_LOW_BITS - np.uint32(key)).view(np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def merge_maps(left, right, tolerance, layer):
    """One layer from the two maps of a pair.

    left, right: (h, W) int64 keys, blank afterwards;  layer: as they, changed in place
    Where both see one surface: their precision-weighted mean, with the smaller sigma, because one
    image pair made both. Elsewhere the closer.
    """
    height, width = left.shape
    squared = tolerance * tolerance
    for y in range(height):
        for x in range(width):
            left_key, right_key = left[y, x], right[y, x]
            left[y, x] = right[y, x] = 0
            a, sa = _unpack(left_key)
            b, sb = _unpack(right_key)
            va, vb = sa * sa, sb * sb
            agree = (a >= _ZERO) & (b >= _ZERO) & ((a - b) * (a - b) <= squared * (va + vb))
            mean = np.float32(b + (a - b) * (vb / (va + vb)))
            # The smaller sigma is the greater lower half.
            low = max(np.uint32(left_key), np.uint32(right_key))
            merged = np.int64(mean.view(np.uint32)) << 32 | np.int64(low)
            layer[y, x] = merged if agree else max(left_key, right_key)


@njit(cache=True, nogil=True)
def gather_sorted(layers, y, x, masks, keys, t, variance, cameras):
    """Samples of one pixel, the greatest key first: t, squared sigma, cameras. Returns their number.

    The last four are scratch, longer than the layers by `LANES` at least. Whatever follows the
    samples up to a multiple of `LANES` agrees with nothing: its variance is NaN. No branch depends on
    a sample, because nobody could predict it.
    """
    number = np.uint64(0)
    for p in range(layers.shape[0]):
        key = layers[p, y, x]
        keys[number] = key
        cameras[number] = masks[p]
        number += np.uint64(key > 0)
    count = np.int64(number)
    for k in range(LANES):
        keys[count + k] = 0
    for i in range(1, count):
        key, mask = keys[i], cameras[i]
        for j in range(i):
            held, its_mask = keys[j], cameras[j]
            closer = key > held
            keys[j], cameras[j] = (key if closer else held), (mask if closer else its_mask)
            key, mask = (held if closer else key), (its_mask if closer else mask)
        keys[i], cameras[i] = key, mask
    for first in range(0, count, LANES):
        for k in range(LANES):
            t[first + k], sigma = _unpack(keys[first + k])
            variance[first + k] = sigma * sigma
    return count


@njit(forceinline=True, nogil=True)
def _agree(difference, variances, squared):
    """Whether two samples differ by no more than the tolerance, squared, times their variances' sum."""
    return difference * difference <= squared * variances


@njit(cache=True, nogil=True)
def support(t, variance, cameras, count, index, squared):
    """Samples that agree with one: how many, and the cameras of their pairs."""
    number, union = 0, np.uint64(0)
    here, spread = t[index], variance[index]
    for first in range(0, count, LANES):
        for k in range(LANES):
            agree = _agree(t[first + k] - here, spread + variance[first + k], squared)
            number += agree
            union |= cameras[first + k] if agree else np.uint64(0)
    return number, union


@njit(cache=True, nogil=True)
def _num_bits(mask):
    """Bits set, counted in pairs, fours and bytes. Source: H. Warren, Hacker's Delight, 5-1."""
    pairs, fours = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
    mask = (mask & pairs) + (mask >> np.uint64(1) & pairs)
    mask = (mask & fours) + (mask >> np.uint64(2) & fours)
    mask = (mask + (mask >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64(mask * np.uint64(0x0101010101010101) >> np.uint64(56))


@njit(cache=True, nogil=True, error_model="numpy")
def _shift_to_mean(t, variance, cameras, count, seed, min_cameras, squared):
    """The consensus that starts at a sample and moves to the mean of what agrees with it, for as long as
    that lets more agree. Source: Y. Cheng, "Mean Shift, Mode Seeking, and Clustering", 1995.

    Returns its last place, the precision-weighted mean of what agrees with that, summed closest first, how
    many agree, and the cameras of their pairs.
    """
    spread = variance[seed]
    center, mean, number, union = t[seed], t[seed], 0, np.uint64(0)
    while True:
        total, weights = _ZERO, _ZERO
        agreeing, mask = 0, np.uint64(0)
        for j in range(count):
            difference = t[j] - mean
            agree = _agree(difference, spread + variance[j], squared)
            weight = spread / variance[j]
            total += weight * difference if agree else _ZERO
            weights += weight if agree else _ZERO
            agreeing += agree
            mask |= cameras[j] if agree else np.uint64(0)
        if agreeing <= number or _num_bits(mask) < min_cameras:
            return center, mean, number, union
        center, number, union = mean, agreeing, mask
        mean = max(mean + total / weights, _ZERO)


@njit(cache=True, nogil=True)
def _num_in_front(t, variance, index, squared):
    """Samples that are closer than one and do not agree with it."""
    number = 0
    for j in range(index):
        number += not _agree(t[j] - t[index], variance[j] + variance[index], squared)
    return number


@njit(cache=True, nogil=True)
def reduce_layers(layers, masks, tolerance, max_front, rules, wanted, chosen, cameras, counts):
    """The four estimates of every pixel from the layers of all pairs.

    layers: (P, h, W) int64 keys;  masks: (P,) uint64 cameras of each pair
    tolerance: float32, combined sigmas;  max_front: float32, samples in front per supporter
    wanted: (4,) bool consensus, closest, median, farthest
    rules: (3,) int64 min_pairs, min_cameras, pairs that the farthest needs
    chosen: (4, h, W) float32 inverse depth;  cameras: (4, h, W) uint64 of the pairs that agree with it
    counts: (2, h, W) uint8 pairs and distinct cameras of the consensus (0 = blank); all three changed

    The closest sample that enough pairs agree with lies before the surface, the farther the more pairs
    there are, so the consensus moves on from there to the mean.
    A sample that agrees with the consensus is a measurement of the same surface, so closest, median
    and farthest take the consensus' depth and cameras there. Elsewhere they are the sample itself.
    """
    num_pairs, height, width = layers.shape
    longest = num_pairs + 2 * LANES
    keys, near = np.empty(longest, np.int64), np.empty(longest, np.uint64)
    t, variance = np.empty(longest, np.float32), np.empty(longest, np.float32)
    squared = tolerance * tolerance
    for y in range(height):
        for x in range(width):
            count = gather_sorted(layers, y, x, masks, keys, t, variance, near)
            for e in range(4):
                chosen[e, y, x] = BLANK
                cameras[e, y, x] = np.uint64(0)
            counts[0, y, x] = counts[1, y, x] = np.uint8(0)
            if count == 0:
                continue
            seed = -1
            for i in range(count if count >= rules[0] else 0):
                number, mask = support(t, variance, near, count, i, squared)
                if number >= rules[0] and _num_bits(mask) >= rules[1]:
                    front = np.float32(_num_in_front(t, variance, i, squared))
                    seed = -1 if front > max_front * np.float32(number) else i
                    break
            center, shared, shared_mask = BLANK, BLANK, np.uint64(0)
            if seed >= 0:
                center, shared, number, shared_mask = _shift_to_mean(
                    t, variance, near, count, seed, rules[1], squared
                )
                if wanted[0]:
                    chosen[0, y, x], cameras[0, y, x] = shared, shared_mask
                    counts[0, y, x], counts[1, y, x] = np.uint8(min(number, 255)), _num_bits(shared_mask)
            for e in range(1, 4):
                if not wanted[e]:
                    continue
                index = 0 if e == 1 else ((count - 1) // 2 if e == 2 else count - 1)
                for i in range(count - 1 if e == 3 and rules[2] > 1 else -1, -1, -1):
                    if support(t, variance, near, count, i, squared)[0] >= rules[2]:
                        index = i
                        break
                if seed >= 0 and _agree(t[index] - center, variance[index] + variance[seed], squared):
                    chosen[e, y, x], cameras[e, y, x] = shared, shared_mask
                else:
                    chosen[e, y, x] = t[index]
                    cameras[e, y, x] = support(t, variance, near, count, index, squared)[1]
