"""What one writes first: projection, z-test, consensus and colours in plain vectorised numpy.

Only for comparison of speed. Splats are squares of two by two pixels with the depth of the point, and
the consensus is not checked for what lies in front of it.
"""

import numpy as np

from fourd.fuse.geometry import DisparityMap, Sources
from fourd.fuse.options import FuseOptions, FusionRules


class NumpyBackend:
    """Same interface as `fourd.fuse.cpu.CpuBackend`."""

    def __init__(
        self, sources: Sources, options: FuseOptions, size: tuple[int, int], num_pairs: int, rows: int
    ) -> None:
        self._sources = sources
        self._options = options
        self._width = size[0]
        self._layers: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def layer(self, index: int, maps: tuple[DisparityMap, DisparityMap], rows: tuple[int, int]) -> int:
        width = self._width
        inverse_depth = np.full((rows[1] - rows[0]) * width, np.float32(-1))
        sigma = np.zeros_like(inverse_depth)
        points = 0
        for m in maps:
            y, x = np.nonzero(np.isfinite(m.disparity) & (m.confidence > 0))
            points += len(y)
            s = (m.disparity[y, x] - m.disparity_at_infinity) * m.inverse_depth_per_px
            P = np.stack([x, y, np.ones_like(x)], 1).astype(np.float32) @ m.A.T + s[:, None] * m.b
            front = (P[:, 2] > 0) & (s >= 0)
            P, s, confidence = P[front], s[front], m.confidence[y, x][front]
            u, v, t = P[:, 0] / P[:, 2], P[:, 1] / P[:, 2], s / P[:, 2]
            noise = m.sigma_px * m.inverse_depth_per_px / confidence / P[:, 2]
            left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64) - rows[0]
            for j in range(2):
                for i in range(2):
                    column, row = left + i, top + j
                    inside = (column >= 0) & (column < width) & (row >= 0) & (row < rows[1] - rows[0])
                    at = row[inside] * width + column[inside]
                    np.maximum.at(inverse_depth, at, t[inside])
                    won = inverse_depth[at] == t[inside]
                    sigma[at[won]] = noise[inside][won]
        shape = rows[1] - rows[0], width
        self._layers[index] = inverse_depth.reshape(shape), sigma.reshape(shape)
        return points

    def reduce(
        self, masks: np.ndarray, rules: FusionRules, rows: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        layers = [self._layers[i] for i in range(len(masks))]
        t, sigma = np.stack([layer[0] for layer in layers]), np.stack([layer[1] for layer in layers])
        order = np.argsort(-t, axis=0, kind="stable")
        t, sigma = np.take_along_axis(t, order, 0), np.take_along_axis(sigma, order, 0)
        bits = masks[order]
        valid = t >= 0
        count = valid.sum(0)
        picks = np.stack([np.full(count.shape, -1), np.zeros_like(count), (count - 1) // 2, count - 1])
        for i in range(len(t) - 1, -1, -1):
            agree = valid & ((t - t[i]) ** 2 <= rules.tolerance**2 * (sigma**2 + sigma[i] ** 2))
            picks[0][valid[i] & (agree.sum(0) >= rules.min_pairs)] = i
        picks[:, count == 0] = -1
        chosen = np.full(picks.shape, np.float32(-1))
        cameras = np.zeros(picks.shape, np.uint64)
        counts = np.zeros((2, *count.shape), np.uint8)
        for e in range(4):
            index = np.maximum(picks[e], 0)[None]
            center, spread = np.take_along_axis(t, index, 0)[0], np.take_along_axis(sigma, index, 0)[0]
            agree = valid & ((t - center) ** 2 <= rules.tolerance**2 * (sigma**2 + spread**2))
            if e == 0:
                weight = np.where(agree, (spread / np.where(agree, sigma, 1)) ** 2, 0)
                with np.errstate(invalid="ignore"):
                    center = (weight * np.where(agree, t, 0)).sum(0) / weight.sum(0)
                counts[0] = agree.sum(0) * (picks[e] >= 0)
            chosen[e] = np.where(picks[e] >= 0, center, -1)
            cameras[e] = np.bitwise_or.reduce(np.where(agree, bits, np.uint64(0)), axis=0)
        return chosen, cameras, counts

    def colours(
        self, chosen: np.ndarray, cameras: np.ndarray, first_row: int
    ) -> tuple[np.ndarray, np.ndarray]:
        rgb = np.zeros((*chosen.shape, 3), np.uint8)
        source = np.full(chosen.shape, 255, np.uint8)
        e, y, x = np.nonzero(chosen >= 0)
        t = chosen[e, y, x]
        pixel = np.stack([x, y + first_row, np.ones_like(x)], 1).astype(np.float32)
        places = []
        for c in range(len(self._sources.names)):
            fx, _, cx, fy, cy, _, _, right, bottom = self._sources.lens[c]
            ray = pixel @ self._sources.A[c].T
            q = ray + t[:, None] * self._sources.b[c]
            px, py = fx * q[:, 0] / q[:, 2] + cx, fy * q[:, 1] / q[:, 2] + cy
            cosine = (q * ray).sum(1) / np.linalg.norm(q, axis=1) / np.linalg.norm(ray, axis=1)
            usable = (cameras[e, y, x] >> np.uint64(c)) & np.uint64(1) > 0
            usable &= (px >= 0) & (px <= right) & (py >= 0) & (py <= bottom) & (q[:, 2] > 0)
            places.append((px, py, np.where(usable, 1 - cosine**2 + 1e-5, np.inf)))
        cost = np.stack([place[2] for place in places])
        order = np.argsort(cost, axis=0, kind="stable")[: self._options.num_sources]
        total, weights = np.zeros((len(t), 3), np.float32), np.zeros(len(t), np.float32)
        for rank in order:
            for c in range(len(places)):
                here = np.flatnonzero((rank == c) & np.isfinite(cost[c]))
                weight = 1 / cost[c][here]
                total[here] += weight[:, None] * bicubic(
                    self._sources.images[c], places[c][0][here], places[c][1][here]
                )
                weights[here] += weight
        seen = weights > 0
        at = e[seen], y[seen], x[seen]
        rgb[at] = np.clip(np.rint(total[seen] / weights[seen, None]), 0, 255)
        source[at] = order[0][seen]
        return rgb, source


def bicubic(image: np.ndarray, px: np.ndarray, py: np.ndarray) -> np.ndarray:
    x, y = px.astype(np.int64), py.astype(np.int64)
    wx, wy = keys(px - x), keys(py - y)
    total = np.zeros((len(px), 3), np.float32)
    for j in range(4):
        row = np.clip(y - 1 + j, 0, image.shape[0] - 1)
        for i in range(4):
            column = np.clip(x - 1 + i, 0, image.shape[1] - 1)
            total += (wy[j] * wx[i])[:, None] * image[row, column]
    return total


def keys(f: np.ndarray) -> list[np.ndarray]:
    g = 1 - f
    return [-0.5 * f * g * g, (1.5 * f - 2.5) * f * f + 1, (1.5 * g - 2.5) * g * g + 1, -0.5 * g * f * f]
