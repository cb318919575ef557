"""Every format by name: what is written, and what is read."""

import logging
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fourd.camera import Camera, CameraTrack, tracks_to_dict
from fourd.errors import InputError
from fourd.export.cameras import READERS as STATIC_READERS
from fourd.export.cameras import qualisys_text, write_opencv, write_toml
from fourd.export.colmap import write_colmap
from fourd.export.datasets import (
    read_dynamic3dg,
    write_dynamic3dg,
    write_easyvolcap,
    write_n3dv,
    write_videos,
)
from fourd.export.event import Event, held_residual_px
from fourd.export.glb import write_glb
from fourd.export.nerfstudio import write_nerfstudio
from fourd.export.points import write_clouds
from fourd.io import write_json, write_text
from fourd.sfm.importers import read_calibration

log = logging.getLogger(__name__)
NOTICEABLE_PX = 2.0
# Formats of which every picture has a camera of its own; all others have one camera for a film.
MOVING = ("colmap", "nerfstudio", "dynamic3dg", "ply", "glb")


def _held(event: Event) -> dict[str, Camera]:
    """Held cameras in the order that Pose2Sim has their films in: it knows a camera by its place."""
    return {name: event.held(name) for name in sorted(event.names, key=last_number_first)}


def last_number_first(name: str) -> tuple[bool, int, str]:
    """Key to sort names by their last number; those without one come last, by their letters."""
    numbers = re.findall(r"\d+", name)
    return not numbers, int(numbers[-1]) if numbers else 0, name


WRITERS: dict[str, Callable[[Event, Path], None]] = {
    "colmap": write_colmap,
    "nerfstudio": write_nerfstudio,
    "n3dv": write_n3dv,
    "easyvolcap": write_easyvolcap,
    "dynamic3dg": write_dynamic3dg,
    "videos": write_videos,
    "pose2sim": lambda event, folder: write_toml(folder / "Calib.toml", _held(event), "pose2sim"),
    "anipose": lambda event, folder: write_toml(folder / "calibration.toml", _held(event), "anipose"),
    "caliscope": lambda event, folder: write_toml(folder / "camera_array.toml", _held(event), "caliscope"),
    "qualisys": lambda event, folder: write_text(folder / "event.qca.txt", qualisys_text(_held(event))),
    "opencv": lambda event, folder: write_opencv(folder, _held(event)),
    "ply": write_clouds,
    "glb": write_glb,
}


def write_format(event: Event, name: str, folder: Path) -> None:
    """Write one format into a folder, with export.json: what every user of it must know.

    Raises InputError if the event cannot be stated in it.
    """
    WRITERS[name](event, folder)
    cameras: dict[str, Any] = {}
    for camera in event.names:
        entry: dict[str, Any] = {"role": "input" if camera in event.scene.inputs else "heldout"}
        if name not in MOVING:
            shift_px = held_residual_px(event.scene, camera, event.size)
            entry["largest_shift_px"] = shift_px
            if shift_px > NOTICEABLE_PX:
                log.warning(
                    "%s: %s moved; in its held film what is nearest shifts by up to %.1f px. Formats with a "
                    "pose per picture (%s) have none of this", name, camera, shift_px, ", ".join(MOVING),
                )  # fmt: skip
        cameras[camera] = entry
    document = {"format": name, "fps": event.scene.fps, "num_frames": event.scene.num_frames}
    document |= {"scale": event.options.scale, "up": event.scene.up.tolist(), "cameras": cameras}
    write_json(folder / "export.json", document)


def read_format(path: Path, name: str) -> dict[str, tuple[Camera, ...]]:
    """Cameras of another program's file, by name, one or one per frame. Raises InputError."""
    if not path.exists():
        raise InputError(f"expected a calibration at {path}, found nothing: check the path")
    if name == "dynamic3dg":
        return read_dynamic3dg(path)
    name = {"easyvolcap": "easymocap", "n3dv": "llff"}.get(name, name)
    if name in STATIC_READERS:
        return {key: (camera,) for key, camera in STATIC_READERS[name](path).items()}
    if name == "llff" and path.is_dir():
        path = path / "poses_bounds.npy"
    return dict(read_calibration(path, name).cameras)


def native_document(cameras: Mapping[str, tuple[Camera, ...]]) -> dict[str, Any]:
    """The cameras as a calibration of ours (`calibration_format: fourd`)."""
    tracks = {name: CameraTrack(name, poses) for name, poses in cameras.items()}
    document = tracks_to_dict(tracks)
    for entry in document.values():
        # Nothing is known of them, and the reader takes a stated depth for known.
        del entry["near"], entry["far"]
    return {"cameras": document}
