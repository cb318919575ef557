"""Stage `views`: the ideal pinholes that every later stage renders for.

In: sfm/cameras.json. Out: views/{view}.json (docs/formats.md), one pinhole per output frame, of a
physical camera at chosen frames of the scene, or of a trajectory at all frames of its film.
"""

import argparse
import dataclasses
import json
import logging
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd.camera import Camera, camera_from_dict
from fourd.cli import run_stage
from fourd.errors import InputError, explain_faults
from fourd.io import MAX_IMAGE_SIDE_PX, read_document, write_json
from fourd.sfm.cameras import SceneCameras, read_cameras
from fourd.trajectory import TrajectorySpec, scene_frames, trajectory_from_mapping

STAGE_VERSION = 1
logger = logging.getLogger(__name__)
LEFT_OUT = "left_out"
ROLES = ("input", "heldout", "virtual", LEFT_OUT)


@dataclasses.dataclass(frozen=True, eq=False)
class ViewFrame:
    """One output frame: its number, the scene frame that it shows, and its pinhole."""

    frame: int
    scene_frame: int
    camera: Camera


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """A place to film from. size: (width, height) px.

    role: `input`, `heldout`, `virtual`, or `left_out`: a camera that could not be placed, without frames
    status: `ok`, or why it was left out
    """

    name: str
    role: str
    size: tuple[int, int]
    frames: tuple[ViewFrame, ...]
    status: str = "ok"

    def frames_of(self, wanted: Sequence[int]) -> list[int]:
        """The wanted output frames, none of a camera that was left out."""
        return [] if self.role == LEFT_OUT else list(wanted)

    def at(self, frame: int) -> ViewFrame:
        """The output frame of that number. Raises InputError if the view has none."""
        for entry in self.frames:
            if entry.frame == frame:
                return entry
        raise InputError(
            f"view {self.name}: expected one of its {len(self.frames)} frames, got {frame}: "
            "make the view again with this frame"
        )


def spread(frames: Sequence[int], count: int) -> list[int]:
    """At most `count` of the frames, evenly spread, the ends included; of one, the middle."""
    if count >= len(frames):
        return list(frames)
    if count == 1:
        return [frames[len(frames) // 2]]
    last = len(frames) - 1
    return [frames[round(i * last / (count - 1))] for i in range(count)]


def physical_view(
    scene: SceneCameras, name: str, frames: Sequence[int], size: tuple[int, int] | None
) -> View:
    """What an ideal pinhole with a physical camera's own pose and focal length sees.

    size: of the output; None is the camera's own. Of another aspect than the camera's, the view is
    the largest part around the middle of the camera's picture that has it.
    A camera that was left out gives a view without frames.
    Raises InputError for an unknown camera, no frames or a frame outside the clip.
    """
    if name in scene.left_out:
        logger.warning("camera %s is left out: %s", name, scene.left_out[name])
        return View(name, LEFT_OUT, size or scene.tracks[scene.inputs[0]].size, (), scene.left_out[name])
    if name not in scene.tracks:
        raise InputError(f"view {name!r}: expected a camera of {', '.join(scene.tracks)}: check the name")
    if not frames:
        raise InputError(f"view {name}: expected frames to look at, got none: give --frames")
    outside = [frame for frame in frames if not 0 <= frame < scene.num_frames]
    if outside:
        raise InputError(
            f"view {name}: expected frames in 0..{scene.num_frames - 1}, got {outside[0]}: "
            "choose frames of the clip"
        )
    track = scene.tracks[name]
    size = track.size if size is None else size
    entries = []
    for frame in sorted(set(frames)):
        ideal = track.at(frame).without_distortion()
        entries.append(ViewFrame(frame, frame, _resized_or_cropped(ideal, size, name)))
    return View(name, "heldout" if name in scene.heldout else "input", size, tuple(entries))


def _resized_or_cropped(camera: Camera, size: tuple[int, int], name: str) -> Camera:
    """The camera at an output size; of another aspect, the middle of its picture that fills it."""
    scale = max(size[0] / camera.size[0], size[1] / camera.size[1])
    filled = (camera.size[0] * scale, camera.size[1] * scale)
    if filled[0] - size[0] <= 0.5 and filled[1] - size[1] <= 0.5:
        return camera.resized(size)
    logger.info("view %s: %s px cut to the aspect of %s px", name, camera.size, size)
    K = camera.K.copy()
    K[:2] *= scale
    K[:2, 2] += (scale - 1) / 2 - (np.array(filled) - size) / 2
    return dataclasses.replace(camera, K=K, size=size)


def virtual_view(scene: SceneCameras, name: str, spec: TrajectorySpec, size: tuple[int, int] | None) -> View:
    """The view of a trajectory. size: None is the first input camera's. Raises InputError."""
    if name in scene.tracks:
        raise InputError(f"trajectory {name}: a camera has this name already: choose another")
    size = scene.tracks[scene.inputs[0]].size if size is None else size
    # SciPy takes 0.3 s to import, and most readers of views place none.
    from fourd.trajectory.presets import place_cameras

    shown = scene_frames(spec, scene.num_frames)
    cameras = place_cameras(spec, scene, size)
    entries = tuple(
        ViewFrame(i, frame, camera) for i, (frame, camera) in enumerate(zip(shown, cameras, strict=True))
    )
    return View(name, "virtual", size, entries)


def write_view(path: Path | str, view: View) -> None:
    """Write views/{view}.json."""
    frames = [
        {"frame": entry.frame, "scene_frame": entry.scene_frame, **entry.camera.to_dict()}
        for entry in view.frames
    ]
    write_json(path, {"role": view.role, "status": view.status, "size": list(view.size), "frames": frames})


def read_view(path: Path | str) -> View:
    """Read views/{view}.json; the name is the file's. Raises InputError, naming the file."""
    document = read_document(path)
    with explain_faults(f"a view of this workflow in {path}"):
        size = (int(document["size"][0]), int(document["size"][1]))
        if document["role"] not in ROLES or not 1 <= min(size) <= max(size) <= MAX_IMAGE_SIDE_PX:
            raise ValueError(f"role {document['role']!r}, size {size}")
        entries = tuple(
            _read_entry(entry, size, f"{path}, frame {i}") for i, entry in enumerate(document["frames"])
        )
        return View(Path(path).stem, document["role"], size, entries, str(document.get("status", "ok")))


def _read_entry(entry: Mapping[str, Any], size: tuple[int, int], where: str) -> ViewFrame:
    return ViewFrame(int(entry["frame"]), int(entry["scene_frame"]), camera_from_dict(entry, size, where))


def run(
    cameras: Path,
    view: str,
    trajectory: str | None,
    frames: Sequence[int],
    size: Sequence[int] | None,
    output: Path,
) -> None:
    """Place one view and write it. trajectory: JSON text of its spec, None for a physical camera."""
    scene = read_cameras(cameras)
    wanted = None if size is None else (size[0], size[1])
    if trajectory is None:
        write_view(output, physical_view(scene, view, frames, wanted))
        return
    try:
        document = json.loads(trajectory)
    except json.JSONDecodeError as error:
        raise InputError(f"trajectory {view}: expected JSON, got {error}: check --trajectory") from None
    if not isinstance(document, dict):
        raise InputError(f"trajectory {view}: expected a JSON object, got {trajectory}: check --trajectory")
    write_view(
        output, virtual_view(scene, view, trajectory_from_mapping(document, f"trajectory {view}"), wanted)
    )


def _parse_size(words: Sequence[str] | None) -> tuple[int, int] | None:
    """`480 270`, or `none` for the camera's own size."""
    if words is None or [word.lower() for word in words] == ["none"]:
        return None
    if len(words) != 2 or not all(word.isdigit() and int(word) >= 1 for word in words):
        raise InputError(f"--size: expected width and height in px, or none, got {' '.join(words)}: fix it")
    return int(words[0]), int(words[1])


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of the stage."""
    parser = argparse.ArgumentParser(prog="python -m fourd.views", description=__doc__)
    parser.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
    parser.add_argument("--view", required=True, help="name of a camera, or of the trajectory")
    parser.add_argument("--trajectory", help="spec of the trajectory as JSON")
    parser.add_argument("--frames", type=int, nargs="*", default=[], help="frames of a physical camera")
    parser.add_argument("--size", nargs="+", help="width and height in px, or none for the camera's")
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args(argv)
    run(args.cameras, args.view, args.trajectory, args.frames, _parse_size(args.size), args.output)


if __name__ == "__main__":
    sys.exit(run_stage(main))
