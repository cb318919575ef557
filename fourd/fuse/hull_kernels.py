"""Compiled loops of the visual hull: march along target rays, compare patches inside, smooth. One core.

A point on the ray of target pixel (u, v) at inverse depth s is at q = A @ [u, v, 1] + s * b on the image
plane of a source (homogeneous), and at lens(q) in its picture. A row of `views` is one of
`geometry.pack_cameras`, then the pixels per unit of the image plane at most. Pictures of all sources lie
one after the other in flat arrays, so that one compiled function serves any number of them; `starts` says
where each begins.
"""

import numpy as np
from numba import njit

from fourd.silhouettes.options import BACKGROUND, MOVING, UNKNOWN

# Of a point that is in no picture: no class of a mask.
UNSEEN = 1
MAX_INTERVALS = 4
_NEVER = np.float32(np.inf)
_ONE = np.float32(1)
_ZERO = np.float32(0)
_HALF = np.float32(0.5)
# From a point in one pixel to the nearest point of another, less than between their centres by at most
# this, px; distances are rounded to 1/16.
_PIXEL_DIAGONAL = np.float32(1.45)


@njit(inline="always")
def ray_in_source(views, c, u, v):
    """Direction of a target ray on the image plane of a source, homogeneous."""
    return (
        views[c, 0] * u + views[c, 1] * v + views[c, 2],
        views[c, 3] * u + views[c, 4] * v + views[c, 5],
        views[c, 6] * u + views[c, 7] * v + views[c, 8],
    )


@njit(inline="always")
def pixel_in_source(views, c, x, y):
    """Lens and intrinsics: image-plane coordinates at z = 1 to px."""
    k1, k2, p1, p2, k3 = views[c, 21], views[c, 22], views[c, 23], views[c, 24], views[c, 25]
    r2 = x * x + y * y
    radial = _ONE + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + (p1 + p1) * x * y + p2 * (r2 + (x * x + x * x))
    yd = y * radial + p1 * (r2 + (y * y + y * y)) + (p2 + p2) * x * y
    return views[c, 12] * xd + views[c, 13] * yd + views[c, 14], views[c, 15] * yd + views[c, 16], r2


@njit(cache=True, nogil=True, error_model="numpy")
def _look(views, c, classes, distances, start, ray, s, radius):
    """Class of a point in one silhouette, and by how much s may fall before the class can change.

    ray: of `ray_in_source`
    radius: half the diagonal of a block of target pixels that shall all be of the class, 0 for one; what
        is neither all background nor all unseen counts as moving
    Source of the second: the distance to the next pixel of another class bounds how far the point may
    move in the picture (sphere tracing, J. Hart 1996), and the motion of a point along a line is a ratio
    of linear functions of s.
    """
    e0, e1, e2 = views[c, 9], views[c, 10], views[c, 11]
    q2 = ray[2] + s * e2
    if q2 <= _ZERO:
        # Behind the camera until s = -d2 / e2; there for ever where that is not below.
        ahead = ray[2] + radius * (abs(views[c, 6]) + abs(views[c, 7]))
        seen = MOVING if q2 + (ahead - ray[2]) > _ZERO else UNSEEN
        return seen, (max(s + ahead / e2, _ZERO) if ahead > _ZERO else _NEVER)
    inverse = _ONE / q2
    x, y = (ray[0] + s * e0) * inverse, (ray[1] + s * e1) * inverse
    px, py, r2 = pixel_in_source(views, c, x, y)
    right, bottom, scale = views[c, 19] + _HALF, views[c, 20] + _HALF, views[c, 26]
    reach, least = _ONE, _HALF
    if r2 > views[c, 17]:
        # Beyond the lens' range pixels mean nothing; the image plane does.
        seen = UNSEEN
        reach = (np.sqrt(r2) - np.sqrt(views[c, 17])) * scale
    elif (px >= -_HALF) & (px < right) & (py >= -_HALF) & (py < bottom):
        at = start + int(py + _HALF) * (int(views[c, 19]) + 1) + int(px + _HALF)
        seen = classes[at]
        reach = distances[at] - _PIXEL_DIAGONAL
    else:
        seen = UNSEEN
        reach = max(max(-_HALF - px, px - right), max(-_HALF - py, py - bottom))
    if radius > _ZERO:
        across = (views[c, 0] - x * views[c, 6]) ** 2 + (views[c, 3] - y * views[c, 6]) ** 2
        along = (views[c, 1] - x * views[c, 7]) ** 2 + (views[c, 4] - y * views[c, 7]) ** 2
        # As far again as a block reaches, so that steps of that length miss nothing between them.
        least = max(radius * scale * np.sqrt(across + along) * inverse, _HALF)
        reach -= least + least
        if (seen == UNKNOWN) | (reach <= _ZERO):
            seen = MOVING
    reach = max(reach, least) / scale
    speed = np.sqrt((e0 - x * e2) ** 2 + (e1 - y * e2) ** 2)
    denominator = speed + reach * e2
    return seen, (reach * q2 / denominator if denominator > _ZERO else _NEVER)


@njit(cache=True, nogil=True)
def _nth_largest(values, count, n):
    """The n-th largest (0 is the largest) of the first `count` values, which are sorted in place."""
    for i in range(1, count):
        value, at = values[i], i
        while at > 0 and values[at - 1] < value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value
    return values[n]


@njit(cache=True, nogil=True, error_model="numpy")
def _poll(views, classes, distances, starts, rays, s, radius, rules, steps):
    """Whether a point is inside the hull, by how much s may fall before that can change, and its votes.

    rays: (C, 3), directions of the target ray in every source;  steps: (2, C) scratch
    """
    min_silhouettes, max_dissent = rules
    carving, moving, others = 0, 0, 0
    soonest = _NEVER
    for c in range(len(views)):
        ray = rays[c, 0], rays[c, 1], rays[c, 2]
        seen, step = _look(views, c, classes, distances, starts[c], ray, s, radius)
        soonest = min(soonest, step)
        if seen == BACKGROUND:
            steps[0, carving] = step
            carving += 1
        if seen == MOVING:
            moving += 1
        else:
            steps[1, others] = step
            others += 1
    if carving > max_dissent:
        return False, _nth_largest(steps[0], carving, max_dissent), moving
    if moving < min_silhouettes:
        # As many of the others as are missing have to change.
        missing = min_silhouettes - moving
        enough = others >= missing
        return False, _nth_largest(steps[1], others, others - missing) if enough else _NEVER, moving
    return True, soonest, moving


@njit(cache=True, nogil=True, error_model="numpy")
def carve_rays(views, classes, distances, starts, grid, ranges, least, rules, intervals, votes):
    """Intervals of target rays inside the hull, nearest first.

    views: (C, 27) float32;  classes: flat uint8;  distances: flat float32, px to the next pixel of another
    class or beyond the border;  starts: (C,)
    grid: position of the first ray, distance between rays and `radius` of `_look`, px
    ranges: (H, W, 2) float32, greatest and least inverse depth of every ray, NaN = not wanted
    least: step of inverse depth;  rules: min_silhouettes, max_dissent
    intervals: (H, W, MAX_INTERVALS, 2) float32, filled with the greatest and least inverse depth
    votes: (H, W) uint8, filled with the silhouettes that hold the first point of the hull
    """
    count = len(views)
    rays, steps = np.empty((count, 3), np.float32), np.empty((2, count), np.float32)
    origin, spacing, radius = grid
    for row in range(ranges.shape[0]):
        for column in range(ranges.shape[1]):
            s, low = ranges[row, column, 0], ranges[row, column, 1]
            if not s >= _ZERO:
                continue
            for c in range(count):
                u, v = origin + spacing * np.float32(column), origin + spacing * np.float32(row)
                rays[c, 0], rays[c, 1], rays[c, 2] = ray_in_source(views, c, u, v)
            found, inside = 0, False
            while s >= low and found < MAX_INTERVALS:
                held, step, moving = _poll(views, classes, distances, starts, rays, s, radius, rules, steps)
                if held and not inside:
                    intervals[row, column, found, 0] = s
                    if found == 0:
                        votes[row, column] = moving
                if inside and not held:
                    intervals[row, column, found, 1] = s
                    found += 1
                inside = held
                s -= max(step, least)
            if inside:
                intervals[row, column, found, 1] = low


@njit(cache=True, nogil=True, error_model="numpy")
def rank_cameras(views, classes, starts, centers, pixel, s, order, angles):
    """Sources that may show the surface at a point, by the angle to the target's ray. Returns their number.

    centers: (C, 3) directions from the target to the sources in the target frame, in units of depth z at s
    pixel: u, v and the ray's direction (3,) at z = 1 in the target frame
    A source that sees background there, or not at all, or from behind, does not show it.
    """
    u, v, dx, dy, dz = pixel
    found = 0
    own = dx * dx + dy * dy + dz * dz
    for c in range(len(views)):
        ray = ray_in_source(views, c, u, v)
        q2 = ray[2] + s * views[c, 11]
        if q2 <= _ZERO:
            continue
        x, y = (ray[0] + s * views[c, 9]) / q2, (ray[1] + s * views[c, 10]) / q2
        px, py, r2 = pixel_in_source(views, c, x, y)
        outside = (px < _ZERO) | (px > views[c, 19]) | (py < _ZERO) | (py > views[c, 20])
        if outside | (r2 > views[c, 17]):
            continue
        if classes[starts[c] + int(py + _HALF) * (int(views[c, 19]) + 1) + int(px + _HALF)] == BACKGROUND:
            continue
        # Times s, the vectors from the source and from the target to the point.
        ex, ey, ez = dx - s * centers[c, 0], dy - s * centers[c, 1], dz - s * centers[c, 2]
        dot = ex * dx + ey * dy + ez * dz
        sine_squared = _ONE - dot * dot / ((ex * ex + ey * ey + ez * ez) * own)
        if dot <= _ZERO:
            continue
        at = found
        while at > 0 and angles[at - 1] > sine_squared:
            angles[at], order[at] = angles[at - 1], order[at - 1]
            at -= 1
        angles[at], order[at] = sine_squared, c
        found += 1
    return found
