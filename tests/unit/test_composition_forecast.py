"""Memory of a training step, told from shapes alone."""

import resource

import pytest
import torch

from fourd.composition.forecast import count_saved_bytes, forecast_bytes, free_bytes, plan_memory
from fourd.composition.model import CompositionNet
from fourd.errors import InputError

TINY = {"num_filters": 4, "unet_width": 1, "depth": 2, "head": "direct", "level": 0}


def test_count_is_what_autograd_saves():
    """Against the real thing: storages that are kept between forward and backward."""
    torch.manual_seed(0)
    network, kept = CompositionNet(**TINY), {}

    def pack(tensor):
        kept[tensor.untyped_storage().data_ptr()] = tensor
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        network(torch.rand(1, 6, 4, 48, 64))
    saved = sum(tensor.untyped_storage().nbytes() for tensor in kept.values())
    assert count_saved_bytes(TINY, (48, 64)) == pytest.approx(saved, rel=0.02)


def test_memory_grows_with_the_area():
    small, large = (count_saved_bytes(TINY, (64 * n, 64 * n)) for n in (4, 8))
    assert large / small == pytest.approx(4, rel=0.05)
    assert forecast_bytes(TINY, (256, 256), "bfloat16") < forecast_bytes(TINY, (256, 256), "float32")


def test_forecast_takes_no_memory_itself():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert forecast_bytes(TINY, (20000, 20000), "float32") > 10 * 2**30
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024


def test_what_does_not_fit_is_refused_with_a_crop_that_does():
    assert "GiB of memory" in plan_memory(TINY, (64, 64), "float32", "cpu")[1]
    with pytest.raises(
        InputError, match=r"needs about .* GiB, cpu has .*set composition crop to (\d+)"
    ) as error:
        plan_memory(TINY, (300000, 300000), "float32", "cpu")
    crop = int(str(error.value).split("crop to ")[1].split()[0])
    assert "GiB of memory" in plan_memory(TINY, (crop, crop), "float32", "cpu")[1]


def test_activations_are_computed_twice_where_that_makes_a_step_fit():
    """A step on a picture that needs a fifth more than there is."""
    free = free_bytes("cpu")
    per_pixel = forecast_bytes(TINY, (1024, 1024), "float32") / 1024**2
    side = int((1.2 * free / per_pixel) ** 0.5) // 64 * 64
    is_recomputed, line = plan_memory(TINY, (side, side), "float32", "cpu")
    assert is_recomputed and "computed twice" in line
    assert not plan_memory(TINY, (side // 2, side // 2), "float32", "cpu")[0]
