"""Films and sound written by the tests, with pictures that tell which frame they are."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from fourd.video.encode import open_encoder

TICKS = Fraction(1, 90000)
SIZE = (64, 48)


def numbered_picture(index: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """A grey picture that tells its index, with a bright bar at its top left."""
    picture = np.full((size[1], size[0], 3), 20 + 8 * index, np.uint8)
    picture[:8, :32] = 255
    return picture


def index_of(picture: np.ndarray) -> int:
    return round((float(np.median(picture)) - 20) / 8)


def constant_ticks(num_frames: int, fps: Fraction | int = 30) -> list[int]:
    return [round(Fraction(90000 * i) / fps) for i in range(num_frames)]


def add_video(
    container: av.container.OutputContainer,
    encoder: str,
    pixel_format: str = "yuv420p",
    size: tuple[int, int] = SIZE,
    options: dict[str, str] | None = None,
) -> av.VideoStream:
    """A video stream on a clock of 90 kHz."""
    quiet = {"x265-params": "log-level=none"} if encoder == "libx265" else {}
    stream = container.add_stream(encoder, rate=30, options={"g": "8", **quiet, **(options or {})})
    stream.width, stream.height, stream.pix_fmt = *size, pixel_format
    stream.time_base = stream.codec_context.time_base = TICKS
    return stream


def encode_pictures(
    container: av.container.OutputContainer,
    stream: av.VideoStream,
    pictures: Sequence[np.ndarray],
    ticks: Sequence[int],
) -> None:
    open_encoder(stream)
    for picture, pts in zip(pictures, ticks, strict=True):
        frame = av.VideoFrame.from_ndarray(picture)
        frame.pts, frame.time_base = pts, TICKS
        container.mux(stream.encode(frame))
    container.mux(stream.encode(None))


def write_video(
    path: Path,
    ticks: Sequence[int],
    encoder: str = "libx264",
    size: tuple[int, int] = SIZE,
    rotation: int = 0,
    hflip: bool = False,
    gop: int = 8,
    faststart: bool = False,
    options: dict[str, str] | None = None,
    pixel_format: str = "yuv420p",
    pixel_aspect: Fraction | None = None,
    metadata: dict[str, str] | None = None,
    pictures: Sequence[np.ndarray] | None = None,
) -> Path:
    """A film of numbered pictures, or of those given."""
    flags = [*(["+faststart"] if faststart else []), *(["+use_metadata_tags"] if metadata else [])]
    with av.open(str(path), "w", options={"movflags": "".join(flags)} if flags else {}) as container:
        container.metadata.update(metadata or {})
        stream = add_video(container, encoder, pixel_format, size, {"g": str(gop), **(options or {})})
        if rotation or hflip:
            stream.set_display_rotation(rotation, hflip=hflip)
        if pixel_aspect is not None:
            stream.codec_context.sample_aspect_ratio = stream.sample_aspect_ratio = pixel_aspect
        given = pictures or [numbered_picture(index, size) for index in range(len(ticks))]
        encode_pictures(container, stream, given, ticks)
    return path


def click(num_samples: int, rate: int, at_s: float) -> np.ndarray:
    """(n,) float32 silence with a click whose middle is at a time, s."""
    times = np.arange(num_samples) / rate - at_s
    return np.where(np.abs(times) < 0.001, 0.8 * np.cos(times * np.pi / 0.002) ** 2, 0).astype(np.float32)


def click_time(samples: np.ndarray, rate: int) -> float:
    """Middle of the loudest click, s after the first sample."""
    peak = int(np.abs(samples).argmax())
    at = np.arange(max(0, peak - rate // 500), min(len(samples), peak + rate // 500))
    power = samples[at].astype(np.float64) ** 2
    return float((at * power).sum() / power.sum() / rate)


def write_sounding_film(
    path: Path,
    channels: np.ndarray,
    codec: str = "aac",
    rate: int = 48000,
    audio_start_s: float = 0.0,
    video_start_s: float = 0.0,
    encoder: str = "libx264",
    gap_s: tuple[float, float] | None = None,
    num_frames: int = 30,
) -> Path:
    """A film with (channels, n) float32 sound; blocks that begin within gap_s are left out.

    num_frames: 0 leaves out the pictures
    """
    layout = {1: "mono", 2: "stereo"}[len(channels)]
    with av.open(str(path), "w") as container:
        video = (
            add_video(container, encoder, options={"bf": "0"} if encoder == "libx264" else {})
            if num_frames
            else None
        )
        audio = container.add_stream(codec, rate=rate, layout=layout)
        resampler = av.AudioResampler(format=audio.codec_context.format.name, layout=layout, rate=rate)
        if video is not None:
            ticks = [round(video_start_s * 90000) + pts for pts in constant_ticks(num_frames)]
            encode_pictures(container, video, [numbered_picture(i % 25) for i in range(num_frames)], ticks)
        step = audio.codec_context.frame_size or 1024
        for begin in range(0, channels.shape[1], step):
            if gap_s is not None and gap_s[0] <= begin / rate < gap_s[1]:
                continue
            block = np.ascontiguousarray(channels[:, begin : begin + step])
            frame = av.AudioFrame.from_ndarray(block, format="fltp", layout=layout)
            frame.sample_rate = rate
            for converted in resampler.resample(frame):
                converted.pts, converted.time_base = begin + round(audio_start_s * rate), Fraction(1, rate)
                container.mux(audio.encode(converted))
        container.mux(audio.encode(None))
    return path
