"""The definitions of projection, reduction and colours, one pixel at a time: slow, and easy to check.

The other backends are tested against this one. All arithmetic is float32, in the order of the
kernels, so that choices agree exactly. Nothing here is shared with them but the options.
"""

from typing import Any

import numpy as np

from fourd.fuse.geometry import DisparityMap, Sources
from fourd.fuse.options import (
    INFINITY_SIGMAS,
    KEYS_A,
    MAX_REACH_PX,
    MAX_STEP_PX,
    MIN_SINE_SQUARED,
    MIN_WEIGHT,
    SIGMA_FLOOR,
    FuseOptions,
    FusionRules,
)

F = np.float32
# A float32: numpy's annotations cannot tell one from an array.
Scalar = Any
Sample = tuple[Scalar, Scalar]
Samples = dict[tuple[int, int], Sample]


class ReferenceBackend:
    """Same interface as `cpu.CpuBackend`."""

    def __init__(
        self, sources: Sources, options: FuseOptions, size: tuple[int, int], num_pairs: int, rows: int
    ) -> None:
        self._sources = sources
        self._options = options
        self._width = size[0]
        self._layers: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def layer(self, index: int, maps: tuple[DisparityMap, DisparityMap], rows: tuple[int, int]) -> int:
        """As `cpu.CpuBackend.layer`."""
        width = self._width
        footprint = F(self._options.footprint)
        planes = []
        points = 0
        for disparity_map in maps:
            samples, used = splat(disparity_map, footprint, rows, width)
            planes.append(samples)
            points += used
        inverse_depth = np.full((rows[1] - rows[0], width), F(-1))
        sigma = np.zeros_like(inverse_depth)
        for pixel in planes[0].keys() | planes[1].keys():
            merged = merge(planes[0].get(pixel), planes[1].get(pixel), F(self._options.tolerance))
            inverse_depth[pixel], sigma[pixel] = merged
        self._layers[index] = inverse_depth, sigma
        return points

    def reduce(
        self, masks: np.ndarray, rules: FusionRules, rows: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Chosen inverse depth, cameras and counts, as `cpu.CpuBackend.reduce`."""
        layers = [self._layers[i] for i in range(len(masks))]
        shape = layers[0][0].shape
        chosen = np.full((4, *shape), F(-1))
        cameras = np.zeros((4, *shape), np.uint64)
        counts = np.zeros((2, *shape), np.uint8)
        for pixel in np.ndindex(shape):
            samples = [
                (t[pixel], s[pixel], int(mask))
                for (t, s), mask in zip(layers, masks, strict=True)
                if t[pixel] >= 0
            ]
            samples.sort(key=lambda sample: (-sample[0], sample[1]))
            for e, (t, mask, number) in enumerate(reduce_pixel(samples, rules)):
                chosen[(e, *pixel)], cameras[(e, *pixel)] = t, mask
                if e == 0:
                    counts[(0, *pixel)], counts[(1, *pixel)] = number, mask.bit_count()
        return chosen, cameras, counts

    def colours(
        self, chosen: np.ndarray, cameras: np.ndarray, first_row: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """RGB and heaviest camera, as `cpu.CpuBackend.colours`."""
        rgb = np.zeros((*chosen.shape, 3), np.uint8)
        source = np.full(chosen.shape, 255, np.uint8)
        for e, y, x in zip(*np.nonzero(chosen >= 0), strict=True):
            mask = int(cameras[e, y, x])
            found = []
            for c in range(len(self._sources.names)):
                if mask >> c & 1:
                    place = see(self._sources, c, F(x), F(y + first_row), chosen[e, y, x])
                    if place is not None:
                        found.append((place[2], c, place[0], place[1]))
            found.sort(key=lambda candidate: candidate[:2])
            if found:
                colour = blend(self._sources, found, self._options.num_sources)
                rgb[e, y, x] = np.clip(np.rint(colour), 0, 255).astype(np.uint8)
                source[e, y, x] = found[0][1]
        return rgb, source


def slope(before: Scalar, here: Scalar, after: Scalar) -> Scalar:
    """Mean of the one-sided differences that stay on the surface; 0 without any."""
    near_before, near_after = abs(here - before) <= MAX_STEP_PX, abs(after - here) <= MAX_STEP_PX
    if near_before and near_after:
        return (after - before) * F(0.5)
    return after - here if near_after else here - before if near_before else F(0)


def splat(m: DisparityMap, footprint: Scalar, rows: tuple[int, int], width: int) -> tuple[Samples, int]:
    """z-buffer of one disparity map: (row in the tile, column) -> inverse depth, sigma."""
    padded = np.pad(m.disparity, 1, constant_values=np.nan)
    buffer: Samples = {}
    points = 0
    for y, x in np.ndindex(m.disparity.shape):
        d, confidence = m.disparity[y, x], m.confidence[y, x]
        if not np.isfinite(d) or confidence <= 0:
            continue
        s = (d - m.disparity_at_infinity) * m.inverse_depth_per_px
        sigma = m.sigma_px * m.inverse_depth_per_px / confidence
        if s < -F(INFINITY_SIGMAS) * sigma:
            continue
        points += 1
        row, column = y + 1, x + 1
        dsdx = slope(padded[row, column - 1], d, padded[row, column + 1]) * m.inverse_depth_per_px
        dsdy = slope(padded[row - 1, column], d, padded[row + 1, column]) * m.inverse_depth_per_px
        _draw_patch(m, (F(x), F(y), max(s, F(0)), dsdx, dsdy, sigma), footprint, rows, width, buffer)
    return buffer, points


def _draw_patch(
    m: DisparityMap,
    point: tuple[Scalar, ...],
    footprint: Scalar,
    rows: tuple[int, int],
    width: int,
    buffer: Samples,
) -> None:
    x, y, s, dsdx, dsdy, sigma = point
    ray = [m.A[i, 0] * x + (m.A[i, 1] * y + m.A[i, 2]) for i in range(3)]
    P = [ray[i] + s * m.b[i] for i in range(3)]
    if not P[2] > 0:
        return
    inverse = F(1) / P[2]
    u, v, t = P[0] * inverse, P[1] * inverse, s * inverse
    dx = [m.A[i, 0] + dsdx * m.b[i] for i in range(3)]
    dy = [m.A[i, 1] + dsdy * m.b[i] for i in range(3)]
    ux, vx, tx = (dx[0] - u * dx[2]) * inverse, (dx[1] - v * dx[2]) * inverse, (dsdx - t * dx[2]) * inverse
    uy, vy, ty = (dy[0] - u * dy[2]) * inverse, (dy[1] - v * dy[2]) * inverse, (dsdy - t * dy[2]) * inverse
    determinant = ux * vy - uy * vx
    if not determinant > 0:
        return
    inverse_determinant = F(1) / determinant
    xu, xv = vy * inverse_determinant, -uy * inverse_determinant
    yu, yv = -vx * inverse_determinant, ux * inverse_determinant
    tu, tv = tx * xu + ty * yu, tx * xv + ty * yv
    sigma_t = sigma * inverse * max(abs(ray[2]) * inverse, F(SIGMA_FLOOR))
    reach_u = min(footprint * (abs(ux) + abs(uy)), F(MAX_REACH_PX))
    reach_v = min(footprint * (abs(vx) + abs(vy)), F(MAX_REACH_PX))
    if not (np.isfinite(u) and np.isfinite(v)):
        return
    columns = range(max(0, int(np.ceil(u - reach_u))), min(width, int(np.floor(u + reach_u)) + 1))
    for row in range(max(rows[0], int(np.ceil(v - reach_v))), min(rows[1], int(np.floor(v + reach_v)) + 1)):
        for column in columns:
            du, dv = F(column) - u, F(row) - v
            if abs(xu * du + xv * dv) > footprint or abs(yu * du + yv * dv) > footprint:
                continue
            sample = max(t + (tu * du + tv * dv), F(0)), sigma_t
            held = buffer.get((row - rows[0], column))
            if held is None or sample[0] > held[0] or (sample[0] == held[0] and sample[1] < held[1]):
                buffer[row - rows[0], column] = sample


def merge(left: Sample | None, right: Sample | None, tolerance: Scalar) -> Sample:
    """The two maps of a pair at one pixel: their mean where they agree, else the closer."""
    if left is None or right is None:
        only = left if left is not None else right
        assert only is not None
        return only
    (a, sigma_a), (b, sigma_b) = left, right
    va, vb = sigma_a * sigma_a, sigma_b * sigma_b
    if (a - b) * (a - b) <= tolerance * tolerance * (va + vb):
        return b + (a - b) * (vb / (va + vb)), min(sigma_a, sigma_b)
    return max(left, right, key=lambda sample: (sample[0], -sample[1]))


def reduce_pixel(
    samples: list[tuple[Scalar, Scalar, int]], rules: FusionRules
) -> list[tuple[Scalar, int, int]]:
    """(inverse depth, cameras, pairs) of consensus, closest, median, farthest; -1, 0, 0 = blank.

    samples: inverse depth, sigma, camera mask of every pair that has one; closest first
    """
    squared = F(rules.tolerance) * F(rules.tolerance)

    def agreeing(t: Scalar, variance: Scalar) -> list[int]:
        return [
            j
            for j, (t_j, sigma_j, _) in enumerate(samples)
            if (t_j - t) * (t_j - t) <= squared * (variance + sigma_j * sigma_j)
        ]

    def supporters(i: int) -> list[int]:
        return agreeing(samples[i][0], samples[i][1] * samples[i][1])

    def cameras(members: list[int]) -> int:
        mask = 0
        for j in members:
            mask |= samples[j][2]
        return mask

    result: list[tuple[Scalar, int, int]] = [(F(-1), 0, 0)] * 4
    if not samples:
        return result

    def are_enough(members: list[int]) -> bool:
        return len(members) >= rules.min_pairs and cameras(members).bit_count() >= rules.min_cameras

    consensus, surface = result[0], []
    for i in range(len(samples)):
        members = supporters(i)
        if are_enough(members):
            in_front = sum(1 for j in range(i) if j not in members)
            if not F(in_front) > F(rules.max_front) * F(len(members)):
                variance = samples[i][1] * samples[i][1]
                mean = _mean(samples, members, samples[i][0], variance)
                shifted = agreeing(mean, variance)
                while len(shifted) > len(members) and are_enough(shifted):
                    members, mean = shifted, _mean(samples, shifted, mean, variance)
                    shifted = agreeing(mean, variance)
                consensus, surface = (mean, cameras(members), len(members)), members
            break
    far = [i for i in range(len(samples)) if len(supporters(i)) >= rules.farthest_min_pairs]
    picks = [0, (len(samples) - 1) // 2, far[-1] if far else len(samples) - 1]
    wanted = rules.wanted()
    if wanted[0]:
        result[0] = consensus
    for e, i in enumerate(picks, start=1):
        if wanted[e]:
            members = supporters(i)
            result[e] = consensus if i in surface else (samples[i][0], cameras(members), len(members))
    return result


def _mean(
    samples: list[tuple[Scalar, Scalar, int]], members: list[int], t: Scalar, variance: Scalar
) -> Scalar:
    total, weights = F(0), F(0)
    for j in members:
        weight = variance / (samples[j][1] * samples[j][1])
        total += weight * (samples[j][0] - t)
        weights += weight
    return max(t + total / weights, F(0))


def see(sources: Sources, c: int, u: Scalar, v: Scalar, t: Scalar) -> tuple[Scalar, Scalar, Scalar] | None:
    """x, y in px and cost of source c for target pixel (u, v) at inverse depth t; None if unusable."""
    A, b = sources.A[c], sources.b[c]
    fx, skew, cx, fy, cy, far, focal_ratio, right, bottom = sources.lens[c]
    k1, k2, p1, p2, k3 = sources.distortion[c]
    d = [A[i, 0] * u + (A[i, 1] * v + A[i, 2]) for i in range(3)]
    e = [t * b[i] for i in range(3)]
    q = [d[i] + e[i] for i in range(3)]
    if not q[2] > 0 or not q[0] * d[0] + q[1] * d[1] + q[2] * d[2] > 0:
        return None
    inverse = F(1) / q[2]
    x, y = q[0] * inverse, q[1] * inverse
    xx, xy, yy = x * x, x * y, y * y
    r2 = xx + yy
    if r2 > far:
        return None
    radial = F(1) + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + (p1 + p1) * xy + p2 * (r2 + (xx + xx))
    yd = y * radial + p1 * (r2 + (yy + yy)) + (p2 + p2) * xy
    px, py = fx * xd + skew * yd + cx, fy * yd + cy
    half = F(0.5)
    if not (-half <= px <= right + half and -half <= py <= bottom + half):
        return None
    px, py = np.clip(px, F(0), right), np.clip(py, F(0), bottom)
    cross = [e[1] * d[2] - e[2] * d[1], e[2] * d[0] - e[0] * d[2], e[0] * d[1] - e[1] * d[0]]
    squares = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2]) * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    sine_squared = (cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2]) / squares
    coarser = max(focal_ratio * q[2], F(1))
    return px, py, np.sqrt(sine_squared + F(MIN_SINE_SQUARED)) * coarser


def blend(sources: Sources, found: list[tuple[Scalar, int, Scalar, Scalar]], num_sources: int) -> np.ndarray:
    """(3,) colour of the first sources of a ranked list (cost, camera, x, y)."""
    total, weights = np.zeros(3, np.float32), F(0)
    for cost, c, px, py in found[:num_sources]:
        weight = F(1) / cost
        if len(found) > num_sources:
            weight *= max(F(1) - cost / found[num_sources][0], F(MIN_WEIGHT))
        total += weight * bicubic(sources.images[c], px, py)
        weights += weight
    return total / weights


def bicubic(image: np.ndarray, px: Scalar, py: Scalar) -> np.ndarray:
    """(3,) float32 RGB; edges repeat. Source: R. Keys, "Cubic convolution interpolation", 1981."""
    x, y = int(px), int(py)
    wx, wy = keys_weights(px - F(x)), keys_weights(py - F(y))
    ys = np.clip(np.arange(y - 1, y + 3), 0, image.shape[0] - 1)
    xs = np.clip(np.arange(x - 1, x + 3), 0, image.shape[1] - 1)
    patch = image[np.ix_(ys, xs)].astype(np.float32)
    columns = (wy[0] * patch[0] + wy[1] * patch[1]) + (wy[2] * patch[2] + wy[3] * patch[3])
    return (wx[0] * columns[0] + wx[1] * columns[1]) + (wx[2] * columns[2] + wx[3] * columns[3])


def keys_weights(f: Scalar) -> tuple[Scalar, ...]:
    """Weights of the samples at -1, 0, 1, 2 for a point at f in 0..1."""
    a, g = F(KEYS_A), F(1) - f
    near = [((a + F(2)) * h - (a + F(3))) * h * h + F(1) for h in (f, g)]
    return a * f * g * g, near[0], near[1], a * g * f * f
