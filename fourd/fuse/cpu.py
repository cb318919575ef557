"""The compiled kernels behind the interface that `view.py` uses."""

import numpy as np

from fourd.fuse import colour_kernels, kernels
from fourd.fuse.geometry import DisparityMap, Sources, source_rows
from fourd.fuse.options import KEYS_A, FuseOptions, FusionRules


class CpuBackend:
    """Projection, reduction and colours on one core; arrays in and out are numpy's."""

    def __init__(self, sources: Sources, options: FuseOptions, height: int) -> None:
        self._params = colour_kernels.pack_sources(sources)
        self._options = options
        self._height = height
        sizes = [image.size for image in sources.images]
        self._starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)
        self._pixels = np.concatenate([image.ravel() for image in sources.images])

    def layer(
        self, maps: tuple[DisparityMap, DisparityMap], rows: tuple[int, int], width: int
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """(h, W) float32 inverse depth and sigma of one pair on rows [first, last); points used."""
        shape = (rows[1] - rows[0], width)
        planes, points = [], 0
        for disparity_map in maps:
            keys = np.zeros(shape, np.uint64)
            points += self._splat(disparity_map, rows, keys)
            planes.append(keys)
        inverse_depth, sigma = np.empty(shape, np.float32), np.empty(shape, np.float32)
        tolerance = np.float32(self._options.tolerance)
        kernels.merge_maps(planes[0], planes[1], tolerance, inverse_depth, sigma)
        return inverse_depth, sigma, points

    def _splat(self, m: DisparityMap, rows: tuple[int, int], keys: np.ndarray) -> int:
        scalars = np.array([m.disparity_at_infinity, m.inverse_depth_per_px, m.sigma_px], np.float32)
        return kernels.splat_map(
            m.disparity, m.confidence, m.A, m.b, scalars, source_rows(m, rows, self._height), rows[0],
            np.float32(self._options.footprint), keys,
        )  # fmt: skip

    def reduce(
        self, layers: list[tuple[np.ndarray, np.ndarray]], masks: np.ndarray, rules: FusionRules
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Chosen inverse depth (4, h, W), cameras (4, h, W) uint64 and counts (2, h, W) uint8."""
        inverse_depths = np.stack([layer[0] for layer in layers])
        sigmas = np.stack([layer[1] for layer in layers])
        shape = inverse_depths.shape[1:]
        chosen = np.empty((4, *shape), np.float32)
        cameras = np.empty((4, *shape), np.uint64)
        counts = np.empty((2, *shape), np.uint8)
        kernels.reduce_layers(
            inverse_depths, sigmas, masks, np.float32(rules.tolerance), np.float32(rules.max_front),
            rules.numbers(), rules.wanted(), chosen, cameras, counts,
        )  # fmt: skip
        return chosen, cameras, counts

    def colours(
        self, chosen: np.ndarray, cameras: np.ndarray, first_row: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """(4, h, W, 3) uint8 RGB and (4, h, W) uint8 camera that weighs most, 255 = none."""
        rgb = np.zeros((*chosen.shape, 3), np.uint8)
        source = np.full(chosen.shape, colour_kernels.NO_SOURCE, np.uint8)
        colour_kernels.sample_colours(
            chosen, cameras, self._params, self._pixels, self._starts, first_row,
            self._options.num_sources, np.float32(KEYS_A), rgb, source,
        )  # fmt: skip
        return rgb, source
