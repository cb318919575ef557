"""Which picture of each film belongs to which frame of the scene, once the clocks are known.

Times are seconds on the common clock; scene frame k is at start_s + k / fps.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from fourd.align.clock import CameraClock
from fourd.errors import InputError

# How the status of a film begins that ends before half of the scene is over: nobody looks at it any further.
TOO_SHORT = "too short for the scene"
# Of two frames that are equally near, take the earlier, whatever the last bits of their times say.
_TIE_S = 1e-6
# Sub-frame phases that are tried, and how often the best one's surroundings are tried again.
_PHASES = 64
_REFINEMENTS = 3


def match_frames(
    common_s: np.ndarray, fps: float, num_frames: int, start_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """For each scene frame the source frame nearest in time.

    common_s: (N,) common times of a film's frames, rising, s;  fps, num_frames, start_s: of the scene
    Returns source_frame (num_frames,) int64 and dt_s (num_frames,) float64, the time of the source
    frame minus the wanted time. Of two equally near frames the earlier is taken.
    """
    wanted = start_s + np.arange(num_frames) / fps
    later = np.clip(np.searchsorted(common_s, wanted), 0, len(common_s) - 1)
    earlier = np.maximum(later - 1, 0)
    take_later = np.abs(common_s[later] - wanted) < np.abs(common_s[earlier] - wanted) - _TIE_S
    source_frame = np.where(take_later, later, earlier)
    return source_frame, common_s[source_frame] - wanted


def check_coverage(
    camera: str,
    source: str,
    common_s: np.ndarray,
    dt_s: np.ndarray,
    fps: float,
    start_s: float,
    max_dt_frames: float,
) -> str:
    """`ok` if every scene frame has a picture within max_dt_frames scene frames, else the reason.

    source: name of the film;  common_s, dt_s, fps, start_s: as in `match_frames`
    """
    last = len(dt_s) - 1
    begin, end = (float(time_s - start_s) * fps for time_s in (common_s[0], common_s[-1]))
    where = f"camera {camera}: {source} shows scene frames {begin:.1f} to {end:.1f} ({fps:g} fps)"
    if begin > last or end < 0:
        return f"{where}, none of the wanted 0 to {last}: it was filmed at another time"
    if begin > max_dt_frames + 1e-6:
        return f"{where}: it starts too late for frame 0, by {begin / fps:.2f} s"
    if end < last - max_dt_frames - 1e-6:
        return f"{where}: it ends too early for frame {last}, by {(last - end) / fps:.2f} s"
    distant = np.abs(dt_s) * fps > max_dt_frames + 1e-6
    if not distant.any():
        return "ok"
    frame = int(distant.argmax())
    return (
        f"camera {camera}: {source} has no picture within {max_dt_frames:g} frames of scene frame {frame}, "
        f"the nearest is {abs(dt_s[frame]) * fps:.2f} frames ({abs(dt_s[frame]) * 1e3:.1f} ms) away, and "
        f"{int(distant.sum())} scene frames are like that: pictures are missing or the film is slower than "
        "the scene"
    )


def find_too_short(
    pts_by_camera: Mapping[str, np.ndarray], inputs: Sequence[str], fps: float, num_frames: int
) -> dict[str, str]:
    """Cameras whose film shows less than half of the scene, such as a mistaken tap, and the reason.

    pts_by_camera: (N,) times of the film's frames on its own clock, s;  inputs: cameras not held out
    Where half of the inputs are so short it is num_frames that is wrong, and none is named.
    """
    reasons = {}
    for name, pts_s in pts_by_camera.items():
        fitting = _count_fitting(float(pts_s[-1] - pts_s[0]), fps)
        if 2 * fitting < num_frames:
            reasons[name] = (
                f"{TOO_SHORT}: it lasts {fitting} of {num_frames} frames at {fps:g} fps; film longer, or "
                "take it out of the scene"
            )
    return reasons if 2 * len(reasons.keys() & set(inputs)) < len(inputs) else {}


def _count_fitting(duration_s: float, fps: float) -> int:
    """Scene frames from the first to the last picture, both included."""
    return int(np.floor(duration_s * fps + 1e-6)) + 1


def choose_start(
    clocks: Mapping[str, CameraClock], pts_by_camera: Mapping[str, np.ndarray], fps: float, num_frames: int
) -> float:
    """The common time of scene frame 0, s: the earliest from which all cameras have pictures.

    clocks: by camera; those whose status is not `ok` do not count
    pts_by_camera: (N,) times of the film's frames on its own clock, s
    Within one frame after the earliest time, the phase is taken that minimises the sum of the squared
    dt_s of all cameras and frames, while all of them still last.
    Raises InputError if no camera is `ok`, or the films overlap for fewer than num_frames frames.
    """
    common = {
        name: clock.common_time(pts_by_camera[name]) for name, clock in clocks.items() if clock.status == "ok"
    }
    if not common:
        reasons = "; ".join(f"{name}: {clock.status}" for name, clock in clocks.items())
        raise InputError(f"expected cameras that could be placed in time, got none ({reasons})")
    last_to_start = max(common, key=lambda name: float(common[name][0]))
    first_to_end = min(common, key=lambda name: float(common[name][-1]))
    earliest, latest = float(common[last_to_start][0]), float(common[first_to_end][-1])
    fitting = _count_fitting(latest - earliest, fps) if latest >= earliest else 0
    if fitting < num_frames:
        raise InputError(
            f"expected all cameras to have filmed {num_frames} frames at {fps:g} fps together, but between "
            f"the start of {last_to_start} and the end of {first_to_end} there are {fitting}: "
            + (f"set num_frames to {fitting} or less, or " if fitting else "")
            + "take one of the two out of the scene"
        )
    slack = min(1 / fps, latest - earliest - (num_frames - 1) / fps)
    return earliest + _best_phase(list(common.values()), fps, num_frames, earliest, max(slack, 0.0))


def _best_phase(films: list[np.ndarray], fps: float, num_frames: int, earliest: float, slack: float) -> float:
    """Delay in 0..slack, s, with the least sum of squared dt; the earliest of equals."""

    def cost(phase: float) -> float:
        return sum(
            float((match_frames(film, fps, num_frames, earliest + phase)[1] ** 2).sum()) for film in films
        )

    low, high = 0.0, slack
    best = 0.0
    for _ in range(_REFINEMENTS):
        phases = np.linspace(low, high, _PHASES + 1)
        costs = np.array([cost(float(phase)) for phase in phases])
        # Sums differ in their last bits; of equals the earliest is meant.
        at = int(np.flatnonzero(costs <= costs.min() + 1e-12 * num_frames)[0])
        best = float(phases[at])
        low, high = float(phases[max(at - 1, 0)]), float(phases[min(at + 1, _PHASES)])
    return best
