"""Opening of films and sound recordings, and one sentence for each of the library's errors."""

import contextlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition

from fourd.errors import InputError

# Films come from strangers. A playlist or a list of files is no film: it would read, or ask a network for,
# what the scene does not name. Frames larger than this would fill the memory from a file of some kilobytes.
CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,mpegvideo,mxf,asf,flv,ogg,gif"
CONTAINERS += ",yuv4mpegpipe,h264,hevc,av1,ivf,mjpeg,wav,mp3,flac,aac,aiff"
MAX_FRAME_PIXELS = 2**27


@contextlib.contextmanager
def explained(path: Path | str) -> Iterator[None]:
    """Turn the library's errors on a source into an InputError."""
    try:
        yield
    except FFmpegError as error:
        raise InputError(
            f"expected a whole video file at {path}, but it cannot be read ({error.strerror}): the file is "
            "truncated, damaged or no video; copy it again"
        ) from None


def open_container(path: Path | str) -> InputContainer:
    """An open file whose decoders use one thread. Raises InputError if it is missing or empty."""
    if not Path(path).is_file():
        raise InputError(f"expected a video file at {path}, found nothing: check the path in the scene file")
    if Path(path).stat().st_size == 0:
        raise InputError(f"expected a video file at {path}, got an empty file: copy it again")
    # Without `file:` a name with a colon is taken for an address.
    limits = {"protocol_whitelist": "file", "format_whitelist": CONTAINERS}
    container = av.open(f"file:{path}", options=limits)
    for stream in (*container.streams.video, *container.streams.audio):
        if stream.codec_context is not None:
            stream.codec_context.thread_count = 1
            stream.codec_context.options = {"max_pixels": str(MAX_FRAME_PIXELS)}
    return container


def film_stream(container: InputContainer) -> av.VideoStream | None:
    """The first stream of moving pictures with a decoder; a cover picture of a sound file is none."""
    streams = (stream for stream in container.streams.video if not _is_cover(stream))
    return next((stream for stream in streams if stream.codec_context is not None), None)


def sound_stream(container: InputContainer) -> av.AudioStream | None:
    """The first stream of sound with a decoder; phones add second ones that only their makers can read."""
    return next((stream for stream in container.streams.audio if stream.codec_context is not None), None)


def video_stream(container: InputContainer, path: Path | str) -> av.VideoStream:
    """As `film_stream`. Raises InputError if there is none."""
    stream = film_stream(container)
    if stream is None:
        raise InputError(
            f"expected a video at {path}, got a file without pictures that can be decoded: it is no video, "
            "truncated or in an unknown codec; copy it again or convert it to H.264"
        )
    if stream.width * stream.height > MAX_FRAME_PIXELS:
        raise InputError(
            f"expected a video of at most {MAX_FRAME_PIXELS} px a frame at {path}, got {stream.width} x "
            f"{stream.height}: make it smaller"
        )
    return stream


def seconds(ticks: int | None, time_base: Fraction | None) -> float | None:
    """Time of a tick of a stream's clock, None where either is unknown."""
    return None if ticks is None or time_base is None else float(ticks * time_base)


def frame_time(frame: av.VideoFrame | av.AudioFrame, path: Path | str) -> float:
    """Presentation time of a decoded frame in its container, s. Raises InputError if it has none."""
    time_s = seconds(frame.pts, frame.time_base)
    if time_s is None:
        raise InputError(f"expected a time on every frame of {path}, got none: write the file anew as MP4")
    return time_s


def _is_cover(stream: av.VideoStream) -> bool:
    return bool(stream.disposition & Disposition.attached_pic)
