"""Faults of a film's statement, each in one sentence."""

from collections.abc import Mapping, Sequence
from typing import Any

from fourd.errors import InputError
from fourd.trajectory.timing import check_eases, check_order, is_number

KEY_NAMES = {"at", "ease", "camera", "position", "rotation", "look_at", "fov_deg"}
# Key -> lowest and highest value of a number.
RANGES: dict[str, tuple[float, float]] = {
    "path_from": (0, 1),
    "path_to": (0, 1),
    "position": (0, 1),
    "turn_deg": (-3600, 3600),
    "closer": (-10, 0.95),
    "fov_deg": (1, 170),
    "stereo": (0, 1),
}
OPTIONAL = ("position", "turn_deg", "fov_deg", "stereo")


def check_numbers(spec: Any, where: str) -> None:
    """Raise InputError for a number, truth value or size of a TrajectorySpec that cannot be."""
    for key, (low, high) in RANGES.items():
        value: Any = getattr(spec, key)
        if value is None and key in OPTIONAL:
            continue
        if not is_number(value) or not low <= value <= high:
            share = "a share of the path" if key.startswith("p") else "a number"
            raise InputError(f"{where}: {key} is {value!r}, expected {share} from {low} to {high}: fix it")
    for key, least in (("time_frame", 0), ("num_frames", 1)):
        value = getattr(spec, key)
        if value is not None and (not _is_whole(value) or value < least):
            raise InputError(
                f"{where}: {key} is {value!r}, expected null or a whole number from {least}: fix it"
            )
    for key in ("ease", "keep_size"):
        if not isinstance(getattr(spec, key), bool):
            raise InputError(f"{where}: {key} is {getattr(spec, key)!r}, expected true or false: fix it")
    size = spec.size
    if size is not None and (
        not isinstance(size, Sequence) or len(size) != 2 or not all(_is_whole(v) and v >= 16 for v in size)
    ):
        raise InputError(f"{where}: size is {size!r}, expected width and height from 16 px: fix it")


def check_points(look_at: Any, where: str) -> None:
    """Raise InputError unless `look_at` is nothing, a point, or keys `{frame, point}` of a moving one."""
    if look_at is None or is_vector(look_at, 3):
        return
    moving = isinstance(look_at, Sequence) and not isinstance(look_at, str) and len(look_at) > 0
    keys: Any = look_at if moving else [look_at]
    for key in keys:
        if not (
            isinstance(key, Mapping)
            and key.keys() == {"frame", "point"}
            and is_number(key["frame"])
            and is_vector(key["point"], 3)
        ):
            raise InputError(
                f"{where}: look_at holds {key!r}, expected three numbers, or keys of frame and point: fix it"
            )
    frames = [key["frame"] for key in keys]
    if any(a >= b for a, b in zip(frames, frames[1:], strict=False)):
        raise InputError(f"{where}: look_at has frames {frames}, expected them rising: sort them")


def check_keys(spec: Any, where: str) -> None:
    """Raise InputError for keys that state no pose, or that the kind of path does not have or lacks."""
    needed = {"keys": "keys", "cameras": "cameras", "follow": "look_at"}.get(spec.kind)
    if needed and not getattr(spec, needed):
        raise InputError(f"{where}: a path of kind {spec.kind} needs `{needed}`, got none: add it")
    if not all(isinstance(name, str) for name in spec.cameras):
        raise InputError(f"{where}: cameras is {list(spec.cameras)}, expected names of cameras: fix it")
    for i, key in enumerate(spec.keys):
        _check_key(key, f"{where}: key {i}")
    places = [key["at"] for key in spec.keys if "at" in key]
    if places and len(places) < len(spec.keys):
        raise InputError(f"{where}: some keys have `at` and some have none: give it to all or to none")
    check_order(places, f"{where}: keys")
    check_eases(spec.keys, f"{where}: keys")


def _check_key(key: Any, where: str) -> None:
    if not isinstance(key, Mapping) or not key.keys() <= KEY_NAMES:
        raise InputError(
            f"{where} is {key!r}, expected a mapping with {', '.join(sorted(KEY_NAMES))}: fix it"
        )
    if "at" in key and not is_number(key["at"]):
        raise InputError(f"{where}: at is {key['at']!r}, expected a share of the film: fix it")
    if isinstance(key.get("camera"), str) and not key.keys() & {"position", "rotation"}:
        return
    if "camera" in key or not is_vector(key.get("position"), 3):
        raise InputError(
            f"{where}: expected either the name of a camera or a position of three numbers: fix it"
        )
    if "rotation" in key and not (is_vector(key["rotation"], 4) and any(key["rotation"])):
        raise InputError(
            f"{where}: rotation is {key['rotation']!r}, expected a quaternion w, x, y, z: fix it"
        )
    if "look_at" in key and not is_vector(key["look_at"], 3):
        raise InputError(f"{where}: look_at is {key['look_at']!r}, expected three numbers: fix it")
    if "fov_deg" in key and not (is_number(key["fov_deg"]) and 1 <= key["fov_deg"] <= 170):
        raise InputError(f"{where}: fov_deg is {key['fov_deg']!r}, expected 1 to 170: fix it")


def is_vector(value: Any, length: int) -> bool:
    """Whether a value of a document is a list of so many finite numbers."""
    is_list = isinstance(value, Sequence) and not isinstance(value, str)
    return is_list and len(value) == length and all(is_number(v) for v in value)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
