import dataclasses
from fractions import Fraction

import numpy as np
import pytest

from fourd.audio import probe_audio
from fourd.video import VideoReader, probe_video, read_video_frames
from tests.unit.film_files import (
    click,
    constant_ticks,
    index_of,
    numbered_picture,
    write_sounding_film,
    write_video,
)

RATES = [Fraction(24000, 1001), 24, 25, Fraction(30000, 1001), 30, 50, Fraction(60000, 1001), 60, 120, 240]
CODECS = [
    ("film.mp4", "libx264", "h264", "yuv420p", 8),
    ("film.mp4", "libx264", "h264", "yuv420p10le", 10),
    ("film.mp4", "libx265", "hevc", "yuv420p", 8),
    ("film.mp4", "libx265", "hevc", "yuv420p10le", 10),
    ("film.webm", "libvpx-vp9", "vp9", "yuv420p", 8),
    ("film.mp4", "libsvtav1", "av1", "yuv420p", 8),
    ("film.mp4", "libsvtav1", "av1", "yuv420p10le", 10),
    ("film.mov", "prores_ks", "prores", "yuv422p10le", 10),
]


def marked_picture() -> np.ndarray:
    """Four unlike corners, so that every turn and mirroring shows."""
    picture = np.full((48, 64, 3), 128, np.uint8)
    picture[:16, :16], picture[:16, -16:], picture[-16:, :16] = 250, 180, 60
    return picture


@pytest.mark.parametrize("fps", RATES, ids=lambda fps: f"{float(fps):.2f}")
def test_customary_rates_are_named_and_times_exact(tmp_path, fps):
    ticks = constant_ticks(40, fps)
    pictures = [numbered_picture(i % 25) for i in range(40)]
    info = probe_video(write_video(tmp_path / "film.mp4", ticks, pictures=pictures))
    assert info.fps == pytest.approx(float(fps), rel=1e-9)
    np.testing.assert_allclose(info.pts_s, np.array(ticks) / 90000, atol=1e-9)


@pytest.mark.parametrize("name, encoder, codec, pixel_format, bits", CODECS)
def test_codecs_are_read(tmp_path, name, encoder, codec, pixel_format, bits):
    path = write_video(tmp_path / name, constant_ticks(12), encoder, pixel_format=pixel_format)
    info = probe_video(path)
    assert (info.codec, info.pixel_format, info.bit_depth) == (codec, pixel_format, bits)
    assert (info.size, info.stored_size, info.transfer, len(info.pts_s)) == ((64, 48), (64, 48), "sdr", 12)
    with VideoReader(path, info) as reader:
        assert [index_of(reader.read(i)) for i in (11, 2, 3, 8)] == [11, 2, 3, 8]
        luma = reader.read_luma(5, 4)
        assert luma.shape == (12, 16) and luma.dtype == np.float32
        # Limited range: 16 + 219 / 255 of the grey.
        assert abs(np.median(luma) - (16 + 219 / 255 * (20 + 8 * 5))) < 2


@pytest.mark.parametrize("rotation", [0, 90, 180, -90])
@pytest.mark.parametrize("hflip", [False, True])
def test_display_matrix_is_applied_once(tmp_path, rotation, hflip):
    pictures = [marked_picture()] * 2
    path = write_video(tmp_path / "a.mp4", [0, 3000], rotation=rotation, hflip=hflip, pictures=pictures)
    info = probe_video(path)
    turned = np.rot90(marked_picture(), rotation // 90)
    expected = turned[:, ::-1] if hflip else turned
    assert info.rotation_deg == rotation % 360
    [(_, read)] = read_video_frames(path, [1])
    assert info.size == (read.shape[1], read.shape[0]) == (expected.shape[1], expected.shape[0])
    assert np.abs(read.astype(int) - expected).mean() < 4


@pytest.mark.parametrize(
    "aspect, rotation, size",
    [
        (Fraction(4, 3), 0, (85, 48)),
        (Fraction(4, 3), 90, (48, 85)),
        (Fraction(3, 4), 0, (64, 64)),
        (Fraction(3, 4), -90, (64, 64)),
        (Fraction(1, 1), 90, (48, 64)),
    ],
)
def test_pixels_become_square_the_longer_way(tmp_path, aspect, rotation, size):
    pictures = [marked_picture()] * 2
    path = write_video(
        tmp_path / "a.mp4", [0, 3000], rotation=rotation, pixel_aspect=aspect, pictures=pictures
    )
    info = probe_video(path)
    assert (info.size, info.stored_size) == (size, (64, 48))
    assert info.pixel_aspect == (aspect.numerator, aspect.denominator)
    stored = probe_video(path, square_pixels=False)
    assert stored.size == ((48, 64) if rotation else (64, 48))
    with VideoReader(path, info) as square, VideoReader(path, stored) as as_stored:
        wide, narrow = square.read(1), as_stored.read(1)
    assert wide.shape == (size[1], size[0], 3)
    # The corners keep their share of both sides.
    for y, x in ((0.1, 0.1), (0.1, 0.9), (0.9, 0.1)):
        at = [int(y * wide.shape[0]), int(x * wide.shape[1])]
        small = [int(y * narrow.shape[0]), int(x * narrow.shape[1])]
        assert abs(int(wide[at[0], at[1], 0]) - int(narrow[small[0], small[1], 0])) < 8


def test_portrait_beside_landscape_reads_as_displayed(tmp_path):
    tall = write_video(tmp_path / "tall.mp4", constant_ticks(3), size=(48, 64))
    turned = write_video(tmp_path / "turned.mp4", constant_ticks(3), rotation=90)
    assert probe_video(tall).size == probe_video(turned).size == (48, 64)
    assert (probe_video(tall).rotation_deg, probe_video(turned).rotation_deg) == (0, 90)


def test_frames_that_an_edit_cuts_off_are_not_there(tmp_path):
    ticks = [pts - 5 * 3000 for pts in constant_ticks(20)]
    path = write_video(tmp_path / "film.mp4", ticks, options={"bf": "0"})
    info = probe_video(path)
    assert len(info.pts_s) == 15
    np.testing.assert_allclose(info.pts_s, np.arange(15) / 30, atol=1e-6)
    with VideoReader(path, info) as reader:
        assert [index_of(reader.read(i)) for i in (0, 14, 1, 3, 9)] == [5, 19, 6, 8, 14]


def test_delay_of_an_edit_moves_pictures_and_sound_alike(tmp_path):
    sound = click(48000, 48000, 0.5)[None]
    path = write_sounding_film(tmp_path / "a.mp4", sound, "pcm_s16le", audio_start_s=0.1, video_start_s=0.3)
    info, extent = probe_video(path), probe_audio(path)
    assert extent is not None
    assert abs(info.pts_s[0] - 0.3) < 1e-3 and abs(extent.start_s + 0.2) < 1e-3
    [(_, first)] = read_video_frames(path, [0])
    assert index_of(first) == 0


def test_what_the_phone_says_of_itself_is_read(tmp_path):
    apple = {
        "com.apple.quicktime.make": "Apple",
        "com.apple.quicktime.model": "iPhone 15",
        "com.apple.quicktime.camera.focal_length.35mm_equivalent": "26",
    }
    info = probe_video(write_video(tmp_path / "a.mov", constant_ticks(3), metadata=apple))
    assert (info.make, info.model, info.focal_35mm_mm) == ("Apple", "iPhone 15", 26.0)
    android = {"com.android.capture.fps": "240.0", "com.android.manufacturer": "Google"}
    info = probe_video(write_video(tmp_path / "b.mp4", constant_ticks(3), metadata=android))
    assert (info.make, info.model, info.focal_35mm_mm, info.capture_fps) == ("Google", None, None, 240.0)
    plain = probe_video(write_video(tmp_path / "c.mp4", constant_ticks(3)))
    assert (plain.make, plain.model, plain.focal_35mm_mm, plain.capture_fps) == (None, None, None, None)


def test_a_change_of_size_is_named(tmp_path):
    path = write_video(tmp_path / "film.mp4", constant_ticks(3))
    info = dataclasses.replace(probe_video(path), stored_size=(32, 48))
    with VideoReader(path, info) as reader, pytest.raises(ValueError, match="32 x 48, frame 0 is 64 x 48"):
        reader.read(0)


def test_numbered_pictures_survive_a_film(tmp_path):
    path = write_video(tmp_path / "film.mp4", constant_ticks(3))
    [(_, read)] = read_video_frames(path, [2])
    assert np.abs(read.astype(int) - numbered_picture(2)).mean() < 4
