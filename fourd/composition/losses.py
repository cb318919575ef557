"""The three losses of section 3.3, as means so that their weights do not depend on the picture's size.

Images are (B, 3, H, W) float, display-referred, 1 is white; `valid` is (B, 1, H, W) bool, the
pixels that have a target. Others are left out of every loss.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from fourd.errors import InputError


def masked_difference(output: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """(B, 3, H, W) output - target, 0 where there is no target, whatever the target holds there.

    At least float32, because sums over a picture leave the range of half precision.
    Raises InputError if a valid target is NaN or infinite.
    """
    clean = torch.where(valid, target, torch.zeros_like(target))
    if not torch.isfinite(clean).all():
        raise InputError(
            "expected finite colours in every valid pixel of a target image, got NaN or infinity: "
            "mark such pixels invalid or replace the frame"
        )
    difference = torch.where(valid, output, torch.zeros_like(output)) - clean
    return difference.to(torch.promote_types(difference.dtype, torch.float32))


def reconstruction_loss(output: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """Mean absolute difference over valid pixels and channels; 0 without valid pixels (equation 1)."""
    difference = masked_difference(output, target, valid)
    return difference.abs().sum() / (valid.sum() * output.shape[1]).clamp(min=1)


def frequency_loss(output: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """Mean complex magnitude of the orthonormal Fourier transform of the difference (equation 3).

    The transform is linear, so transforming the difference equals the difference of transforms,
    and pixels without target drop out before they can spread over all frequencies. Orthonormal:
    white noise costs the same at every size.
    """
    return torch.fft.fft2(masked_difference(output, target, valid), norm="ortho").abs().mean()


def generator_loss(fake_logits: Tensor) -> Tensor:
    """-log D(G) from logits, mean over patches: the non-saturating form of equation 2.

    softplus(-x) is -log sigmoid(x) without ever forming a probability, so log 0 cannot occur.
    Source: Goodfellow et al., "Generative Adversarial Nets", section 3.
    """
    return F.softplus(-fake_logits.float()).mean()


def discriminator_loss(real_logits: Tensor, fake_logits: Tensor) -> Tensor:
    """-log D(real) - log(1 - D(fake)) from logits, mean over patches (equation 2)."""
    return F.softplus(-real_logits.float()).mean() + F.softplus(fake_logits.float()).mean()
