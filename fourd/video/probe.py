"""What a video file says about itself."""

import dataclasses
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from fourd.errors import InputError
from fourd.video.colour import transfer_of
from fourd.video.container import explained, open_container, sound_stream, video_stream
from fourd.video.geometry import display_matrix, displayed_size, rotation_from_matrix
from fourd.video.times import count_times, nominal_fps, read_times

_MAKE_KEYS = ("com.apple.quicktime.make", "com.android.manufacturer", "make")
_MODEL_KEYS = ("com.apple.quicktime.model", "com.android.model", "model")
_FOCAL_KEYS = ("com.apple.quicktime.camera.focal_length.35mm_equivalent",)
_CAPTURE_FPS_KEYS = ("com.android.capture.fps",)


@dataclasses.dataclass(frozen=True, eq=False)
class VideoInfo:
    """What a video file says about itself.

    size: (width, height) px as displayed;  stored_size: (width, height) px as coded
    rotation_deg: counterclockwise turn that makes it upright
    fps: nominal;  pts_s: (N,) float64 presentation times, rising
    keyframes: indices of frames at which decoding can start
    is_counted: the container (AVI) keeps no presentation times: frame i is taken at i / rate
    pixel_aspect: (width, height) of a stored pixel;  transfer: `sdr`, `hlg` or `pq`
    focal_35mm_mm: focal length for a 36 x 24 mm picture;  capture_fps: rate of the sensor, which
    slow motion plays slower. Both, make and model are None where the file does not tell.
    """

    size: tuple[int, int]
    rotation_deg: int
    fps: float
    codec: str
    has_audio: bool
    pts_s: np.ndarray
    keyframes: tuple[int, ...]
    stored_size: tuple[int, int]
    is_counted: bool = False
    pixel_aspect: tuple[int, int] = (1, 1)
    pixel_format: str = "rgb24"
    bit_depth: int = 8
    transfer: str = "sdr"
    focal_35mm_mm: float | None = None
    make: str | None = None
    model: str | None = None
    capture_fps: float | None = None


def probe_video(path: Path | str, square_pixels: bool = True) -> VideoInfo:
    """Frame times, displayed size, colour and codec of a video file.

    square_pixels: `size` is that of square pixels; otherwise a pixel aspect is left as stored
    Packets are read, and only the first frame decoded, unless the container's presentation times
    are incomplete: then every frame is decoded.
    Raises InputError if there is no file, no video in it, no frame, or if the file ends too early.
    """
    with explained(path), open_container(path) as container:
        stream = video_stream(container, path)
        _check_complete(stream, path)
        first = next(container.decode(stream), None)
        if first is None:
            raise InputError(
                f"expected a video with frames at {path}, got none: it is empty or truncated, copy it again"
            )
        matrix = display_matrix(first, path)
        pixel_aspect = stream.sample_aspect_ratio or Fraction(1)
        tags = {**container.metadata, **stream.metadata}
        has_audio, codec = sound_stream(container) is not None, stream.codec_context.codec.canonical_name
        is_counted = container.format.name == "avi"
    pts_s, keyframes = count_times(path) if is_counted else read_times(path)
    stored_size = (first.width, first.height)
    return VideoInfo(
        size=displayed_size(stored_size, matrix, pixel_aspect if square_pixels else Fraction(1)),
        rotation_deg=rotation_from_matrix(matrix),
        fps=nominal_fps(pts_s),
        codec=codec,
        has_audio=has_audio,
        pts_s=pts_s,
        keyframes=keyframes,
        stored_size=stored_size,
        is_counted=is_counted,
        pixel_aspect=(pixel_aspect.numerator, pixel_aspect.denominator),
        pixel_format=first.format.name,
        bit_depth=first.format.components[0].bits,
        transfer=transfer_of(first),
        focal_35mm_mm=_number(tags, _FOCAL_KEYS),
        make=_first(tags, _MAKE_KEYS),
        model=_first(tags, _MODEL_KEYS),
        capture_fps=_number(tags, _CAPTURE_FPS_KEYS),
    )


def _check_complete(stream: av.VideoStream, path: Path | str) -> None:
    """Compare the container's index with the bytes that are there (a copy that was cut short)."""
    num_bytes = Path(path).stat().st_size
    needed = max((entry.pos + entry.size for entry in stream.index_entries), default=0)
    if needed > num_bytes:
        raise InputError(
            f"expected {needed} bytes or more in {path}, as its index says, got {num_bytes}: the video is "
            "truncated, copy it again"
        )


def _first(tags: dict[str, str], keys: tuple[str, ...]) -> str | None:
    return next((tags[key].strip() for key in keys if tags.get(key, "").strip()), None)


def _number(tags: dict[str, str], keys: tuple[str, ...]) -> float | None:
    """A positive number of the metadata; what is none tells nothing."""
    try:
        number = float(_first(tags, keys) or "nan")
    except ValueError:
        return None
    return number if np.isfinite(number) and number > 0 else None
