"""Speckles, ghosts and holes of the depth."""

import numpy as np
from numba import njit

# Inverse depths that differ by a smaller share are one surface, next to each other and across a hole.
ONE_SURFACE_NEARBY = 0.03
ONE_SURFACE = 0.1
# From this share of the median inverse depth on, towards infinity, differences are measured by it.
FAR = 0.25
# A pixel is a speckle if a smaller share of the pixels around it is on its surface.
SPECKLE_RADIUS_PX = 3
LEAST_NEIGHBOURS = 0.25
# What is seen at a smaller share of the sampled times may be something that passed.
LEAST_TIMES = 0.4


def drop_speckles(inverse_depth: np.ndarray, seen_by: np.ndarray) -> None:
    """Make those pixels unknown that share their surface with too few of their neighbours.

    inverse_depth: (H, W) float32, negative = unknown;  seen_by: (S, H, W) uint64; both changed in place
    Where matching has little to go by, wrong depths are lonely; beside an edge they are what stays of
    a surface that no two cameras see.
    """
    lonely = np.zeros(inverse_depth.shape, bool)
    known = inverse_depth[inverse_depth >= 0]
    if known.size:
        _find_lonely(inverse_depth, np.float32(FAR * np.median(known)), lonely)
    inverse_depth[lonely] = -1
    seen_by[:, lonely] = 0


def drop_ghosts(inverse_depth: np.ndarray, seen_by: np.ndarray) -> int:
    """Make those parts unknown that few of the sampled times show and that continue nothing around them.

    inverse_depth: (H, W) float32, negative = unknown;  seen_by: (S, H, W) uint64; both changed in place
    Where nothing matches what stands still, all that is ever seen is what passes before it. What stands
    still and was hidden for most of the time is on one surface with what is known around it, along half of
    that border at least. A part with nothing known around it stays. Returns the number of pixels.
    """
    rare = (inverse_depth >= 0) & (np.count_nonzero(seen_by, axis=0) < LEAST_TIMES * len(seen_by))
    ghosts = np.zeros(rare.shape, bool)
    if rare.any():
        far = np.float32(FAR * np.median(inverse_depth[inverse_depth >= 0]))
        _find_apart(inverse_depth, rare, far, ghosts)
    inverse_depth[ghosts] = -1
    seen_by[:, ghosts] = 0
    return int(ghosts.sum())


def fill_holes(inverse_depth: np.ndarray, seen_by: np.ndarray, widest_px: int) -> np.ndarray:
    """Close holes from what is known on both sides.

    inverse_depth: (H, W) float32, negative = unknown;  seen_by: (S, H, W) uint64 cameras that see it;
    both changed in place;  widest_px: of a hole that is closed, between what is known on both sides
    A hole between two known pixels of its row or column, whichever are nearer to each other, takes the
    plane through them where they are one surface, else the farther of the two: a gap beside an edge
    belongs to what the edge hides. It takes over the cameras of the one it continues. A hole with
    something known on one side only stays.
    Returns (H, W) bool, the pixels that were filled.
    """
    source = np.full(inverse_depth.shape, -1, np.int64)
    if widest_px > 0:
        _fill(inverse_depth.copy(), inverse_depth >= 0, widest_px, inverse_depth, source)
    filled = source >= 0
    seen_by[:, filled] = seen_by.reshape(len(seen_by), -1)[:, source[filled]]
    return filled


@njit(cache=True, nogil=True)
def _find_lonely(inverse_depth, far, lonely):
    height, width = inverse_depth.shape
    for y in range(height):
        top, bottom = max(y - SPECKLE_RADIUS_PX, 0), min(y + SPECKLE_RADIUS_PX + 1, height)
        for x in range(width):
            here = inverse_depth[y, x]
            if here < 0:
                continue
            left, right = max(x - SPECKLE_RADIUS_PX, 0), min(x + SPECKLE_RADIUS_PX + 1, width)
            agreeing, difference = 0, ONE_SURFACE_NEARBY * max(here, far)
            for v in range(top, bottom):
                for u in range(left, right):
                    agreeing += abs(inverse_depth[v, u] - here) <= difference
            lonely[y, x] = agreeing < LEAST_NEIGHBOURS * (bottom - top) * (right - left)


@njit(cache=True, nogil=True)
def _find_apart(inverse_depth, rare, far, apart):
    """Connected parts of `rare` whose border is mostly with other surfaces, into `apart`."""
    height, width = inverse_depth.shape
    part = np.zeros((height, width), np.int64)
    members = np.empty((rare.sum(), 2), np.int64)
    number = 0
    for first_y in range(height):
        for first_x in range(width):
            if not rare[first_y, first_x] or part[first_y, first_x] > 0:
                continue
            number += 1
            part[first_y, first_x] = number
            members[0] = first_y, first_x
            size, visited, agreeing, others = 1, 0, 0, 0
            while visited < size:
                y, x = members[visited]
                visited += 1
                for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                    v, u = y + dy, x + dx
                    if v < 0 or u < 0 or v >= height or u >= width:
                        continue
                    here, there = inverse_depth[y, x], inverse_depth[v, u]
                    if there < 0 or part[v, u] == number:
                        continue
                    is_one = abs(there - here) <= ONE_SURFACE_NEARBY * max(here, there, far)
                    if is_one and rare[v, u]:
                        part[v, u] = number
                        members[size] = v, u
                        size += 1
                    else:
                        agreeing += is_one
                        others += not is_one
            if agreeing < others:
                for i in range(size):
                    apart[members[i, 0], members[i, 1]] = True


@njit(cache=True, nogil=True)
def _reach(known, y, x, dy, dx, reach):
    """Steps to the first known pixel in a direction; 0 if there is none within reach."""
    for step in range(1, reach + 1):
        v, u = y + dy * step, x + dx * step
        if v < 0 or u < 0 or v >= known.shape[0] or u >= known.shape[1]:
            return 0
        if known[v, u]:
            return step
    return 0


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(before_filling, known, widest, out, source):
    height, width = known.shape
    for y in range(height):
        for x in range(width):
            if known[y, x]:
                continue
            shortest = widest + 2
            for dy, dx in ((0, 1), (1, 0)):
                before, after = _reach(known, y, x, -dy, -dx, widest), _reach(known, y, x, dy, dx, widest)
                if before == 0 or after == 0 or before + after >= shortest:
                    continue
                shortest = before + after
                a = before_filling[y - dy * before, x - dx * before]
                b = before_filling[y + dy * after, x + dx * after]
                is_one = abs(a - b) <= ONE_SURFACE * max(a, b)
                between = a + (b - a) * np.float32(before) / np.float32(before + after)
                out[y, x] = between if is_one else min(a, b)
                takes_first = before <= after if is_one else a < b
                step = -before if takes_first else after
                source[y, x] = (y + dy * step) * width + x + dx * step
