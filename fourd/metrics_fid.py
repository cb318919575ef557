"""Features of the Inception network of FID, from a file that the user brings.

FID is the Frechet distance (`fourd.metrics_distribution`) of these 2048 features. The network is
nobody's to pass on here, so nothing is fetched: the usual TorchScript file `inception-2015-12-05.pt`
holds it with its own scaling of pictures, which is a part of the metric.
Source: Heusel, Ramsauer, Unterthiner, Nessler, Hochreiter, "GANs trained by a two time-scale update
rule converge to a local Nash equilibrium", NIPS 2017.
"""

import functools
from pathlib import Path

import numpy as np

from fourd.errors import InputError

NUM_FEATURES = 2048


@functools.lru_cache(maxsize=1)
def load_inception(path: str) -> "InceptionNetwork":
    """The network of a TorchScript file, read once. Raises InputError for a file that is none."""
    return InceptionNetwork(Path(path))


class InceptionNetwork:
    """Called with (N, 3, H, W) uint8 RGB and `return_features=True` the file gives (N, 2048)."""

    def __init__(self, path: Path) -> None:
        import torch

        if not path.is_file():
            raise InputError(
                f"expected the network of FID at {path}, found nothing: correct evaluate inception"
            )
        try:
            self._network = torch.jit.load(str(path), map_location="cpu").eval()
            found = self.describe(np.zeros((299, 299, 3), np.uint8)).shape
        except (RuntimeError, ValueError) as error:
            line = str(error).strip().splitlines()[-1]
            raise InputError(
                f"expected a TorchScript network that is called with pictures and return_features in {path}, "
                f"got: {line}; use inception-2015-12-05.pt"
            ) from None
        if found != (NUM_FEATURES,):
            raise InputError(
                f"expected {NUM_FEATURES} features from the network in {path}, got {found}: "
                "use inception-2015-12-05.pt"
            )

    def describe(self, image: np.ndarray) -> np.ndarray:
        """(2048,) float32 features of an (H, W, 3) uint8 RGB picture of any size."""
        import torch

        pictures = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)[None]))
        with torch.inference_mode():
            return self._network(pictures, return_features=True)[0].float().numpy()
