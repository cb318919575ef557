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
    still; `near` and `far` (null = infinite) per camera and `up`, `points` and `metres_per_unit` at the
    top are optional. A `frame` in the frames is the film's own, counted from 0, and may skip some. A
    camera with another `status` than `ok` is left out.
    Raises InputError for a missing size, unordered frames or a camera that cannot be used.
    """
    document = read_json(path)
    entries = document.get("cameras")
    if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
        raise InputError(f"{path}: expected `cameras` to map names to cameras: see docs/formats.md")
    left_out = {name: str(e["status"]) for name, e in entries.items() if e.get("status", "ok") != "ok"}
    cameras, bounds, numbers = {}, {}, {}
    for name, entry in entries.items():
        if name in left_out:
            continue
        where = f"{path}, camera {name}"
        cameras[name] = _read_track(entry, _read_size(entry, document, where), where)
        frames = _frame_numbers(entry, where)
        if frames is not None:
            numbers[name] = frames
        if entry.get("near"):
            far = entry.get("far")
            bounds[name] = _read_bounds(entry["near"], float("inf") if far is None else far, where)
    return ImportedCameras(
        path,
        cameras,
        image_numbers=numbers,
        has_film_frames=True,
        left_out=left_out,
        points=_read_points(document, path),
        bounds=bounds,
        up=_read_up(document, path),
        metres_per_unit=_read_scale(document, path),
        notes=tuple(f"camera {name} is left out: {reason}" for name, reason in left_out.items()),
    )


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
    return tuple(camera_from_dict(frame, size, f"{where}, frame {i}") for i, frame in enumerate(frames))


def _frame_numbers(entry: Mapping[str, Any], where: str) -> tuple[int, ...] | None:
    """Frames of the film that the poses belong to; None where the poses are simply counted.

    A file without gaps that does not come from `recover` may as well be on the scene's clock.
    """
    frames = entry.get("frames", [entry])
    numbers = [frame.get("frame", i) for i, frame in enumerate(frames)]
    is_rising = all(isinstance(n, int) and n >= 0 for n in numbers)
    is_rising = is_rising and all(a < b for a, b in zip(numbers, numbers[1:], strict=False))
    if not is_rising and len(numbers) > 1:
        raise InputError(
            f"{where}: expected rising frame numbers from 0, got {str(numbers[:8])[1:-1]}: sort the frames "
            "and name each once"
        )
    is_counted = numbers == list(range(len(numbers))) and "status" not in entry
    return None if is_counted or not is_rising else tuple(numbers)


def _read_points(document: Mapping[str, Any], path: Path) -> np.ndarray | None:
    if document.get("points") is None:
        return None
    try:
        points = np.asarray(document["points"], dtype=np.float64).reshape(-1, 3)
    except (TypeError, ValueError):
        points = np.full((1, 3), np.nan)
    if not np.isfinite(points).all():
        raise InputError(
            f"{path}: expected `points` as a list of three finite numbers each: correct the list"
        )
    return points


def _read_scale(document: Mapping[str, Any], path: Path) -> float | None:
    scale = document.get("metres_per_unit")
    if scale is not None and not (_is_number(scale) and 0 < scale < float("inf")):
        raise InputError(f"{path}: expected `metres_per_unit` above 0 or null, got {scale}: correct it")
    return None if scale is None else float(scale)


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
