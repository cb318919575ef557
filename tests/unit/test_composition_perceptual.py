"""The perceptual loss against the metric it is made of, and how training takes it."""

import dataclasses

import numpy as np
import pytest
import torch

from fourd.composition import data
from fourd.composition.perceptual import NET, PerceptualLoss
from fourd.composition.train import Trainer, update
from fourd.errors import InputError
from fourd.metrics_lpips import NETWORKS, lpips
from tests.composition_scene import TINY
from tests.conftest import REPOSITORY

WEIGHTS = REPOSITORY / "data" / "lpips"
SIZE = (64, 80)


@pytest.fixture(scope="module")
def loss():
    if not (WEIGHTS / NETWORKS[NET].file).is_file():
        pytest.skip(f"needs the weights: python -m fourd.fetch lpips --output {WEIGHTS}")
    torch.set_num_threads(1)
    return PerceptualLoss(str(WEIGHTS), "cpu")


def pictures(num):
    return np.random.default_rng(0).integers(0, 256, (num, *SIZE, 3)).astype(np.uint8)


def tensor(image):
    return torch.from_numpy(image).permute(2, 0, 1)[None].to(torch.float32) / 255


def everywhere():
    return torch.ones(1, 1, *SIZE, dtype=torch.bool)


def test_it_is_the_metric(loss):
    first, second = pictures(2)
    expected = lpips(first, second, str(WEIGHTS), NET)
    assert float(loss(tensor(first), tensor(second), everywhere())) == pytest.approx(expected, rel=1e-4)


def test_pixels_without_target_have_no_say(loss):
    output, target = map(tensor, pictures(2))
    valid = everywhere()
    valid[..., 20:40, 30:50] = False
    other = torch.where(valid, target, torch.full_like(target, torch.nan))
    output.requires_grad_(True)
    value = loss(output, other, valid)
    value.backward()
    assert torch.equal(value, loss(torch.where(valid, output, torch.ones_like(output)), target, valid))
    assert output.grad is not None
    assert torch.equal(output.grad, output.grad * valid)
    assert float(output.grad.abs().max()) > 0


def test_blank_pictures_have_a_finite_gradient(loss):
    output = torch.zeros(1, 3, *SIZE, requires_grad=True)
    loss(output, tensor(pictures(1)[0]), everywhere()).backward()
    assert output.grad is not None and torch.isfinite(output.grad).all()


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_training_lowers_it_where_only_it_counts(loss, precision):
    """And its own weights stay as they are: they are no part of what is optimised or saved."""
    options = dataclasses.replace(
        TINY,
        l1_weight=0.0,
        frequency_weight=0.0,
        perceptual_weight=1.0,
        lpips_weights=str(WEIGHTS),
        learning_rate=1e-2,
        precision=precision,
    )
    stack = np.concatenate([pictures(7), np.full((7, *SIZE, 1), 255, np.uint8)], axis=3)
    target, valid = data.target_from_images(stack)
    trainer, streams = Trainer(0, options, "cpu"), data.streams_from_images(stack, data.TRAINING_STREAMS)
    history = []
    for _ in range(30):
        result = update(trainer, streams, target, valid, options)
        assert result is not None
        history.append(result[0]["perceptual"])
    assert history[-1] < 0.9 * history[0]
    plain = Trainer(0, TINY, "cpu")
    assert trainer.state()["generator"].keys() == plain.state()["generator"].keys()
    assert trainer.state().keys() == plain.state().keys()


def test_missing_weights_are_named(tmp_path):
    options = dataclasses.replace(TINY, perceptual_weight=1.0, lpips_weights=str(tmp_path))
    with pytest.raises(InputError, match=r"alexnet.ckpt .*fourd.fetch lpips"):
        Trainer(0, options, "cpu")
    with pytest.raises(InputError, match="perceptual_weight"):
        Trainer(0, dataclasses.replace(options, lpips_weights=""), "cpu")


def test_other_weights_are_refused(tmp_path):
    (tmp_path / NETWORKS[NET].file).write_bytes(b"other")
    with pytest.raises(InputError, match="sha256|SHA-256|checksum"):
        PerceptualLoss(str(tmp_path), "cpu")
