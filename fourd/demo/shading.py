"""Compiled shading: filtered textures, sun with shadow rays, sky light, reflection, tone curve."""

import math
from typing import NamedTuple

import numpy as np

from fourd.demo.raycast import (
    TILE_PX,
    CellLists,
    Geometry,
    is_blocked,
    kernel,
    local_surface,
    nearest_hit,
    to_local,
    world_normal,
)

MAX_PROBES = 8
# Half a mipmap level below the footprint: what sampling theory asks blurs twice (mipmap and pixel).
LEVEL_BIAS = -0.4
SKY_TEXTURE = 0
SKY_TOP_RAD, SKY_BOTTOM_RAD = 0.70, -0.08
# Sky pictures hold at most 1; the sky is brighter than a white wall.
SKY_GAIN = 1.9
EXPOSURE = 0.62


class Textures(NamedTuple):
    """Mipmapped pictures in one array.

    texels: (n, 3) uint8, square root of linear colour;  levels: (T, L, 3) int64 offset, width, height
    extent: (T, 2) metres of one repeat
    """

    texels: np.ndarray
    levels: np.ndarray
    extent: np.ndarray


class World(NamedTuple):
    """All that a ray can ask for.

    materials: (M, 7) texture (-1 = none), tint r g b, specular, exponent, reflectance
    occluders: (K, 5) spheres x y z radius label, that darken sky light nearby
    sun: (3,) unit vector to the sun;  light_axes: (2, 3), light_grid: (5,) the plane seen by the sun:
    minimum p, minimum q, cell size (metres), columns, rows
    """

    geometry: Geometry
    textures: Textures
    materials: np.ndarray
    occluders: np.ndarray
    sun: np.ndarray
    light_axes: np.ndarray
    light_grid: np.ndarray
    shadow_lists: CellLists
    all_lists: CellLists


@kernel()
def _bilinear(textures, texture, level, u, v):
    """Encoded colour at u, v in repeats of the texture."""
    offset, width, height = textures.levels[texture, level]
    x = (u - math.floor(u)) * width - 0.5
    y = (v - math.floor(v)) * height - 0.5
    x0, y0 = int(math.floor(x)), int(math.floor(y))
    fx, fy = x - x0, y - y0
    left = x0 if x0 >= 0 else width - 1
    low = y0 if y0 >= 0 else height - 1
    right = x0 + 1 if x0 + 1 < width else 0
    high = y0 + 1 if y0 + 1 < height else 0
    a = textures.texels[offset + low * width + left]
    b = textures.texels[offset + low * width + right]
    c = textures.texels[offset + high * width + left]
    d = textures.texels[offset + high * width + right]
    wa, wb, wc, wd = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    return (
        wa * a[0] + wb * b[0] + wc * c[0] + wd * d[0],
        wa * a[1] + wb * b[1] + wc * c[1] + wd * d[1],
        wa * a[2] + wb * b[2] + wc * c[2] + wd * d[2],
    )


@kernel()
def sample_texture(textures, texture, u, v, major_u, major_v, minor):
    """Linear colour averaged over an elongated footprint.

    u, v, major_u, major_v: position and long axis of the footprint, metres
    minor: length of its short axis, metres
    """
    extent_u, extent_v = textures.extent[texture]
    texels_per_m = textures.levels[texture, 0, 1] / extent_u
    major = math.sqrt(major_u * major_u + major_v * major_v)
    probes = int(min(float(MAX_PROBES), max(1.0, math.ceil(major / minor))))
    width = max(minor, major / probes) * texels_per_m
    last = textures.levels.shape[1] - 1
    level = min(float(last), max(0.0, math.log2(max(width, 1e-6)) + LEVEL_BIAS))
    base = int(level)
    fraction = level - base
    r = g = b = 0.0
    for k in range(probes):
        at = (k + 0.5) / probes - 0.5
        pu, pv = (u + at * major_u) / extent_u, (v + at * major_v) / extent_v
        x, y, z = _bilinear(textures, texture, base, pu, pv)
        if fraction > 0.02 and base < last:
            x1, y1, z1 = _bilinear(textures, texture, base + 1, pu, pv)
            x, y, z = x + fraction * (x1 - x), y + fraction * (y1 - y), z + fraction * (z1 - z)
        r, g, b = r + x, g + y, b + z
    scale = 1.0 / (255.0 * probes)
    r, g, b = r * scale, g * scale, b * scale
    return r * r, g * g, b * b


@kernel()
def sky_color(world, dx, dy, dz, pixel_rad):
    """Linear colour of the sky and the hills along a direction."""
    elevation = math.atan2(dz, math.sqrt(dx * dx + dy * dy))
    top = min(SKY_TOP_RAD, max(SKY_BOTTOM_RAD, elevation)) - SKY_BOTTOM_RAD
    span = SKY_TOP_RAD - SKY_BOTTOM_RAD
    top = min(span * 0.995, max(span * 0.005, top))
    azimuth = math.atan2(dx, dy)
    r, g, b = sample_texture(world.textures, SKY_TEXTURE, azimuth, top, 0.0, 0.0, pixel_rad)
    return SKY_GAIN * r, SKY_GAIN * g, SKY_GAIN * b


@kernel()
def is_in_shadow(world, x, y, z):
    """Whether the sun is hidden from a world point."""
    axes, grid = world.light_axes, world.light_grid
    p = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
    q = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
    column, row = math.floor((p - grid[0]) / grid[2]), math.floor((q - grid[1]) / grid[2])
    if not (0 <= column < grid[3] and 0 <= row < grid[4]):
        return False
    cell = int(row) * int(grid[3]) + int(column)
    sun = world.sun
    return is_blocked(world.geometry, world.shadow_lists, cell, x, y, z, sun[0], sun[1], sun[2])


@kernel()
def sky_visibility(world, label, x, y, z, nx, ny, nz):
    """Share of sky light that nearby spheres leave. Source: solid angle of a sphere, cosine weighted."""
    hidden = 0.0
    for k in range(world.occluders.shape[0]):
        o = world.occluders[k]
        if o[4] == label:
            continue
        dx, dy, dz = o[0] - x, o[1] - y, o[2] - z
        square = dx * dx + dy * dy + dz * dz
        if square > 25 * o[3] * o[3]:
            continue
        cosine = (nx * dx + ny * dy + nz * dz) / math.sqrt(square)
        if cosine > 0:
            hidden += cosine * min(1.0, o[3] * o[3] / square)
    return 1.0 - min(0.8, hidden)


@kernel()
def _albedo(world, i, u, v, axis, dx, dy, dz, nx, ny, nz, facing, footprint):
    """Linear reflectance at a hit, filtered over the pixel's footprint on the surface."""
    m = world.materials[world.geometry.material[i]]
    if m[0] < 0:
        return m[1], m[2], m[3]
    slant = min(12.0, 1.0 / max(facing, 0.02))
    along_u = along_v = 0.0
    minor = footprint
    if axis >= 0:
        # The long axis of the footprint is the ray's shadow on the surface.
        px, py, pz = dx + facing * nx, dy + facing * ny, dz + facing * nz
        norm = math.sqrt(px * px + py * py + pz * pz) + 1e-12
        qx, qy, qz = to_local(world.geometry.linear[i], px / norm, py / norm, pz / norm)
        along_u = (qy if axis % 4 == 0 else qx) * footprint * slant * (-1.0 if axis >= 4 else 1.0)
        along_v = (qy if axis == 2 else qz) * footprint * slant
    else:
        minor = footprint * min(3.0, math.sqrt(slant))
    r, g, b = sample_texture(world.textures, int(m[0]), u, v, along_u, along_v, minor)
    return r * m[1], g * m[2], b * m[3]


@kernel()
def shade_hit(world, i, t, ox, oy, oz, dx, dy, dz, pixel_rad):
    """Linear colour of primitive i at t, without reflection.

    pixel_rad: width of a pixel per unit of t
    Returns r, g, b, world normal (3), surface id (changes across edges and shadow borders).
    """
    g = world.geometry
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    lx, ly, lz, u, v, axis = local_surface(g, i, x, y, z)
    nx, ny, nz = world_normal(g.linear[i], lx, ly, lz)
    norm = math.sqrt(dx * dx + dy * dy + dz * dz)
    ux, uy, uz = dx / norm, dy / norm, dz / norm
    facing = -(nx * ux + ny * uy + nz * uz)
    if facing < 0:
        nx, ny, nz, facing = -nx, -ny, -nz, -facing
    r, gr, b = _albedo(world, i, u, v, axis, ux, uy, uz, nx, ny, nz, facing, pixel_rad * t)
    sun = world.sun
    cosine = nx * sun[0] + ny * sun[1] + nz * sun[2]
    lit = 0
    if cosine > 0 and not is_in_shadow(world, x + 1e-4 * nx, y + 1e-4 * ny, z + 1e-4 * nz):
        lit = 1
    direct = 2.75 * cosine * lit
    up = 0.5 + 0.5 * nz
    open_sky = sky_visibility(world, float(g.label[i]), x, y, z, nx, ny, nz)
    r *= direct * 1.0 + open_sky * (0.30 + 0.28 * up)
    gr *= direct * 0.93 + open_sky * (0.26 + 0.42 * up)
    b *= direct * 0.80 + open_sky * (0.22 + 0.66 * up)
    m = world.materials[g.material[i]]
    if m[4] > 0 and lit == 1:
        hx, hy, hz = sun[0] - ux, sun[1] - uy, sun[2] - uz
        half = (nx * hx + ny * hy + nz * hz) / math.sqrt(hx * hx + hy * hy + hz * hz)
        glint = 3.0 * m[4] * max(0.0, half) ** m[5]
        r, gr, b = r + glint, gr + glint * 0.95, b + glint * 0.85
    # Thin haze: far things lose contrast, as in air.
    clear = math.exp(-t * norm / 140.0)
    r, gr, b = r * clear + 0.80 * (1 - clear), gr * clear + 0.98 * (1 - clear), b * clear + 1.2 * (1 - clear)
    return r, gr, b, nx, ny, nz, ((i + 1) * 8 + axis + 1) * 2 + lit


@kernel()
def radiance(world, lists, cell, ox, oy, oz, dx, dy, dz, pixel_rad):
    """Linear colour along a ray, with one reflection.

    Returns r, g, b, t, index of the primitive (-1 = sky), surface id.
    """
    t, i = nearest_hit(world.geometry, lists, cell, ox, oy, oz, dx, dy, dz)
    if i < 0:
        r, g, b = sky_color(world, dx, dy, dz, pixel_rad)
        return r, g, b, t, i, 0
    r, g, b, nx, ny, nz, surface = shade_hit(world, i, t, ox, oy, oz, dx, dy, dz, pixel_rad)
    reflectance = world.materials[world.geometry.material[i], 6]
    if reflectance > 0:
        norm = math.sqrt(dx * dx + dy * dy + dz * dz)
        ux, uy, uz = dx / norm, dy / norm, dz / norm
        into = nx * ux + ny * uy + nz * uz
        ux, uy, uz = ux - 2 * into * nx, uy - 2 * into * ny, uz - 2 * into * nz
        px, py, pz = ox + t * dx + 1e-4 * nx, oy + t * dy + 1e-4 * ny, oz + t * dz + 1e-4 * nz
        # A curved mirror spreads the pixel's cone; a wide footprint keeps the mirror image calm.
        spread = 6 * pixel_rad
        s, j = nearest_hit(world.geometry, world.all_lists, 0, px, py, pz, ux, uy, uz)
        if j >= 0:
            mr, mg, mb = shade_hit(world, j, s, px, py, pz, ux, uy, uz, spread)[:3]
        else:
            mr, mg, mb = sky_color(world, ux, uy, uz, spread)
        # Schlick's approximation of the Fresnel term.
        share = reflectance + (1 - reflectance) * (1 - abs(into)) ** 5
        r, g, b = r + share * (mr - r), g + share * (mg - g), b + share * (mb - b)
    return r, g, b, t, i, surface


@kernel()
def _tone(value):
    """Mild shoulder, linear radiance to [0, 1)."""
    return 1 - math.exp(-EXPOSURE * 1.45 * value)


@kernel()
def render_pixels(world, tiles, K, world_from_cam, center, samples, color, depth, label, surface):
    """Fill one picture: a ray through every pixel's centre, more rays where surfaces meet.

    K: (3, 3), world_from_cam: (3, 3) rotation, center: (3,);  samples: rays per axis of a mixed pixel
    color: (H, W, 3) float32 out, linear [0, 1);  depth: (H, W) float32 out, z, inf = sky
    label: (H, W) uint8 out;  surface: (H, W) int64 work space
    """
    height, width = depth.shape
    columns = (width + TILE_PX - 1) // TILE_PX
    pixel_rad = 1.0 / K[0, 0]
    # Pass 0 looks through centres; pass 1 refines pixels whose neighbours show another surface.
    for refine in range(2 if samples > 1 else 1):
        n = samples if refine else 1
        for row in range(height):
            for column in range(width):
                if refine and not _is_mixed(world, surface, row, column):
                    continue
                cell = (row // TILE_PX) * columns + column // TILE_PX
                red = green = blue = 0.0
                for k in range(n * n):
                    y = (row + (k // n + 0.5) / n - 0.5 - K[1, 2]) / K[1, 1]
                    x = (column + (k % n + 0.5) / n - 0.5 - K[0, 2]) / K[0, 0]
                    dx, dy, dz = to_local(world_from_cam, x, y, 1.0)
                    r, g, b, t, i, where = radiance(
                        world, tiles, cell, center[0], center[1], center[2], dx, dy, dz, pixel_rad / n
                    )
                    red, green, blue = red + _tone(r), green + _tone(g), blue + _tone(b)
                    if not refine:
                        depth[row, column] = t
                        label[row, column] = world.geometry.label[i] if i >= 0 else 0
                        surface[row, column] = where
                color[row, column, 0] = red / (n * n)
                color[row, column, 1] = green / (n * n)
                color[row, column, 2] = blue / (n * n)


@kernel()
def _is_mixed(world, surface, row, column):
    here = surface[row, column]
    if here > 0 and world.materials[world.geometry.material[here // 16 - 1], 6] > 0.2:
        return True
    height, width = surface.shape
    for y in range(max(0, row - 1), min(height, row + 2)):
        for x in range(max(0, column - 1), min(width, column + 2)):
            if surface[y, x] != here:
                return True
    return False


@kernel()
def trace_depth(geometry, tiles, K, world_from_cam, center, depth, label):
    """Depth and labels of pixel centres only, the same rays as `render_pixels`."""
    height, width = depth.shape
    columns = (width + TILE_PX - 1) // TILE_PX
    for row in range(height):
        for column in range(width):
            y, x = (row - K[1, 2]) / K[1, 1], (column - K[0, 2]) / K[0, 0]
            dx, dy, dz = to_local(world_from_cam, x, y, 1.0)
            cell = (row // TILE_PX) * columns + column // TILE_PX
            t, i = nearest_hit(geometry, tiles, cell, center[0], center[1], center[2], dx, dy, dz)
            depth[row, column] = t
            label[row, column] = geometry.label[i] if i >= 0 else 0
