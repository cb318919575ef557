import av
import numpy as np
import pytest

from fourd.audio import place_blocks, probe_audio, read_audio
from fourd.errors import InputError
from fourd.video import probe_video
from tests.unit.film_files import click, click_time, constant_ticks, write_sounding_film, write_video

CODECS = [
    ("aac.mp4", "aac", 48000),
    ("aac.mov", "aac", 44100),
    ("opus.webm", "libopus", 48000),
    ("opus.mp4", "libopus", 48000),
    ("pcm.mov", "pcm_s16le", 48000),
    ("pcm24.mov", "pcm_s24le", 48000),
    ("float.mov", "pcm_f32le", 48000),
    ("mp3.mp4", "libmp3lame", 44100),
    ("flac.mkv", "flac", 48000),
]


@pytest.mark.parametrize("audio_start_s", [0.0, 0.25])
@pytest.mark.parametrize("name, codec, rate", CODECS, ids=[name for name, _, _ in CODECS])
def test_sound_stands_where_it_was_recorded(tmp_path, name, codec, rate, audio_start_s):
    sound = click(rate, rate, 0.5)[None]
    encoder = "libvpx-vp9" if name.endswith("webm") else "libx264"
    path = write_sounding_film(tmp_path / name, sound, codec, rate, audio_start_s, encoder=encoder)
    audio = read_audio(path)
    assert audio is not None and audio.sample_rate == rate and audio.samples.dtype == np.float32
    at_s = audio.start_s + click_time(audio.samples, rate)
    assert abs(at_s - (audio_start_s + 0.5)) < 1e-3
    assert 0.6 < np.abs(audio.samples).max() <= 1
    extent = probe_audio(path)
    assert extent is not None and abs(extent.start_s - audio.start_s) < 1.1e-3
    assert abs(extent.duration_s - len(audio.samples) / rate) < 0.05


@pytest.mark.parametrize("name, codec", [("late.mkv", "flac"), ("late.mov", "pcm_s16le")])
def test_convention_sound_counts_from_the_first_frame(tmp_path, name, codec):
    sound = click(48000, 48000, 0.5)[None]
    audio = read_audio(write_sounding_film(tmp_path / name, sound, codec, video_start_s=0.2))
    assert audio is not None
    assert abs(audio.start_s + 0.2) < 1.1e-3
    assert abs(audio.start_s + click_time(audio.samples, 48000) - 0.3) < 1.1e-3


def test_sound_before_an_edit_is_cut_off_and_the_rest_stays_in_time(tmp_path):
    sound = click(48000, 48000, 0.5)[None]
    path = write_sounding_film(tmp_path / "cut.mp4", sound, "pcm_s16le", audio_start_s=-0.125)
    audio = read_audio(path)
    assert audio is not None
    assert abs(audio.start_s) < 1e-3 and len(audio.samples) == 42000
    assert abs(audio.start_s + click_time(audio.samples, 48000) - 0.375) < 1e-3


def test_stereo_is_mixed_and_opposite_channels_do_not_cancel(tmp_path):
    mono = click(48000, 48000, 0.5)
    mixed = read_audio(write_sounding_film(tmp_path / "a.mov", np.stack([mono, 0 * mono]), "pcm_s16le"))
    opposite = read_audio(write_sounding_film(tmp_path / "b.mov", np.stack([mono, -mono]), "pcm_s16le"))
    assert mixed is not None and opposite is not None
    np.testing.assert_allclose(mixed.samples, mono / 2, atol=1e-4)
    np.testing.assert_allclose(opposite.samples, mono, atol=1e-4)


def test_gaps_in_the_times_are_silent(tmp_path):
    rate = 48000
    tone = np.full(rate, 0.5, np.float32)
    path = write_sounding_film(tmp_path / "gap.mkv", tone[None], "pcm_s16le", gap_s=(0.3, 0.6))
    audio = read_audio(path)
    assert audio is not None and abs(len(audio.samples) - rate) < 0.002 * rate
    silent = np.flatnonzero(audio.samples == 0) / rate
    assert abs(silent[0] - 0.3) < 0.025 and abs(silent[-1] - 0.6) < 0.025
    assert len(silent) / rate == pytest.approx(0.3, abs=0.025)


def test_jitter_and_rounding_of_times_do_not_break_the_sound():
    lengths = np.full(50, 960)
    exact = np.arange(50) * 0.02
    jitter = np.random.default_rng(0).uniform(-0.002, 0.002, 50)
    np.testing.assert_array_equal(place_blocks(exact + jitter, lengths, 48000), np.arange(50) * 960)
    np.testing.assert_array_equal(place_blocks(np.round(exact, 3), lengths, 48000), np.arange(50) * 960)


def test_lost_blocks_leave_their_place_empty():
    times = np.delete(np.arange(50) * 0.02, [10, 11, 30])
    starts = place_blocks(times, np.full(47, 960), 48000)
    np.testing.assert_array_equal(starts, np.delete(np.arange(50) * 960, [10, 11, 30]))


def test_film_without_sound_has_none(tmp_path):
    path = write_video(tmp_path / "silent.mp4", constant_ticks(5))
    assert read_audio(path) is None and probe_audio(path) is None


def test_streams_of_unknown_codecs_are_no_sound_and_no_pictures(tmp_path):
    sound = click(48000, 48000, 0.5)[None]
    data = write_sounding_film(tmp_path / "a.mov", sound, "pcm_s16le").read_bytes()
    (tmp_path / "sound.mp4").write_bytes(data.replace(b"sowt", b"zzzz"))
    assert read_audio(tmp_path / "sound.mp4") is None and probe_audio(tmp_path / "sound.mp4") is None
    info = probe_video(tmp_path / "sound.mp4")
    assert not info.has_audio and len(info.pts_s) == 30
    (tmp_path / "film.mp4").write_bytes(data.replace(b"avc1", b"zzzz"))
    with pytest.raises(InputError, match=r"film\.mp4, got a file without pictures .* unknown codec"):
        probe_video(tmp_path / "film.mp4")


def test_sound_without_pictures_starts_its_own_clock(tmp_path):
    sound = click(48000, 48000, 0.5)[None]
    audio = read_audio(write_sounding_film(tmp_path / "sound.m4a", sound, num_frames=0))
    assert audio is not None and audio.start_s == 0
    assert abs(click_time(audio.samples, 48000) - 0.5) < 1e-3


def test_changing_sample_rate_is_refused(tmp_path):
    path = tmp_path / "two.aac"
    with path.open("wb") as joined:
        for rate in (44100, 48000):
            part = write_sounding_film(
                tmp_path / f"{rate}.aac", click(rate, rate, 0.5)[None], "aac", rate, num_frames=0
            )
            joined.write(part.read_bytes())
    with pytest.raises(InputError, match=r"one sample rate in .*two\.aac, got 44100 and 48000 Hz"):
        read_audio(path)


@pytest.mark.parametrize("content", [b"", b"no film, only words\n" * 50], ids=["empty", "text"])
def test_no_film_is_refused(tmp_path, content):
    path = tmp_path / "film.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"expected a (whole )?video file at .*film\.mp4"):
        read_audio(path)
    path.unlink()
    with pytest.raises(InputError, match="found nothing"):
        probe_audio(path)


def test_narrow_band_speech_codec_is_read(tmp_path):
    # Its decoder's own delay, 5 ms and more, is not told by the file.
    assert "libopencore_amrnb" in av.codecs_available
    rate = 8000
    noise = np.random.default_rng(0).normal(0, 1, rate // 4)
    sound = np.zeros(rate, np.float32)
    sound[rate // 2 : 3 * rate // 4] = 0.3 * noise.clip(-2, 2)
    audio = read_audio(write_sounding_film(tmp_path / "a.3gp", sound[None], "libopencore_amrnb", rate))
    assert audio is not None and audio.sample_rate == rate
    loud = np.flatnonzero(np.abs(audio.samples) > 0.1) / rate + audio.start_s
    assert abs(loud[0] - 0.5) < 0.03 and abs(loud[-1] - 0.75) < 0.03
