"""Cameras from the workflow's own JSON: K, R, t, distortion per camera and frame."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fourd.camera import Camera, camera_from_dict
from fourd.errors import InputError
from fourd.io import read_json
from fourd.sfm.importers.imported import DepthBounds, ImportedCameras


def read_native(path: Path) -> ImportedCameras:
    """Read `{"cameras": {name: {"size": [w, h], "frames": [{"K", "R", "t", "distortion"}]}}}`.

    The size may stand at the top as `width` and `height`; one frame means a camera that stands
    still; `near` and `far` (null = infinite) per camera and `up` at the top are optional.
    Raises InputError for a missing size, gaps in the frames or a camera that cannot be used.
    """
    document = read_json(path)
    entries = document.get("cameras")
    if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
        raise InputError(f"{path}: expected `cameras` to map names to cameras: see docs/formats.md")
    cameras, bounds = {}, {}
    for name, entry in entries.items():
        where = f"{path}, camera {name}"
        cameras[name] = _read_track(entry, _read_size(entry, document, where), where)
        if entry.get("near"):
            far = entry.get("far")
            bounds[name] = _read_bounds(entry["near"], float("inf") if far is None else far, where)
    return ImportedCameras(path, cameras, bounds=bounds, up=_read_up(document, path))


def _read_size(entry: Mapping[str, Any], document: Mapping[str, Any], where: str) -> tuple[int, int]:
    size: Any = entry.get("size")
    if size is None:
        holder = entry if "width" in entry else document
        size = [holder.get("width"), holder.get("height")]
    if not isinstance(size, list) or len(size) != 2 or not all(_is_number(s) and s >= 1 for s in size):
        raise InputError(
            f"{where}: expected `size` [width, height], or `width` and `height` at the top of the file, "
            f"got {size}: add the size that K belongs to"
        )
    return int(size[0]), int(size[1])


def _read_track(entry: Mapping[str, Any], size: tuple[int, int], where: str) -> tuple[Camera, ...]:
    frames = entry.get("frames", [entry])
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{where}: expected a list of frames with K, R, t, got {str(frames)[:60]}")
    numbers = [frame.get("frame", i) for i, frame in enumerate(frames)]
    if len(frames) > 1 and numbers != list(range(len(frames))):
        raise InputError(
            f"{where}: expected frames 0, 1, 2 ... without a gap, got {str(numbers[:8])[1:-1]}: add the "
            "missing poses or give one frame if the camera stands still"
        )
    return tuple(camera_from_dict(frame, size, f"{where}, frame {i}") for i, frame in enumerate(frames))


def _read_bounds(near: Any, far: Any, where: str) -> DepthBounds:
    if not (_is_number(near) and _is_number(far) and 0 < near < far):
        raise InputError(f"{where}: expected depths 0 < near < far, got near {near} and far {far}")
    return DepthBounds(float(near), float(far))


def _read_up(document: Mapping[str, Any], path: Path) -> np.ndarray | None:
    given = document.get("up")
    if given is None:
        return None
    if not isinstance(given, list) or len(given) != 3 or not all(_is_number(value) for value in given):
        raise InputError(f"{path}: expected `up` as three numbers, got {given}")
    up = np.asarray(given, dtype=np.float64)
    if not np.linalg.norm(up) > 0 or not np.isfinite(up).all():
        raise InputError(f"{path}: expected `up` as a direction of length above 0, got {given}")
    return up / np.linalg.norm(up)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
