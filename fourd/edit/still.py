"""What one film shows of a place at other times, without depth: pictures laid over each other.

A camera that turns, or that films from afar, moves its picture by a homography. Where most other times agree
on something else than the picture shows, something moves.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from fourd.flow import find_background_homography

# Frames before and after that are laid over a picture: near enough to show the same place, far enough for
# what moves to have left it.
_STEPS = (3, 6, 10, 14, 19, 25, 32)
# Places may be off by so many px: homographies are no depth, and leaves move.
_SHIFT_PX = 2
# Grey levels of no opinion, and beyond it up to a sure one.
_EVEN_LEVELS, _SURE_LEVELS = 15.0, 10.0
_UNKNOWN = 256
# Which piece of the film a picture belongs to, and (3, 3) picture from the piece's first one, px.
Place = tuple[int, np.ndarray]


def register_film(images: Sequence[np.ndarray]) -> list[Place]:
    """Where each (H, W, 3) uint8 picture lies; where nothing holds two together a new piece begins."""
    places: list[Place] = [(0, np.eye(3))]
    for before, image in zip(images, images[1:], strict=False):
        piece, so_far = places[-1]
        step = find_background_homography(before, image)
        places.append((piece + 1, np.eye(3)) if step is None else (piece, step @ so_far))
    return places


def find_movers(
    images: Sequence[np.ndarray], places: Sequence[Place], now: int, masks: Sequence[np.ndarray] | None
) -> np.ndarray:
    """(H, W) float32 -1 (as at other times) to 1 (something else), 0 where nothing is known.

    images: (H, W, 3) uint8;  places: of `register_film`;  now: the picture that is asked about
    masks: (H, W) bool of each picture, what is known to move and is left out
    """
    image = images[now]
    usual, known = _usual_picture(images, places, now, masks)
    usual = np.where(known[..., None], usual, image)
    smooth, ground = (cv2.GaussianBlur(i.astype(np.float32), (0, 0), 0.8) for i in (image, usual))
    height, width = known.shape
    around = np.pad(ground, ((_SHIFT_PX, _SHIFT_PX), (_SHIFT_PX, _SHIFT_PX), (0, 0)), mode="edge")
    least = np.full(known.shape, np.inf, np.float32)
    for dy in range(2 * _SHIFT_PX + 1):
        for dx in range(2 * _SHIFT_PX + 1):
            shifted = around[dy : dy + height, dx : dx + width]
            np.minimum(least, cv2.absdiff(smooth, shifted).max(axis=2), out=least)
    return np.where(known, np.clip((least - _EVEN_LEVELS) / _SURE_LEVELS, -1, 1), 0).astype(np.float32)


def _usual_picture(
    images: Sequence[np.ndarray], places: Sequence[Place], now: int, masks: Sequence[np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) uint8 median of other times in the place of a picture, and (H, W) bool where one is known."""
    height, width = images[now].shape[:2]
    piece, here = places[now]
    times = [t for step in _STEPS for t in (now - step, now + step) if 0 <= t < len(images)]
    samples = [np.full((height, width, 3), _UNKNOWN, np.int16)]
    for time in times:
        if places[time][0] != piece:
            continue
        there_from_here = places[time][1] @ np.linalg.inv(here)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        seen = np.full((height, width), 255, np.uint8)
        if masks is not None:
            seen = cv2.erode(np.where(masks[time], 0, seen).astype(np.uint8), np.ones((7, 7), np.uint8))
        seen = cv2.warpPerspective(seen, there_from_here, (width, height), flags=flags)
        sample = cv2.warpPerspective(images[time], there_from_here, (width, height), flags=flags)
        samples.append(np.where((seen == 255)[..., None], sample.astype(np.int16), np.int16(_UNKNOWN)))
    ordered = np.sort(samples, axis=0)
    count = (ordered[..., :1] < _UNKNOWN).sum(axis=0)
    usual = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    return np.minimum(usual, 255).astype(np.uint8), count[..., 0] > 0
