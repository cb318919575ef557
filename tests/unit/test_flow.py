"""Time compensation: what moves is moved, what stands still keeps its bits."""

import dataclasses

import cv2
import numpy as np
import pytest

from fourd.flow import CompensationOptions, compensate_motion, find_background_homography

SIZE = (240, 160)
FINE = 4
OPTIONS = CompensationOptions()
GAP_S = 1 / 30


def texture(seed: int, size: tuple[int, int]) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(128, 90, (size[1], size[0], 3)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 3 * FINE / 2) * 4 - 3 * 128


BACKGROUND = texture(0, (SIZE[0] * FINE + 200, SIZE[1] * FINE + 200))
MOVER = texture(1, (40 * FINE, 50 * FINE))


def picture(mover_x: float, camera_x: float = 0.0, light: float = 1.0) -> np.ndarray:
    """A textured square in front of a textured wall, both px from the left; the camera may move."""
    wall = BACKGROUND.copy()
    left = round(mover_x * FINE) + 100
    wall[100 + 50 * FINE : 100 + 100 * FINE, left : left + 40 * FINE] = MOVER
    start = 100 + round(camera_x * FINE)
    seen = wall[100 : 100 + SIZE[1] * FINE, start : start + SIZE[0] * FINE]
    small = cv2.resize(seen, SIZE, interpolation=cv2.INTER_AREA)
    return np.clip(np.rint(small * light), 0, 255).astype(np.uint8)


def psnr_db(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    return 10 * np.log10(255**2 / ((a.astype(float) - b)[mask] ** 2).mean())


@pytest.mark.parametrize("speed_px", [2, -3, 6])
@pytest.mark.parametrize("share", [0.25, 0.5])
def test_mover_arrives_where_it_is_at_the_wanted_time(speed_px, share):
    image, neighbour = picture(100), picture(100 + speed_px)
    truth = picture(100 + share * speed_px)
    out = compensate_motion(image, neighbour, -share * GAP_S, GAP_S, OPTIONS)
    concerned = (image != truth).any(axis=2)
    assert psnr_db(out, truth, concerned) > psnr_db(image, truth, concerned) + 6


def test_sign_of_dt_says_only_on_which_side_the_neighbour_is():
    image, neighbour = picture(100), picture(96)
    after = compensate_motion(image, neighbour, 0.4 * GAP_S, GAP_S, OPTIONS)
    before = compensate_motion(image, neighbour, -0.4 * GAP_S, GAP_S, OPTIONS)
    np.testing.assert_array_equal(after, before)


def test_whole_gap_is_the_neighbour_for_what_moves():
    image, neighbour = picture(100), picture(104)
    out = compensate_motion(image, neighbour, -GAP_S * (1 + 1e-9), GAP_S, OPTIONS)
    concerned = (image != neighbour).any(axis=2)
    assert psnr_db(out, neighbour, concerned) > psnr_db(image, neighbour, concerned) + 6


def test_static_pixels_keep_their_bits_while_the_hand_shakes():
    image, neighbour = picture(100), picture(105, camera_x=2.75)
    truth = picture(102)
    out = compensate_motion(image, neighbour, -0.4 * GAP_S, GAP_S, OPTIONS)
    concerned = (image != truth).any(axis=2)
    assert psnr_db(out, truth, concerned) > psnr_db(image, truth, concerned) + 6
    far = cv2.dilate(concerned.astype(np.uint8), np.ones((41, 41))) == 0
    assert far.mean() > 0.5
    np.testing.assert_array_equal(out[far], image[far])


def test_camera_motion_alone_changes_nothing():
    image, neighbour = picture(100), picture(100, camera_x=3.5)
    np.testing.assert_array_equal(compensate_motion(image, neighbour, -0.01, GAP_S, OPTIONS), image)


@pytest.mark.parametrize("dt_s", [0.0, 0.0015, -0.0015])
def test_near_the_wanted_time_nothing_changes(dt_s):
    out = compensate_motion(picture(100), picture(106), dt_s, GAP_S, OPTIONS)
    np.testing.assert_array_equal(out, picture(100))


def test_zero_threshold_still_leaves_the_exact_moment_alone():
    options = dataclasses.replace(OPTIONS, min_dt_s=0.0)
    np.testing.assert_array_equal(
        compensate_motion(picture(100), picture(106), 0.0, GAP_S, options), picture(100)
    )


@pytest.mark.parametrize(
    "neighbour",
    [
        picture(104, light=0.8),
        np.random.default_rng(2).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8),
        np.zeros((SIZE[1], SIZE[0], 3), np.uint8),
    ],
    ids=["darker", "another scene", "black"],
)
def test_a_neighbour_that_does_not_fit_changes_nothing(neighbour):
    image = picture(100)
    np.testing.assert_array_equal(compensate_motion(image, neighbour, -0.01, GAP_S, OPTIONS), image)


def test_same_pictures_give_the_same_bytes_whatever_the_threads():
    image, neighbour = picture(100), picture(105)
    threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        one = compensate_motion(image, neighbour, -0.012, GAP_S, OPTIONS)
        cv2.setNumThreads(4)
        four = compensate_motion(image, neighbour, -0.012, GAP_S, OPTIONS)
    finally:
        cv2.setNumThreads(threads)
    np.testing.assert_array_equal(one, four)


@pytest.mark.parametrize("size", [(8, 8), (16, 9), (33, 61), (1, 1)])
def test_tiny_pictures_are_no_reason_to_fail(size):
    noise = np.random.default_rng(3).integers(0, 256, (2, size[1], size[0], 3), dtype=np.uint8)
    assert compensate_motion(noise[0], noise[1], -0.01, GAP_S, OPTIONS).shape == noise[0].shape


def test_wide_pictures_have_their_flow_computed_smaller():
    options = dataclasses.replace(OPTIONS, max_flow_width_px=120)
    image, neighbour, truth = picture(100), picture(106), picture(103)
    out = compensate_motion(image, neighbour, -GAP_S / 2, GAP_S, options)
    concerned = (image != truth).any(axis=2)
    assert psnr_db(out, truth, concerned) > psnr_db(image, truth, concerned) + 3


def test_homography_is_that_of_the_background():
    found = find_background_homography(picture(100), picture(106, camera_x=2.5))
    assert found is not None
    corners = np.array([[[10.0, 10]], [[220, 10]], [[220, 150]], [[10, 150]]])
    moved = cv2.perspectiveTransform(corners, found)
    np.testing.assert_allclose(moved - corners, np.broadcast_to([-2.5, 0], corners.shape), atol=0.15)


@pytest.mark.parametrize(
    "neighbour, dt_s, gap_s",
    [
        (picture(100)[:-1], 0.01, GAP_S),
        (picture(100).astype(np.float32), 0.01, GAP_S),
        (picture(100), 0.01, 0.0),
        (picture(100), 0.05, GAP_S),
        (picture(100), float("nan"), GAP_S),
    ],
)
def test_impossible_arguments_are_refused(neighbour, dt_s, gap_s):
    with pytest.raises(ValueError, match="expected"):
        compensate_motion(picture(100), neighbour, dt_s, gap_s, OPTIONS)
