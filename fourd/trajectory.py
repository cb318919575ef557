"""Paths of a virtual camera through the places where people filmed, and the time that they show.

A trajectory has two independent halves: where the view is (`kind`), and which frame of the event
is shown (`time`). The path runs through the input cameras' mean places, so the shake of hand-held
cameras does not enter; the picture stays level and looks where the neighbouring cameras look.
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from fourd.camera import Camera
from fourd.errors import InputError

if TYPE_CHECKING:
    from fourd.sfm.cameras import SceneCameras

DEFAULT_TRAJECTORIES: dict[str, dict[str, Any]] = {
    "freeze_time": {"kind": "arc", "time": "frozen"},
    "hold_view": {"kind": "hold", "time": "running"},
    "time_and_view": {"kind": "arc", "time": "running"},
}


@dataclasses.dataclass(frozen=True)
class TrajectorySpec:
    """One film, as the configuration states it (section `trajectories`).

    kind: `arc` moves from `path_from` to `path_to`, `hold` stays at `position`; all three are
    shares of the path's length, 0 the leftmost camera, 1 the rightmost (lowest and highest, or
    farthest and nearest, where the cameras stand so). `position` None is halfway between the two
    middle cameras.
    time: `running` shows the whole clip once, `frozen` only `time_frame` (None: the middle one)
    num_frames: of the film; None is the clip's number
    ease: the view starts and stops smoothly
    """

    kind: str = "arc"
    path_from: float = 0.1
    path_to: float = 0.9
    position: float | None = None
    time: str = "running"
    time_frame: int | None = None
    num_frames: int | None = None
    ease: bool = True


def trajectory_from_mapping(document: Mapping[str, Any], where: str) -> TrajectorySpec:
    """Spec from its JSON form, checked.

    where: name of the trajectory for the error message
    Raises InputError for unknown keys, wrong values or keys that contradict each other.
    """
    known = {field.name for field in dataclasses.fields(TrajectorySpec)}
    unknown = sorted(set(document) - known)
    if unknown:
        raise InputError(f"{where}: unknown key {unknown[0]!r}; known keys are {', '.join(sorted(known))}")
    spec = TrajectorySpec(**document)
    allowed = {"kind": ("arc", "hold"), "time": ("running", "frozen")}
    for key, values in allowed.items():
        if getattr(spec, key) not in values:
            raise InputError(
                f"{where}: {key} is {getattr(spec, key)!r}, expected one of {', '.join(values)}: fix it"
            )
    for key in ("path_from", "path_to", "position"):
        value = getattr(spec, key)
        if value is None and key == "position":
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
            raise InputError(f"{where}: {key} is {value!r}, expected a share of the path from 0 to 1: fix it")
    for key, least in (("time_frame", 0), ("num_frames", 1)):
        value = getattr(spec, key)
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < least):
            raise InputError(
                f"{where}: {key} is {value!r}, expected null or a whole number from {least}: fix it"
            )
    if not isinstance(spec.ease, bool):
        raise InputError(f"{where}: ease is {spec.ease!r}, expected true or false: fix it")
    return spec


def scene_frames(spec: TrajectorySpec | Mapping[str, Any], num_frames: int) -> list[int]:
    """The frame of the scene that each frame of the film shows.

    spec: or its JSON form;  num_frames: of the clip
    No camera is needed, so the films' jobs are known before any job runs.
    Raises InputError when the frozen frame lies outside the clip.
    """
    if isinstance(spec, Mapping):
        spec = trajectory_from_mapping(spec, "trajectory")
    length = num_frames if spec.num_frames is None else spec.num_frames
    if spec.time == "frozen":
        frame = num_frames // 2 if spec.time_frame is None else spec.time_frame
        if frame >= num_frames:
            raise InputError(
                f"trajectory: time_frame is {frame}, expected 0..{num_frames - 1}, the frames of the clip: "
                "choose an earlier one"
            )
        return [frame] * length
    if length == 1:
        return [num_frames // 2]
    # Integer rounding: the same list on every machine.
    return [(2 * i * (num_frames - 1) + length - 1) // (2 * (length - 1)) for i in range(length)]


def place_cameras(spec: TrajectorySpec, scene_cameras: "SceneCameras", size: tuple[int, int]) -> list[Camera]:
    """The ideal pinhole of every frame of the film.

    size: of the film, (width, height) px; pixels are square, the principal point is central and
    the field of view over the diagonal is interpolated from the neighbouring cameras'
    Raises InputError when there are fewer than two input cameras or all stand in one place.
    """
    # SciPy takes 0.3 s to import, and the workflow's every start needs `scene_frames` only.
    from fourd.arc_path import ArcPath

    tracks = [scene_cameras.tracks[name] for name in scene_cameras.inputs]
    path = ArcPath(tracks, scene_cameras.up)
    length = len(scene_frames(spec, scene_cameras.num_frames))
    if spec.kind == "hold":
        position = path.middle_share() if spec.position is None else spec.position
        return [path.camera_at(position, size)] * length
    run = np.linspace(0.0, 1.0, length) if length > 1 else np.array([0.5])
    if spec.ease:
        run = run * run * (3 - 2 * run)
    shares = spec.path_from + (spec.path_to - spec.path_from) * run
    return [path.camera_at(float(share), size) for share in shares]
