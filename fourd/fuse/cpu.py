"""The compiled kernels behind the interface that `view.py` uses."""

import threading

import numpy as np

from fourd.fuse import colour_kernels, reduce_kernels, splat_kernels
from fourd.fuse.geometry import DisparityMap, Sources, source_rows
from fourd.fuse.options import KEYS_A, FuseOptions, FusionRules

_kept = threading.local()


def _scratch(name: str, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """An array with any content that the next call with this name overwrites; one set per thread.

    The system hands out new memory page by page, and that takes as long as the work done on it.
    """
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    held = getattr(_kept, name, None)
    if held is None or held.nbytes < size:
        held = np.empty(size, np.uint8)
        setattr(_kept, name, held)
    return held[:size].view(dtype).reshape(shape)


class CpuBackend:
    """Projection, reduction and colours on one core. Arrays that it returns last until the next call.

    layers: (P, rows, W) int64, the cost volume of a tile
    """

    def __init__(
        self, sources: Sources, options: FuseOptions, size: tuple[int, int], num_pairs: int, rows: int
    ) -> None:
        """size: (width, height) of the target;  rows: of the highest tile."""
        self._params = sources.params
        self._options = options
        self._height = size[1]
        self._pixels = _scratch("pixels", (colour_kernels.packed_size(sources.images),), np.uint8)
        self._starts = colour_kernels.pack_images(sources.images, self._pixels)
        self.layers = _scratch("layers", (num_pairs, rows, size[0]), np.int64)
        self._keys = _scratch("keys", (2, rows, size[0]), np.int64)
        # Blank before every pair: merging reads them, and leaves them so.
        self._keys[:] = 0

    def layer(self, index: int, maps: tuple[DisparityMap, DisparityMap], rows: tuple[int, int]) -> int:
        """Project pair `index` into rows [first, last) of the cost volume. Returns the points used."""
        height = rows[1] - rows[0]
        left, right = self._keys[:, :height]
        points = self._splat(maps[0], rows, left) + self._splat(maps[1], rows, right)
        reduce_kernels.merge_maps(
            left, right, np.float32(self._options.tolerance), self.layers[index, :height]
        )
        return points

    def _splat(self, m: DisparityMap, rows: tuple[int, int], keys: np.ndarray) -> int:
        scalars = np.array([m.disparity_at_infinity, m.inverse_depth_per_px, m.sigma_px], np.float32)
        return splat_kernels.splat_map(
            m.disparity, m.confidence, m.A, m.b, scalars, source_rows(m, rows, self._height), rows[0],
            np.float32(self._options.footprint), keys,
        )  # fmt: skip

    def reduce(
        self, masks: np.ndarray, rules: FusionRules, rows: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Chosen inverse depth (4, h, W), cameras (4, h, W) uint64 and counts (2, h, W) uint8."""
        layers = self.layers[:, : rows[1] - rows[0]]
        shape = layers.shape[1:]
        chosen = _scratch("chosen", (4, *shape), np.float32)
        cameras = _scratch("cameras", (4, *shape), np.uint64)
        counts = _scratch("counts", (2, *shape), np.uint8)
        reduce_kernels.reduce_layers(
            layers, masks, np.float32(rules.tolerance), np.float32(rules.max_front),
            rules.numbers(), rules.wanted(), chosen, cameras, counts,
        )  # fmt: skip
        return chosen, cameras, counts

    def colours(
        self, chosen: np.ndarray, cameras: np.ndarray, first_row: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """(4, h, W, 3) uint8 RGB and (4, h, W) uint8 camera that weighs most, 255 = none."""
        rgb = _scratch("rgb", (*chosen.shape, 3), np.uint8)
        source = _scratch("source", chosen.shape, np.uint8)
        rgb[:] = 0
        source[:] = colour_kernels.NO_SOURCE
        colour_kernels.sample_colours(
            chosen, cameras, self._params, self._pixels, self._starts, first_row,
            self._options.num_sources, np.float32(KEYS_A),
            np.empty(16, np.float32), rgb, source,
        )  # fmt: skip
        return rgb, source
