import cv2
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


def smooth_pair(shape: tuple[int, ...], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Structure at several scales, so that no scale's similarity is zero."""
    rng = np.random.default_rng(seed)
    truth = cv2.GaussianBlur(rng.integers(0, 256, shape).astype(np.uint8), (0, 0), 3.0)
    return np.clip(truth + rng.normal(0, 12, shape), 0, 255).astype(np.uint8), truth


def as_tensor(image: np.ndarray):
    import torch

    return torch.from_numpy(np.atleast_3d(image).transpose(2, 0, 1)[None].astype(np.float64))


@pytest.mark.parametrize("shape", [(180, 211, 3), (200, 177)])
def test_ms_ssim_agrees_with_torchmetrics(shape):
    ssim_module = pytest.importorskip("torchmetrics.functional.image.ssim", reason="needs torchmetrics")
    from torch.nn.functional import avg_pool2d

    image, truth = smooth_pair(shape, 8)
    x, y, product = as_tensor(image), as_tensor(truth), 1.0
    for i, weight in enumerate(metrics.MS_SSIM_WEIGHTS):
        options = {"sigma": 1.5, "kernel_size": 11, "data_range": 255.0}
        full = ssim_module.structural_similarity_index_measure(x, y, return_full_image=True, **options)[1]
        # It counts windows that leave the picture in its SSIM, but not in its contrast term.
        similarity = full[..., 5:-5, 5:-5].mean()
        contrast = ssim_module.structural_similarity_index_measure(
            x, y, return_contrast_sensitivity=True, **options
        )[1].mean()
        if i == 0:
            assert metrics.ssim(image, truth) == pytest.approx(float(similarity), rel=1e-9)
        product *= float(similarity if i == 4 else contrast) ** weight
        x, y = avg_pool2d(x, 2), avg_pool2d(y, 2)
    assert metrics.ms_ssim(image, truth) == pytest.approx(product, rel=1e-9)
    whole = ssim_module.multiscale_structural_similarity_index_measure(
        as_tensor(image), as_tensor(truth), data_range=255.0
    )
    assert metrics.ms_ssim(image, truth) == pytest.approx(float(whole), abs=5e-3)


def test_ms_ssim_is_one_for_equal_pictures_and_falls_with_noise():
    rng = np.random.default_rng(2)
    truth = smooth_pair((190, 180, 3), 1)[1]
    values = [metrics.ms_ssim(truth, truth)]
    for sigma in (5, 20, 60):
        noisy = np.clip(truth + rng.normal(0, sigma, truth.shape), 0, 255).astype(np.uint8)
        values.append(metrics.ms_ssim(noisy, truth))
    assert values[0] == pytest.approx(1, abs=1e-12)
    assert values == sorted(values, reverse=True) and values[-1] < 0.9
    # Opposite structure: the finest scale's contrast term is negative, and counts as 0.
    assert metrics.ms_ssim(255 - truth, truth) == 0


def test_ms_ssim_of_a_small_picture_is_not_defined():
    image, truth = smooth_pair((175, 400, 3), 3)
    assert np.isnan(metrics.ms_ssim(image, truth))
    image, truth = smooth_pair((176, 176, 3), 3)
    assert 0 < metrics.ms_ssim(image, truth) < 1


def test_both_conventions_of_dssim():
    image, truth = smooth_pair((40, 40, 3), 4)
    similarity = metrics.ssim(image, truth)
    assert metrics.dssim_full(similarity) == pytest.approx(1 - similarity)
    assert metrics.dssim_full(similarity) == pytest.approx(2 * metrics.dssim_half(similarity))
    assert (metrics.dssim_half(1.0), metrics.dssim_half(-1.0)) == (0, 1)


def test_flicker_is_the_change_that_the_truth_does_not_have():
    rng = np.random.default_rng(6)
    earlier, truth = rng.integers(0, 200, (2, 9, 11, 3)).astype(np.uint8)
    # An error that stays is none.
    assert (metrics.flicker_map(truth + 7, truth, earlier + 7, earlier) == 0).all()
    assert (metrics.flicker_map(truth + 7, truth, earlier + 2, earlier) == 5).all()
    # A render that stands still lacks the truth's change.
    expected = np.abs(truth.astype(float) - earlier).mean(axis=2)
    found = metrics.flicker_map(truth, truth, truth, earlier)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert metrics.flicker_map(truth[..., 0], truth[..., 0], truth[..., 0], earlier[..., 0]).shape == (9, 11)
