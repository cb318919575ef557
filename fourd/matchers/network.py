"""A user's own stereo network, in a TorchScript or ONNX file.

Tensor contract. Two inputs, left and right, (1, 3, H, W) float32 RGB in 0..1; H and W are multiples of
64, filled at the bottom and on the right by repeating the border. One output, (1, H, W) or (1, 1, H, W)
float: x_left - x_right in px of the input, at least 0. The right image is shifted beforehand, so that the
lowest disparity of the pair is 0. What is not finite or outside the pair's range is a hole.
The inputs of an ONNX file are named `left` and `right`.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from fourd.errors import InputError
from fourd.matchers import Match

if TYPE_CHECKING:
    import torch

_MULTIPLE = 64
_TORCH_SUFFIXES = (".pt", ".pth", ".ts", ".torchscript")
_ONNX_INPUTS = ("left", "right")

_Network = Callable[[np.ndarray, np.ndarray], np.ndarray]


class NetworkMatcher:
    """Any network that meets the tensor contract of this module."""

    def __init__(self, path: str) -> None:
        self._path = Path(path)
        if not path or not self._path.is_file():
            raise InputError(
                f"expected a stereo network, got {f'no file {path}' if path else 'no path'}: set stereo "
                "network_file to a TorchScript (.pt) or ONNX (.onnx) file"
            )
        if self._path.suffix == ".onnx":
            self._run = _load_onnx(self._path)
        elif self._path.suffix in _TORCH_SUFFIXES:
            self._run = _load_torchscript(self._path)
        else:
            raise InputError(
                f"expected a network in a file ending in .onnx or {', '.join(_TORCH_SUFFIXES)}, got "
                f"{path}: export it to TorchScript or ONNX"
            )

    def match(self, left: np.ndarray, right: np.ndarray, disparity_range: tuple[float, float]) -> Match:
        """See `Matcher.match`."""
        height, width = left.shape[:2]
        lowest = math.floor(disparity_range[0])
        padded = [pad_to_multiple(image, _MULTIPLE) for image in (left, shift_columns(right, lowest))]
        tensors = [image.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255) for image in padded]
        found = np.asarray(self._run(tensors[0], tensors[1]), np.float32)
        expected = padded[0].shape[:2]
        if found.squeeze().shape != expected or found.ndim not in (3, 4):
            raise InputError(
                f"expected disparities of shape (1, {expected[0]}, {expected[1]}) from {self._path}, got "
                f"{found.shape}: see the tensor contract in fourd/matchers/network.py"
            )
        disparity = found.reshape(expected)[:height, :width] + np.float32(lowest)
        good = np.isfinite(disparity) & (disparity >= lowest) & (disparity <= disparity_range[1] + 1)
        return Match(np.where(good, disparity, np.float32(np.nan)), good.astype(np.float32))


def pad_to_multiple(image: np.ndarray, multiple: int, least: int = 0) -> np.ndarray:
    """(H', W', C) image filled at the bottom and on the right by its border.  least: smallest side, px"""
    height, width = (multiple * math.ceil(max(side, least) / multiple) for side in image.shape[:2])
    bottom, right = height - image.shape[0], width - image.shape[1]
    return cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE)


def shift_columns(image: np.ndarray, columns: int) -> np.ndarray:
    """The image moved to the right by whole columns (negative: left), its border repeated."""
    width = image.shape[1]
    return np.ascontiguousarray(image[:, np.clip(np.arange(width) - columns, 0, width - 1)])


def normalised_tensor(
    image: np.ndarray, mean: tuple[float, ...], deviation: tuple[float, ...]
) -> "torch.Tensor":
    """(1, 3, H, W) float32 of (H, W, 3) uint8, levels in 0..1 less mean, over deviation, per channel."""
    import torch

    levels = (image.astype(np.float32) / 255 - np.asarray(mean, np.float32)) / np.asarray(
        deviation, np.float32
    )
    return torch.from_numpy(np.ascontiguousarray(levels.transpose(2, 0, 1))[None])


def _load_torchscript(path: Path) -> _Network:
    import torch

    device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        module = torch.jit.load(str(path), map_location=device).eval()
    except RuntimeError as error:
        raise InputError(
            f"expected a TorchScript network in {path}, got: {str(error).splitlines()[0]}; save it with "
            "torch.jit.save"
        ) from None

    def run(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            images = (torch.from_numpy(image).to(device) for image in (left, right))
            return module(*images).float().cpu().numpy()

    return run


def _load_onnx(path: Path) -> _Network:
    try:
        network = cv2.dnn.readNetFromONNX(str(path))
    except cv2.error as error:
        raise InputError(
            f"expected an ONNX network that OpenCV can run in {path}, got: {error.err}; export it with "
            "other operators, or to TorchScript"
        ) from None

    def run(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        for name, image in zip(_ONNX_INPUTS, (left, right), strict=True):
            network.setInput(image, name)
        return network.forward()

    return run
