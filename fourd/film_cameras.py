"""Cameras over the films' own frames, before there is a common clock: sfm/film_cameras.json."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fourd.camera import Camera, camera_from_dict
from fourd.errors import explain_faults
from fourd.io import SCHEMA_VERSION, read_json, write_json


@dataclasses.dataclass(frozen=True, eq=False)
class FilmCamera:
    """One physical camera over its own film.

    source_frames: (N,) int64 rising, the film's frames that `cameras` belong to
    is_static: one camera stands for all frames of the film
    status: `ok`, or the reason why the camera is left out (then there are no cameras)
    reprojection_error_px: RMS over static points, NaN where unknown
    """

    name: str
    size: tuple[int, int]
    source_frames: np.ndarray
    cameras: tuple[Camera, ...]
    is_static: bool = False
    status: str = "ok"
    reprojection_error_px: float = float("nan")

    def at(self, source_frame: int) -> Camera | None:
        """The camera at one of the film's frames, None where it is not known."""
        if self.is_static:
            return self.cameras[0]
        index = int(np.searchsorted(self.source_frames, source_frame))
        known = index < len(self.source_frames) and self.source_frames[index] == source_frame
        return self.cameras[index] if known else None


@dataclasses.dataclass(frozen=True, eq=False)
class FilmCameras:
    """All cameras in one world. points: (P, 3) float64 static points that input cameras saw.

    up: (3,) upward direction or None;  metres_per_unit: metric scale of the world, None if unknown
    notes: sentences for the report (what was left out, what is degenerate, which models were tried)
    """

    cameras: Mapping[str, FilmCamera]
    points: np.ndarray
    up: np.ndarray | None = None
    metres_per_unit: float | None = None
    notes: tuple[str, ...] = ()


def write_film_cameras(path: Path | str, films: FilmCameras) -> None:
    """Write film_cameras.json; it is also a calibration in the native format."""
    entries = {}
    for name, film in films.cameras.items():
        error = film.reprojection_error_px
        entries[name] = {
            "size": list(film.size),
            "status": film.status,
            "is_static": film.is_static,
            "reprojection_error_px": error if np.isfinite(error) else None,
            "frames": [
                {"frame": int(frame), **camera.to_dict()}
                for frame, camera in zip(film.source_frames, film.cameras, strict=True)
            ],
        }
    document = {
        "up": None if films.up is None else films.up.tolist(),
        "metres_per_unit": films.metres_per_unit,
        "notes": list(films.notes),
        "points": films.points.tolist(),
        "cameras": entries,
    }
    write_json(path, document)


def read_film_cameras(path: Path | str) -> FilmCameras:
    """Inverse of `write_film_cameras`; every camera is checked. Raises InputError, naming the file."""
    document = read_json(path)
    with explain_faults(f"film_cameras.json of the stage sfm in {path}"):
        if document["schema_version"] != SCHEMA_VERSION:
            raise ValueError(f"schema_version {document['schema_version']}")
        cameras = {
            name: _read_film(name, entry, f"{path}, camera {name}")
            for name, entry in document["cameras"].items()
        }
        up = document["up"]
        return FilmCameras(
            cameras=cameras,
            points=np.asarray(document["points"], dtype=np.float64).reshape(-1, 3),
            up=None if up is None else np.asarray(up, dtype=np.float64).reshape(3),
            metres_per_unit=document["metres_per_unit"],
            notes=tuple(document["notes"]),
        )


def _read_film(name: str, entry: dict, where: str) -> FilmCamera:
    size = (int(entry["size"][0]), int(entry["size"][1]))
    error = entry["reprojection_error_px"]
    return FilmCamera(
        name=name,
        size=size,
        source_frames=np.array([frame["frame"] for frame in entry["frames"]], dtype=np.int64),
        cameras=tuple(camera_from_dict(f, size, f"{where}, frame {f['frame']}") for f in entry["frames"]),
        is_static=bool(entry["is_static"]),
        status=str(entry["status"]),
        reprojection_error_px=float("nan") if error is None else float(error),
    )
