"""LPIPS 0.1 and the convolutional features under it, from weights that are fetched on request.

Weights: a folder with `alexnet.ckpt` and `vgg16.ckpt`, which hold ImageNet features and the linear
heads of LPIPS version 0.1 (`python -m fourd.fetch lpips --output DIR`).
Source: Zhang, Isola, Efros, Shechtman, Wang, "The unreasonable effectiveness of deep features as a
perceptual metric", CVPR 2018; the networks are those of Krizhevsky 2014 (one column) and VGG-16.
"""

import dataclasses
import functools
import io
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fourd.checksum import check_sha256
from fourd.errors import InputError
from fourd.image import resize_area

if TYPE_CHECKING:
    import torch

FEATURE_SIDE_PX = 227
HOW_TO_GET = "run `python -m fourd.fetch lpips --output DIR` and set evaluate lpips_weights to DIR"
_EPSILON = 1e-10
# The mean and deviation of ImageNet on the scale -1 to 1, as LPIPS 0.1 rounds them.
MEAN = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)


@dataclasses.dataclass(frozen=True)
class _Layer:
    """A convolution with its ReLU, after a pooling of `pool` = (side, step) px or none."""

    stride: int
    padding: int
    pool: tuple[int, int] | None = None
    is_scored: bool = True


@dataclasses.dataclass(frozen=True)
class _Network:
    file: str
    sha256: str
    group: str
    layers: tuple[_Layer, ...]


_PLAIN = _Layer(1, 1, None, False)
_POOLED = _Layer(1, 1, (2, 2), False)
_SCORED = _Layer(1, 1)
NETWORKS = {
    "alex": _Network(
        "alexnet.ckpt",
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
        "AlexNet_0",
        (_Layer(4, 2), _Layer(1, 2, (3, 2)), _Layer(1, 1, (3, 2)), _SCORED, _SCORED),
    ),
    "vgg": _Network(
        "vgg16.ckpt",
        "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
        "VGG16_0",
        (_PLAIN, _SCORED, _POOLED, _SCORED, *(_POOLED, _PLAIN, _SCORED) * 3),
    ),
}


class _ArraysOnly(pickle.Unpickler):
    """Reads NumPy arrays in plain containers; anything else in the file is refused, never run."""

    _ALLOWED = ("_reconstruct", "ndarray", "dtype")

    def find_class(self, module_name: str, global_name: str) -> Any:
        if module_name.split(".")[0] == "numpy" and global_name in self._ALLOWED:
            # The module where arrays are rebuilt was renamed in NumPy 2.
            return super().find_class(module_name.replace("numpy.core", "numpy._core"), global_name)
        raise pickle.UnpicklingError(f"{module_name}.{global_name} is no array")


def read_arrays_only(path: Path) -> dict[str, Any]:
    """A pickled mapping of arrays, without running anything in the file. Raises InputError."""
    try:
        return _ArraysOnly(io.BytesIO(path.read_bytes())).load()
    except (pickle.UnpicklingError, EOFError) as error:
        raise InputError(f"expected pickled arrays in {path}, got: {error}; {HOW_TO_GET}") from None


def missing_weights(folder: str, net: str) -> str | None:
    """Why a network cannot be used, None if it can."""
    if not folder:
        return f"no weights are given: {HOW_TO_GET}"
    path = Path(folder) / NETWORKS[net].file
    return None if path.is_file() else f"no file {path}: {HOW_TO_GET}"


@functools.lru_cache(maxsize=2)
def load_network(folder: str, net: str) -> "FeatureNetwork":
    """`alex` or `vgg`, read once. Raises InputError for weights that are missing or others."""
    reason = missing_weights(folder, net)
    if reason is not None:
        raise InputError(f"expected the weights of {net} for LPIPS, got none: {reason}")
    path = Path(folder) / NETWORKS[net].file
    check_sha256(path, NETWORKS[net].sha256)
    return FeatureNetwork(NETWORKS[net], read_arrays_only(path))


class FeatureNetwork:
    """Convolutions of one network in torch, on the CPU, with the heads of LPIPS."""

    def __init__(self, network: _Network, arrays: Mapping[str, Any]) -> None:
        import torch

        self._layers = network.layers
        convolutions = arrays[network.group]
        self._weights = []
        for i in range(len(network.layers)):
            entry = convolutions[f"Conv_{i}"]
            kernel = np.ascontiguousarray(entry["kernel"].transpose(3, 2, 0, 1))
            self._weights.append((torch.from_numpy(kernel), torch.from_numpy(np.array(entry["bias"]))))
        num_heads = sum(layer.is_scored for layer in network.layers)
        heads = [arrays[f"NetLinLayer_{i}"]["Conv_0"]["kernel"] for i in range(num_heads)]
        self._heads = [torch.from_numpy(np.array(head).reshape(1, -1, 1, 1)) for head in heads]

    def features(self, image: np.ndarray) -> list["torch.Tensor"]:
        """(1, C, h, w) float32 activations of the scored layers; image: (H, W, 3) uint8 RGB."""
        import torch

        scaled = image.astype(np.float32) / np.float32(127.5) - np.float32(1)
        scaled = (scaled - np.array(MEAN, np.float32)) / np.array(SCALE, np.float32)
        x = torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)[None], np.float32))
        with torch.inference_mode():
            return self.activate(x)

    def activate(self, x: "torch.Tensor") -> list["torch.Tensor"]:
        """The same of (B, 3, H, W) pictures on the scale -1 to 1, less `MEAN`, over `SCALE`."""
        from torch.nn import functional

        found = []
        for layer, (kernel, bias) in zip(self._layers, self._weights, strict=True):
            if layer.pool is not None:
                x = functional.max_pool2d(x, *layer.pool)
            x = functional.relu(functional.conv2d(x, kernel, bias, layer.stride, layer.padding))
            if layer.is_scored:
                found.append(x)
        return found

    def distance(self, first: Sequence["torch.Tensor"], second: Sequence["torch.Tensor"]) -> float:
        """LPIPS of two pictures of one size, from their `features`."""
        import torch

        total = 0.0
        with torch.inference_mode():
            for a, b, head in zip(first, second, self._heads, strict=True):
                difference = _unit(a) - _unit(b)
                total += float((difference * difference * head).sum(dim=1).mean())
        return total

    def describe(self, image: np.ndarray) -> np.ndarray:
        """(9216,) float32 of norm 1: AlexNet's last convolution, pooled, of the picture at 227 x 227 px."""
        from torch.nn import functional

        small = resize_area(image, (FEATURE_SIDE_PX, FEATURE_SIDE_PX))
        pooled = functional.max_pool2d(self.features(small)[-1], 3, 2).numpy().ravel()
        return pooled / max(float(np.linalg.norm(pooled)), _EPSILON)


def _unit(x: "torch.Tensor") -> "torch.Tensor":
    return x / (x.square().sum(dim=1, keepdim=True).sqrt() + _EPSILON)


def lpips(image: np.ndarray, truth: np.ndarray, folder: str, net: str = "alex") -> float:
    """Learned perceptual distance of two (H, W, 3) uint8 RGB pictures, version 0.1; 0 if identical.

    folder: where the weights are;  net: `alex` or `vgg`
    Raises ValueError if the shapes differ, InputError for missing weights.
    """
    if image.shape != truth.shape:
        raise ValueError(f"expected two images of one shape, got {image.shape} and {truth.shape}")
    network = load_network(folder, net)
    return network.distance(network.features(image), network.features(truth))
