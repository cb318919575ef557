"""Images: resampling between views of one centre, sizes, padding, labelled sheets.

Images are (H, W, 3) uint8 RGB, display-referred; sizes are (width, height).
"""

from collections.abc import Sequence

import cv2
import numpy as np

from fourd.camera import Camera

WHITE = (255, 255, 255)
LABEL_BACKGROUND = (24, 24, 24)


def undistort(image: np.ndarray, camera: Camera, target: Camera) -> tuple[np.ndarray, np.ndarray]:
    """A physical frame as its ideal pinhole sees it, in one bicubic resampling.

    image: (H, W, 3) uint8 taken by `camera`;  target: a camera with the same centre, any size,
    lens and rotation. Where the target has fewer pixels per angle, a whole number of samples per
    side is averaged, so that fine texture does not alias.
    Returns (h, w, 3) uint8 and (h, w) bool, False (and black) where `camera` did not look. Equal
    cameras give the same array back.
    Raises ValueError if the image is not of the camera's size or the centres differ.
    """
    if image.shape[1::-1] != camera.size:
        raise ValueError(f"expected an image of {camera.size} px, got {image.shape[1::-1]}")
    if _same_view(camera, target):
        return image, np.ones(image.shape[:2], bool)
    _check_same_center(camera, target)
    step = max(1, int(np.ceil(camera.focal_px / target.focal_px - 0.25)))
    fine = target.resized((target.size[0] * step, target.size[1] * step))
    pixels = _source_pixels(camera, fine)
    width, height = camera.size
    with np.errstate(invalid="ignore"):
        x, y = pixels[..., 0], pixels[..., 1]
        valid = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    pixels = np.where(valid[..., None], pixels, -1.0).astype(np.float32)
    # Mirrored at the border, so that the outermost half pixel is not darkened by a blank.
    resampled = cv2.remap(
        image, pixels[..., 0], pixels[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    if step > 1:
        resampled = cv2.resize(resampled, target.size, interpolation=cv2.INTER_AREA)
        valid = valid.reshape(target.size[1], step, target.size[0], step).all(axis=(1, 3))
    resampled[~valid] = 0
    return np.asarray(resampled), np.asarray(valid)


def _same_view(a: Camera, b: Camera) -> bool:
    pairs = ((a.K, b.K), (a.R, b.R), (a.t, b.t), (a.distortion, b.distortion))
    return a.size == b.size and all(np.array_equal(x, y) for x, y in pairs)


def _check_same_center(a: Camera, b: Camera) -> None:
    offset = float(np.linalg.norm(a.center - b.center))
    if offset > 1e-6 * max(float(np.linalg.norm(a.t)), float(np.linalg.norm(b.t))):
        raise ValueError(f"undistort needs two cameras with one centre, got {offset:.3g} world units between")


def _source_pixels(camera: Camera, target: Camera) -> np.ndarray:
    """(h, w, 2) float64 px in `camera` of every pixel of `target`; NaN behind the camera."""
    width, height = target.size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    directions = target.rays(grid) @ (camera.R @ target.R.T).T
    depth = directions[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = camera.pixels_from_normalized(directions[..., :2] / depth)
    return np.where(depth > 0, pixels, np.nan)


def resize_area(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The picture at another size: averaged over areas when smaller, bicubic when larger."""
    if image.shape[1::-1] == tuple(size):
        return image
    shrinks = size[0] <= image.shape[1] and size[1] <= image.shape[0]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


def fit_inside(image: np.ndarray, size: tuple[int, int], fill: int = 0) -> np.ndarray:
    """The picture as large as it fits into (width, height) without distortion, centred on grey `fill`."""
    scale = min(size[0] / image.shape[1], size[1] / image.shape[0])
    inner = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    canvas = np.full((size[1], size[0], *image.shape[2:]), fill, image.dtype)
    left, top = (size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2
    canvas[top : top + inner[1], left : left + inner[0]] = resize_area(image, inner)
    return canvas


def pad_to_multiple(image: np.ndarray, multiple: int) -> tuple[np.ndarray, tuple[slice, slice]]:
    """Zero padding on all sides up to the next multiple of `multiple` in height and width.

    image: (H, W) or (H, W, C). Returns the padded array and the window that `crop` takes back.
    """
    height, width = image.shape[:2]
    extra_height, extra_width = -height % multiple, -width % multiple
    top, left = extra_height // 2, extra_width // 2
    around = [(top, extra_height - top), (left, extra_width - left)] + [(0, 0)] * (image.ndim - 2)
    return np.pad(image, around), (slice(top, top + height), slice(left, left + width))


def crop(image: np.ndarray, window: tuple[slice, slice]) -> np.ndarray:
    """The window of an image, inverse of `pad_to_multiple`."""
    return image[window]


def uint8_from_float(image: np.ndarray) -> np.ndarray:
    """0-1 float to 0-255 uint8, clipped and rounded to nearest. Raises ValueError on NaN."""
    if np.isnan(image).any():
        raise ValueError("expected an image without NaN")
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def grey_from_rgb(image: np.ndarray) -> np.ndarray:
    """(H, W) float32 luma on the 0-255 scale (ITU-R BT.601 weights, as in OpenCV)."""
    return image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)


def difference_of(image: np.ndarray, changed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What `apply_difference` needs to make `changed` of `image`, exactly.

    image, changed: (H, W, 3) uint8. Returns (ceil(H W / 8),) uint8 packed bits of where they differ, and
    (n, 3) uint8 what stands there.
    """
    differs = (image != changed).any(axis=2)
    return np.packbits(differs), changed[differs]


def apply_difference(image: np.ndarray, where: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """A copy of (H, W, 3) uint8 `image` with the pixels of `difference_of` put in."""
    result = image.copy()
    height, width = image.shape[:2]
    result[np.unpackbits(where, count=height * width).reshape(height, width).astype(bool)] = rgb
    return result


def label_image(text: str, size: tuple[int, int], left: bool = False) -> np.ndarray:
    """White text on dark grey, as large as fits into (width, height), centred or at the left."""
    width, height = size
    font, margin = cv2.FONT_HERSHEY_SIMPLEX, 3
    canvas = np.full((height, width, 3), LABEL_BACKGROUND, np.uint8)
    # The height of a text with ascenders and descenders, so that labels of one size look alike.
    (_, text_height), below = cv2.getTextSize("Ag|", font, 1.0, 1)
    (text_width, _), _ = cv2.getTextSize(text, font, 1.0, 1)
    if text_width == 0:
        return canvas
    scale = min((width - 2 * margin) / text_width, (height - margin) / (text_height + below))
    (text_width, _), _ = cv2.getTextSize(text, font, scale, 1)
    x = margin if left else max(margin, (width - text_width) // 2)
    y = round((height + (text_height - below) * scale) / 2)
    cv2.putText(canvas, text, (x, y), font, scale, WHITE, 1, cv2.LINE_AA)
    return canvas


def tile_images(rows: Sequence[Sequence[np.ndarray]], gap: int = 2, fill: int = 255) -> np.ndarray:
    """One sheet from a grid of images; images of a row share a height, of a column a width.

    Raises ValueError for an empty or ragged grid.
    """
    if not rows or not rows[0] or any(len(row) != len(rows[0]) for row in rows):
        raise ValueError(f"expected a full grid of images, got rows of {[len(row) for row in rows]}")
    heights = [row[0].shape[0] for row in rows]
    widths = [image.shape[1] for image in rows[0]]
    sheet = np.full(
        (sum(heights) + gap * (len(rows) - 1), sum(widths) + gap * (len(widths) - 1), 3), fill, np.uint8
    )
    top = 0
    for row, height in zip(rows, heights, strict=True):
        left = 0
        for image, width in zip(row, widths, strict=True):
            sheet[top : top + height, left : left + width] = image
            left += width + gap
        top += height + gap
    return sheet
