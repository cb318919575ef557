"""How far the recovered cameras and clocks are from the true ones, where somebody knows them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fourd.camera import Camera
from fourd.config import spread_frames
from fourd.errors import InputError
from fourd.io import read_json
from fourd.report.numbers import finite
from fourd.sfm.compare import align_similarity

# Poses of one film that are compared, evenly spread.
NUM_POSES = 12


def collect_truth(results: Path, path: Path | None) -> dict[str, Any] | None:
    """The part `truth` of the report; None without a file of true cameras.

    path: JSON with `phones`: by camera `start_time_s` and `frames` with K, R, t of every film frame,
    centres of pixels at integer coordinates, cam_from_world (truth/phones.json of the embedded event).
    Poses are compared after the one similarity that takes the recovered world nearest to the true one,
    clocks after the one shift that takes their median to the true one's.
    Raises InputError for a file that is missing or not of this form.
    """
    if path is None:
        return None
    document = read_json(path)
    try:
        phones = document["phones"]
        starts = {name: float(phone["start_time_s"]) for name, phone in phones.items()}
        frames = {name: [_matrices(frame) for frame in phone["frames"]] for name, phone in phones.items()}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"expected true films in {path} (phones: start_time_s, frames with K, R, t), it lacks {error}: "
            "give another file, or none"
        ) from None
    return {
        "cameras": _compare_cameras(results / "sfm" / "film_cameras.json", frames),
        "clocks": _compare_clocks(results / "align" / "offsets.json", starts),
    }


def _matrices(frame: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    K, R, t = (np.array(frame[key], np.float64) for key in ("K", "R", "t"))
    return K.reshape(3, 3), R.reshape(3, 3), t.reshape(3)


def _compare_cameras(
    path: Path, truth: Mapping[str, list[tuple[np.ndarray, np.ndarray, np.ndarray]]]
) -> list[dict[str, Any]]:
    """Medians over a film's poses, by camera; none where fewer than two cameras were recovered."""
    entries = read_json(path)["cameras"] if path.is_file() else {}
    found, true, owners = [], [], []
    for name, entry in entries.items():
        poses = [pose for pose in entry["frames"] if pose["frame"] < len(truth.get(name, ()))]
        if entry["status"] != "ok" or not poses:
            continue
        size = tuple(entry["size"])
        for i in spread_frames(len(poses), NUM_POSES):
            found.append(Camera(*_matrices(poses[i]), size))
            true.append(Camera(*truth[name][int(poses[i]["frame"])], size))
            owners.append(name)
    names = list(dict.fromkeys(owners))
    if len(names) < 2:
        return []
    errors = align_similarity(found, true)
    rows = []
    for name in names:
        own = np.array([owner == name for owner in owners])
        rows.append(
            {
                "name": name,
                "rotation_deg": finite(np.median(errors.rotation_deg[own])),
                "center": finite(np.median(errors.center[own])),
                "center_share": finite(np.median(errors.center[own] / errors.distance[own])),
                "focal_share": finite(np.median(errors.focal[own])),
            }
        )
    return rows


def _compare_clocks(path: Path, starts: Mapping[str, float]) -> list[dict[str, Any]]:
    """Error of each film's start in seconds; none where clocks were given or fewer than two are known."""
    entries = read_json(path)["cameras"] if path.is_file() else {}
    found = {
        name: float(entry["offset_s"]) - starts[name]
        for name, entry in entries.items()
        if name in starts and entry.get("offset_s") is not None
    }
    if len(found) < 2:
        return []
    shift = float(np.median(list(found.values())))
    return [{"name": name, "error_s": error - shift} for name, error in found.items()]
