"""The network: three foreground and three background streams, a U-Net, an image (figures 7 to 9)."""

import contextlib
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from fourd.errors import InputError

NUM_STREAMS = 6
STREAM_CHANNELS = 4
HEADS = ("blend", "direct")
# Which estimate feeds each stream at test: all six, as in training; or only the consensus and the static
# background (the paper, section 4).
TEST_STREAMS = {"all": (0, 1, 2, 3, 4, 5), "paper": (0, 0, 0, 3, 3, 3)}
PRECISIONS = ("float32", "bfloat16")
# Where several estimates are valid the first of this order is pasted: consensus, static
# background, then what only training sees.
PASTE_ORDER = (0, 3, 4, 5, 1, 2)
PAD_BASE = 64

RunBlock = Callable[[nn.Module, Tensor], Tensor]


def autocast(device: str, precision: str) -> contextlib.AbstractContextManager:
    """Context in which convolutions are computed in a precision of `PRECISIONS`, weights staying float32."""
    if precision == "float32":
        return contextlib.nullcontext()
    return torch.autocast(torch.device(device).type, torch.bfloat16)


def resolve_precision(precision: str, device: str) -> str:
    """`auto` is bfloat16 where the device has units for it, which is two to three times as fast there.

    Raises InputError for a name that is none of `auto` and `PRECISIONS`.
    """
    if precision in PRECISIONS:
        return precision
    if precision != "auto":
        raise InputError(f"expected precision auto, {' or '.join(PRECISIONS)}, got {precision!r}")
    if torch.device(device).type == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    return "bfloat16" if torch.cpu._is_amx_tile_supported() else "float32"


def padded_size(height: int, width: int, level: int) -> tuple[int, int]:
    """Height and width after zero padding at a level, px: the next multiples of 64 * 2**level.

    Source: the paper, 3.3 and 4.1: 270x480 to 320x512, 540x960 to 640x1024, 1080x1920 to 1280x2048.
    """
    multiple = PAD_BASE * 2**level
    return -(-height // multiple) * multiple, -(-width // multiple) * multiple


def pad(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Zero-pad (..., H, W) to `size` (height, width), the picture in the middle."""
    extra_y, extra_x = size[0] - image.shape[-2], size[1] - image.shape[-1]
    top, left = extra_y // 2, extra_x // 2
    return F.pad(image, (left, extra_x - left, top, extra_y - top))


def crop(image: Tensor, size: tuple[int, int]) -> Tensor:
    """The middle (..., size[0], size[1]) of an image; `crop(pad(x, s), x.shape[-2:])` is x."""
    top, left = (image.shape[-2] - size[0]) // 2, (image.shape[-1] - size[1]) // 2
    return image[..., top : top + size[0], left : left + size[1]]


def convolutions(channels: list[int]) -> nn.Sequential:
    """3x3 convolutions, each followed by a ReLU, with these numbers of channels in and between.

    No normalisation layer: with a batch of one, batch statistics are those of one crop, and the
    network is trained on crops and used on whole frames that are partly blank.
    """
    layers: list[nn.Module] = []
    for num_in, num_out in zip(channels[:-1], channels[1:], strict=True):
        layers += [nn.Conv2d(num_in, num_out, 3, padding=1), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class UNet(nn.Module):
    """Two convolutions per scale, `depth` halvings, doubling filters, skip connections.

    Source: Ronneberger, Fischer, Brox, "U-Net", MICCAI 2015, with zero padding.
    """

    def __init__(self, num_in: int, width: int, depth: int) -> None:
        super().__init__()
        widths = [width * 2**scale for scale in range(depth + 1)]
        pairs = list(zip([num_in, *widths[:-1]], widths, strict=True))
        self.down = nn.ModuleList(convolutions([a, b, b]) for a, b in pairs)
        self.up = nn.ModuleList(nn.ConvTranspose2d(2 * a, a, 2, stride=2) for a in widths[:-1])
        self.merge = nn.ModuleList(convolutions([2 * a, a, a]) for a in widths[:-1])

    def forward(self, features: Tensor, run_block: RunBlock) -> Tensor:
        """(B, num_in, H, W) to (B, width, H, W); H and W are multiples of 2**depth.

        run_block: calls a block with its input, see `CompositionNet.run_block`
        """
        skips: list[Tensor] = []
        for block in self.down:
            features = run_block(block, F.max_pool2d(skips[-1], 2) if skips else features)
            skips.append(features)
        for scale in reversed(range(len(self.up))):
            joined = torch.cat([skips[scale], self.up[scale](features)], dim=1)
            features = run_block(self.merge[scale], joined)
        return features


class CompositionNet(nn.Module):
    """Foreground and background estimates of a view to its image.

    num_filters: n_f, filters of the convolutions of a stream
    unet_width:  filters of the U-Net's first scale in units of n_f
    depth:       halvings of the U-Net
    head:        `direct`, three convolutions give the image (the paper); or `blend`, they give
                 weights over the six inputs and an additive correction, and the U-Net is also told how
                 the inputs differ
    level:       0 is the coarsest; it sets the padding
    streams:     of `TEST_STREAMS`; `test_streams` says which estimates it is to be given at test

    With `is_recomputed` the backward pass computes each block's activations again instead of keeping
    them: the same gradients, in less memory and more time.
    """

    is_recomputed = False

    def __init__(
        self, num_filters: int, unet_width: int, depth: int, head: str, level: int, streams: str = "all"
    ) -> None:
        super().__init__()
        if head not in HEADS:
            raise ValueError(f"head must be one of {HEADS}, got {head!r}")
        self.level, self.head, self.test_streams = level, head, TEST_STREAMS[streams]
        stream = [STREAM_CHANNELS] + [num_filters] * 3
        width = unet_width * num_filters
        self.streams = nn.ModuleList(convolutions(stream) for _ in range(NUM_STREAMS))
        num_differences = 0 if head == "direct" else NUM_STREAMS * 3
        self.unet = UNet(NUM_STREAMS * num_filters + num_differences, width, depth)
        num_out = 3 if head == "direct" else NUM_STREAMS + 1 + 3
        last = nn.Conv2d(width, num_out, 3, padding=1)
        self.output = nn.Sequential(*convolutions([width, width, width]), last)
        self.apply(_initialize)
        if head == "blend":
            nn.init.zeros_(last.weight)

    def run_block(self, block: nn.Module, features: Tensor) -> Tensor:
        if self.is_recomputed and torch.is_grad_enabled():
            return checkpoint(block, features, use_reentrant=False, preserve_rng_state=False)
        return block(features)

    def forward(self, streams: Tensor, precision: str = "float32") -> Tensor:
        """(B, 6, 4, H, W) in [0, 1] to (B, 3, H, W), about [0, 1], float32.

        Streams are RGB and validity, three foreground then three background; colours are 0 where
        validity is 0. Any H and W: the input is zero-padded and the output cropped back.
        precision: of `PRECISIONS`, for all layers but the last
        """
        size = (streams.shape[-2], streams.shape[-1])
        padded = pad(streams, padded_size(*size, self.level))
        with autocast(streams.device.type, precision):
            encoded = [self.run_block(stream, padded[:, i]) for i, stream in enumerate(self.streams)]
            if self.head == "blend":
                encoded.append(compare(padded).to(encoded[0].dtype))
            features = self.unet(torch.cat(encoded, dim=1), self.run_block)
            features = self.run_block(self.output[:-1], features)
        # Always in full precision: 8 bits of mantissa are coarser than a grey level.
        decoded = crop(self.output[-1](features.to(streams.dtype)), size)
        return decoded if self.head == "direct" else blend(streams, decoded)


def paste(streams: Tensor) -> tuple[Tensor, Tensor]:
    """The first valid stream of `PASTE_ORDER` per pixel.

    Returns (B, 3, H, W), 0 where none is valid, and (B, 1, H, W), 1 where one is, else 0.
    """
    image, filled = torch.zeros_like(streams[:, 0, :3]), torch.zeros_like(streams[:, 0, 3:])
    for index in PASTE_ORDER:
        colour, valid = streams[:, index, :3], streams[:, index, 3:]
        image = torch.where(filled > 0, image, colour * valid)
        filled = torch.maximum(filled, valid)
    return image, filled


def compare(streams: Tensor) -> Tensor:
    """(B, 18, H, W): what each stream's colours are above those of the paste, 0 where it is invalid.

    Which estimate to believe shows in which ones agree, and that can be read from streams encoded one by one
    only after all of them have learned the same code.
    """
    image, _ = paste(streams)
    return ((streams[:, :, :3] - image.unsqueeze(1)) * streams[:, :, 3:]).flatten(1, 2)


def fill_blanks(image: Tensor, filled: Tensor) -> Tensor:
    """Blank pixels smoothly continued from around them; the others are kept exactly.

    image: (B, 3, H, W), 0 where blank;  filled: (B, 1, H, W), 1 or 0, in between on coarser scales
    Source: Gortler et al., "The Lumigraph", 1996, 3.4.1 (pull-push).
    """
    height, width = image.shape[-2:]
    if max(height, width) == 1:
        return image / filled.clamp(min=1e-12)
    stacked = F.pad(torch.cat([image, filled], dim=1), (0, width % 2, 0, height % 2))
    total = 4 * F.avg_pool2d(stacked, 2)
    coarse = total / total[:, 3:].clamp(min=1)
    around = fill_blanks(coarse[:, :3], coarse[:, 3:])
    finer = F.interpolate(around, scale_factor=2, mode="bilinear")[..., :height, :width]
    return image + (1 - filled) * finer


def blend(streams: Tensor, decoded: Tensor) -> Tensor:
    """Weighted inputs plus a correction; where `decoded` is 0 exactly the paste, its blanks filled.

    decoded: (B, 10, H, W): six logits, how far to leave the paste for their softmax over the valid
    inputs (0 not at all, 1 entirely), and an RGB correction. A softmax alone could start at the
    paste only saturated, where it has no gradient.
    """
    valid = streams[:, :, 3]
    logits, gate, correction = decoded.split([NUM_STREAMS, 1, 3], dim=1)
    # Masked before the softmax: an invalid input of great weight would leave nothing to the valid ones.
    masked = logits.masked_fill(valid == 0, torch.finfo(logits.dtype).min)
    weights = torch.softmax(masked, dim=1) * valid
    mixed = (weights.unsqueeze(2) * streams[:, :, :3]).sum(dim=1)
    image, filled = paste(streams)
    base = fill_blanks(image, filled)
    return base + gate * filled * (mixed - base) + correction


class Discriminator(nn.Module):
    """Patches of an image to logits of being real; it sees the image only, as in equation 2.

    Source: Isola et al., "Image-to-Image Translation with Conditional Adversarial Networks", 3.2.2
    (patches), with 3 halvings and no normalisation.
    """

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for num_in, num_out in ((3, width), (width, 2 * width), (2 * width, 4 * width)):
            layers += [nn.Conv2d(num_in, num_out, 4, stride=2, padding=1), nn.LeakyReLU(0.2, inplace=True)]
        self.patches = nn.Sequential(*layers, nn.Conv2d(4 * width, 1, 3, padding=1))
        self.apply(_initialize)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, 1, H // 8, W // 8) logits; a side below 8 px is zero-padded to 8."""
        height, width = (max(side, 8) for side in image.shape[-2:])
        return self.patches(pad(image, (height, width)))


def _initialize(module: nn.Module) -> Any:
    if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        nn.init.zeros_(module.bias)  # type: ignore[arg-type]
