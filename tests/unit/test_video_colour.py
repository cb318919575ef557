from pathlib import Path

import av
import numpy as np
import pytest

from fourd.video import probe_video, read_video_frames
from fourd.video.colour import BT709_FROM_BT2020, REFERENCE_WHITE_NITS, WHITE_16, rgb_image, sdr_from_hdr
from fourd.video.encode import open_encoder
from tests.unit.film_files import TICKS, add_video

TRANSFERS = {"hlg": 18, "pq": 16}
KR, KB = 0.2627, 0.0593


def hdr_frame(signal: np.ndarray, transfer: str) -> av.VideoFrame:
    """A 10-bit 4:2:0 frame of (H, W, 3) BT.2020 signals; chroma is that of every second pixel."""
    red, green, blue = np.moveaxis(signal, -1, 0)
    luma = KR * red + (1 - KR - KB) * green + KB * blue
    planes = [64 + 876 * luma]
    planes += [512 + 896 * c[::2, ::2] for c in ((blue - luma) / (2 - 2 * KB), (red - luma) / (2 - 2 * KR))]
    flat = np.concatenate([np.round(plane).astype(np.uint16).ravel() for plane in planes])
    height, width = luma.shape
    frame = av.VideoFrame.from_ndarray(flat.reshape(height * 3 // 2, width), format="yuv420p10le")
    frame.colorspace, frame.color_range = 9, 1
    frame.color_trc, frame.color_primaries = TRANSFERS[transfer], 9
    return frame


def signal_of(nits: np.ndarray | float, transfer: str) -> np.ndarray:
    """Grey signal that a display of 1000 cd/m2 shows at a luminance: the inverse, written anew."""
    light = np.asarray(nits, dtype=np.float64)
    if transfer == "pq":
        power = (light / 10000) ** (2610 / 16384)
        ratio = (3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)
        return ratio ** (2523 / 32)
    scene = (light / 1000) ** (1 / 1.2)
    return np.where(
        scene <= 1 / 12,
        np.sqrt(3 * scene),
        0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073,
    )


def grey(signal: np.ndarray) -> np.ndarray:
    return np.repeat(np.round(np.atleast_1d(signal) * WHITE_16).astype(np.uint16)[None, :, None], 3, axis=2)


@pytest.mark.parametrize("transfer", ["hlg", "pq"])
def test_grey_ramp_stays_grey_rises_and_ends_at_black_and_white(transfer):
    ramp = sdr_from_hdr(grey(np.linspace(0, 1, 4096)), transfer)[0].astype(int)
    assert (np.ptp(ramp, axis=1) <= 1).all()
    assert (np.diff(ramp[:, 1]) >= 0).all()
    assert (ramp[0] == 0).all() and (ramp[-1] == 255).all()


@pytest.mark.parametrize("transfer", ["hlg", "pq"])
def test_reference_white_is_nearly_white_and_the_rest_below_it_exact(transfer):
    assert signal_of(REFERENCE_WHITE_NITS, transfer) == pytest.approx(
        {"hlg": 0.75, "pq": 0.58}[transfer], abs=2e-3
    )
    white = sdr_from_hdr(grey(signal_of(REFERENCE_WHITE_NITS, transfer)), transfer)
    assert 0.92 * 255 < white.min() <= white.max() < 0.95 * 255
    share = np.array([0.01, 0.05, 0.18, 0.5, 0.69])
    below = sdr_from_hdr(grey(signal_of(share * REFERENCE_WHITE_NITS, transfer)), transfer)
    np.testing.assert_allclose(below[0, :, 1], 255 * share ** (1 / 2.4), atol=0.8)


def test_hlg_and_pq_of_the_same_light_agree():
    nits = np.geomspace(1, 1000, 40)
    hlg, pq = (sdr_from_hdr(grey(signal_of(nits, name)), name).astype(int) for name in ("hlg", "pq"))
    assert np.abs(hlg - pq).max() <= 1


def test_primaries_are_those_of_the_recommendations():
    def xyz_from_rgb(red, green, blue):
        columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in (red, green, blue)]).T
        white = np.array([0.3127 / 0.3290, 1, (1 - 0.3127 - 0.3290) / 0.3290])
        return columns * np.linalg.solve(columns, white)

    bt709 = xyz_from_rgb((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
    bt2020 = xyz_from_rgb((0.708, 0.292), (0.170, 0.797), (0.131, 0.046))
    np.testing.assert_allclose(BT709_FROM_BT2020, np.linalg.solve(bt709, bt2020), atol=2e-5)


def test_saturated_colours_stay_in_range_and_keep_their_hue():
    signal = np.array([[[0.7, 0.2, 0.2], [0.2, 0.7, 0.2], [0.2, 0.2, 0.7]]])
    for transfer in ("hlg", "pq"):
        read = sdr_from_hdr(np.round(signal * WHITE_16).astype(np.uint16), transfer)[0]
        np.testing.assert_array_equal(read.argmax(axis=1), [0, 1, 2])


@pytest.mark.parametrize("transfer", ["hlg", "pq"])
@pytest.mark.parametrize("colour", [(0.5, 0.5, 0.5), (0.6, 0.4, 0.3), (0.3, 0.5, 0.45)])
def test_decoded_colours_are_those_of_the_signal(transfer, colour):
    signal = np.broadcast_to(np.array(colour), (32, 48, 3))
    expected = sdr_from_hdr(np.round(signal * WHITE_16).astype(np.uint16), transfer)
    read = rgb_image(hdr_frame(signal, transfer))
    assert np.abs(read.astype(int) - expected).max() <= 2


@pytest.mark.parametrize("transfer", ["hlg", "pq"])
@pytest.mark.parametrize("encoder", ["libx265", "libsvtav1"])
def test_hdr_films_are_recognised_and_mapped(tmp_path: Path, transfer: str, encoder: str):
    path, signal = tmp_path / "film.mp4", np.full((48, 64, 3), float(signal_of(60.0, transfer)))
    with av.open(str(path), "w") as container:
        stream = add_video(container, encoder, "yuv420p10le")
        context = stream.codec_context
        context.colorspace, context.color_range = 9, 1
        context.color_primaries, context.color_trc = 9, TRANSFERS[transfer]
        open_encoder(stream)
        for index in range(3):
            frame = hdr_frame(signal, transfer)
            frame.pts, frame.time_base = 3000 * index, TICKS
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    info = probe_video(path)
    assert (info.transfer, info.bit_depth, info.pixel_format) == (transfer, 10, "yuv420p10le")
    for _, read in read_video_frames(path, [0, 2]):
        assert abs(np.median(read) - 255 * (60 / REFERENCE_WHITE_NITS) ** (1 / 2.4)) < 2


def test_sdr_is_left_untouched():
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (32, 48, 3), dtype=np.uint8)
    np.testing.assert_array_equal(rgb_image(av.VideoFrame.from_ndarray(picture, format="rgb24")), picture)


def test_ten_bit_sdr_is_the_eight_bit_picture():
    ramp = np.tile(np.linspace(0, 1, 64), (48, 1))
    frame = hdr_frame(np.repeat(ramp[..., None], 3, axis=2), "hlg")
    frame.color_trc, frame.colorspace = 1, 1
    assert np.abs(rgb_image(frame)[..., 1] - 255 * ramp).max() < 1.1
