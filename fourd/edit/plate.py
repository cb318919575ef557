"""What a part of a picture would show if nothing moved: the same camera at other times, by depth."""

from collections.abc import Sequence

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.edit.moving import project_ideal, sample_depth

Window = tuple[slice, slice]
# Depths between which a plate is looked for, as multiples of a typical one: from half an arm before the
# nearest wall to where a ray no longer moves by a pixel in another picture.
NEAREST, FARTHEST = 0.2, 100.0
# Difference of two depths of one surface, as a share of the depth.
_SAME = 0.03
# A picture is as bright as its plate times 1, give or take noise, or darker in a shadow.
_NOISE_LEVELS = 14.0
# Grey levels beside the best light and the best place around that are surely something else.
_SURE_LEVELS = 21.0
DARKEST_SHADOW = 0.35


def plate_of(
    camera: Camera,
    window: Window,
    depth_range: tuple[float, float],
    others: Sequence[tuple[Camera, np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours of what stands still, in a window of a picture.

    camera: ideal pinhole;  depth_range: nearest and farthest z that is looked for
    others: camera, (H, W, 3) uint8 picture and (H, W) float32 z, NaN where it moves or is unknown, of other
    times
    Returns (h, w, 3) uint8, what most of the times show, (h, w) bool where at least one time tells, and
    (h, w) float32 z, infinite where unknown.
    """
    rows, columns = window
    shape = rows.stop - rows.start, columns.stop - columns.start
    nearest = np.full(shape, np.inf, np.float32)
    for other, _, depth in others:
        points = _points_in_window(other, depth, camera, window, depth_range)
        pixels, z = project_ideal(camera, points)
        x = np.rint(pixels[:, 0]).astype(np.int64) - columns.start
        y = np.rint(pixels[:, 1]).astype(np.int64) - rows.start
        inside = (z > 0) & (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
        np.minimum.at(nearest, (y[inside], x[inside]), z[inside].astype(np.float32))
    around = cv2.erode(nearest, np.ones((3, 3), np.uint8))
    nearest = np.where(np.isfinite(nearest), nearest, around)
    known = np.isfinite(nearest)
    y, x = np.nonzero(known)
    places = camera.unproject(
        np.stack([x + columns.start, y + rows.start], axis=-1).astype(np.float64),
        nearest[known].astype(float),
    )
    return *_usual_colours(places, known, others), nearest


def _points_in_window(
    other: Camera, depth: np.ndarray, camera: Camera, window: Window, depth_range: tuple[float, float]
) -> np.ndarray:
    """World points of the part of another picture that may show up in the window."""
    rows, columns = window
    corners = np.array(
        [[x, y] for x in (columns.start, columns.stop) for y in (rows.start, rows.stop)], float
    )
    ends = np.concatenate([camera.unproject(corners, np.full(4, z)) for z in depth_range])
    pixels, z = project_ideal(other, ends)
    height, width = depth.shape
    low, high = np.zeros(2), np.array([width, height], float)
    if (z > 0).all():
        low, high = np.maximum(pixels.min(axis=0), low), np.minimum(pixels.max(axis=0) + 1, high)
    left, top = (int(v) for v in np.minimum(low, high))
    right, bottom = (int(np.ceil(v)) for v in high)
    part = depth[top:bottom, left:right]
    y, x = np.nonzero(np.isfinite(part))
    places = np.stack([x + left, y + top], axis=-1).astype(np.float64)
    return other.unproject(places, part[y, x].astype(np.float64))


def _usual_colours(
    places: np.ndarray, known: np.ndarray, others: Sequence[tuple[Camera, np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    samples = np.full((len(others), len(places), 3), 256, np.int16)
    for i, (other, image, depth) in enumerate(others):
        seen, z = sample_depth(other, depth, places)
        with np.errstate(invalid="ignore"):
            same = np.abs(seen - z) <= _SAME * z
        at = project_ideal(other, places[same])[0].astype(np.float32).reshape(-1, 1, 2)
        if len(at):
            samples[i, same] = _bilinear(image, at)
    ordered = np.sort(samples, axis=0)
    count = (ordered[..., 0] < 256).sum(axis=0)
    # Above the median: a shadow that passes darkens a place at some of the times.
    upper = np.minimum(2 * count // 3, np.maximum(count - 1, 0))
    usual = np.take_along_axis(ordered, upper[None, :, None], axis=0)[0]
    rgb, told = np.zeros((*known.shape, 3), np.uint8), np.zeros(known.shape, bool)
    told[known] = count > 0
    rgb[known] = np.where(count[:, None] > 0, usual, 0).astype(np.uint8)
    return rgb, told


def _bilinear(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(N, 3) of (N, 1, 2) float32 places, in strips as long as a remap may be."""
    strips = [at[i : i + 16384] for i in range(0, len(at), 16384)]
    return np.concatenate([cv2.remap(image, strip, None, cv2.INTER_LINEAR)[:, 0] for strip in strips])  # type: ignore[call-overload]


def is_plate(image: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """(H, W) bool: the picture shows the plate, in the light or in a shadow.

    image, plate: (H, W, 3) uint8. A shadow darkens all three channels about alike.
    """
    return _difference(*_smooth(image, plate)) <= _NOISE_LEVELS


def is_no_plate(image: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """(H, W) bool: the picture surely shows something else, as the plate a pixel to any side is unlike too.

    image, plate: (H, W, 3) uint8. Neither noise, a shadow nor a plate that is off by a pixel differ so much.
    """
    picture, ground = _smooth(image, plate)
    height, width = ground.shape[:2]
    around = np.pad(ground, ((1, 1), (1, 1), (0, 0)), mode="edge")
    least = np.full((height, width), np.inf, np.float32)
    for dy in range(3):
        for dx in range(3):
            np.minimum(least, _difference(picture, around[dy : dy + height, dx : dx + width]), out=least)
    return least > _SURE_LEVELS


def _smooth(*images: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.7) for image in images)


def _difference(picture: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """(H, W) float32 grey levels by which a picture is off the ground in the light that fits best."""
    share = (picture * ground).sum(axis=2) / np.maximum((ground * ground).sum(axis=2), 1.0)
    share = np.clip(share, DARKEST_SHADOW, 1.0)[..., None]
    return np.abs(picture - share * ground).max(axis=2)
