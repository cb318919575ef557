"""Projection, reduction and colours in torch, for any device; same choices as the compiled kernels.

Every operation is float32 and elementwise in the order of the compiled kernels, and the only scatter is a
maximum, so the result does not depend on the device's scheduling.
"""

import numpy as np
import torch

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

_LOW_BITS = 0xFFFFFFFF
# Elements that the colour kernels hold per camera; bounds memory where a tile is large.
_COLOUR_BATCH = 1 << 18


class TorchBackend:
    """Same interface as `cpu.CpuBackend`; the layers stay on the device, results come back as numpy."""

    def __init__(
        self,
        sources: Sources,
        options: FuseOptions,
        size: tuple[int, int],
        num_pairs: int,
        rows: int,
        device: str,
    ) -> None:
        self._options = options
        self._device = torch.device(device)
        self._width = size[0]
        self._layers = torch.empty((2, num_pairs, rows, size[0]), device=self._device)
        self._sources = [
            {
                "A": sources.A[c].tolist(),
                "b": sources.b[c].tolist(),
                "lens": sources.lens[c].tolist(),
                "distortion": sources.distortion[c].tolist(),
                "image": self._tensor(sources.images[c]),
            }
            for c in range(len(sources.names))
        ]

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._device)

    def layer(self, index: int, maps: tuple[DisparityMap, DisparityMap], rows: tuple[int, int]) -> int:
        """As `cpu.CpuBackend.layer`; the cost volume stays on the device."""
        footprint = _round(self._options.footprint)
        planes, points = [], 0
        for m in maps:
            patches, used = _project(m, self._tensor(m.disparity), self._tensor(m.confidence), footprint)
            planes.append(_splat(patches, rows, self._width, footprint))
            points += used
        inverse_depth, sigma = _merge(planes[0], planes[1], _round(self._options.tolerance))
        self._layers[0, index, : rows[1] - rows[0]] = inverse_depth
        self._layers[1, index, : rows[1] - rows[0]] = sigma
        return points

    def reduce(
        self, masks: np.ndarray, rules: FusionRules, rows: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `cpu.CpuBackend.reduce`."""
        t, sigma = self._layers[:, :, : rows[1] - rows[0]]
        bits = torch.from_numpy(masks.view(np.int64)).to(self._device)
        chosen, cameras, counts = _reduce(t, sigma, bits, rules)
        return chosen.cpu().numpy(), cameras.cpu().numpy().view(np.uint64), counts.cpu().numpy()

    def colours(
        self, chosen: np.ndarray, cameras: np.ndarray, first_row: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `cpu.CpuBackend.colours`."""
        rgb = np.zeros((*chosen.shape, 3), np.uint8)
        source = np.full(chosen.shape, 255, np.uint8)
        e, y, x = np.nonzero(chosen >= 0)
        for start in range(0, len(e), _COLOUR_BATCH):
            part = slice(start, start + _COLOUR_BATCH)
            at = e[part], y[part], x[part]
            colour, best = self._colour(
                self._tensor(at[2].astype(np.float32)),
                self._tensor((at[1] + first_row).astype(np.float32)),
                self._tensor(chosen[at]),
                self._tensor(cameras[at].view(np.int64)),
            )
            rgb[at], source[at] = colour.cpu().numpy(), best.cpu().numpy()
        return rgb, source

    def _colour(
        self, u: torch.Tensor, v: torch.Tensor, t: torch.Tensor, mask: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """(N, 3) uint8 and (N,) uint8 of N points."""
        places = [_see(source, u, v, t) for source in self._sources]
        cost = torch.stack(
            [torch.where((mask >> c & 1) == 1, place[2], float("inf")) for c, place in enumerate(places)]
        )
        ranked, order = torch.sort(cost, dim=0, stable=True)
        count = self._options.num_sources
        total = torch.zeros(len(u), 3, device=self._device)
        weights = torch.zeros(len(u), device=self._device)
        for i in range(min(count, len(places))):
            weight = 1 / ranked[i]
            if count < len(places):
                left_out = ranked[count]
                ratio = torch.clamp(1 - ranked[i] / left_out, min=_round(MIN_WEIGHT))
                weight = torch.where(torch.isfinite(left_out), weight * ratio, weight)
            colour = torch.zeros(len(u), 3, device=self._device)
            for c, place in enumerate(places):
                here = (order[i] == c) & torch.isfinite(ranked[i])
                colour[here] = _bicubic(self._sources[c]["image"], place[0][here], place[1][here])
            total = total + weight[:, None] * colour
            weights = weights + weight
        seen = torch.isfinite(ranked[0])
        rgb = torch.where(seen[:, None], total / weights[:, None], 0.0)
        best = torch.where(seen, order[0], 255).to(torch.uint8)
        return torch.round(rgb).clamp(0, 255).to(torch.uint8), best


def _round(value: float) -> float:
    """A Python float with the value that float32 holds."""
    return float(np.float32(value))


def _squared(value: float) -> float:
    """The square in float32."""
    return float(np.float32(value) * np.float32(value))


def _slope(padded: torch.Tensor, axis: int) -> torch.Tensor:
    """Slope of (H, W) disparities from a map padded by 1 with NaN (`splat_kernels._slope`)."""
    here = padded[1:-1, 1:-1]
    before = padded[1:-1, :-2] if axis == 1 else padded[:-2, 1:-1]
    after = padded[1:-1, 2:] if axis == 1 else padded[2:, 1:-1]
    near_before, near_after = (here - before).abs() <= MAX_STEP_PX, (after - here).abs() <= MAX_STEP_PX
    one_sided = torch.where(near_after, after - here, torch.where(near_before, here - before, 0.0))
    return torch.where(near_before & near_after, (after - before) * 0.5, one_sided)


def _project(
    m: DisparityMap, disparity: torch.Tensor, confidence: torch.Tensor, footprint: float
) -> tuple[dict[str, torch.Tensor], int]:
    """Patches of all valid points of a map (`splat_kernels._project`), and their number."""
    padded = torch.nn.functional.pad(disparity, (1, 1, 1, 1), value=float("nan"))
    per_px = float(m.inverse_depth_per_px)
    s = (disparity - float(m.disparity_at_infinity)) * per_px
    sigma = float(m.sigma_px * m.inverse_depth_per_px) / confidence
    usable = torch.isfinite(disparity) & (confidence > 0) & ~(s < -INFINITY_SIGMAS * sigma)
    y, x = (i.to(torch.float32) for i in torch.nonzero(usable, as_tuple=True))
    sx, sy = _slope(padded, 1)[usable] * per_px, _slope(padded, 0)[usable] * per_px
    s, sigma = s[usable].clamp(min=0), sigma[usable]
    A, b = m.A.tolist(), m.b.tolist()
    ray = [A[i][0] * x + (A[i][1] * y + A[i][2]) for i in range(3)]
    w = ray[2] + s * b[2]
    inverse = 1 / w
    u, v, t = (ray[0] + s * b[0]) * inverse, (ray[1] + s * b[1]) * inverse, s * inverse
    wx, wy = A[2][0] + sx * b[2], A[2][1] + sy * b[2]
    ux, uy = (A[0][0] + sx * b[0] - u * wx) * inverse, (A[0][1] + sy * b[0] - u * wy) * inverse
    vx, vy = (A[1][0] + sx * b[1] - v * wx) * inverse, (A[1][1] + sy * b[1] - v * wy) * inverse
    tx, ty = (sx - t * wx) * inverse, (sy - t * wy) * inverse
    determinant = ux * vy - uy * vx
    scale = 1 / determinant
    patches = {
        "u": u,
        "v": v,
        "t": t,
        "xu": vy * scale,
        "xv": -uy * scale,
        "yu": -vx * scale,
        "yv": ux * scale,
    }
    patches["sigma"] = sigma * inverse * (ray[2].abs() * inverse).clamp(min=SIGMA_FLOOR)
    patches["reach_u"] = (footprint * (ux.abs() + uy.abs())).clamp(max=MAX_REACH_PX)
    patches["reach_v"] = (footprint * (vx.abs() + vy.abs())).clamp(max=MAX_REACH_PX)
    patches["tu"] = tx * patches["xu"] + ty * patches["yu"]
    patches["tv"] = tx * patches["xv"] + ty * patches["yv"]
    front = (w > 0) & (determinant > 0)
    return {name: values[front] for name, values in patches.items()}, int(usable.sum())


def _splat(
    patches: dict[str, torch.Tensor], rows: tuple[int, int], width: int, footprint: float
) -> torch.Tensor:
    """(h, W) int64 keys, 0 = blank (`splat_kernels._key`); positive, so signed order is theirs."""
    height = rows[1] - rows[0]
    u, v = patches["u"], patches["v"]
    left, right = torch.ceil(u - patches["reach_u"]), torch.floor(u + patches["reach_u"])
    upper, lower = torch.ceil(v - patches["reach_v"]), torch.floor(v + patches["reach_v"])
    touches = (right >= 0) & (left <= width - 1) & (lower >= rows[0]) & (upper <= rows[1] - 1)
    patches = {name: values[touches] for name, values in patches.items()}
    left, right, upper, lower = left[touches], right[touches], upper[touches], lower[touches]
    low = _LOW_BITS - patches["sigma"].view(torch.int32).to(torch.int64)
    keys = torch.zeros(height * width, dtype=torch.int64, device=u.device)
    if len(low) == 0:
        return keys.view(height, width)
    for j in range(int((lower - upper).max()) + 1):
        for i in range(int((right - left).max()) + 1):
            x, y = left + i, upper + j
            du, dv = x - patches["u"], y - patches["v"]
            across = patches["xu"] * du + patches["xv"] * dv
            along = patches["yu"] * du + patches["yv"] * dv
            inside = (across.abs() <= footprint) & (along.abs() <= footprint) & (x <= right) & (y <= lower)
            inside &= (x >= 0) & (x <= width - 1) & (y >= rows[0]) & (y <= rows[1] - 1)
            here = (patches["t"] + (patches["tu"] * du + patches["tv"] * dv)).clamp(min=0)
            key = (here.view(torch.int32).to(torch.int64) << 32) | low
            at = ((y - rows[0]) * width + x).to(torch.int64)
            keys.scatter_reduce_(0, at[inside], key[inside], "amax")
    return keys.view(height, width)


def _unpack(keys: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    t = (keys >> 32).to(torch.int32).view(torch.float32)
    sigma = (_LOW_BITS - (keys & _LOW_BITS)).to(torch.int32).view(torch.float32)
    return torch.where(keys > 0, t, -1.0), sigma


def _merge(left: torch.Tensor, right: torch.Tensor, tolerance: float) -> tuple[torch.Tensor, torch.Tensor]:
    """One layer from the keys of two maps (`reduce_kernels.merge_maps`)."""
    a, sigma_a = _unpack(left)
    b, sigma_b = _unpack(right)
    va, vb = sigma_a * sigma_a, sigma_b * sigma_b
    squared = _squared(tolerance)
    agree = (a >= 0) & (b >= 0) & ((a - b) * (a - b) <= squared * (va + vb))
    mean = b + (a - b) * (vb / (va + vb))
    wins = left > right
    sigma = torch.where(agree, torch.minimum(sigma_a, sigma_b), torch.where(wins, sigma_a, sigma_b))
    return torch.where(agree, mean, torch.where(wins, a, b)), sigma


def _reduce(
    t: torch.Tensor, sigma: torch.Tensor, bits: torch.Tensor, rules: FusionRules
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """`reduce_kernels.reduce_layers` on (P, h, W) layers; P passes over P layers."""
    order = torch.sort(sigma, dim=0, stable=True).indices
    order = order.gather(0, torch.sort(t.gather(0, order), dim=0, stable=True, descending=True).indices)
    t, sigma, masks = t.gather(0, order), sigma.gather(0, order), bits[order]
    valid = t >= 0
    count = valid.sum(0)
    num_pairs, *shape = t.shape
    squared = _squared(rules.tolerance)
    variance = sigma * sigma
    agree_with = lambda i: valid & ((t - t[i]) * (t - t[i]) <= squared * (variance[i] + variance))  # noqa: E731
    picks = torch.full((4, *shape), -1, dtype=torch.int64, device=t.device)
    settled = torch.zeros(shape, dtype=torch.bool, device=t.device)
    far = count - 1
    for i in range(num_pairs):
        agree = agree_with(i)
        number = agree.sum(0)
        found = valid[i] & ~settled & (number >= rules.min_pairs)
        found &= _num_bits(_cameras(agree, masks)) >= rules.min_cameras
        in_front = (i - agree[:i].sum(0)).to(torch.float32)
        hidden = in_front > _round(rules.max_front) * number.to(torch.float32)
        picks[0] = torch.where(found & ~hidden, i, picks[0])
        settled |= found
        picks[3] = torch.where(valid[i] & (number >= rules.farthest_min_pairs), i, picks[3])
    picks[1] = torch.where(count > 0, 0, -1)
    picks[2] = torch.where(count > 0, (count - 1).clamp(min=0) // 2, -1)
    picks[3] = torch.where(picks[3] >= 0, picks[3], far)
    chosen, cameras, counts = _gather_picks(picks, t, variance, masks, valid, rules)
    unwanted = ~torch.from_numpy(rules.wanted()).to(t.device)
    chosen[unwanted], cameras[unwanted] = -1.0, 0
    counts[:, unwanted[:1].expand(shape)] = 0
    return chosen, cameras, counts


def _gather_picks(
    picks: torch.Tensor,
    t: torch.Tensor,
    variance: torch.Tensor,
    masks: torch.Tensor,
    valid: torch.Tensor,
    rules: FusionRules,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Depth, cameras and counts of the picked samples (4, h, W)."""
    squared = _squared(rules.tolerance)
    chosen = torch.full(picks.shape, -1.0, device=t.device)
    cameras = torch.zeros(picks.shape, dtype=torch.int64, device=t.device)
    counts = torch.zeros((2, *picks.shape[1:]), dtype=torch.uint8, device=t.device)
    seed = seed_variance = has_seed = t[0]
    for e in range(4):
        index = picks[e].clamp(min=0)[None]
        picked = picks[e] >= 0
        center, spread = t.gather(0, index)[0], variance.gather(0, index)[0]
        agree = _agreeing(t, variance, center, spread, squared) & valid & picked
        cameras[e] = _cameras(agree, masks)
        chosen[e] = torch.where(picked, center, -1.0)
        if e == 0:
            mean = _mean(t, variance, center, spread, agree)
            better = picked
            while better.any():
                around = _agreeing(t, variance, mean, spread, squared) & valid & better
                union = _cameras(around, masks)
                better = (around.sum(0) > agree.sum(0)) & (_num_bits(union) >= rules.min_cameras)
                shifted = _mean(t, variance, mean, spread, around)
                center, mean = torch.where(better, mean, center), torch.where(better, shifted, mean)
                agree, cameras[e] = torch.where(better, around, agree), torch.where(better, union, cameras[e])
            chosen[e] = torch.where(picked, mean, -1.0)
            counts[0] = agree.sum(0).clamp(max=255).to(torch.uint8)
            counts[1] = _num_bits(cameras[e]).to(torch.uint8)
            seed, seed_variance, has_seed = center, spread, picked
        else:
            difference = center - seed
            same = has_seed & (difference * difference <= squared * (seed_variance + spread))
            chosen[e] = torch.where(same, chosen[0], chosen[e])
            cameras[e] = torch.where(same, cameras[0], cameras[e])
    return chosen, cameras, counts


def _agreeing(
    t: torch.Tensor, variance: torch.Tensor, center: torch.Tensor, spread: torch.Tensor, squared: float
) -> torch.Tensor:
    """(P, h, W) bool: what agrees with an inverse depth of variance `spread` (h, W)."""
    return (t - center) * (t - center) <= squared * (spread + variance)


def _mean(
    t: torch.Tensor, variance: torch.Tensor, center: torch.Tensor, spread: torch.Tensor, agree: torch.Tensor
) -> torch.Tensor:
    """(h, W) precision-weighted mean of what agrees, summed in order (`reduce_kernels._shift_to_mean`)."""
    total, weights = torch.zeros_like(center), torch.zeros_like(center)
    for j in range(t.shape[0]):
        weight = torch.where(agree[j], spread / variance[j], 0.0)
        total = total + torch.where(agree[j], weight * (t[j] - center), 0.0)
        weights = weights + weight
    return (center + total / weights).clamp(min=0)


def _cameras(agree: torch.Tensor, masks: torch.Tensor) -> torch.Tensor:
    """(h, W) int64 union of the masks of the samples that agree."""
    union = torch.zeros(agree.shape[1:], dtype=torch.int64, device=agree.device)
    for j in range(agree.shape[0]):
        union |= torch.where(agree[j], masks[j], 0)
    return union


def _num_bits(mask: torch.Tensor) -> torch.Tensor:
    """Bits set, counted in pairs, fours and bytes. Source: H. Warren, Hacker's Delight, 5-1."""
    mask = (mask & 0x5555555555555555) + (mask >> 1 & 0x5555555555555555)
    mask = (mask & 0x3333333333333333) + (mask >> 2 & 0x3333333333333333)
    mask = (mask & 0x0F0F0F0F0F0F0F0F) + (mask >> 4 & 0x0F0F0F0F0F0F0F0F)
    # Sum of eight bytes, at most 64: it fits into the highest byte, below its sign.
    return mask * 0x0101010101010101 >> 56


def _see(
    source: dict, u: torch.Tensor, v: torch.Tensor, t: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """x, y in px and cost, infinite where the source is unusable (`colour_kernels.place_point`)."""
    A, b = source["A"], source["b"]
    fx, skew, cx, fy, cy, far, focal_ratio, right, bottom = source["lens"]
    k1, k2, p1, p2, k3 = source["distortion"]
    d = [A[i][0] * u + (A[i][1] * v + A[i][2]) for i in range(3)]
    e = [t * b[i] for i in range(3)]
    q = [d[i] + e[i] for i in range(3)]
    inverse = 1 / q[2]
    x, y = q[0] * inverse, q[1] * inverse
    xx, xy, yy = x * x, x * y, y * y
    r2 = xx + yy
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + (p1 + p1) * xy + p2 * (r2 + (xx + xx))
    yd = y * radial + p1 * (r2 + (yy + yy)) + (p2 + p2) * xy
    px, py = fx * xd + skew * yd + cx, fy * yd + cy
    c = [e[1] * d[2] - e[2] * d[1], e[2] * d[0] - e[0] * d[2], e[0] * d[1] - e[1] * d[0]]
    squares = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2]) * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    sine_squared = (c[0] * c[0] + c[1] * c[1] + c[2] * c[2]) / squares
    coarser = (focal_ratio * q[2]).clamp(min=1)
    cost = torch.sqrt(sine_squared + _round(MIN_SINE_SQUARED)) * coarser
    inside = (px >= -0.5) & (px <= right + 0.5) & (py >= -0.5) & (py <= bottom + 0.5) & (r2 <= far)
    px, py = px.clamp(0, right), py.clamp(0, bottom)
    facing = q[0] * d[0] + q[1] * d[1] + q[2] * d[2] > 0
    return px, py, torch.where(inside & facing & (q[2] > 0), cost, float("inf"))


def _bicubic(image: torch.Tensor, px: torch.Tensor, py: torch.Tensor) -> torch.Tensor:
    """(N, 3) float32 RGB; edges repeat (`colour_kernels.sample_bicubic`)."""
    height, width = image.shape[:2]
    x, y = px.to(torch.int64), py.to(torch.int64)
    wx, wy = _keys(px - x.to(torch.float32)), _keys(py - y.to(torch.float32))
    columns = []
    for i in range(4):
        at = (x - 1 + i).clamp(0, width - 1)
        rows = [image[(y - 1 + j).clamp(0, height - 1), at].to(torch.float32) for j in range(4)]
        columns.append((wy[0] * rows[0] + wy[1] * rows[1]) + (wy[2] * rows[2] + wy[3] * rows[3]))
    return (wx[0] * columns[0] + wx[1] * columns[1]) + (wx[2] * columns[2] + wx[3] * columns[3])


def _keys(f: torch.Tensor) -> list[torch.Tensor]:
    g, a = 1 - f, KEYS_A
    near = [((a + 2) * h - (a + 3)) * h * h + 1 for h in (f, g)]
    return [w[:, None] for w in (a * f * g * g, near[0], near[1], a * g * f * f)]
