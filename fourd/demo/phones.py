"""What each phone recorded: its own clock, frame rate, picture compression, and sound from where it stood."""

import dataclasses
import functools
import logging
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace

from fourd.demo.cameras import camera_at
from fourd.demo.figures import ball_center, bounce_times
from fourd.demo.options import DemoOptions, camera_index
from fourd.demo.render import FrozenScene
from fourd.io import atomic_path
from fourd.video.encode import SAME_BYTES

log = logging.getLogger(__name__)

SAMPLE_RATE = 48_000
SOUND_M_S = 343.0
CLAP_POSITION = np.array([-1.9, 1.6, 1.1])
TIME_BASE = 90_000
_MARGIN_S = 0.3
_REST_S = 0.5


@dataclasses.dataclass(frozen=True)
class Phone:
    """One recording. start_time_s: event time of its first frame (0 = synchronised frame 0)."""

    name: str
    start_time_s: float
    fps: float
    num_frames: int
    gain: float

    @property
    def frame_times(self) -> np.ndarray:
        """(num_frames,) event time of every frame, seconds."""
        return self.start_time_s + np.arange(self.num_frames) / self.fps


def make_phone(name: str, options: DemoOptions) -> Phone:
    """The clock of one phone: all cover the synchronised frames, some start between two of them.

    Every fourth phone (cam03, cam07, ...) runs at 5/6 of the event's frame rate (25 for 30).
    Raises InputError if there is no such camera.
    """
    index = camera_index(name, options)
    rng = np.random.default_rng([options.seed, 200, index])
    fps = options.fps * 5 / 6 if index % 4 == 3 else options.fps
    # Five is coprime to nine: up to nine phones all start in different frames.
    frames_before = 2 + (5 * index + options.seed) % 9
    # Whole frames for even phones, sub-frame offsets for odd ones, exact in ticks of the container.
    part = 0.0 if index % 2 == 0 else float(rng.uniform(0.15, 0.85))
    start = -round((frames_before + part) / options.fps * TIME_BASE) / TIME_BASE
    end = (options.num_frames - 1) / options.fps + float(rng.uniform(0.1, _MARGIN_S))
    return Phone(name, start, fps, int(np.floor((end - start) * fps)) + 1, float(rng.uniform(0.35, 0.8)))


def clap_times(options: DemoOptions) -> np.ndarray:
    """(n,) event times of claps, uneven, from before the clip to after it, seconds."""
    rng = np.random.default_rng([options.seed, 300])
    end = options.num_frames / options.fps + _REST_S
    gaps = rng.uniform(0.22, 0.46, int(np.ceil((end + _REST_S) / 0.22)))
    times = -_REST_S + np.cumsum(gaps)
    return times[times < end]


def _pulse(rng: np.random.Generator, low_hz: float, high_hz: float, decay_s: float) -> np.ndarray:
    """A decaying burst of noise between two frequencies, unit peak, SAMPLE_RATE."""
    count = int(8 * decay_s * SAMPLE_RATE)
    spectrum = np.fft.rfft(rng.standard_normal(count))
    frequency = np.fft.rfftfreq(count, 1 / SAMPLE_RATE)
    spectrum[(frequency < low_hz) | (frequency > high_hz)] = 0
    time_s = np.arange(count) / SAMPLE_RATE
    wave = np.fft.irfft(spectrum, count) * np.exp(-time_s / decay_s) * (1 - np.exp(-time_s / 4e-4))
    return wave / np.abs(wave).max()


class Sound(NamedTuple):
    """When and where a sound is made (s, metres), how loud it is at 1 m, and its samples."""

    time_s: float
    position: tuple[float, ...]
    loudness: float
    wave: np.ndarray


@functools.lru_cache(maxsize=4)
def event_sounds(options: DemoOptions) -> tuple[Sound, ...]:
    """Everything that is heard."""
    rng = np.random.default_rng([options.seed, 301])
    sounds = []
    for time_s in clap_times(options):
        sounds.append(Sound(float(time_s), tuple(CLAP_POSITION), 2.2, _pulse(rng, 700, 9000, 0.012)))
    end = options.num_frames / options.fps + _REST_S
    for time_s in bounce_times(-_REST_S, end):
        position = tuple(float(v) for v in ball_center(float(time_s)))
        sounds.append(Sound(float(time_s), position, 1.3, _pulse(rng, 90, 900, 0.03)))
    murmur_s = end + 2 * _REST_S + 0.5
    count = int(murmur_s * SAMPLE_RATE)
    spectrum = np.fft.rfft(rng.standard_normal(count))
    frequency = np.fft.rfftfreq(count, 1 / SAMPLE_RATE)
    spectrum *= (frequency > 200) * (frequency < 3500) / np.maximum(frequency, 200)
    murmur = np.fft.irfft(spectrum, count)
    sounds.append(Sound(-2 * _REST_S, (1.6, 4.2, 1.5), 0.22, murmur / np.abs(murmur).std() / 3))
    return tuple(sounds)


def record_audio(phone: Phone, options: DemoOptions) -> np.ndarray:
    """(n,) float32 in [-1, 1] at SAMPLE_RATE: what the phone's microphone heard during its frames.

    A sound made at time s at distance d is heard at s + d / SOUND_M_S, weaker by 1 / d, with the
    phone's gain and its own noise (about 25 dB below the claps).
    """
    count = int(round(phone.num_frames / phone.fps * SAMPLE_RATE))
    heard = np.zeros(count + 1)
    clock = phone.start_time_s + np.arange(count) / SAMPLE_RATE
    for time_s, position, loudness, wave in event_sounds(options):
        microphone = camera_at(phone.name, time_s, options).center
        distance = float(np.linalg.norm(np.asarray(position) - microphone))
        arrival = time_s + distance / SOUND_M_S
        first = max(0, int(np.floor((arrival - phone.start_time_s) * SAMPLE_RATE)))
        last = min(count, first + len(wave) + 1) if arrival > phone.start_time_s else count
        at = (clock[first:last] - arrival) * SAMPLE_RATE
        heard[first:last] += loudness / distance * np.interp(at, np.arange(len(wave)), wave, left=0, right=0)
    rng = np.random.default_rng([options.seed, 302, camera_index(phone.name, options)])
    heard = phone.gain * heard[:count] + 0.008 * rng.standard_normal(count)
    return np.clip(heard, -1, 1).astype(np.float32)


def write_phone_file(path: Path | str, name: str, options: DemoOptions, without: Sequence[int] = ()) -> Phone:
    """Film the event with one phone into an MP4 (H.264 yuv420p BT.709, AAC). Returns its clock.

    path: ends in .mp4, written beside and renamed;  without: labels left out of the scene
    """
    phone = make_phone(name, options)
    with atomic_path(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        rate = Fraction(phone.fps).limit_denominator(1001)
        video = container.add_stream(
            "libx264", rate=rate, options={"crf": "17", "preset": "medium", **SAME_BYTES}
        )
        # Subsampled colour needs even sizes; one column or row is cut where the picture is odd.
        width, height = options.width // 2 * 2, options.height // 2 * 2
        video.width, video.height, video.pix_fmt = width, height, "yuv420p"
        video.codec_context.time_base = Fraction(1, TIME_BASE)
        # 1 is BT.709 in the tables of ITU-T H.273 for all three.
        video.codec_context.color_primaries = video.codec_context.color_trc = 1
        video.codec_context.colorspace, video.codec_context.color_range = 1, 1
        audio = container.add_stream("aac", rate=SAMPLE_RATE, layout="mono")
        audio.bit_rate = 128_000
        for index, time_s in enumerate(phone.frame_times):
            picture, _, _ = FrozenScene(float(time_s), options, without).render(
                camera_at(name, float(time_s), options)
            )
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture[:height, :width]), format="rgb24")
            frame = frame.reformat(
                format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
            )
            frame.pts, frame.time_base = round(index / phone.fps * TIME_BASE), Fraction(1, TIME_BASE)
            container.mux(video.encode(frame))
            log.info("%s: frame %d of %d", name, index + 1, phone.num_frames)
        container.mux(video.encode(None))
        _mux_audio(container, audio, record_audio(phone, options))
    return phone


def _mux_audio(container, stream, samples: np.ndarray) -> None:
    """Encode mono samples in blocks of the encoder's size."""
    block = 1024
    for first in range(0, len(samples), block):
        piece = samples[None, first : first + block]
        frame = av.AudioFrame.from_ndarray(piece, format="fltp", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = SAMPLE_RATE, first, Fraction(1, SAMPLE_RATE)
        container.mux(stream.encode(frame))
    container.mux(stream.encode(None))
