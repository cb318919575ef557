"""Films: the path of a virtual camera among the places where people filmed, and the time that it shows.

A trajectory has two independent halves: where the view is (`kind` and its keys), and which frame of
the event is shown (`time`). Paths run through the input cameras' mean places, so the shake of
hand-held cameras does not enter. The keys are told in docs/paths.md. What a film states and shows is
told here; its poses are placed by `presets`, so that the job graph, which needs the frames only, loads
nothing of geometry.
"""

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from fourd.errors import InputError
from fourd.trajectory.checks import check_keys, check_numbers, check_points
from fourd.trajectory.timing import check_time, frames_of_keys

DEFAULT_TRAJECTORIES: dict[str, dict[str, Any]] = {
    "freeze_time": {"kind": "arc", "time": "frozen"},
    "hold_view": {"kind": "hold", "time": "running"},
    "time_and_view": {"kind": "arc", "time": "running"},
}
KINDS = ("arc", "hold", "orbit", "dolly", "bullet_time", "follow", "cameras", "keys")
EYES = ("middle", "left", "right")
RIGHT_EYE = "_right"


@dataclasses.dataclass(frozen=True)
class TrajectorySpec:
    """One film, as the configuration states it (section `trajectories`).

    kind: `arc` moves from `path_from` to `path_to`, `hold` stays at `position`; all three are
    shares of the path's length, 0 the leftmost camera, 1 the rightmost (lowest and highest, or
    farthest and nearest, where the cameras stand so). `position` None is halfway between the two
    middle cameras. The other kinds are described in `fourd.trajectory.presets`.
    time: `running` shows the whole clip once, `frozen` only `time_frame` (None: the middle one); see
    `fourd.trajectory.timing` for the others and for keys
    num_frames: of the film; None is the clip's number, twice that of a bullet time
    ease: the view starts and stops smoothly
    file: a path file that says all the rest
    """

    kind: str = "arc"
    path_from: float = 0.1
    path_to: float = 0.9
    position: float | None = None
    turn_deg: float | None = None
    closer: float = 0.3
    keep_size: bool = False
    cameras: tuple[str, ...] = ()
    keys: tuple[Mapping[str, Any], ...] = ()
    look_at: tuple[Any, ...] | None = None
    fov_deg: float | None = None
    world: str = "scene"
    time: str | tuple[Mapping[str, Any], ...] = "running"
    time_frame: int | None = None
    num_frames: int | None = None
    ease: bool = True
    size: tuple[int, int] | None = None
    stereo: float | None = None
    eye: str = "middle"
    file: str | None = None


def read_path_file(path: Path | str) -> dict[str, Any]:
    """A path file, JSON or YAML (docs/paths.md). Raises InputError if it is missing or no mapping."""
    source = Path(path)
    if not source.is_file():
        raise InputError(f"expected a path file at {source}, found nothing: check the name")
    try:
        # JSON is YAML, but for tabs, which no writer of ours uses.
        document = yaml.safe_load(source.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"expected JSON or YAML in {source}, got: {' '.join(str(error).split())}") from None
    if not isinstance(document, dict) or "file" in document:
        raise InputError(f"expected the keys of a path in {source} (without `file`): see docs/paths.md")
    document.pop("schema_version", None)
    return document


def resolve_trajectories(trajectories: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Trajectories as jobs need them: path files with a digest of their content, stereo films as two views.

    A film `NAME` with `stereo` stays as the left eye's; the right eye's is added as `NAME_right`.
    Raises InputError for an unusable trajectory or path file, or a name that is taken.
    """
    resolved: dict[str, dict[str, Any]] = {}
    for name, given in trajectories.items():
        spec = trajectory_from_mapping(given, f"trajectory {name}")
        document = dict(given)
        if spec.file:
            digest = hashlib.sha256(Path(spec.file).read_bytes()).hexdigest()[:16]
            document = {"file": spec.file, "digest": digest, "size": spec.size, "stereo": spec.stereo}
        if spec.stereo is None or spec.eye != "middle":
            resolved[name] = document
            continue
        if name + RIGHT_EYE in trajectories:
            raise InputError(
                f"trajectory {name} is stereo, and its right eye would be {name}{RIGHT_EYE}, which exists: "
                "rename one"
            )
        resolved[name] = {**document, "eye": "left"}
        resolved[name + RIGHT_EYE] = {**document, "eye": "right"}
    return resolved


def trajectory_from_mapping(document: Mapping[str, Any], where: str) -> TrajectorySpec:
    """Spec from its JSON form, checked; a path file that it names is read.

    where: name of the trajectory for the error message
    Raises InputError for unknown keys, wrong values or keys that contradict each other.
    """
    document = {key: value for key, value in document.items() if key != "digest"}
    if document.get("file"):
        eye = document.get("eye", "middle")
        where = f"{where}, {document['file']}"
        document = {**read_path_file(document["file"]), "file": document["file"]}
        if eye != "middle":
            document["eye"] = eye
    known = {field.name for field in dataclasses.fields(TrajectorySpec)}
    unknown = sorted(set(document) - known)
    if unknown:
        raise InputError(f"{where}: unknown key {unknown[0]!r}; known keys are {', '.join(sorted(known))}")
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in document.items()}
    spec = TrajectorySpec(**values)
    allowed = {"kind": KINDS, "eye": EYES, "world": ("scene", "source")}
    for key, words in allowed.items():
        if getattr(spec, key) not in words:
            raise InputError(
                f"{where}: {key} is {getattr(spec, key)!r}, expected one of {', '.join(words)}: fix it"
            )
    check_numbers(spec, where)
    check_time(spec.time, where)
    check_points(spec.look_at, where)
    check_keys(spec, where)
    return spec


def film_length(spec: TrajectorySpec, num_frames: int) -> int:
    """Frames of the film. num_frames: of the clip."""
    if spec.num_frames is not None:
        return spec.num_frames
    return 2 * num_frames if spec.kind == "bullet_time" else num_frames


def bullet_moment(spec: TrajectorySpec, num_frames: int) -> tuple[int, float]:
    """The frame at which a bullet time stands still, and the share of the film at which it stops."""
    frame = num_frames // 2 if spec.time_frame is None else spec.time_frame
    return frame, 0.5 * frame / (num_frames - 1) if num_frames > 1 else 0.25


def scene_frames(spec: TrajectorySpec | Mapping[str, Any], num_frames: int) -> list[int]:
    """The frame of the scene that each frame of the film shows.

    spec: or its JSON form;  num_frames: of the clip
    No camera is needed, so the films' jobs are known before any job runs.
    Raises InputError when a frame lies outside the clip.
    """
    if isinstance(spec, Mapping):
        spec = trajectory_from_mapping(spec, "trajectory")
    length, last = film_length(spec, num_frames), num_frames - 1
    if spec.time_frame is not None and spec.time_frame > last:
        raise InputError(
            f"trajectory: time_frame is {spec.time_frame}, expected 0..{last}, the frames of the clip: "
            "choose an earlier one"
        )
    if not isinstance(spec.time, str):
        return frames_of_keys(spec.time, length, num_frames, "trajectory")
    if spec.kind == "bullet_time":
        frame, stop = bullet_moment(spec, num_frames)
        ends = [{"at": 0, "frame": 0}, {"at": 1, "frame": last}]
        still = [{"at": stop, "frame": frame}, {"at": stop + 0.5, "frame": frame}]
        return frames_of_keys([ends[0], *still, ends[1]], length, num_frames, "trajectory")
    if spec.time == "frozen":
        return [num_frames // 2 if spec.time_frame is None else spec.time_frame] * length
    if length == 1:
        return [num_frames // 2]
    # Integer rounding: the same list on every machine.
    if spec.time == "there_and_back":
        end = length - 1
        return [(4 * last * min(i, end - i) + end) // (2 * end) for i in range(length)]
    frames = [(2 * i * last + length - 1) // (2 * (length - 1)) for i in range(length)]
    return frames[::-1] if spec.time == "reversed" else frames
