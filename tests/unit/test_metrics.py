import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from fourd import metrics


def noisy_pair(shape: tuple[int, ...], seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = rng.integers(0, 256, shape).astype(np.uint8)
    noise = rng.normal(0, 20, shape)
    return np.clip(truth + noise, 0, 255).astype(np.uint8), truth


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 200), st.integers(0, 55))
def test_psnr_of_a_constant_offset_is_the_closed_form(offset, base):
    truth = np.full((12, 17, 3), base, np.uint8)
    image = (truth + offset).astype(np.uint8)
    assert metrics.mse(image, truth) == offset**2
    assert metrics.psnr(image, truth) == pytest.approx(20 * np.log10(255 / offset), rel=1e-12)


def test_identical_images_have_infinite_psnr_and_ssim_one():
    image, _ = noisy_pair((20, 20, 3), 0)
    assert metrics.psnr(image, image) == float("inf")
    assert metrics.ssim(image, image) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("shape", [(40, 53), (40, 53, 3), (11, 11, 3)])
def test_agrees_with_scikit_image(shape):
    image, truth = noisy_pair(shape, 1)
    expected = structural_similarity(
        truth,
        image,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=255,
        channel_axis=2 if len(shape) == 3 else None,
    )
    assert metrics.ssim(image, truth) == pytest.approx(expected, rel=1e-9)
    assert metrics.psnr(image, truth) == pytest.approx(
        peak_signal_noise_ratio(truth, image, data_range=255), rel=1e-12
    )


def test_ssim_map_agrees_with_scikit_image_at_the_border_too():
    image, truth = noisy_pair((30, 31), 2)
    _, expected = structural_similarity(
        truth, image, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255, full=True
    )
    np.testing.assert_allclose(metrics.ssim_map(image, truth), expected, rtol=1e-9, atol=1e-12)


def test_ssim_of_two_constants_is_the_luminance_term():
    a, b = np.full((16, 16), 100, np.uint8), np.full((16, 16), 140, np.uint8)
    c1 = (0.01 * 255) ** 2
    assert metrics.ssim(a, b) == pytest.approx((2 * 100 * 140 + c1) / (100**2 + 140**2 + c1), rel=1e-9)


def test_a_region_counts_only_its_own_pixels():
    truth = np.zeros((20, 20, 3), np.uint8)
    image = truth.copy()
    image[:10] = 30
    region = np.zeros((20, 20), bool)
    region[:10] = True
    assert metrics.mse(image, truth, region) == 900
    assert metrics.mse(image, truth, ~region) == 0
    assert metrics.mse(image, truth) == 450


def test_masked_ssim_is_the_mean_of_the_map():
    image, truth = noisy_pair((30, 30, 3), 3)
    region = np.zeros((30, 30), bool)
    region[4:9, 20:] = True
    assert metrics.ssim(image, truth, region) == metrics.ssim_map(image, truth)[region].mean()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_metrics_are_symmetric(seed):
    image, truth = noisy_pair((15, 14, 3), seed)
    assert metrics.mse(image, truth) == metrics.mse(truth, image)
    assert metrics.ssim(image, truth) == pytest.approx(metrics.ssim(truth, image), abs=1e-12)


def test_mse_over_parts_adds_up_to_the_whole():
    image, truth = noisy_pair((24, 31, 3), 4)
    region = np.random.default_rng(5).random((24, 31)) < 0.3
    parts = (
        metrics.mse(image, truth, region) * region.sum()
        + metrics.mse(image, truth, ~region) * (~region).sum()
    )
    assert parts / region.size == pytest.approx(metrics.mse(image, truth), rel=1e-12)


def test_an_empty_region_has_no_value():
    image, truth = noisy_pair((20, 20, 3), 6)
    empty = np.zeros((20, 20), bool)
    assert np.isnan(metrics.mse(image, truth, empty))
    assert np.isnan(metrics.psnr(image, truth, empty))
    assert np.isnan(metrics.ssim(image, truth, empty))


def test_bad_images_are_refused():
    image, truth = noisy_pair((20, 20, 3), 7)
    with pytest.raises(ValueError, match="one shape"):
        metrics.mse(image[:10], truth)
    with pytest.raises(ValueError, match="NaN"):
        metrics.mse(np.full(truth.shape, np.nan), truth)
    with pytest.raises(ValueError, match="11 px"):
        metrics.ssim(image[:8], truth[:8])
    with pytest.raises(ValueError, match="bool region"):
        metrics.mse(image, truth, np.ones((20, 20)))
