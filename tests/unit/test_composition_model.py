import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd.composition import model
from fourd.composition.model import CompositionNet, Discriminator


def random_streams(height, width, seed=0, num=1):
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 256, (num, 6, 3, height, width)) / np.float32(255)
    valid = rng.integers(0, 2, (num, 6, 1, height, width))
    streams = np.concatenate([rgb * valid, valid], axis=2).astype(np.float32)
    return torch.from_numpy(streams)


@pytest.mark.parametrize(
    ("level", "size", "padded"),
    [(0, (270, 480), (320, 512)), (1, (540, 960), (640, 1024)), (2, (1080, 1920), (1280, 2048))],
)
def test_padding_is_the_papers_at_every_level(level, size, padded):
    assert model.padded_size(*size, level) == padded


@pytest.mark.parametrize(("level", "num_filters"), [(0, 28), (1, 23), (2, 13)])
@pytest.mark.parametrize("head", model.HEADS)
def test_shapes_of_the_papers_levels(level, num_filters, head):
    height, width = 270 * 2**level, 480 * 2**level
    with torch.device("meta"):
        network = CompositionNet(num_filters, 1, 4, head, level)
        assert network(torch.empty(1, 6, 4, height, width)).shape == (1, 3, height, width)


@given(
    height=st.integers(1, 90), width=st.integers(1, 90), level=st.integers(0, 1), channels=st.integers(1, 3)
)
@settings(max_examples=30, deadline=None)
def test_crop_undoes_pad(height, width, level, channels):
    image = torch.arange(channels * height * width, dtype=torch.float32).reshape(channels, height, width)
    padded = model.pad(image, model.padded_size(height, width, level))
    assert padded.shape[-2:] == model.padded_size(height, width, level)
    assert torch.equal(model.crop(padded, (height, width)), image)
    assert (padded != 0).sum() == (image != 0).sum()


def test_number_of_parameters_follows_from_the_architecture():
    n, width, depth = 5, 10, 2
    network = CompositionNet(n, 2, depth, "direct", 0)

    def conv(num_in, num_out, side=3):
        return num_in * num_out * side**2 + num_out

    streams = 6 * (conv(4, n) + 2 * conv(n, n))
    down = conv(6 * n, 10) + conv(10, 10) + conv(10, 20) + conv(20, 20) + conv(20, 40) + conv(40, 40)
    up = conv(40, 20, 2) + conv(40, 20) + conv(20, 20) + conv(20, 10, 2) + conv(20, 10) + conv(10, 10)
    output = 2 * conv(width, width) + conv(width, 3)
    assert sum(p.numel() for p in network.parameters()) == streams + down + up + output


def test_each_stream_sees_its_own_input_only():
    torch.manual_seed(0)
    network = CompositionNet(3, 1, 1, "direct", 0)
    weights = [stream[0].weight for stream in network.streams]
    assert len(weights) == 6
    assert all(w.shape == (3, 4, 3, 3) for w in weights)
    streams = random_streams(16, 16)
    streams[:, 2] = 0
    network(streams).sum().backward()
    assert weights[2].grad.abs().sum() == 0
    assert weights[1].grad.abs().sum() > 0


def test_comparison_is_with_the_paste_and_says_nothing_of_blanks():
    streams = random_streams(12, 20)
    found = model.compare(streams).reshape(1, 6, 3, 12, 20)
    pasted, _ = model.paste(streams)
    valid = streams[:, :, 3:].expand_as(found) > 0
    assert torch.equal(found[~valid], torch.zeros_like(found[~valid]))
    assert torch.equal(found[valid], (streams[:, :, :3] - pasted[:, None])[valid])
    consensus = streams[:, 0, 3] > 0
    assert not found[:, 0].any()
    assert torch.equal(
        found[:, 3].movedim(1, -1)[consensus],
        ((streams[:, 3, :3] - streams[:, 0, :3]) * streams[:, 3, 3:]).movedim(1, -1)[consensus],
    )


def test_direct_head_compares_nothing():
    """The paper's U-Net is given the features of the streams, and no more."""
    narrow, wide = (CompositionNet(4, 1, 2, head, 0).unet.down[0][0] for head in ("direct", "blend"))
    assert (narrow.in_channels, wide.in_channels) == (24, 24 + 18)


def test_blend_starts_as_the_paste_exactly():
    torch.manual_seed(0)
    streams = random_streams(30, 40)
    output = CompositionNet(4, 1, 2, "blend", 0)(streams)
    consensus, background = streams[:, 0], streams[:, 3]
    expected = torch.where(consensus[:, 3:] > 0, consensus[:, :3], background[:, :3])
    known = ((consensus[:, 3] > 0) | (background[:, 3] > 0))[:, None].expand_as(output)
    assert known.any()
    assert torch.equal(output[known], expected[known])
    assert torch.equal(output, model.fill_blanks(*model.paste(streams)))


def test_blend_can_leave_the_paste_from_the_first_step():
    torch.manual_seed(0)
    network = CompositionNet(4, 1, 2, "blend", 0)
    network(random_streams(16, 16)).square().mean().backward()
    gate_and_correction = network.output[-1].weight.grad[6:]
    assert (gate_and_correction.abs().amax(dim=(1, 2, 3)) > 0).all()


def test_blend_copies_any_valid_input_and_never_an_invalid_one():
    streams = random_streams(8, 8)
    decoded = torch.zeros(1, 10, 8, 8)
    decoded[:, 4], decoded[:, 6] = 200.0, 1.0
    output = model.blend(streams, decoded)
    valid = streams[:, 4, 3:] > 0
    assert torch.allclose(
        output[valid.expand_as(output)], streams[:, 4, :3][valid.expand_as(output)], atol=1e-6
    )
    assert torch.isfinite(output).all()


def test_blanks_are_filled_from_around_and_the_rest_is_kept():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, 13, 22, generator=generator)
    filled = (torch.rand(1, 1, 13, 22, generator=generator) < 0.4).float()
    result = model.fill_blanks(image * filled, filled)
    kept = (filled > 0).expand_as(result)
    assert torch.equal(result[kept], image[kept])
    assert result.min() >= image[kept].min() - 1e-6
    assert result.max() <= image[kept].max() + 1e-6
    constant = model.fill_blanks(0.3 * filled.expand_as(image), filled)
    assert torch.allclose(constant, torch.full_like(constant, 0.3), atol=1e-6)
    halves = torch.zeros(1, 3, 16, 16)
    halves[..., 12:] = 0.8
    known = torch.zeros(1, 1, 16, 16)
    known[..., :4], known[..., 12:] = 1, 1
    row = model.fill_blanks(halves, known)[0, 0, 8]
    assert (row.diff() >= -1e-6).all()
    assert row[5] < 0.3
    assert row[10] > 0.5


def test_all_blank_is_filled_with_black():
    assert torch.equal(
        model.fill_blanks(torch.zeros(1, 3, 5, 9), torch.zeros(1, 1, 5, 9)), torch.zeros(1, 3, 5, 9)
    )


def test_black_and_blank_are_different_inputs():
    torch.manual_seed(0)
    network = CompositionNet(4, 1, 2, "direct", 0)
    black = torch.zeros(1, 6, 4, 16, 16)
    black[:, :, 3] = 1
    assert not torch.allclose(network(black), network(torch.zeros_like(black)))


def test_all_holes_give_finite_output_and_gradient():
    network = CompositionNet(4, 1, 2, "blend", 0)
    output = network(torch.zeros(1, 6, 4, 16, 16))
    output.square().sum().backward()
    assert torch.isfinite(output).all()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())


def test_discriminator_gives_a_logit_per_patch():
    assert Discriminator()(torch.rand(2, 3, 64, 40)).shape == (2, 1, 8, 5)
    assert Discriminator()(torch.rand(1, 3, 8, 8)).shape == (1, 1, 1, 1)


def test_unknown_head_is_refused():
    with pytest.raises(ValueError, match="blend"):
        CompositionNet(4, 1, 2, "softmax", 0)


@pytest.mark.parametrize("head", model.HEADS)
@pytest.mark.parametrize("precision", model.PRECISIONS)
def test_activations_computed_twice_give_the_same_gradients_from_less_memory(head, precision):
    torch.manual_seed(0)
    network = CompositionNet(6, 1, 3, head, 0)
    torch.nn.init.normal_(network.output[-1].weight, std=0.1)
    streams, gradients, kept = random_streams(64, 64), [], []
    for network.is_recomputed in (False, True):
        network.zero_grad()
        sizes = {}

        def pack(tensor, sizes=sizes):
            sizes[tensor.untyped_storage().data_ptr()] = tensor
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            loss = network(streams, precision).square().mean()
        loss.backward()
        gradients.append([p.grad.clone() for p in network.parameters()])
        kept.append(sum(tensor.nbytes for tensor in sizes.values()))
    assert all(map(torch.equal, *gradients))
    assert any(float(gradient.abs().max()) > 0 for gradient in gradients[0])
    assert kept[1] < 0.6 * kept[0]
