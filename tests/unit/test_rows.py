import cv2
import numpy as np
import pytest

from fourd.camera import Camera
from fourd.stereo.disparity import StereoOptions, find_row_shift, make_matcher, match_pair, rectify_image
from fourd.stereo.rectification import Rectification
from fourd.stereo.rows import RowShift, measure_rows

HEIGHT, WIDTH = 240, 360
RANGE = (0.0, 16.0)
DISPARITY = 8.0
ALL = np.ones((HEIGHT, WIDTH), bool)


def picture() -> np.ndarray:
    """(H, W, 3) uint8 smooth noise at several scales."""
    rng = np.random.default_rng(5)
    image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    for cells in (15, 50, 110):
        image += cv2.resize(rng.uniform(0, 85, (cells, cells, 3)).astype(np.float32), (WIDTH, HEIGHT))
    return image.astype(np.uint8)


def seen_from_the_right(offset: float = 0.0, scale: float = 1.0, along_x: float = 0.0) -> np.ndarray:
    """The picture 8 px to the left, where row y shows up in row offset + scale y + along_x x."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    source = (y - np.float32(offset) - np.float32(along_x) * x) / np.float32(scale)
    return cv2.remap(
        picture(), x + np.float32(DISPARITY), source, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


def flat_pair() -> tuple[Rectification, tuple[Camera, Camera]]:
    K = np.array([[300.0, 0, WIDTH / 2], [0, 300.0, HEIGHT / 2], [0, 0, 1]])
    size = (WIDTH, HEIGHT)
    right = np.array([1.0, 0, 0])
    cameras = Camera(K, np.eye(3), np.zeros(3), size), Camera(K, np.eye(3), -right, size)
    return Rectification(K, K, np.eye(3), np.zeros(3), right, size, RANGE), cameras


def shift_at(rows: RowShift, x: float, y: float) -> float:
    return rows.offset + rows.along_y * y + rows.along_x * x


@pytest.mark.parametrize(
    ("offset", "scale", "along_x"), [(0.7, 1.002, 0.0), (-1.5, 1.0, 0.0), (0.3, 0.997, 0.003)]
)
def test_shift_stretch_and_turn_are_measured(offset, scale, along_x):
    rows = measure_rows(picture(), seen_from_the_right(offset, scale, along_x), (ALL, ALL), RANGE)
    assert rows is not None
    for x, y in ((20, 20), (340, 20), (20, 220), (340, 220)):
        true = offset + (scale - 1) * y + along_x * x
        assert shift_at(rows, x, y) == pytest.approx(true, abs=0.1)
    assert rows.after_px < 0.1 < rows.before_px


def test_a_stretch_without_a_turn_has_none():
    rows = measure_rows(picture(), seen_from_the_right(0.7, 1.002), (ALL, ALL), RANGE)
    assert rows is not None and rows.along_x == 0


def test_a_tenth_of_wrong_matches_changes_nothing():
    right = seen_from_the_right(0.7)
    clean = measure_rows(picture(), right, (ALL, ALL), RANGE)
    # A tenth of the picture slides down by two rows.
    right[:, 200:236] = np.roll(right[:, 200:236], 2, axis=0)
    pulled = measure_rows(picture(), right, (ALL, ALL), RANGE)
    assert clean is not None and pulled is not None
    assert shift_at(pulled, 180, 120) == pytest.approx(shift_at(clean, 180, 120), abs=0.05)


def test_aligned_pairs_stay_as_they_are():
    rectification, cameras = flat_pair()
    images = picture(), seen_from_the_right()
    rows = find_row_shift(rectification, cameras, images, StereoOptions())
    assert rows is None


def test_pictures_without_corners_or_matches_stay_as_they_are():
    flat = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    assert measure_rows(flat, flat, (ALL, ALL), RANGE) is None
    assert measure_rows(picture(), noise, (ALL, ALL), RANGE) is None
    assert measure_rows(picture(), seen_from_the_right(0.7), (~ALL, ALL), RANGE) is None


def test_the_one_resampling_undoes_it():
    rectification, cameras = flat_pair()
    images = picture(), seen_from_the_right(0.7, 1.002)
    rows = find_row_shift(rectification, cameras, images, StereoOptions())
    right, valid = rectify_image(images[1], rectification, cameras[1], "right", "cubic", rows)
    shown = right.astype(float)[:, : -int(DISPARITY)] - images[0].astype(float)[:, int(DISPARITY) :]
    inner = valid[:, : -int(DISPARITY)]
    assert np.abs(shown[inner]).mean() < 1.5
    left, _ = rectify_image(images[0], rectification, cameras[0], "left", "cubic", rows)
    np.testing.assert_array_equal(left, images[0])


def test_aligned_rows_match_better():
    rectification, cameras = flat_pair()
    images = picture(), seen_from_the_right(1.4)
    options = StereoOptions()
    rows = find_row_shift(rectification, cameras, images, options)
    errors = [
        np.abs(
            match_pair(rectification, cameras, images, make_matcher(options), options, r).left_disparity - 8
        )
        for r in (None, rows)
    ]
    assert np.nanmean(errors[1]) < 0.5 * np.nanmean(errors[0])
    # NaN is not right either.
    assert (errors[1] < 0.2).mean() > (errors[0] < 0.2).mean()
