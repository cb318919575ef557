"""The distance of LPIPS as a loss: what a picture looks like, with a gradient.

Source: Zhang, Isola, Efros, Shechtman, Wang, "The unreasonable effectiveness of deep features as a
perceptual metric", CVPR 2018.
"""

from pathlib import Path

import torch
from torch import Tensor

from fourd.checksum import check_sha256
from fourd.errors import InputError
from fourd.metrics_lpips import MEAN, NETWORKS, SCALE, FeatureNetwork, read_arrays_only

# Of the two networks that LPIPS is made with the one that costs a step little.
NET = "alex"
# Activations are scaled to length 1; where all are 0 the root has no gradient without it.
_EPSILON = 1e-10


class PerceptualLoss(FeatureNetwork):
    """LPIPS 0.1 of two pictures, differentiable in the first; its own weights are never trained.

    folder: where `alexnet.ckpt` is, see `fourd.metrics_lpips`;  device: of the pictures
    Raises InputError if the file is missing or another one.
    """

    def __init__(self, folder: str, device: str) -> None:
        path = Path(folder) / NETWORKS[NET].file
        if not path.is_file():
            raise InputError(
                f"expected {path.name} in composition lpips_weights for a perceptual_weight above 0, got "
                f"{folder!r} without it: run `python -m fourd.fetch lpips --output DIR` and set "
                "lpips_weights to DIR, or perceptual_weight to 0"
            )
        check_sha256(path, NETWORKS[NET].sha256)
        super().__init__(NETWORKS[NET], read_arrays_only(path))
        self._weights = [(kernel.to(device), bias.to(device)) for kernel, bias in self._weights]
        self._heads = [head.to(device) for head in self._heads]

    def __call__(self, output: Tensor, target: Tensor, valid: Tensor) -> Tensor:
        """Mean distance, 0 if both are equal where there is a target; arguments as in `losses`."""
        blank = torch.zeros_like(output)
        with torch.no_grad():
            wanted = self._activate(torch.where(valid, target, blank))
        found = self._activate(torch.where(valid, output, blank))
        terms = [
            ((_unit(a) - _unit(b)).square() * head).sum(dim=1).mean()
            for a, b, head in zip(found, wanted, self._heads, strict=True)
        ]
        return torch.stack(terms).sum()

    def _activate(self, image: Tensor) -> list[Tensor]:
        mean, scale = (torch.tensor(v, device=image.device).view(1, 3, 1, 1) for v in (MEAN, SCALE))
        return self.activate((2 * image - 1 - mean) / scale)


def _unit(x: Tensor) -> Tensor:
    x = x.float()
    return x * torch.rsqrt(x.square().sum(dim=1, keepdim=True) + _EPSILON)
