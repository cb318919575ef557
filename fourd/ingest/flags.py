"""What is wrong with the frames of a film: lost, repeated, paused, always the same.

Repeated pictures are told from a still scene by the sensor's noise. A camera on a tripod in an empty
room records two unlike pictures, because its noise differs; a picture that was handed over twice
differs from itself only by what the codec adds. So a frame is a duplicate where the difference
to the frame before falls far below what is usual around it, in the picture's mean and in its worst
block alike. Strong compression copies what is still and its noise with it, so where nothing moves for
a moment there is no difference either. Two things tell this apart: repeats (lost pictures, films
stored at another rate) come in short runs between pictures that do change, and longer runs are
called `still` (nothing moves, or the camera froze); and where hardly anything changes at all, as in
an empty room, nothing is flagged.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.ndimage import percentile_filter

# A frame interval is long from here on, in usual intervals.
LONG_INTERVALS = 1.5
PAUSE_S = 0.5
# Intervals around one that say what is usual, where the rate changes slowly (dim light).
_USUAL_INTERVALS = 9
# Every 4th pixel of every 4th row; a block is 8 x 8 of these.
SAMPLE_STEP = 4
_BLOCK = 8
# Mean and worst block of a repeated picture, as shares of the usual difference around it.
_REPEAT_SHARE = 0.25
# The worst block changes this many times as much just before and after repeats.
_CHANGE_RATIO = 2.5
_USUAL_FRAMES = 25
_USUAL_PERCENTILE = 85
# Change of the worst block, 8-bit levels, from which a film moves enough to tell.
_MOVING_LEVELS = 2.0
# 24 pictures per second stored at 120 repeat each four times.
_MAX_REPEATS = 4
# Blocks keep their mean within this in a constant picture, whatever its noise; 8-bit levels.
_CONSTANT_LEVELS = 2.0


def find_gaps(pts_s: np.ndarray, fps: float) -> tuple[list[int], list[int]]:
    """Frames with frames missing before them, and those that follow a pause.

    pts_s: (N,) rising, s;  fps: nominal
    An interval is long against the film's nominal one and the median around it, so that a rate
    which falls slowly is no loss.
    """
    intervals = np.diff(pts_s)
    if len(intervals) == 0:
        return [], []
    around = percentile_filter(intervals, 50, size=min(_USUAL_INTERVALS, len(intervals)), mode="nearest")
    is_long = intervals > LONG_INTERVALS * np.maximum(around, 1 / fps)
    is_pause = is_long & (intervals > PAUSE_S)
    return (np.flatnonzero(is_long & ~is_pause) + 1).tolist(), (np.flatnonzero(is_pause) + 1).tolist()


def measure_changes(samples: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
    """How each picture differs from the one before, and the largest lasting change of the film.

    samples: per frame (h, w) float32, 8-bit levels, single pixels;  consumed one at a time
    Returns mean (N - 1,) and worst block's mean (N - 1,) of absolute differences, and the largest
    difference of any block's mean to that of the first frame.
    """
    means, worst = [], []
    first = previous = None
    lasting = 0.0
    for sample in samples:
        if first is None or previous is None:
            first = _block_means(sample)
        else:
            difference = np.abs(sample - previous)
            means.append(float(difference.mean()))
            worst.append(float(_block_means(difference).max()))
            lasting = max(lasting, float(np.abs(_block_means(sample) - first).max()))
        previous = sample
    return np.array(means), np.array(worst), lasting


def find_repeats(mean: np.ndarray, worst: np.ndarray) -> tuple[list[int], list[int]]:
    """Frames that are duplicates of the one before, and those that are still (see the module).

    mean, worst: of `measure_changes`
    """
    if len(mean) == 0:
        return [], []
    size = min(_USUAL_FRAMES, len(mean))
    usual_mean, usual_worst = (
        percentile_filter(change, _USUAL_PERCENTILE, size=size, mode="nearest") for change in (mean, worst)
    )
    is_small = (mean < _REPEAT_SHARE * usual_mean) & (worst < _REPEAT_SHARE * usual_worst)
    is_small &= usual_worst > _MOVING_LEVELS
    # Beyond both ends lies what nobody knows; it counts as change.
    around = np.concatenate([[np.inf], worst, [np.inf]])
    duplicate: list[int] = []
    still: list[int] = []
    small = np.flatnonzero(is_small)
    for run in np.split(small, np.flatnonzero(np.diff(small) > 1) + 1):
        if len(run) > _MAX_REPEATS:
            still.extend((run + 1).tolist())
        elif len(run):
            before_and_after = min(around[run[0]], around[run[-1] + 2])
            if before_and_after > max(_MOVING_LEVELS, _CHANGE_RATIO * worst[run].max()):
                duplicate.extend((run + 1).tolist())
    return duplicate, still


def is_constant_picture(lasting_change: float) -> bool:
    """Whether a film shows one picture all along, but for noise (a covered lens, a frozen camera)."""
    return lasting_change < _CONSTANT_LEVELS


def words_by_frame(flags: Mapping[str, Sequence[int]], num_frames: int) -> list[str]:
    """The flags of each frame, separated by spaces."""
    words: list[list[str]] = [[] for _ in range(num_frames)]
    for name, frames in flags.items():
        for frame in frames:
            words[frame].append(name)
    return [" ".join(each) for each in words]


def _block_means(sample: np.ndarray) -> np.ndarray:
    """Means of blocks; what remains at the right and bottom belongs to the last blocks."""
    edges = [np.arange(max(1, length // _BLOCK)) * _BLOCK for length in sample.shape]
    sums = np.add.reduceat(np.add.reduceat(sample, edges[0], axis=0), edges[1], axis=1)
    lengths = [np.diff([*edge, length]) for edge, length in zip(edges, sample.shape, strict=True)]
    return sums / (lengths[0][:, None] * lengths[1])
