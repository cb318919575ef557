"""ALIKED, a learned detector and descriptor: corners that stay recognisable from far apart.

The architecture is the 16-sample one of the paper; its deformable convolutions are written with
bilinear sampling, which is all they are.

Source: X. Zhao, X. Wu, W. Chen, P. C. Y. Chen, Q. Xu, Z. Li, "ALIKED: A Lighter Keypoint and Descriptor
Extraction Network via Deformable Transformation", IEEE TIM 2023.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch

NUM_CHANNELS = 128
SIDE_MULTIPLE = 32
_NUM_SAMPLES = 16
_RADIUS_PX = 2
_MIN_SCORE = 0.2
_TEMPERATURE = 0.1
_MAX_OFFSET_SHARE = 0.25
_BATCH_NORM_EPSILON = 1e-5
_POOLING = {"block2": 2, "block3": 4, "block4": 4}


class Aliked:
    """ALIKED with given weights, names and shapes as published."""

    def __init__(self, state: Mapping[str, "torch.Tensor"]) -> None:
        self._weights = _fold_batch_norms(state)

    def detect(self, image: "torch.Tensor", max_keypoints: int) -> tuple[np.ndarray, np.ndarray]:
        """Corners of a picture, the strongest first.

        image: (3, H, W) float32 RGB in 0..1, both sides multiples of `SIDE_MULTIPLE`
        Returns (N, 2) float32 px and (N, 128) float32 of unit length; nothing where nothing stands out.
        """
        import torch

        with torch.inference_mode():
            features, scores = self._dense_maps(image[None])
            pixels = pick_keypoints(scores[0, 0], max_keypoints)
            if len(pixels) == 0:
                return np.zeros((0, 2), np.float32), np.zeros((0, NUM_CHANNELS), np.float32)
            return pixels.numpy(), self._describe(features, pixels).numpy()

    def _conv(self, x: "torch.Tensor", name: str) -> "torch.Tensor":
        """Convolution that keeps the size of the picture."""
        import torch.nn.functional as F

        weight = self._weights[f"{name}.weight"]
        return F.conv2d(x, weight, self._weights.get(f"{name}.bias"), padding=weight.shape[-1] // 2)

    def _block_conv(self, x: "torch.Tensor", name: str) -> "torch.Tensor":
        """The same, or where the network learned where to look, a deformable one."""
        if f"{name}.weight" in self._weights:
            return self._conv(x, name)
        limit = _MAX_OFFSET_SHARE * max(x.shape[2:])
        offset = self._conv(x, f"{name}.offset_conv").clamp(-limit, limit)
        weight = self._weights[f"{name}.regular_conv.weight"]
        return deform_conv2d(x, offset, weight, self._weights[f"{name}.regular_conv.bias"])

    def _dense_maps(self, image: "torch.Tensor") -> tuple["torch.Tensor", "torch.Tensor"]:
        """(1, 128, H, W) features of unit length and (1, 1, H, W) scores in 0..1 of an image (1, 3, H, W)."""
        import torch
        import torch.nn.functional as F

        size = image.shape[2:]
        x = F.selu(self._block_conv(image, "block1.conv1"))
        x = F.selu(self._block_conv(x, "block1.conv2"))
        levels = [F.selu(self._conv(x, "conv1"))]
        for level, (block, step) in enumerate(_POOLING.items(), start=2):
            x = F.avg_pool2d(x, step)
            y = F.selu(self._block_conv(x, f"{block}.conv1"))
            x = F.selu(self._block_conv(y, f"{block}.conv2") + self._conv(x, f"{block}.downsample"))
            y = F.selu(self._conv(x, f"conv{level}"))
            levels.append(F.interpolate(y, size, mode="bilinear", align_corners=True))
        features = torch.cat(levels, dim=1)
        y = self._conv(features, "score_head.0")
        for layer in (2, 4, 6):
            y = self._conv(F.selu(y), f"score_head.{layer}")
        return F.normalize(features, dim=1), y.sigmoid()

    def _describe(self, features: "torch.Tensor", pixels: "torch.Tensor") -> "torch.Tensor":
        """(N, 128) descriptors: features at 16 places that the neighbourhood of each keypoint chooses."""
        import torch
        import torch.nn.functional as F

        height, width = features.shape[2:]
        last = torch.tensor([width - 3, height - 3])
        corner = (pixels.floor().long() - 1).clamp(min=0).minimum(last)
        step = torch.arange(3)
        columns, rows = corner[:, 0, None] + step, corner[:, 1, None] + step
        patches = features[0][:, rows[:, :, None], columns[:, None]].transpose(0, 1)
        head = {n: self._weights[f"desc_head.offset_conv.{n}"] for n in ("0.weight", "0.bias")}
        y = F.selu(F.conv2d(patches, head["0.weight"], head["0.bias"]))
        limit = _MAX_OFFSET_SHARE * max(height, width)
        offset = self._conv(y, "desc_head.offset_conv.2").clamp(-limit, limit)
        places = pixels[:, None] + offset.reshape(-1, 2, _NUM_SAMPLES).transpose(1, 2)
        samples = sample_bilinear(features, places[None])
        samples = F.selu(self._conv(samples, "desc_head.sf_conv"))[0]
        found = torch.einsum("cnp,pcd->nd", samples, self._weights["desc_head.agg_weights"])
        return F.normalize(found, dim=1)


def sample_bilinear(x: "torch.Tensor", places: "torch.Tensor") -> "torch.Tensor":
    """(1, C, M, N) values of x (1, C, H, W) at places (1, M, N, 2), px from the first one's centre.

    What lies outside counts as zero.
    """
    import torch
    import torch.nn.functional as F

    size = torch.tensor([x.shape[3], x.shape[2]])
    return F.grid_sample(x, (2 * places + 1) / size - 1, mode="bilinear", align_corners=False)


def deform_conv2d(
    x: "torch.Tensor", offset: "torch.Tensor", weight: "torch.Tensor", bias: "torch.Tensor | None"
) -> "torch.Tensor":
    """Convolution whose taps are displaced, each by its own amount in every pixel; size is kept.

    x: (1, C, H, W);  offset: (1, 2 K K, H, W) px, down and right of each tap in turn, row by row
    weight: (O, C, K, K), K odd;  bias: (O,) or None
    Source: J. Dai et al., "Deformable Convolutional Networks", ICCV 2017, equation 2.
    """
    import torch

    height, width = x.shape[2:]
    side = weight.shape[-1]
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    out = x.new_zeros(weight.shape[0], height * width) if bias is None else bias[:, None]
    for tap in range(side * side):
        row, column = divmod(tap, side)
        down, right = offset[0, 2 * tap], offset[0, 2 * tap + 1]
        places = torch.stack([columns + column - side // 2 + right, rows + row - side // 2 + down], dim=-1)
        out = out + weight[:, :, row, column] @ sample_bilinear(x, places[None])[0].flatten(1)
    return out.reshape(1, -1, height, width)


def pick_keypoints(scores: "torch.Tensor", count: int) -> "torch.Tensor":
    """(N, 2) float32 px of the strongest local maxima of (H, W) scores, to parts of a pixel."""
    import torch

    peaks = _suppress(scores)
    inside = torch.zeros_like(peaks, dtype=torch.bool)
    inside[_RADIUS_PX:-_RADIUS_PX, _RADIUS_PX:-_RADIUS_PX] = True
    rows, columns = (inside & (peaks > _MIN_SCORE)).nonzero(as_tuple=True)
    # The sort is stable: equal scores stay in the order of the picture.
    strongest = scores[rows, columns].sort(descending=True, stable=True).indices[:count]
    rows, columns = rows[strongest], columns[strongest]
    step = torch.arange(-_RADIUS_PX, _RADIUS_PX + 1)
    window = scores[(rows[:, None] + step)[:, :, None], (columns[:, None] + step)[:, None]]
    share = (window.flatten(1) / _TEMPERATURE).softmax(dim=1).reshape(window.shape)
    across, down = (share.sum(dim=1) * step).sum(dim=1), (share.sum(dim=2) * step).sum(dim=1)
    return torch.stack([columns + across, rows + down], dim=1)


def _suppress(scores: "torch.Tensor") -> "torch.Tensor":
    """Scores (H, W) of local maxima, zero elsewhere.

    A maximum next to a suppressed one may stand: twice, those in nobody's shadow are looked for again.
    """
    import torch
    import torch.nn.functional as F

    def widest(x: "torch.Tensor") -> "torch.Tensor":
        return F.max_pool2d(x[None, None], 2 * _RADIUS_PX + 1, stride=1, padding=_RADIUS_PX)[0, 0]

    is_peak = scores == widest(scores)
    for _ in range(2):
        shadowed = widest(is_peak.float()) > 0
        rest = torch.where(shadowed, 0.0, scores)
        is_peak = is_peak | ((rest == widest(rest)) & ~shadowed)
    return torch.where(is_peak, scores, 0.0)


def _fold_batch_norms(state: Mapping[str, "torch.Tensor"]) -> dict[str, "torch.Tensor"]:
    """The weights with every batch normalization made part of the convolution before it."""
    import torch

    folded = {name: tensor for name, tensor in state.items() if ".bn" not in name}
    for block in ("block1", "block2", "block3", "block4"):
        for layer in (1, 2):
            conv, norm = f"{block}.conv{layer}", f"{block}.bn{layer}"
            name = conv if f"{conv}.weight" in state else f"{conv}.regular_conv"
            gain = state[f"{norm}.weight"] / torch.sqrt(state[f"{norm}.running_var"] + _BATCH_NORM_EPSILON)
            folded[f"{name}.weight"] = state[f"{name}.weight"] * gain[:, None, None, None]
            folded[f"{name}.bias"] = state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * gain
    return folded
