"""Learned features for wide baselines: ALIKED finds them, LightGlue matches them.

The weights are the authors'. They are not part of this project and never fetched without being asked
for. Everything runs on one thread, so that the same pictures give the same bytes.
"""

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from fourd.checksum import check_sha256
from fourd.errors import InputError
from fourd.sfm.recover.aliked import SIDE_MULTIPLE, Aliked
from fourd.sfm.recover.lightglue import LightGlue, normalise_places

SHA256 = {
    "aliked-n16rot.pth": "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
    "aliked_lightglue.pth": "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
}
_HOW_TO_GET = (
    "run `python -m fourd.fetch aliked --output DIR` and set recover learned_weights to DIR, or set recover "
    "features to sift"
)
# Pictures of the size that the networks were trained on; larger ones cost memory and time in proportion.
_LONG_SIDE_PX = 1024


class LearnedFeatures:
    """Both networks. weights: folder with the files of `SHA256`. Raises InputError without them."""

    def __init__(self, weights: str) -> None:
        states = [_read_weights(weights, name) for name in SHA256]
        self._aliked, self._lightglue = Aliked(states[0]), LightGlue(states[1])

    def detect(self, image: np.ndarray, max_features: int) -> tuple[np.ndarray, np.ndarray]:
        """(N, 2) float64 px of the picture, our pixel centres, and (N, 128) float32 descriptors.

        image: (H, W, 3) uint8 RGB
        """
        import torch

        size = network_size((image.shape[1], image.shape[0]))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        tensor = torch.from_numpy(small.transpose(2, 0, 1).astype(np.float32) / np.float32(255))
        with _one_thread():
            pixels, descriptors = self._aliked.detect(tensor, max_features)
        scale = np.array([image.shape[1], image.shape[0]]) / size
        return (pixels.astype(np.float64) + 0.5) * scale - 0.5, descriptors

    def match(
        self,
        pixels: tuple[np.ndarray, np.ndarray],
        descriptors: tuple[np.ndarray, np.ndarray],
        sizes: tuple[tuple[int, int], tuple[int, int]],
    ) -> np.ndarray:
        """(M, 2) int64 indices of matching features of two pictures. sizes: their (width, height) px"""
        places = (normalise_places(pixels[0], sizes[0]), normalise_places(pixels[1], sizes[1]))
        with _one_thread():
            return self._lightglue.match(places, descriptors)


@functools.lru_cache(maxsize=1)
def load_learned_features(weights: str) -> LearnedFeatures:
    """The networks of a folder, read once."""
    return LearnedFeatures(weights)


def network_size(size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) px at which the network sees a picture: no larger, sides multiples of 32."""
    scale = min(1, _LONG_SIDE_PX / max(size))
    width, height = (max(1, round(scale * side / SIDE_MULTIPLE)) * SIDE_MULTIPLE for side in size)
    return width, height


def _read_weights(weights: str, name: str) -> dict:
    import torch

    path = Path(weights) / name
    if not weights or not path.is_file():
        where = f"no file {path}" if weights else "none (recover learned_weights is empty)"
        raise InputError(
            f"expected the weights {name} for recover features aliked, got {where}: {_HOW_TO_GET}"
        )
    check_sha256(path, SHA256[name])
    return torch.load(path, map_location="cpu", weights_only=True)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    import torch

    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)
