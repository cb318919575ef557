"""Which moment a film shows, and how far along its way the view is, at each of its frames."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeGuard

from fourd.errors import InputError

EASINGS: dict[str, Callable[[float], float]] = {
    "linear": lambda x: x,
    "smooth": lambda x: x * x * (3 - 2 * x),
    "in": lambda x: x * x,
    "out": lambda x: x * (2 - x),
    "hold": lambda x: 0.0,
}
TIME_WORDS = ("running", "frozen", "reversed", "there_and_back")


def film_shares(length: int) -> list[float]:
    """Place of every frame in the film, from 0 to 1; the middle of a film of one frame."""
    return [i / (length - 1) for i in range(length)] if length > 1 else [0.5]


def check_time(time: Any, where: str) -> None:
    """Raise InputError unless `time` is one of TIME_WORDS or a list of keys `{at, frame, ease}`."""
    if isinstance(time, str):
        if time not in TIME_WORDS:
            known = ", ".join(TIME_WORDS)
            raise InputError(f"{where}: time is {time!r}, expected a list of keys or one of {known}: fix it")
        return
    if not isinstance(time, Sequence) or len(time) < 2:
        raise InputError(f"{where}: time is {time!r}, expected a word or a list of two keys or more: fix it")
    for i, key in enumerate(time):
        known = isinstance(key, Mapping) and {"at", "frame"} <= key.keys() <= {"at", "frame", "ease"}
        if not known or not all(is_number(key[name]) for name in ("at", "frame")):
            raise InputError(f"{where}: time key {i} is {key!r}, expected at, frame and perhaps ease: fix it")
    check_order([key["at"] for key in time], f"{where}: time")
    check_eases(time, f"{where}: time")


def check_order(at: Sequence[float], what: str) -> None:
    """Raise InputError unless places in the film rise (two may be equal: a jump) from 0 to 1."""
    is_sorted = all(a <= b for a, b in zip(at, at[1:], strict=False))
    if not is_sorted or not all(0 <= a <= 1 for a in at):
        raise InputError(f"{what}: at is {list(at)}, expected rising shares of the film from 0 to 1: fix it")


def check_eases(keys: Sequence[Mapping[str, Any]], what: str) -> None:
    """Raise InputError for a key whose `ease` is not known."""
    for key in keys:
        if key.get("ease", "linear") not in EASINGS:
            raise InputError(f"{what}: ease is {key['ease']!r}, expected one of {', '.join(EASINGS)}: fix it")


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value of a document is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def locate(at: Sequence[float], share: float) -> tuple[int, float]:
    """The key whose stretch a place of the film lies in, and how far in it (0 to 1).

    at: rising;  before the first key it is the first, after the last the last stretch's end. At two
    equal keys the later counts, so that a jump has happened.
    """
    last = len(at) - 1
    if share >= at[last]:
        return max(last - 1, 0), 1.0 if last else 0.0
    index = 0
    while index + 1 < last and share >= at[index + 1]:
        index += 1
    width = at[index + 1] - at[index]
    return index, min(max((share - at[index]) / width, 0.0), 1.0) if width > 0 else 0.0


def frames_of_keys(keys: Sequence[Mapping[str, Any]], length: int, num_frames: int, where: str) -> list[int]:
    """The scene frame that each frame of the film shows, nearest to the keys' line, halves upward.

    keys: checked;  num_frames: of the clip
    Raises InputError for a key outside the clip.
    """
    outside = [key["frame"] for key in keys if not 0 <= key["frame"] <= num_frames - 1]
    if outside:
        raise InputError(
            f"{where}: time shows frame {outside[0]}, expected 0..{num_frames - 1}, the frames of the clip: "
            "choose another"
        )
    at = [float(key["at"]) for key in keys]
    frames = []
    for share in film_shares(length):
        index, part = locate(at, share)
        if part < 1:
            part = EASINGS[keys[index].get("ease", "linear")](part)
        first, second = keys[index]["frame"], keys[min(index + 1, len(keys) - 1)]["frame"]
        frames.append(math.floor(first + (second - first) * part + 0.5))
    return frames
