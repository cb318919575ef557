"""When the frames of a film were taken, as its container says."""

from pathlib import Path

import numpy as np

from fourd.errors import InputError
from fourd.video.container import explained, frame_time, open_container, seconds, video_stream

STANDARD_FPS = (10, 12, 12.5, 15, 20, 24000 / 1001, 24, 25, 30000 / 1001, 30, 48, 50, 60000 / 1001, 60)
STANDARD_FPS += (72, 90, 100, 120000 / 1001, 120, 240000 / 1001, 240)


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


def read_times(path: Path | str) -> tuple[np.ndarray, tuple[int, ...]]:
    """(N,) presentation times, s, and the indices of keyframes, in order of presentation.

    Times are the container's after its edit list: frames that an edit cuts off are not there.
    Raises InputError if there is no frame or two have the same time.
    """
    times: list[tuple[float | None, bool]] = []
    with explained(path), open_container(path) as container:
        for packet in container.demux(video_stream(container, path)):
            if packet.is_corrupt:
                raise InputError(
                    f"expected a whole video file at {path}, but it is cut short or damaged after "
                    f"{len(times)} frames: copy it again"
                )
            if packet.size > 0 and not packet.is_discard:
                times.append((seconds(packet.pts, packet.time_base), packet.is_keyframe))
    if any(time_s is None for time_s, _ in times) or len({time_s for time_s, _ in times}) < len(times):
        # Some raw streams have no presentation times, some VP9 packets show nothing: ask the decoder.
        with explained(path), open_container(path) as container:
            decoded = container.decode(video_stream(container, path))
            times = [(frame_time(frame, path), bool(frame.key_frame)) for frame in decoded]
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


def count_times(path: Path | str) -> tuple[np.ndarray, tuple[int, ...]]:
    """Times at the container's constant rate, one per decoded frame; decoding starts at the first."""
    with explained(path), open_container(path) as container:
        stream = video_stream(container, path)
        rate = stream.average_rate or stream.guessed_rate
        num_frames = sum(1 for _ in container.decode(stream))
    if not rate or num_frames == 0:
        raise InputError(f"expected frames and a frame rate in {path}, got {num_frames} frames at {rate} fps")
    return np.array([float(i / rate) for i in range(num_frames)]), (0,)
