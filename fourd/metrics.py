"""Image quality against a true image: MSE, PSNR, SSIM, MS-SSIM, flicker; LPIPS is in metrics_lpips.

Images are (H, W) or (H, W, C), uint8 or float on the 0-255 scale, display-referred. A region is
(H, W) bool; None is the whole frame. An empty region has no quality: every metric is NaN then,
and callers write the row with `num_pixels` 0 and an empty value.

SSIM and MS-SSIM see a Gaussian window of 11 px and sigma 1.5 px, data range 255, every channel by
itself. Papers report structural dissimilarity as (1 - SSIM) / 2 or as 1 - SSIM, half or twice the
other: `dssim_half` and `dssim_full`.
"""

import cv2
import numpy as np

DATA_RANGE = 255.0
SSIM_WINDOW = 11
SSIM_SIGMA_PX = 1.5
SSIM_K1 = 0.01
SSIM_K2 = 0.03
# Exponents of the five scales, the finest first.
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
# At the coarsest scale a picture still holds one window.
MS_SSIM_MIN_SIDE_PX = SSIM_WINDOW * 2 ** (len(MS_SSIM_WEIGHTS) - 1)


def squared_error(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(H, W) float64 squared difference per pixel, mean over channels, grey levels squared.

    Raises ValueError if the shapes differ or a value is not finite.
    """
    if image.shape != truth.shape:
        raise ValueError(f"expected two images of one shape, got {image.shape} and {truth.shape}")
    difference = image.astype(np.float64) - truth.astype(np.float64)
    if not np.isfinite(difference).all():
        raise ValueError("expected finite images, got NaN or infinity")
    squared = difference * difference
    return squared.mean(axis=2) if squared.ndim == 3 else squared


def mse(image: np.ndarray, truth: np.ndarray, region: np.ndarray | None = None) -> float:
    """Mean squared error over pixels and channels, grey levels squared (0 to 65025)."""
    return _mean_over(squared_error(image, truth), region)


def psnr_from_mse(mean_squared_error: float) -> float:
    """Peak signal-to-noise ratio, dB, for a peak of 255; infinity for identical images."""
    if mean_squared_error == 0:
        return float("inf")
    return float(10.0 * np.log10(DATA_RANGE**2 / mean_squared_error))


def psnr(image: np.ndarray, truth: np.ndarray, region: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio over a region, dB; infinity where the images are identical."""
    return psnr_from_mse(mse(image, truth, region))


def ssim_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(H, W) float64 structural similarity around every pixel, mean over channels, in [-1, 1].

    Gaussian window of 11 px and sigma 1.5 px, population covariance, K1 0.01, K2 0.03, range 255.
    The picture is mirrored at its border (d c b a | a b c d), so every pixel has a value.
    Raises ValueError if the shapes differ or a side is shorter than the window.
    Source: Wang, Bovik, Sheikh, Simoncelli, "Image quality assessment: from error visibility to
    structural similarity", IEEE TIP 2004, equations 13 to 16.
    """
    return structure_maps(image, truth)[0]


def structure_maps(image: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) float64 similarity as in `ssim_map`, and the part of it without the luminance term."""
    if image.shape != truth.shape:
        raise ValueError(f"expected two images of one shape, got {image.shape} and {truth.shape}")
    if min(image.shape[:2]) < SSIM_WINDOW:
        raise ValueError(f"SSIM needs at least {SSIM_WINDOW} px a side, got {image.shape[:2]}")
    x = np.atleast_3d(image.astype(np.float64))
    y = np.atleast_3d(truth.astype(np.float64))
    # One channel at a time: five blurred float64 copies of a large frame are enough memory.
    maps = [_structure_of_channel(x[..., c], y[..., c]) for c in range(x.shape[2])]
    return np.mean([m[0] for m in maps], axis=0), np.mean([m[1] for m in maps], axis=0)


def _structure_of_channel(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    mean_x, mean_y = _blur(x), _blur(y)
    variance_x = _blur(x * x) - mean_x * mean_x
    variance_y = _blur(y * y) - mean_y * mean_y
    covariance = _blur(x * y) - mean_x * mean_y
    c1 = (SSIM_K1 * DATA_RANGE) ** 2
    c2 = (SSIM_K2 * DATA_RANGE) ** 2
    contrast = (2 * covariance + c2) / (variance_x + variance_y + c2)
    return (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1) * contrast, contrast


def _blur(channel: np.ndarray) -> np.ndarray:
    kernel = cv2.getGaussianKernel(SSIM_WINDOW, SSIM_SIGMA_PX, cv2.CV_64F)
    return cv2.sepFilter2D(channel, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_REFLECT)


def ssim(image: np.ndarray, truth: np.ndarray, region: np.ndarray | None = None) -> float:
    """Mean structural similarity.

    Over the whole frame the outer 5 px, whose windows leave the picture, do not count, as in
    scikit-image. Over a region it is the mean of `ssim_map` over the region's pixels.
    """
    values = ssim_map(image, truth)
    return mean_ssim(values) if region is None else _mean_over(values, region)


def mean_ssim(values: np.ndarray) -> float:
    """Mean of a (H, W) `ssim_map` over the whole frame, without the outer 5 px."""
    margin = SSIM_WINDOW // 2
    return float(values[margin:-margin, margin:-margin].mean(dtype=np.float64))


def dssim_half(similarity: float) -> float:
    """Structural dissimilarity as (1 - SSIM) / 2, in [0, 1]."""
    return (1 - similarity) / 2


def dssim_full(similarity: float) -> float:
    """Structural dissimilarity as 1 - SSIM, in [0, 2]."""
    return 1 - similarity


def ms_ssim(image: np.ndarray, truth: np.ndarray) -> float:
    """Multi-scale structural similarity of whole frames, in [0, 1]; NaN for a side under 176 px.

    Five scales, each the mean of 2 x 2 px of the one before; windows that leave the picture do not
    count. A scale's negative mean counts as 0. Raises ValueError if the shapes differ.
    Source: Wang, Simoncelli, Bovik, "Multi-scale structural similarity for image quality
    assessment", Asilomar 2003, equation 7 and its weights.
    """
    if min(image.shape[:2]) < MS_SSIM_MIN_SIDE_PX:
        return float("nan")
    return ms_ssim_from_maps(image, truth, structure_maps(image, truth))


def ms_ssim_from_maps(image: np.ndarray, truth: np.ndarray, finest: tuple[np.ndarray, np.ndarray]) -> float:
    """`ms_ssim`, given `structure_maps` of the full size."""
    similarity, contrast = (mean_ssim(m) for m in finest)
    product = max(contrast, 0.0) ** MS_SSIM_WEIGHTS[0]
    for weight in MS_SSIM_WEIGHTS[1:]:
        image, truth = _halve(image), _halve(truth)
        similarity, contrast = (mean_ssim(m) for m in structure_maps(image, truth))
        last = weight == MS_SSIM_WEIGHTS[-1]
        product *= max(similarity if last else contrast, 0.0) ** weight
    return product


def _halve(image: np.ndarray) -> np.ndarray:
    """Mean of 2 x 2 px, float64; an odd last row or column is left out."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    blocks = image[: 2 * height, : 2 * width].astype(np.float64)
    return blocks.reshape(height, 2, width, 2, -1).mean(axis=(1, 3))


def flicker_map(
    image: np.ndarray, truth: np.ndarray, earlier: np.ndarray, earlier_truth: np.ndarray
) -> np.ndarray:
    """(H, W) float32 grey levels by which the render changes otherwise than the truth does.

    Absolute difference of the two changes since an earlier frame, mean over channels: 0 for an
    error that stays as it is, whatever its size.
    """
    change = image.astype(np.float32) - earlier.astype(np.float32)
    difference = np.abs(change - (truth.astype(np.float32) - earlier_truth.astype(np.float32)))
    return difference.mean(axis=2) if difference.ndim == 3 else difference


def _mean_over(values: np.ndarray, region: np.ndarray | None) -> float:
    if region is None:
        return float(values.mean(dtype=np.float64))
    if region.shape != values.shape or region.dtype != bool:
        raise ValueError(f"expected a bool region of shape {values.shape}, got {region.dtype} {region.shape}")
    return float(values[region].mean(dtype=np.float64)) if region.any() else float("nan")
