import math

import numpy as np
import pytest
import torch

from fourd.composition import losses
from fourd.errors import InputError


def everywhere(height, width):
    return torch.ones(1, 1, height, width, dtype=torch.bool)


def noise(height, width, seed=0):
    values = np.random.default_rng(seed).normal(size=(1, 3, height, width))
    return torch.from_numpy(values.astype(np.float32))


def test_reconstruction_of_a_constant_offset_is_the_offset():
    target = torch.rand(1, 3, 9, 11, generator=torch.Generator().manual_seed(0))
    loss = losses.reconstruction_loss(target + 0.25, target, everywhere(9, 11))
    assert loss.item() == pytest.approx(0.25, rel=1e-6)


@pytest.mark.parametrize(("height", "width"), [(8, 8), (9, 11), (32, 20)])
def test_frequency_loss_of_a_constant_offset_has_a_closed_form(height, width):
    # The offset is one coefficient of magnitude c * sqrt(H W), averaged over H W coefficients.
    target = torch.zeros(1, 3, height, width)
    loss = losses.frequency_loss(target + 0.5, target, everywhere(height, width))
    assert loss.item() == pytest.approx(0.5 / math.sqrt(height * width), rel=1e-5)


def test_frequency_loss_of_one_wrong_pixel_has_a_closed_form():
    # An impulse has the same magnitude, a / sqrt(H W), at every frequency.
    target = torch.zeros(1, 3, 12, 10)
    output = target.clone()
    output[:, :, 4, 7] = 0.6
    loss = losses.frequency_loss(output, target, everywhere(12, 10))
    assert loss.item() == pytest.approx(0.6 / math.sqrt(120), rel=1e-5)


def test_frequency_loss_of_white_noise_does_not_depend_on_the_size():
    # Coefficients are complex normal of variance 1: mean magnitude sqrt(pi) / 2.
    for side in (32, 128):
        output = noise(side, side)
        loss = losses.frequency_loss(output, torch.zeros_like(output), everywhere(side, side))
        assert loss.item() == pytest.approx(math.sqrt(math.pi) / 2, rel=0.03)


def test_frequency_loss_is_the_transform_of_both_images():
    output, target = noise(10, 14, 1), noise(10, 14, 2)
    both = torch.fft.fft2(output, norm="ortho") - torch.fft.fft2(target, norm="ortho")
    loss = losses.frequency_loss(output, target, everywhere(10, 14))
    assert loss.item() == pytest.approx(both.abs().mean().item(), rel=1e-5)


@pytest.mark.parametrize("value", [-1e4, -100.0, 0.0, 100.0, 1e4])
def test_adversarial_losses_are_finite_with_finite_gradients(value):
    real = torch.full((1, 1, 4, 4), value, requires_grad=True)
    fake = torch.full((1, 1, 4, 4), -value, requires_grad=True)
    total = losses.discriminator_loss(real, fake) + losses.generator_loss(fake)
    total.backward()
    assert torch.isfinite(total)
    assert torch.isfinite(real.grad).all()
    assert torch.isfinite(fake.grad).all()


def test_adversarial_losses_are_minus_log_probability():
    logit = torch.tensor([[[[0.3]]]])
    probability = 1 / (1 + math.exp(-0.3))
    assert losses.generator_loss(logit).item() == pytest.approx(-math.log(probability), rel=1e-6)
    both = losses.discriminator_loss(logit, logit).item()
    assert both == pytest.approx(-math.log(probability) - math.log(1 - probability), rel=1e-6)


@pytest.mark.parametrize(("output", "target"), [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)])
def test_losses_of_black_and_white_are_finite_with_finite_gradients(output, target):
    image = torch.full((1, 3, 8, 8), output, requires_grad=True)
    aim, valid = torch.full((1, 3, 8, 8), target), everywhere(8, 8)
    total = losses.reconstruction_loss(image, aim, valid) + losses.frequency_loss(image, aim, valid)
    total.backward()
    assert torch.isfinite(total)
    assert torch.isfinite(image.grad).all()


@pytest.mark.parametrize("loss", [losses.reconstruction_loss, losses.frequency_loss])
def test_pixels_without_target_are_left_out_whatever_they_hold(loss):
    target, valid = noise(8, 8, 3), everywhere(8, 8)
    valid[..., 2:5, 1:4] = False
    output = (target + 0.1).requires_grad_()
    value = loss(output, target, valid)
    spoiled = torch.where(valid, target, torch.tensor(float("nan")))
    assert loss(output, spoiled, valid).item() == value.item()
    value.backward()
    assert output.grad[(~valid).expand_as(output)].abs().max() == 0


def test_reconstruction_averages_over_valid_pixels_only():
    target, valid = torch.zeros(1, 3, 8, 8), everywhere(8, 8)
    valid[..., :4] = False
    assert losses.reconstruction_loss(target + 0.2, target, valid).item() == pytest.approx(0.2, rel=1e-6)


def test_no_valid_pixel_costs_nothing():
    target, valid = torch.zeros(1, 3, 8, 8), ~everywhere(8, 8)
    assert losses.reconstruction_loss(target + 1, target, valid).item() == 0
    assert losses.frequency_loss(target + 1, target, valid).item() == 0


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_target_that_is_not_finite_is_refused(bad):
    target = torch.zeros(1, 3, 8, 8)
    target[0, 0, 3, 3] = bad
    with pytest.raises(InputError, match="NaN or infinity"):
        losses.reconstruction_loss(torch.zeros_like(target), target, everywhere(8, 8))
