"""Frames of a video by index."""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError

from fourd.errors import InputError
from fourd.video.colour import luma_samples, rgb_image
from fourd.video.container import explained, frame_time, open_container, video_stream
from fourd.video.geometry import display_image, display_matrix
from fourd.video.probe import VideoInfo, probe_video

_TIME_TOLERANCE_S = 1e-6


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
        """(H, W, 3) uint8 RGB of one frame, as displayed. Raises InputError if it cannot be decoded."""
        with explained(self._path):
            frame = self._decode(index)
            return display_image(rgb_image(frame), display_matrix(frame, self._path), self._info.size)

    def read_luma(self, index: int, step: int) -> np.ndarray:
        """Every step-th pixel of one stored frame (`luma_samples`); cheaper than `read`."""
        with explained(self._path):
            return luma_samples(self._decode(index), step)

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
                "be decoded: the file is damaged, copy it again or cut the damaged part off"
            )
        if (frame.width, frame.height) != tuple(self._info.stored_size):
            raise InputError(
                f"{self._path}: expected every frame to be {_times(self._info.stored_size)}, frame {index} "
                f"is {frame.width} x {frame.height}: cut the video where its size changes"
            )
        return frame

    def _start(self, keyframe: int) -> None:
        """Open the decoder anew, at the start or at a keyframe."""
        container = self._container
        if container is None or keyframe == 0:
            self.close()
            self._container = container = open_container(self._path)
        stream = video_stream(container, self._path)
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
            at = self._next if self._info.is_counted else self._index_of(frame_time(frame, self._path))
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
    """Frames `(index, (H, W, 3) uint8 RGB)` in the order asked for, as displayed; memory of one frame.

    Raises InputError for an index outside the clip or a frame that cannot be decoded.
    """
    with VideoReader(path, probe_video(path)) as reader:
        for index in indices:
            yield index, reader.read(index)


def _times(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"
