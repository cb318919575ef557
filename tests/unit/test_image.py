import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd import image as im
from fourd import metrics
from fourd.camera import Camera


def make_camera(size=(96, 64), focal=90.0, distortion=None) -> Camera:
    K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
    lens = np.zeros(5) if distortion is None else np.array(distortion, dtype=np.float64)
    return Camera(K, np.eye(3), np.array([0.3, -0.2, 2.0]), size, lens)


def smooth_scene(camera: Camera) -> np.ndarray:
    """What a camera sees of a pattern at infinity, exact per pixel."""
    grid = np.stack(np.meshgrid(np.arange(camera.size[0]), np.arange(camera.size[1])), -1).astype(float)
    directions = camera.rays(grid) @ camera.R
    x, y = directions[..., 0] / directions[..., 2], directions[..., 1] / directions[..., 2]
    channels = [np.sin(14 * x + 3 * y), np.cos(11 * y - 2 * x), np.sin(9 * (x + y))]
    return (127.5 + 100 * np.stack(channels, -1)).round().astype(np.uint8)


def test_equal_cameras_give_the_same_bytes():
    camera = make_camera()
    frame = smooth_scene(camera)
    result, valid = im.undistort(frame, camera, make_camera())
    assert result is frame
    assert valid.all()


@pytest.mark.parametrize("distortion", [[-0.2, 0.05, 0, 0, 0], [0.15, 0, 0.002, -0.003, 0.01]])
def test_undistort_shows_the_scene_as_the_pinhole_sees_it(distortion):
    camera = make_camera(distortion=distortion)
    result, valid = im.undistort(smooth_scene(camera), camera, camera.without_distortion())
    truth = smooth_scene(camera.without_distortion())
    assert valid.mean() > 0.8
    assert metrics.psnr(result, truth, valid) > 42


def test_undistort_averages_when_the_target_is_smaller():
    camera = make_camera((288, 192), 270.0, [-0.1, 0, 0, 0, 0])
    checker = np.indices((192, 288)).sum(0) % 2 * 255
    frame = np.repeat(checker[..., None], 3, 2).astype(np.uint8)
    result, valid = im.undistort(frame, camera, camera.without_distortion().resized((96, 64)))
    assert abs(float(result[valid].mean()) - 127.5) < 2
    assert float(result[valid].std()) < 30


def test_pure_downscale_equals_area_average():
    camera = make_camera((96, 64))
    frame = smooth_scene(camera)
    result, valid = im.undistort(frame, camera, camera.resized((48, 32)))
    assert valid.all()
    assert np.abs(result.astype(int) - im.resize_area(frame, (48, 32)).astype(int)).max() <= 1


def test_undistort_marks_what_the_camera_did_not_see():
    camera = make_camera()
    wide = make_camera(focal=45.0)
    result, valid = im.undistort(np.full((64, 96, 3), 200, np.uint8), camera, wide)
    assert 0.2 < valid.mean() < 0.3
    assert (result[~valid] == 0).all()
    assert (result[valid] == 200).all()


def test_convention_a_blank_is_invalid_not_black():
    black = np.zeros((64, 96, 3), np.uint8)
    result, valid = im.undistort(black, make_camera(), make_camera(focal=45.0))
    assert (result == 0).all()
    assert valid[32, 48] and not valid[0, 0]


def test_undistort_refuses_what_it_cannot_mean():
    camera = make_camera()
    other = Camera(camera.K, camera.R, camera.t + 0.1, camera.size)
    with pytest.raises(ValueError, match="one centre"):
        im.undistort(smooth_scene(camera), camera, other)
    with pytest.raises(ValueError, match="expected an image of"):
        im.undistort(np.zeros((10, 10, 3), np.uint8), camera, other)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 70), st.integers(1, 70), st.sampled_from([1, 8, 32, 64]))
def test_padding_is_undone_by_crop(height, width, multiple):
    array = np.random.default_rng(height * 71 + width).integers(0, 255, (height, width, 3)).astype(np.uint8)
    padded, window = im.pad_to_multiple(array, multiple)
    assert padded.shape[0] % multiple == 0 and padded.shape[1] % multiple == 0
    assert padded.shape[0] - height < multiple and padded.shape[1] - width < multiple
    assert (im.crop(padded, window) == array).all()
    assert padded.sum() == array.sum()


def test_uint8_float_round_trip_is_exact():
    levels = np.arange(256, dtype=np.uint8)
    assert (im.uint8_from_float(levels / np.float32(255)) == levels).all()
    assert im.uint8_from_float(np.array([-1.0, 2.0])).tolist() == [0, 255]
    with pytest.raises(ValueError, match="NaN"):
        im.uint8_from_float(np.array([np.nan]))


def test_resize_area_averages_blocks():
    array = np.arange(4 * 6, dtype=np.uint8).reshape(4, 6)
    small = im.resize_area(array, (3, 2))
    assert small.tolist() == [[4, 6, 8], [16, 18, 20]]
    assert im.resize_area(array, (6, 4)) is array


def test_fit_inside_keeps_the_aspect():
    portrait = np.full((80, 40, 3), 90, np.uint8)
    fitted = im.fit_inside(portrait, (80, 40), fill=7)
    assert fitted.shape == (40, 80, 3)
    assert (fitted[:, 30:50] == 90).all() and (fitted[:, :30] == 7).all() and (fitted[:, 50:] == 7).all()


def test_grey_matches_opencv():
    rgb = np.random.default_rng(0).integers(0, 256, (9, 9, 3)).astype(np.uint8)
    assert np.abs(im.grey_from_rgb(rgb) - cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)).max() < 1


def test_tiles_have_the_size_of_their_parts():
    rows = [[np.full((5, 8, 3), 1, np.uint8)] * 3, [np.full((7, 8, 3), 2, np.uint8)] * 3]
    sheet = im.tile_images(rows, gap=2)
    assert sheet.shape == (5 + 2 + 7, 3 * 8 + 2 * 2, 3)
    assert (sheet[:5, :8] == 1).all() and (sheet[7:, 20:] == 2).all() and (sheet[5:7] == 255).all()
    with pytest.raises(ValueError, match="full grid"):
        im.tile_images([rows[0], rows[1][:2]])


def test_label_is_written_inside_its_box():
    label = im.label_image("cam03 frame 12", (120, 18))
    assert label.shape == (18, 120, 3)
    bright = np.argwhere(label[..., 0] > 128)
    assert len(bright) > 50
    assert bright.min() >= 1 and bright[:, 1].max() <= 118 and bright[:, 0].max() <= 16
    assert (im.label_image("", (30, 10)) == im.LABEL_BACKGROUND).all()
