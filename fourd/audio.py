"""Sound of a film: one channel of samples whose times on the camera's own clock are known."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer

from fourd.errors import InputError
from fourd.video.container import explained, film_stream, frame_time, open_container, seconds, sound_stream

# Longer jumps of the presentation times are gaps or overlaps; shorter ones the rounding of containers
# (1 ms in Matroska) and the jitter of recorders. A lost packet is 20 ms or more.
_JUMP_S = 0.01
# The channels cancel (one is the other's negative) when their mean has less of their power than this.
_MIN_MEAN_POWER = 0.05


@dataclasses.dataclass(frozen=True, eq=False)
class Audio:
    """samples: (n,) float32 in [-1, 1];  sample_rate: Hz

    start_s: time of the first sample on the camera's own clock (0 is the first frame), s
    """

    samples: np.ndarray
    sample_rate: int
    start_s: float


@dataclasses.dataclass(frozen=True)
class AudioExtent:
    """start_s: time of the first sample since the first frame, s;  duration_s: as the container says"""

    start_s: float
    duration_s: float


def probe_audio(path: Path | str) -> AudioExtent | None:
    """When the sound of a film starts and how long it lasts; None if there is none.

    Packets are read, only the first are decoded. Raises InputError for a damaged file.
    """
    with explained(path), open_container(path) as container:
        stream = sound_stream(container)
        first = None if stream is None else next(container.decode(stream), None)
        if first is None:
            return None
        start_s = frame_time(first, path)
    end_s = start_s + first.samples / first.sample_rate
    with explained(path), open_container(path) as container:
        for packet in container.demux(sound_stream(container)):
            time_s = seconds(packet.pts, packet.time_base)
            if time_s is not None and packet.size > 0 and not packet.is_discard:
                end_s = max(end_s, time_s + float((packet.duration or 0) * (packet.time_base or 0)))
    return AudioExtent(start_s - _film_start(path, start_s), end_s - start_s)


def read_audio(path: Path | str) -> Audio | None:
    """The sound of a film, mixed to one channel; None if there is none.

    The mean of the channels, or the loudest where they cancel. What encoders add before the first
    sample (priming) and what edit lists cut off is left out; gaps in the times are silent.
    A file without pictures starts at 0.
    Raises InputError if the file is missing or damaged, or its sample rate changes.
    """
    blocks, times_s, rate, loudest = _decode_mono(path, None)
    if loudest is not None:
        blocks, times_s, rate, _ = _decode_mono(path, loudest)
    if not blocks:
        return None
    starts = place_blocks(np.array(times_s), np.array([len(block) for block in blocks]), rate)
    samples = np.zeros(max(s + len(b) for s, b in zip(starts, blocks, strict=True)), dtype=np.float32)
    for start, block in zip(starts, blocks, strict=True):
        samples[start : start + len(block)] = block
    first_s = float(np.median(np.array(times_s) - starts / rate))
    return Audio(np.clip(samples, -1, 1), rate, first_s - _film_start(path, first_s))


def place_blocks(times_s: np.ndarray, lengths: np.ndarray, rate: int) -> np.ndarray:
    """Index of each block's first sample in the whole recording, (B,) int64, from 0.

    times_s: (B,) presentation times;  lengths: (B,) samples
    Blocks follow each other without a break, except where their times jump by more than 10 ms. Each
    such run stands where the median of its times says, so that jitter and rounding do not add up.
    """
    follow = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    lead_s = times_s - follow / rate
    starts = np.empty(len(lengths), dtype=np.int64)
    run_begin, run_lead = 0, lead_s[0]
    for block in range(1, len(lengths) + 1):
        if block < len(lengths) and abs(lead_s[block] - run_lead) <= _JUMP_S:
            continue
        shift = round(float(np.median(lead_s[run_begin:block])) * rate)
        starts[run_begin:block] = follow[run_begin:block] + shift
        if block < len(lengths):
            run_begin, run_lead = block, lead_s[block]
    return starts - starts.min()


def _decode_mono(
    path: Path | str, channel: int | None
) -> tuple[list[np.ndarray], list[float], int, int | None]:
    """Blocks (n,) float32, their times, the sample rate, and the channel to take instead of the mean.

    channel: None takes the mean of all
    """
    blocks: list[np.ndarray] = []
    times_s: list[float] = []
    rate, mean_power = 0, 0.0
    power: np.ndarray | None = None
    with explained(path), open_container(path) as container:
        for frame in _audio_frames(container):
            if rate not in (0, frame.sample_rate):
                raise InputError(
                    f"expected sound of one sample rate in {path}, got {rate} and {frame.sample_rate} Hz: "
                    "write the file anew with one"
                )
            rate = frame.sample_rate
            channels = _channels(frame)
            block = channels.mean(axis=0) if channel is None else channels[min(channel, len(channels) - 1)]
            mean_power += float(block @ block)
            each = np.einsum("cn,cn->c", channels, channels)
            power = each if power is None or len(power) != len(each) else power + each
            blocks.append(block)
            times_s.append(frame_time(frame, path))
    cancels = channel is None and power is not None and mean_power < _MIN_MEAN_POWER * power.mean()
    return blocks, times_s, rate, int(np.argmax(power)) if cancels and power is not None else None


def _audio_frames(container: InputContainer) -> Iterator[av.AudioFrame]:
    stream = sound_stream(container)
    if stream is not None:
        yield from container.decode(stream)


def _channels(frame: av.AudioFrame) -> np.ndarray:
    """(channels, samples) float32 in [-1, 1]."""
    data = frame.to_ndarray()
    if not frame.format.is_planar:
        data = data.reshape(-1, frame.layout.nb_channels).T
    if data.dtype == np.uint8:
        return (data.astype(np.float32) - 128) / 128
    if data.dtype.kind == "i":
        return (data / 2.0 ** (8 * data.dtype.itemsize - 1)).astype(np.float32)
    return data.astype(np.float32)


def _film_start(path: Path | str, otherwise: float) -> float:
    """The container's time of the first frame, s; `otherwise` where there are no pictures."""
    with explained(path), open_container(path) as container:
        stream = film_stream(container)
        if stream is None:
            return otherwise
        if container.format.name == "avi":
            return 0.0
        first = next(container.decode(stream), None)
        return otherwise if first is None else frame_time(first, path)
