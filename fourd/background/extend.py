"""Surfaces continued beyond where two cameras see them, so that a single camera can colour them."""

import cv2
import numpy as np

from fourd.background.fill import FAR, ONE_SURFACE_NEARBY

# Planes are fitted on a grid of at most this many columns or rows: what they are for is coarse.
GRID = 240
# Half a window's side and its least known share; a smaller patch says nothing of its slope.
WINDOW = 12
LEAST_SHARE = 0.35
# Mean distance of a window's inverse depths from its plane, as a share of the plane's.
LEAST_FLAT = 0.01
# Surfaces with a smaller share of the picture are not continued.
LEAST_SURFACE = 0.01
# Planes count by their distance to the power of minus this, and by their area.
POWER = 4
# Unknown regions of a smaller share of the picture stay: what is hidden there continues nothing.
LEAST_REGION = 0.005


def extend_surfaces(inverse_depth: np.ndarray) -> np.ndarray:
    """Continue the planes around large unknown regions into these.

    inverse_depth: (H, W) float32, negative = unknown, affine in the pixel on a plane; changed in place
    Ground and walls go on beyond what two cameras share; one camera suffices for their colour. Nothing
    comes nearer than what is known; what would lie behind infinity is put there. Without any plane all
    stays as it is.
    Returns (H, W) bool, the pixels that were filled.
    """
    unknown = _large_regions(inverse_depth < 0)
    step = max(1, -(-max(inverse_depth.shape) // GRID))
    planes, known = _fit_planes(inverse_depth[::step, ::step])
    if not unknown.any() or not known.any():
        return np.zeros_like(unknown)
    spread = _spread(planes, known)
    y, x = np.nonzero(unknown)
    height, width = inverse_depth.shape
    # Bilinear between grid nodes, at pixels that are multiples of the step.
    columns = (np.arange(width, dtype=np.float32) / step)[None].repeat(height, axis=0)
    rows = (np.arange(height, dtype=np.float32) / step)[:, None].repeat(width, axis=1)
    fine = [
        cv2.remap(c, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[y, x] for c in spread
    ]
    guess = fine[0] + fine[1] * (x / step) + fine[2] * (y / step)
    inverse_depth[y, x] = np.clip(guess, 0, inverse_depth.max()).astype(np.float32)
    return unknown


def _large_regions(unknown: np.ndarray) -> np.ndarray:
    """(H, W) bool, the connected parts that are worth a guess."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(unknown.astype(np.uint8), connectivity=8)
    is_large = stats[:, cv2.CC_STAT_AREA] >= LEAST_REGION * unknown.size
    is_large[0] = False
    return is_large[np.asarray(labels, np.int64)]


def _fit_planes(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Plane of the surface around each node: (3, h, w) float64 constant, x and y slope, and (h, w) bool.

    values: (h, w) float32 inverse depths, negative = unknown
    """
    planes, is_flat = np.zeros((3, *values.shape)), np.zeros(values.shape, bool)
    labels, stats = _label_surfaces(values)
    y, x = np.mgrid[: values.shape[0], : values.shape[1]].astype(np.float64)
    for number in np.flatnonzero(stats[:, cv2.CC_STAT_AREA] >= LEAST_SURFACE * values.size):
        inside = labels == number
        if number == 0 or not inside.any():
            continue
        weight, z = inside.astype(np.float64), np.where(inside, values, 0).astype(np.float64)
        count = np.maximum(_sum(weight), 1e-9)
        mx, my, mz = (_sum(weight * a) / count for a in (x, y, z))
        # A trace of ridge: a single row or column has no slope across it.
        xx, yy = (_sum(weight * a * a) / count - m * m + 1e-3 for a, m in ((x, mx), (y, my)))
        xy = _sum(weight * x * y) / count - mx * my
        xz, yz = (_sum(a * z) / count - m * mz for a, m in ((x, mx), (y, my)))
        slope_x, slope_y = (xz * yy - yz * xy) / (xx * yy - xy**2), (yz * xx - xz * xy) / (xx * yy - xy**2)
        constant = mz - slope_x * mx - slope_y * my
        off = np.abs(constant + slope_x * x + slope_y * y - z) * inside
        flat = inside & (count > LEAST_SHARE * (2 * WINDOW + 1) ** 2)
        flat &= (off < LEAST_FLAT * mz) & (_sum(off) / count < LEAST_FLAT * mz)
        planes[:, flat] = np.stack([constant, slope_x, slope_y])[:, flat]
        is_flat |= flat
    return planes, is_flat


def _sum(values: np.ndarray) -> np.ndarray:
    side = (2 * WINDOW + 1, 2 * WINDOW + 1)
    return cv2.boxFilter(values, -1, side, normalize=False, borderType=cv2.BORDER_CONSTANT)


def _label_surfaces(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) int32 numbers of connected parts without a step in depth, 0 = none, and OpenCV's statistics."""
    is_smooth = values >= 0
    far = FAR * np.median(values[values >= 0]) if is_smooth.any() else 0.0
    for axis in (0, 1):
        here, there = (np.take(values, range(a, values.shape[axis] - 1 + a), axis) for a in (0, 1))
        steps = np.abs(here - there) > ONE_SURFACE_NEARBY * np.maximum(np.maximum(here, there), far)
        part = [slice(None), slice(None)]
        part[axis] = slice(1, None)
        is_smooth[tuple(part)] &= ~steps
    _, labels, stats, _ = cv2.connectedComponentsWithStats(is_smooth.astype(np.uint8), connectivity=4)
    return labels, stats


def _spread(planes: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(3, h, w) float32: the planes' average around every node, near ones counting most."""
    height, width = known.shape
    stacked = np.dstack([known.astype(np.float64), *planes])
    total = np.zeros(stacked.shape)
    for scale in range(1, 1 + max(known.shape).bit_length()):
        cell = 2**scale
        size = max(1, -(-width // cell)), max(1, -(-height // cell))
        # Means over cells and back by interpolation: a tent of the cell's width around every node.
        means = cv2.resize(stacked, size, interpolation=cv2.INTER_AREA)
        total += float(cell) ** -POWER * cv2.resize(means, (width, height), interpolation=cv2.INTER_LINEAR)
    weights = np.maximum(total[..., 0], np.finfo(np.float64).tiny)
    return np.moveaxis(total[..., 1:] / weights[..., None], 2, 0).astype(np.float32)
