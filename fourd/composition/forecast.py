"""What a training will need, said before it starts: memory from the shapes alone, time from a probe."""

from collections.abc import Mapping
from typing import Any

import torch

from fourd.composition.model import NUM_STREAMS, STREAM_CHANNELS, CompositionNet
from fourd.errors import InputError

# Peak of a step over what float32 would save for its backward pass, measured on a CPU at 270 and 540
# lines: 1.16 to 1.30 in float32, 0.71 to 0.90 in bfloat16.
_PEAK_SHARE = {"float32": 1.3, "bfloat16": 0.9}


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


def forecast_bytes(arguments: Mapping[str, Any], size: tuple[int, int], precision: str) -> int:
    """About how much memory a training step takes at its peak, without the samples.

    precision: of `PRECISIONS`;  the others as `count_saved_bytes`
    """
    return int(_PEAK_SHARE[precision] * count_saved_bytes(arguments, size))


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


def check_memory(arguments: Mapping[str, Any], size: tuple[int, int], precision: str, device: str) -> str:
    """A line about the memory to come; arguments as `forecast_bytes`.

    Raises InputError if the device has less.
    """
    needed, free = forecast_bytes(arguments, size, precision), free_bytes(device)
    if free is not None and needed > free:
        raise InputError(
            f"training on {size[1]}x{size[0]} px needs about {needed / 2**30:.1f} GiB, {device} has "
            f"{free / 2**30:.1f} GiB left: set composition crop to {_fitting_crop(size, needed, free)} or "
            "less, or fewer num_filters"
        )
    left = "unknown" if free is None else f"{free / 2**30:.1f} GiB"
    return f"a step takes about {needed / 2**30:.2f} GiB of memory at its peak ({left} free)"


def _fitting_crop(size: tuple[int, int], needed: int, free: int) -> int:
    """Side of a square that takes the share of the memory that is there, a multiple of 64 px."""
    side = (size[0] * size[1] * free / needed) ** 0.5
    return max(64, int(side) // 64 * 64)
