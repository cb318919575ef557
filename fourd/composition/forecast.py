"""What a training will need, said before it starts: memory from the shapes alone, time from a probe."""

from collections.abc import Mapping
from typing import Any

import torch

from fourd.composition.model import NUM_STREAMS, STREAM_CHANNELS, CompositionNet
from fourd.errors import InputError

# Peak of a step over what float32 would save for its backward pass, measured on a CPU at 270 and 540
# lines: 1.10 to 1.32 in float32, 0.63 to 0.90 in bfloat16; with activations computed twice 0.64 to 0.91 and
# 0.42 to 0.64.
_PEAK_SHARE = {"float32": 1.3, "bfloat16": 0.9}
_RECOMPUTED_SHARE = {"float32": 0.95, "bfloat16": 0.65}


def count_saved_bytes(arguments: Mapping[str, Any], size: tuple[int, int]) -> int:
    """Bytes that the backward pass keeps of one sample in float32, found without computing anything.

    arguments: of `CompositionNet`;  size: (height, width) of the sample, px
    """
    alive: list[torch.Tensor] = []
    sizes: dict[int, int] = {}

    def pack(tensor: torch.Tensor) -> torch.Tensor:
        # Kept alive, so that no two storages ever share an address.
        alive.append(tensor)
        storage = tensor.untyped_storage()
        sizes[storage._cdata] = storage.nbytes()
        return tensor

    with torch.device("meta"):
        network = CompositionNet(**arguments)
        streams = torch.empty(1, NUM_STREAMS, STREAM_CHANNELS, *size)
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        network(streams)
    return sum(sizes.values())


def forecast_bytes(
    arguments: Mapping[str, Any], size: tuple[int, int], precision: str, is_recomputed: bool = False
) -> int:
    """About how much memory a training step takes at its peak, without the samples.

    precision: of `PRECISIONS`;  is_recomputed: see `CompositionNet`;  the others as `count_saved_bytes`
    """
    share = (_RECOMPUTED_SHARE if is_recomputed else _PEAK_SHARE)[precision]
    return int(share * count_saved_bytes(arguments, size))


def free_bytes(device: str) -> int | None:
    """Memory that the device has left; None where nobody tells."""
    if torch.device(device).type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            fields = dict(line.split(":", 1) for line in file)
        return 1024 * int(fields["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return None


def plan_memory(
    arguments: Mapping[str, Any], size: tuple[int, int], precision: str, device: str
) -> tuple[bool, str]:
    """Whether activations have to be computed twice for a step to fit, and a line about the memory to come.

    Arguments as `forecast_bytes`. Raises InputError if the device has less even then.
    """
    free = free_bytes(device)
    needed = forecast_bytes(arguments, size, precision)
    is_recomputed = free is not None and needed > free
    if is_recomputed:
        needed = forecast_bytes(arguments, size, precision, is_recomputed)
    if free is not None and needed > free:
        raise InputError(
            f"training on {size[1]}x{size[0]} px needs about {needed / 2**30:.1f} GiB, {device} has "
            f"{free / 2**30:.1f} GiB left: set composition crop to {_fitting_crop(size, needed, free)} or "
            "less, or fewer num_filters"
        )
    left = "unknown" if free is None else f"{free / 2**30:.1f} GiB"
    how = ", with activations computed twice" if is_recomputed else ""
    return is_recomputed, (
        f"a step takes about {needed / 2**30:.2f} GiB of memory at its peak{how} ({left} free)"
    )


def _fitting_crop(size: tuple[int, int], needed: int, free: int) -> int:
    """Side of a square that takes the share of the memory that is there, a multiple of 64 px."""
    side = (size[0] * size[1] * free / needed) ** 0.5
    return max(64, int(side) // 64 * 64)
