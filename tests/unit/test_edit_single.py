"""A mask through one film without depth: what other times show settles what flow and colour cannot."""

import functools

import cv2
import numpy as np
import pytest

from fourd.edit.carry import carry_flow
from fourd.edit.single import follow_mask
from fourd.edit.still import find_movers, register_film
from fourd.edit.voxels import UNKNOWN

NUM_FRAMES, SIZE = 24, (160, 120)
SIDE = 36
# Pictures may be off by so much (`fourd.edit.still`).
SHIFT_PX = 2


@functools.cache
def film() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """A square walks before a wall of its own colours while the camera turns; where it is."""
    rng = np.random.default_rng(3)
    wall, square = (
        np.clip(cv2.GaussianBlur(rng.normal(128, 90, (*shape, 3)), (0, 0), 1.5) * 3 - 256, 0, 255)
        for shape in ((SIZE[1], SIZE[0] + 60), (SIDE, SIDE))
    )
    images, masks = [], []
    for frame in range(NUM_FRAMES):
        image = wall[:, frame : frame + SIZE[0]].copy()
        left = 15 + 3 * frame
        image[45 : 45 + SIDE, left : left + SIDE] = square
        mask = np.zeros(image.shape[:2], bool)
        mask[45 : 45 + SIDE, left : left + SIDE] = True
        images.append(image.astype(np.uint8))
        masks.append(mask)
    return images, masks


def iou(mask: np.ndarray, truth: np.ndarray) -> float:
    return float((mask & truth).sum() / max((mask | truth).sum(), 1))


def test_the_wall_is_registered_whatever_walks_before_it() -> None:
    places = register_film(film()[0])
    corners = np.array([[[10, 10]], [[150, 10]], [[10, 110]], [[80, 60]]], np.float64)
    for frame, (piece, place) in enumerate(places):
        assert piece == 0
        moved = cv2.perspectiveTransform(corners, place) - corners
        assert np.abs(moved - [-frame, 0]).max() < SHIFT_PX


def test_what_moves_is_unlike_other_times_and_the_unseen_is_no_opinion() -> None:
    images, masks = film()
    places = register_film(images)
    for frame in (0, 12, 23):
        evidence = find_movers(images, places, frame, None)
        told = evidence != 0
        assert (evidence[masks[frame] & told] > 0).mean() > 0.85
        assert (evidence[~masks[frame] & told] < 0).mean() > 0.85
    first_alone = find_movers(images[:1], places[:1], 0, None)
    assert (first_alone == 0).all()
    everything = [np.ones_like(mask) for mask in masks]
    assert (find_movers(images, places, 12, everything) == 0).all()


def test_pictures_that_nothing_holds_together_are_pieces() -> None:
    images, _ = film()
    blank = np.full_like(images[0], 128)
    pieces = [piece for piece, _ in register_film([*images[:3], blank, *images[3:6]])]
    assert pieces == [0, 0, 0, 1, 2, 2, 2]


def test_a_thing_of_the_walls_own_colours_is_followed() -> None:
    images, masks = film()
    found = follow_mask(images, masks[0])
    assert min(iou(*pair) for pair in zip(found, masks, strict=True)) > 0.85


def test_a_thing_is_found_again_where_flow_knows_nothing() -> None:
    images, masks = film()

    def forgetful(image: np.ndarray, before: np.ndarray, mask: np.ndarray) -> np.ndarray:
        carried = carry_flow(image, before, mask)
        carried[:, SIZE[0] // 2 :] = UNKNOWN
        return carried

    found = follow_mask(images, masks[0], forgetful)
    assert np.mean([iou(*pair) for pair in zip(found, masks, strict=True)]) > 0.75


@pytest.mark.parametrize("size", [(160, 120), (640, 480)])
def test_masks_have_the_size_of_the_film(size: tuple[int, int]) -> None:
    images, masks = film()
    large = [cv2.resize(image, size) for image in images[:4]]
    first = cv2.resize(masks[0].astype(np.uint8), size) > 0
    found = follow_mask(large, first)
    assert len(found) == 4 and all(mask.shape == size[::-1] and mask.dtype == bool for mask in found)
