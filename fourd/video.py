"""Video files: exact frame times, upright RGB frames, H.264 films. The only user of PyAV.

Times are those of the container (presentation, seconds, exact to its clock tick). Pictures are in
stored pixels after rotation; a sample aspect ratio is left to the calibration (fx != fy).
"""

import contextlib
import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer, OutputContainer
from av.error import FFmpegError
from av.video.reformatter import ColorRange, Colorspace, Interpolation

from fourd.errors import InputError
from fourd.io import atomic_path

ENCODERS = {"h264": "libx264"}
CONSTANT_RATE_FACTOR = 18
STANDARD_FPS = (10, 12, 12.5, 15, 20, 24000 / 1001, 24, 25, 30000 / 1001, 30, 48, 50, 60000 / 1001, 60)
STANDARD_FPS += (72, 90, 100, 120000 / 1001, 120, 240)
# The fast path of swscale repeats chroma samples and rounds down; 6 ms per 1080p frame buys both back.
_INTERPOLATION = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
# H.273 matrix coefficients to swscale's numbering.
_COLORSPACES = {1: Colorspace.ITU709, 4: Colorspace.FCC, 5: Colorspace.ITU601, 6: Colorspace.ITU601}
_COLORSPACES |= {7: Colorspace.SMPTE240M, 9: Colorspace.BT2020, 10: Colorspace.BT2020}
_TIME_TOLERANCE_S = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class VideoInfo:
    """What a video file says about itself.

    size: (width, height) px, upright;  rotation_deg: counterclockwise turn that makes it upright
    fps: nominal;  pts_s: (N,) float64 presentation times, rising
    keyframes: indices of frames at which decoding can start
    is_counted: the container (AVI) keeps no presentation times: frame i is taken at i / rate
    """

    size: tuple[int, int]
    rotation_deg: int
    fps: float
    codec: str
    has_audio: bool
    pts_s: np.ndarray
    keyframes: tuple[int, ...]
    is_counted: bool = False


def probe_video(path: Path | str) -> VideoInfo:
    """Frame times, upright size and codec of a video file.

    Packets are read, and only the first frame decoded, unless the container's presentation times
    are incomplete: then every frame is decoded.
    Raises InputError if there is no file, no video in it, no frame, or if the file ends too early.
    """
    with _explained(path), _open(path) as container:
        stream = _video_stream(container, path)
        _check_complete(stream, path)
        first = next(container.decode(stream), None)
        if first is None:
            raise InputError(
                f"expected a video with frames at {path}, got none: it is empty or truncated, copy it again"
            )
        matrix = _display_matrix(first, path)
        size = (first.height, first.width) if matrix[0] == 0 else (first.width, first.height)
        rotation_deg = -round(np.degrees(np.arctan2(matrix[1], matrix[0]))) % 360
        codec, has_audio = stream.codec_context.name, bool(container.streams.audio)
        is_counted = container.format.name == "avi"
    pts_s, keyframes = _count_times(path) if is_counted else _read_times(path)
    return VideoInfo(size, rotation_deg, nominal_fps(pts_s), codec, has_audio, pts_s, keyframes, is_counted)


def nominal_fps(pts_s: np.ndarray) -> float:
    """Frames per second from the usual interval, snapped to a customary rate within 1.5 %.

    Intervals that span dropped frames do not count; Matroska rounds times to milliseconds, hence
    the mean and the snapping. A single frame has no rate: 1.
    """
    if len(pts_s) < 2:
        return 1.0
    intervals = np.diff(pts_s)
    rate = float(1 / intervals[intervals < 1.5 * np.median(intervals)].mean())
    nearest = min(STANDARD_FPS, key=lambda fps: abs(fps - rate))
    return float(nearest) if abs(nearest - rate) < 0.015 * rate else round(rate, 6)


class VideoReader:
    """Frames of a video by index, in any order; cheap in rising order. Use as a context manager.

    The decoder stays open between calls and jumps to a keyframe only when that saves decoding.
    """

    def __init__(self, path: Path | str, info: VideoInfo) -> None:
        self._path = path
        self._info = info
        self._keyframes = np.asarray(info.keyframes, dtype=np.int64)
        self._container: InputContainer | None = None
        self._frames: Iterator[av.VideoFrame] = iter(())
        self._next = 0
        self._is_damaged = False

    def __enter__(self) -> "VideoReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, index: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB of one frame, upright. Raises InputError if it cannot be decoded."""
        with _explained(self._path):
            frame = self._decode(index)
            image = _rgb_image(frame, self._path)
        if (image.shape[1], image.shape[0]) != tuple(self._info.size):
            raise InputError(
                f"{self._path}: expected every frame to be {_times(self._info.size)}, frame {index} is "
                f"{image.shape[1]} x {image.shape[0]}: cut the video where its size changes"
            )
        return image

    def close(self) -> None:
        if self._container is not None:
            self._container.close()
            self._container = None

    def _decode(self, index: int) -> av.VideoFrame:
        if not 0 <= index < len(self._info.pts_s):
            raise InputError(
                f"{self._path}: expected a frame in 0..{len(self._info.pts_s) - 1}, got {index}: "
                "the clip is shorter than what was asked for"
            )
        keyframe = int(self._keyframes[self._keyframes <= index].max(initial=0))
        if self._container is None or not keyframe <= self._next <= index:
            self._start(keyframe)
        frame = self._advance(index)
        if frame is None:
            # A seek may land behind the frame, or on a picture that leans on earlier ones.
            self._start(0)
            frame = self._advance(index)
        if frame is None:
            raise InputError(
                f"expected frame {index} at {self._info.pts_s[index]:.3f} s in {self._path}, but it cannot "
                "be decoded: the file is damaged, copy it again or use a range before the damage"
            )
        return frame

    def _start(self, keyframe: int) -> None:
        """Open the decoder anew, at the start or at a keyframe."""
        container = self._container
        if container is None or keyframe == 0:
            self.close()
            self._container = container = _open(self._path)
        stream = _video_stream(container, self._path)
        if keyframe > 0 and stream.time_base is not None:
            ticks = round(Fraction(self._info.pts_s[keyframe]) / stream.time_base)
            container.seek(ticks, stream=stream, backward=True, any_frame=False)
        self._frames = container.decode(stream)
        self._next, self._is_damaged = keyframe, False

    def _advance(self, index: int) -> av.VideoFrame | None:
        """Decode up to a frame; None if the stream passes it, ends, or the picture is damaged.

        Damage lasts until the next keyframe: what is predicted from a damaged picture is damaged
        too, though the decoder only marks the first.
        """
        while (frame := self._next_frame()) is not None:
            at = self._next if self._info.is_counted else self._index_of(_frame_time(frame))
            if at is None:
                continue
            is_broken_off = not frame.key_frame and (self._is_damaged or at > self._next)
            self._is_damaged = frame.is_corrupt or is_broken_off
            self._next = at + 1
            if at >= index:
                return frame if at == index and not self._is_damaged else None
        return None

    def _next_frame(self) -> av.VideoFrame | None:
        try:
            return next(self._frames, None)
        except FFmpegError:
            # A decoder that broke down is of no more use; the next start opens it anew.
            self.close()
            return None

    def _index_of(self, time_s: float) -> int | None:
        times = self._info.pts_s
        at = int(np.searchsorted(times, time_s - _TIME_TOLERANCE_S))
        return at if at < len(times) and times[at] - time_s < _TIME_TOLERANCE_S else None


def read_video_frames(path: Path | str, indices: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Frames `(index, (H, W, 3) uint8 RGB)` in the order asked for, upright; memory of one frame.

    Raises InputError for an index outside the clip or a frame that cannot be decoded.
    """
    with VideoReader(path, probe_video(path)) as reader:
        for index in indices:
            yield index, reader.read(index)


def encode_video(
    path: Path | str, frames: Iterable[np.ndarray], fps: Fraction | float, codec: str = "h264"
) -> None:
    """Write (H, W, 3) uint8 RGB frames as an MP4 that plays everywhere (yuv420p, BT.709, faststart).

    Odd sizes grow by one repeated row or column, since chroma is stored at half the size. The
    same frames give the same bytes. The file appears whole or not at all.
    Raises InputError without frames, ValueError for an unknown codec or frames that differ in size.
    """
    if codec not in ENCODERS:
        raise ValueError(f"expected a codec of {', '.join(ENCODERS)}, got {codec!r}")
    rate = Fraction(fps).limit_denominator(1001)
    with (
        atomic_path(path) as temporary,
        av.open(str(temporary), "w", options={"movflags": "+faststart"}) as container,
    ):
        stream = None
        shape: tuple[int, ...] = ()
        for index, image in enumerate(frames):
            if stream is None:
                shape = image.shape
                stream = _add_stream(container, ENCODERS[codec], rate, shape)
            if image.shape != shape or image.dtype != np.uint8:
                raise ValueError(f"frame {index} is {image.shape} {image.dtype}, expected {shape} uint8")
            container.mux(stream.encode(_yuv_frame(image, index, rate)))
        if stream is None:
            raise InputError(
                f"expected at least one frame to write to {path}, got none: check the frame range"
            )
        container.mux(stream.encode(None))


def _add_stream(
    container: OutputContainer, encoder: str, rate: Fraction, shape: tuple[int, ...]
) -> av.VideoStream:
    # One thread: x264's decisions, hence the bytes, depend on how many there are.
    options = {"crf": str(CONSTANT_RATE_FACTOR), "preset": "medium", "threads": "1"}
    stream = container.add_stream(encoder, rate=rate, options=options)
    assert isinstance(stream, av.VideoStream)
    height, width = shape[:2]
    stream.width, stream.height, stream.pix_fmt = width + width % 2, height + height % 2, "yuv420p"
    context = stream.codec_context
    context.color_primaries = context.color_trc = context.colorspace = 1
    context.color_range = ColorRange.MPEG
    return stream


def _yuv_frame(image: np.ndarray, index: int, rate: Fraction) -> av.VideoFrame:
    height, width = image.shape[:2]
    padded = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(padded), format="rgb24").reformat(
        format="yuv420p",
        dst_colorspace=Colorspace.ITU709,
        dst_color_range=ColorRange.MPEG,
        interpolation=_INTERPOLATION,
        threads=1,
    )
    frame.pts, frame.time_base = index, 1 / rate
    return frame


@contextlib.contextmanager
def _explained(path: Path | str) -> Iterator[None]:
    """Turn the library's errors on a source into one sentence."""
    try:
        yield
    except FFmpegError as error:
        raise InputError(
            f"expected a whole video file at {path}, but it cannot be read ({error.strerror}): the file is "
            "truncated, damaged or no video; copy it again"
        ) from None


def _open(path: Path | str) -> InputContainer:
    if not Path(path).is_file():
        raise InputError(f"expected a video file at {path}, found nothing: check the path in the scene file")
    if Path(path).stat().st_size == 0:
        raise InputError(f"expected a video file at {path}, got an empty file: copy it again")
    container = av.open(str(path))
    for stream in container.streams.video:
        stream.codec_context.thread_count = 1
    return container


def _video_stream(container: InputContainer, path: Path | str) -> av.VideoStream:
    if not container.streams.video:
        raise InputError(
            f"expected a video at {path}, got a file without pictures: it is no "
            "video or truncated, copy it again"
        )
    return container.streams.video[0]


def _check_complete(stream: av.VideoStream, path: Path | str) -> None:
    """Compare the container's index with the bytes that are there (a copy that was cut short)."""
    num_bytes = Path(path).stat().st_size
    needed = max((entry.pos + entry.size for entry in stream.index_entries), default=0)
    if needed > num_bytes:
        raise InputError(
            f"expected {needed} bytes or more in {path}, as its index says, got {num_bytes}: the video is "
            "truncated, copy it again"
        )


def _read_times(path: Path | str) -> tuple[np.ndarray, tuple[int, ...]]:
    """(N,) presentation times, s, and the indices of keyframes, in order of presentation."""
    times: list[tuple[float | None, bool]] = []
    with _explained(path), _open(path) as container:
        for packet in container.demux(_video_stream(container, path)):
            if packet.is_corrupt:
                raise InputError(
                    f"expected a whole video file at {path}, but it is cut short or damaged after "
                    f"{len(times)} frames: copy it again"
                )
            if packet.size > 0 and not packet.is_discard:
                times.append((_seconds(packet.pts, packet.time_base), packet.is_keyframe))
    if any(time_s is None for time_s, _ in times) or len({time_s for time_s, _ in times}) < len(times):
        # Some raw streams have no presentation times, some VP9 packets show nothing: ask the decoder.
        with _explained(path), _open(path) as container:
            decoded = container.decode(_video_stream(container, path))
            times = [(_frame_time(frame), bool(frame.key_frame)) for frame in decoded]
    ordered = sorted((time_s, is_key) for time_s, is_key in times if time_s is not None)
    pts_s = np.array([time_s for time_s, _ in ordered])
    if len(pts_s) == 0:
        raise InputError(
            f"expected a video with frames at {path}, got none: it is empty or truncated, copy it again"
        )
    if np.any(np.diff(pts_s) <= 0):
        index = int(np.argmax(np.diff(pts_s) <= 0))
        raise InputError(
            f"expected the frame times of {path} to rise, but frames {index} and {index + 1} are both at "
            f"{pts_s[index]:.6f} s: write the video anew with a constant frame rate"
        )
    return pts_s, tuple(i for i, (_, is_key) in enumerate(ordered) if is_key)


def _count_times(path: Path | str) -> tuple[np.ndarray, tuple[int, ...]]:
    """Times at the container's constant rate, one per decoded frame; decoding starts at the first."""
    with _explained(path), _open(path) as container:
        stream = _video_stream(container, path)
        rate = stream.average_rate or stream.guessed_rate
        num_frames = sum(1 for _ in container.decode(stream))
    if not rate or num_frames == 0:
        raise InputError(f"expected frames and a frame rate in {path}, got {num_frames} frames at {rate} fps")
    return np.array([float(i / rate) for i in range(num_frames)]), (0,)


def _frame_time(frame: av.VideoFrame) -> float:
    time_s = _seconds(frame.pts, frame.time_base)
    if time_s is None:
        raise InputError("expected a time on every frame, got none: write the video anew as MP4")
    return time_s


def _seconds(ticks: int | None, time_base: Fraction | None) -> float | None:
    return None if ticks is None or time_base is None else float(ticks * time_base)


def _display_matrix(frame: av.VideoFrame, path: Path | str) -> tuple[int, int, int, int]:
    """(a, b, c, d), each -1, 0 or 1: the stored pixel (x, y) is shown at (a x + c y, b x + d y)."""
    data = frame.side_data.get("DISPLAYMATRIX")
    if data is None:
        return 1, 0, 0, 1
    # Rows of (a, b, u), 16.16 fixed point (ISO/IEC 14496-12, 8.3.2: transformation matrix).
    a, b, _, c, d = (np.frombuffer(bytes(data), dtype=np.int32)[:5] / 65536.0).tolist()
    matrix = round(a), round(b), round(c), round(d)
    turned = np.abs(np.subtract((a, b, c, d), matrix)).max() < 1e-3
    if not turned or sorted(map(abs, matrix)) != [0, 0, 1, 1] or (a == 0) != (d == 0):
        raise InputError(
            f"expected {path} to be turned by 0, 90, 180 or 270 degrees, got the display matrix "
            f"{(a, b, c, d)}: write the video anew without it"
        )
    return matrix


def _rgb_image(frame: av.VideoFrame, path: Path | str) -> np.ndarray:
    """(H, W, 3) uint8 RGB, full range, turned as the file says. Untagged video follows HD or SD custom."""
    untagged = Colorspace.ITU709 if frame.width >= 1280 or frame.height > 576 else Colorspace.ITU601
    image = frame.to_ndarray(
        format="rgb24",
        src_colorspace=None if frame.format.is_rgb else _COLORSPACES.get(frame.colorspace, untagged),
        dst_color_range=ColorRange.JPEG,
        interpolation=_INTERPOLATION,
        threads=1,
    )
    a, b, c, d = _display_matrix(frame, path)
    upright = image[::d, ::a] if a else image.transpose(1, 0, 2)[::b, ::c]
    return np.ascontiguousarray(upright)


def _times(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"
