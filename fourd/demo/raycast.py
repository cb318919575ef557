"""Compiled ray casting of convex analytic primitives.

Every primitive lives in its own frame, `local = linear @ (world - origin)`, where it has one of the
five canonical forms below; the map may be any affinity, so an ellipsoid is a unit sphere. Rays are
`origin + t * direction` with directions whose camera z is 1, so that t of a primary ray is depth.
Arithmetic is float64 without reassociation: same input, same bytes.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit

SPHERE, BOX, ROUND_CONE, FRUSTUM, RECTANGLE = 0, 1, 2, 3, 4
TILE_PX = 16
_PARALLEL = 1e-14


def kernel(**options: Any) -> Callable[[Callable], Callable]:
    """Decorator that compiles a function which allocates nothing."""
    # Without allocations numba's reference counts can be switched off: counting every array that is
    # passed to a small function takes three times longer than the work itself.
    settings: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}
    return njit(**settings, **options)


class Geometry(NamedTuple):
    """N primitives as arrays.

    kind: (N,) int64, one of the forms above;  linear: (N, 3, 3), origin: (N, 3) local_from_world
    shape: (N, 3) half sizes of a box, or radius at z = 0, radius at z = height, height
    uv: (N, 4) scale and offset of texture coordinates, metres
    material: (N,) int64;  label: (N,) uint8, who it belongs to
    """

    kind: np.ndarray
    linear: np.ndarray
    origin: np.ndarray
    shape: np.ndarray
    uv: np.ndarray
    material: np.ndarray
    label: np.ndarray


class CellLists(NamedTuple):
    """Which primitives can be met from each cell of a grid; a CSR table of indices.

    start: (cells + 1,) int64;  items: indices of primitives;  near: (N,) least t per primitive
    """

    start: np.ndarray
    items: np.ndarray
    near: np.ndarray


@kernel(inline="always")
def to_local(linear, x, y, z):
    """A vector in the primitive's frame."""
    return (
        linear[0, 0] * x + linear[0, 1] * y + linear[0, 2] * z,
        linear[1, 0] * x + linear[1, 1] * y + linear[1, 2] * z,
        linear[2, 0] * x + linear[2, 1] * y + linear[2, 2] * z,
    )


@kernel()
def _hit_sphere(oz, radius, ox, oy, dx, dy, dz, t_min):
    """First t > t_min on a sphere around the local origin shifted along z, or inf."""
    a = dx * dx + dy * dy + dz * dz
    b = ox * dx + oy * dy + oz * dz
    # The closest point of the ray, not its origin, enters the discriminant: far rays stay exact.
    t = -b / a
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    rest = radius * radius - (x * x + y * y + z * z)
    if rest < 0:
        return np.inf
    half = math.sqrt(rest / a)
    if t - half > t_min:
        return t - half
    return t + half if t + half > t_min else np.inf


@kernel()
def _hit_lateral(radius, slope, z_low, z_high, ox, oy, oz, dx, dy, dz, t_min):
    """First t > t_min on x^2 + y^2 = (radius + slope z)^2, z_low <= z <= z_high, or inf."""
    wide = radius + slope * oz
    a = dx * dx + dy * dy - slope * slope * dz * dz
    b = ox * dx + oy * dy - slope * dz * wide
    c = ox * ox + oy * oy - wide * wide
    if abs(a) < _PARALLEL:
        return np.inf
    rest = b * b - a * c
    if rest < 0:
        return np.inf
    root = math.sqrt(rest)
    first, second = (-b - root) / a, (-b + root) / a
    if first > second:
        first, second = second, first
    z = oz + first * dz
    if first > t_min and z_low <= z <= z_high:
        return first
    z = oz + second * dz
    if second > t_min and z_low <= z <= z_high:
        return second
    return np.inf


@kernel()
def _hit_disc(z, radius, ox, oy, oz, dx, dy, dz, t_min):
    """t > t_min on the disc at height z, or inf."""
    if abs(dz) < _PARALLEL:
        return np.inf
    t = (z - oz) / dz
    x, y = ox + t * dx, oy + t * dy
    return t if t > t_min and x * x + y * y <= radius * radius else np.inf


@kernel()
def _hit_box(sx, sy, sz, ox, oy, oz, dx, dy, dz, t_min):
    """t of entering the box of half sizes, or inf; rays from inside see nothing."""
    enter, leave = -np.inf, np.inf
    for size, o, d in ((sx, ox, dx), (sy, oy, dy), (sz, oz, dz)):
        if abs(d) < _PARALLEL:
            if abs(o) > size:
                return np.inf
            continue
        t0, t1 = (-size - o) / d, (size - o) / d
        enter, leave = max(enter, min(t0, t1)), min(leave, max(t0, t1))
    return enter if enter <= leave and enter > t_min else np.inf


@kernel()
def round_cone_tangents(r0, r1, height):
    """Where the cone touches its two spheres: z_low, z_high, and radius + slope z between.

    Raises nothing: callers keep |r0 - r1| < height, otherwise one sphere swallows the other.
    """
    sine = (r0 - r1) / height
    cosine = math.sqrt(1 - sine * sine)
    z_low, z_high = r0 * sine, height + r1 * sine
    slope = (r1 - r0) * cosine / (z_high - z_low)
    return z_low, z_high, r0 * cosine - slope * z_low, slope


@kernel()
def intersect(g, i, ox, oy, oz, dx, dy, dz, t_min):
    """First t > t_min at which a world ray meets primitive i, or inf."""
    linear, origin, shape = g.linear[i], g.origin[i], g.shape[i]
    px, py, pz = to_local(linear, ox - origin[0], oy - origin[1], oz - origin[2])
    qx, qy, qz = to_local(linear, dx, dy, dz)
    kind = g.kind[i]
    if kind == BOX:
        return _hit_box(shape[0], shape[1], shape[2], px, py, pz, qx, qy, qz, t_min)
    if kind == SPHERE:
        return _hit_sphere(pz, 1.0, px, py, qx, qy, qz, t_min)
    if kind == RECTANGLE:
        if abs(qz) < _PARALLEL:
            return np.inf
        t = -pz / qz
        inside = abs(px + t * qx) <= shape[0] and abs(py + t * qy) <= shape[1]
        return t if t > t_min and inside else np.inf
    r0, r1, height = shape[0], shape[1], shape[2]
    if kind == FRUSTUM:
        slope = (r1 - r0) / height
        t = _hit_lateral(r0, slope, 0.0, height, px, py, pz, qx, qy, qz, t_min)
        t = min(t, _hit_disc(0.0, r0, px, py, pz, qx, qy, qz, t_min))
        return min(t, _hit_disc(height, r1, px, py, pz, qx, qy, qz, t_min))
    z_low, z_high, radius, slope = round_cone_tangents(r0, r1, height)
    t = _hit_lateral(radius, slope, z_low, z_high, px, py, pz, qx, qy, qz, t_min)
    t = min(t, _hit_sphere(pz, r0, px, py, qx, qy, qz, t_min))
    return min(t, _hit_sphere(pz - height, r1, px, py, qx, qy, qz, t_min))


@kernel()
def nearest_hit(g, lists, cell, ox, oy, oz, dx, dy, dz):
    """t and index of the first primitive among those of a cell; inf and -1 for the sky."""
    best, found = np.inf, -1
    for k in range(lists.start[cell], lists.start[cell + 1]):
        i = lists.items[k]
        if lists.near[i] > best:
            break
        t = intersect(g, i, ox, oy, oz, dx, dy, dz, 1e-6)
        if t < best:
            best, found = t, i
    return best, found


@kernel()
def is_blocked(g, lists, cell, ox, oy, oz, dx, dy, dz):
    """Whether anything in a cell's list lies ahead on the ray."""
    for k in range(lists.start[cell], lists.start[cell + 1]):
        if intersect(g, lists.items[k], ox, oy, oz, dx, dy, dz, 1e-4) < np.inf:
            return True
    return False


@kernel()
def local_surface(g, i, x, y, z):
    """Normal, texture coordinates and face of a point on primitive i.

    Returns local normal (3, not unit), u, v (metres) and the local axis of a flat face (4 more where u
    runs against it), or -1.
    """
    origin, shape, uv, kind = g.origin[i], g.shape[i], g.uv[i], g.kind[i]
    x, y, z = to_local(g.linear[i], x - origin[0], y - origin[1], z - origin[2])
    nx, ny, nz, axis = x, y, z, -1
    u, v = x, y
    if kind == BOX:
        ax, ay, az = abs(x) - shape[0], abs(y) - shape[1], abs(z) - shape[2]
        axis = 0 if ax > ay and ax > az else (1 if ay > az else 2)
        nx, ny, nz = 0.0, 0.0, 0.0
        if axis == 0:
            nx = math.copysign(1.0, x)
        elif axis == 1:
            ny = math.copysign(1.0, y)
        else:
            nz = math.copysign(1.0, z)
        # Side faces are read from outside; a face whose u runs against its axis is marked by 4.
        mirrored = (axis == 0 and x < 0) or (axis == 1 and y > 0)
        u = (y if axis == 0 else x) * (-1.0 if mirrored else 1.0)
        v = y if axis == 2 else z
        axis += 4 if mirrored else 0
    elif kind == RECTANGLE:
        nx, ny, nz, axis = 0.0, 0.0, 1.0, 2
    elif kind == FRUSTUM and min(abs(z), abs(z - shape[2])) < 1e-7:
        nx, ny, axis = 0.0, 0.0, 2
        nz = 1.0 if z > 0.5 * shape[2] else -1.0
    else:
        u, v = math.atan2(y, x) / (2 * math.pi), z
        if kind == SPHERE:
            v = math.asin(min(1.0, max(-1.0, z))) / math.pi
        elif kind == FRUSTUM:
            slope = (shape[1] - shape[0]) / shape[2]
            nz = -slope * (shape[0] + slope * z)
        else:
            z_low, z_high, radius, slope = round_cone_tangents(shape[0], shape[1], shape[2])
            if z > z_high:
                nz = z - shape[2]
            elif z >= z_low:
                nz = -slope * (radius + slope * z)
    return nx, ny, nz, u * uv[0] + uv[2], v * uv[1] + uv[3], axis


@kernel()
def world_normal(linear, nx, ny, nz):
    """Unit world normal of a local one: normals go with the transpose of local_from_world."""
    x = linear[0, 0] * nx + linear[1, 0] * ny + linear[2, 0] * nz
    y = linear[0, 1] * nx + linear[1, 1] * ny + linear[2, 1] * nz
    z = linear[0, 2] * nx + linear[1, 2] * ny + linear[2, 2] * nz
    norm = math.sqrt(x * x + y * y + z * z)
    return x / norm, y / norm, z / norm


@njit(cache=True, nogil=True, error_model="numpy")
def fill_cells(cell_boxes, order, columns, num_cells, start, items):
    """Write the CSR table of which primitive covers which cells; call twice, first to count.

    cell_boxes: (N, 4) int64 first and last column, first and last row, empty if first > last
    order: (N,) primitives in the order they are listed;  start: (cells + 1,) zeros at first
    items: empty at first; of length start[-1] at the second call
    """
    counting = items.size == 0
    cursor = start.copy()
    for i in order:
        for row in range(cell_boxes[i, 2], cell_boxes[i, 3] + 1):
            for column in range(cell_boxes[i, 0], cell_boxes[i, 1] + 1):
                cell = row * columns + column
                if counting:
                    start[cell + 1] += 1
                else:
                    items[cursor[cell]] = i
                    cursor[cell] += 1
    if counting:
        for cell in range(num_cells):
            start[cell + 1] += start[cell]
