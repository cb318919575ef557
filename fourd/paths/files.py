"""Camera paths of other programs: nerfstudio's camera path, a COLMAP model, a table.

A `Film` is a path frame by frame in the calibration's own world. It is read from a views file and
written as a path file of ours (kind `keys`, `world: source`), or as one of the others, and back.
Poses come back to rounding (1e-9 of the scene). What a format does not hold is lost: only tables and
path files of ours know which scene frame is shown.
"""

import csv
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fourd.camera import Camera, check_camera
from fourd.errors import InputError
from fourd.io import atomic_folder, json_text, read_csv, read_json, write_csv, write_json, write_text
from fourd.sfm.cameras import SceneCameras
from fourd.sfm.importers.colmap import PIXEL_CENTER, read_colmap
from fourd.sfm.importers.nerfstudio import OPENCV_FROM_OPENGL
from fourd.trajectory import read_path_file, scene_frames, trajectory_from_mapping
from fourd.trajectory.presets import focal_of_fov, fov_of_focal, place_cameras
from fourd.trajectory.timing import film_shares
from fourd.views import View

FORMATS = ("path", "nerfstudio", "colmap", "csv")
CSV_COLUMNS = ("frame", "scene_frame", "x", "y", "z", "qw", "qx", "qy", "qz", "fov_deg", "width", "height")


@dataclasses.dataclass(frozen=True, eq=False)
class Film:
    """A path frame by frame. cameras: in the calibration's world;  scene_frames: none where not known."""

    cameras: tuple[Camera, ...]
    scene_frames: tuple[int, ...] | None
    fps: float


def film_of_view(view: View, scene: SceneCameras) -> Film:
    """The film of a views file, its poses brought back to the calibration's world."""
    cameras = tuple(_to_source(entry.camera, scene) for entry in view.frames)
    return Film(cameras, tuple(entry.scene_frame for entry in view.frames), scene.fps)


def _to_source(camera: Camera, scene: SceneCameras) -> Camera:
    center = camera.center * scene.scale + scene.origin
    return dataclasses.replace(camera, t=-camera.R @ center)


def read_dataparser(path: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """What nerfstudio did to a dataset's world: R (3, 3), t (3,), scale of model = scale * (R data + t).

    path: dataparser_transforms.json beside a trained model
    Raises InputError.
    """
    document = read_json(path)
    try:
        matrix = np.asarray(document["transform"], dtype=np.float64)[:3].reshape(3, 4)
        scale = float(document["scale"])
        if not np.isfinite(matrix).all() or not 0 < scale < float("inf"):
            raise ValueError(f"scale {scale}")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"expected transform (3 x 4) and scale of nerfstudio in {path}, got {error!r}"
        ) from None
    return matrix[:, :3], matrix[:, 3], scale


def moved_film(film: Film, dataparser: tuple[np.ndarray, np.ndarray, float], to_model: bool) -> Film:
    """A film in nerfstudio's model coordinates (`to_model`) or back in the dataset's, the calibration's."""
    turn, shift, scale = dataparser
    cameras = []
    for camera in film.cameras:
        if to_model:
            R, center = camera.R @ turn.T, scale * (turn @ camera.center + shift)
        else:
            R, center = camera.R @ turn, turn.T @ (camera.center / scale - shift)
        cameras.append(dataclasses.replace(camera, R=R, t=-R @ center))
    return dataclasses.replace(film, cameras=tuple(cameras))


def path_document(film: Film) -> dict[str, Any]:
    """The keys of a path file that passes every frame of a film exactly."""
    shares = film_shares(len(film.cameras))
    keys = []
    for share, camera in zip(shares, film.cameras, strict=True):
        quaternion = Rotation.from_matrix(camera.R).as_quat(canonical=True, scalar_first=True)
        pose = {"position": camera.center.tolist(), "rotation": quaternion.tolist()}
        keys.append({"at": share, **pose, "fov_deg": fov_of_focal(camera.focal_px, camera.size[1])})
    document: dict[str, Any] = {"kind": "keys", "world": "source", "num_frames": len(keys), "keys": keys}
    document["size"] = list(film.cameras[0].size)
    if film.scene_frames is not None and len(keys) > 1:
        pairs = zip(shares, film.scene_frames, strict=True)
        document["time"] = [{"at": share, "frame": frame} for share, frame in pairs]
    elif film.scene_frames is not None:
        document |= {"time": "frozen", "time_frame": film.scene_frames[0]}
    return document


def read_film(path: Path, path_format: str, scene: SceneCameras, size: tuple[int, int]) -> Film:
    """A film in one of FORMATS. size: of the picture where the format has none. Raises InputError."""
    if not path.exists():
        raise InputError(f"expected a camera path at {path}, found nothing: check the path")
    readers = {"nerfstudio": _read_nerfstudio, "colmap": _read_colmap, "csv": _read_csv}
    if path_format == "path":
        spec = trajectory_from_mapping(read_path_file(path), str(path))
        cameras = place_cameras(spec, scene, spec.size or size)
        shown = tuple(scene_frames(spec, scene.num_frames))
        return Film(tuple(_to_source(camera, scene) for camera in cameras), shown, scene.fps)
    try:
        film = readers[path_format](path, scene.fps)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, ZeroDivisionError, UnicodeDecodeError) as error:
        raise InputError(f"expected a camera path in format {path_format} in {path}, got {error!r}") from None
    if not film.cameras:
        raise InputError(f"expected a camera path with poses in {path}, found none: export it again")
    for i, camera in enumerate(film.cameras):
        check_camera(camera, f"{path}, frame {i}")
    return film


def write_film(path: Path, path_format: str, film: Film) -> None:
    """Write a film in one of FORMATS; `colmap` is a folder, the others are files."""
    if not film.cameras:
        raise InputError(f"expected a film with frames to write to {path}, got none: check the view")
    writers = {"nerfstudio": _write_nerfstudio, "colmap": _write_colmap, "csv": _write_csv}
    if path_format == "path":
        write_json(path, path_document(film))
    else:
        writers[path_format](path, film)


def _camera(R: np.ndarray, center: np.ndarray, fov_deg: float, size: tuple[int, int]) -> Camera:
    focal = focal_of_fov(fov_deg, size[1])
    K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    return Camera(K, R, -R @ center, size)


def _write_nerfstudio(path: Path, film: Film) -> None:
    width, height = film.cameras[0].size
    entries = []
    for camera in film.cameras:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = camera.R.T @ OPENCV_FROM_OPENGL, camera.center
        fov = fov_of_focal(camera.focal_px, height)
        entries.append({"camera_to_world": matrix.ravel().tolist(), "fov": fov, "aspect": width / height})
    document = {
        "camera_type": "perspective",
        "render_width": width,
        "render_height": height,
        "fps": film.fps,
        "seconds": len(entries) / film.fps,
        "is_cycle": False,
        "smoothness_value": 0,
        "crop": None,
        "keyframes": [],
        "camera_path": entries,
    }
    write_text(path, json_text(document, path, indent=1) + "\n")


def _read_nerfstudio(path: Path, fps: float) -> Film:
    document = read_json(path)
    if document.get("camera_type", "perspective") != "perspective":
        raise InputError(f"{path}: expected a perspective camera path, got {document['camera_type']}")
    size = (int(document["render_width"]), int(document["render_height"]))
    cameras = []
    for entry in document["camera_path"]:
        matrix = np.asarray(entry["camera_to_world"], dtype=np.float64).reshape(4, 4)
        R = OPENCV_FROM_OPENGL @ matrix[:3, :3].T
        cameras.append(_camera(R, matrix[:3, 3], float(entry["fov"]), size))
    return Film(tuple(cameras), None, float(document.get("fps", fps)))


def _write_colmap(path: Path, film: Film) -> None:
    cameras, images = (
        ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS"],
        ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"],
    )
    for i, camera in enumerate(film.cameras):
        K = camera.K
        lens = (K[0, 0], K[1, 1], K[0, 2] + PIXEL_CENTER, K[1, 2] + PIXEL_CENTER)
        words = [i + 1, "PINHOLE", *camera.size, *map(_exact, lens)]
        cameras.append(" ".join(map(str, words)))
        quaternion = Rotation.from_matrix(camera.R).as_quat(canonical=True, scalar_first=True)
        pose = [*map(_exact, quaternion), *map(_exact, camera.t)]
        images += [" ".join(map(str, [i + 1, *pose, i + 1, f"{i:06d}.png"])), ""]
    with atomic_folder(path) as folder:
        for name, lines in {"cameras.txt": cameras, "images.txt": images, "points3D.txt": []}.items():
            (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _read_colmap(path: Path, fps: float) -> Film:
    folder = path if path.is_dir() else path.parent
    imported = read_colmap(folder)
    # The pictures' names order the film; they are one camera each, or one camera's numbered pictures.
    cameras = [camera for name in sorted(imported.cameras) for camera in imported.cameras[name]]
    return Film(tuple(cameras), None, fps)


def _write_csv(path: Path, film: Film) -> None:
    rows = []
    for i, camera in enumerate(film.cameras):
        quaternion = Rotation.from_matrix(camera.R).as_quat(canonical=True, scalar_first=True)
        frame = "" if film.scene_frames is None else film.scene_frames[i]
        values = [i, frame, *map(_exact, camera.center), *map(_exact, quaternion)]
        values += [_exact(fov_of_focal(camera.focal_px, camera.size[1])), *camera.size]
        rows.append(dict(zip(CSV_COLUMNS, values, strict=True)))
    write_csv(path, CSV_COLUMNS, rows)


def _read_csv(path: Path, fps: float) -> Film:
    try:
        rows = read_csv(path)
    except csv.Error as error:
        raise InputError(f"expected a table in {path}, got: {error}") from None
    cameras, shown = [], []
    for row in rows:
        center = np.array([float(row[name]) for name in ("x", "y", "z")])
        quaternion = [float(row[name]) for name in ("qw", "qx", "qy", "qz")]
        R = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        cameras.append(_camera(R, center, float(row["fov_deg"]), (int(row["width"]), int(row["height"]))))
        shown.append(row["scene_frame"])
    has_frames = all(word != "" for word in shown)
    return Film(tuple(cameras), tuple(map(int, shown)) if has_frames else None, fps)


def _exact(value: float) -> str:
    """The shortest text that reads back as the same number."""
    return repr(float(value))
