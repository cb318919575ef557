"""Cameras of other programs' calibration files, written and read: one pose per camera.

Every writer takes name -> pinhole or lens in our conventions and returns the text or writes the file;
every reader returns name -> `Camera` in the file's own world. Pixel centres are OpenCV's in all of them.
"""

import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fourd.camera import NUM_DISTORTION, Camera, check_camera
from fourd.errors import InputError
from fourd.io import write_text

Cameras = Mapping[str, Camera]
TOML_FLAVOURS = ("pose2sim", "anipose", "caliscope")
# Qualisys: x right, y up, z backward, millimetres, and pixels in 64 parts; windows include their last pixel.
OPENCV_FROM_QUALISYS = np.diag([1.0, -1.0, -1.0])
MILLIMETRES = 1000.0
PARTS_OF_PIXEL = 64.0


def toml_text(cameras: Cameras, flavour: str) -> str:
    """A TOML calibration as Pose2Sim, anipose or caliscope has it; lengths as given, metres there."""
    lines: list[str] = []
    for i, (name, camera) in enumerate(cameras.items()):
        # Pose2Sim knows four lens coefficients; a fifth is kept where there is one.
        lens = camera.distortion[: 5 if flavour != "pose2sim" or camera.distortion[4] else 4]
        entry: dict[str, Any] = {"name": name, "size": list(camera.size), "matrix": camera.K.tolist()}
        entry["distortions"] = lens.tolist()
        entry["rotation"] = _rotation_vector(camera.R).tolist()
        entry["translation"] = camera.t.tolist()
        entry["fisheye"] = False
        if flavour == "caliscope":
            entry |= {"cam_id": i, "rotation_count": 0, "error": 0.0, "grid_count": 0, "ignore": False}
        table = {"pose2sim": name, "anipose": f"cam_{i}", "caliscope": f"cameras.{i}"}[flavour]
        lines += [f"[{table}]", *(f"{key} = {_toml_value(value)}" for key, value in entry.items()), ""]
    if flavour != "caliscope":
        lines += ["[metadata]", "adjusted = false", "error = 0.0", ""]
    return "\n".join(lines)


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return "[ " + ", ".join(_toml_value(item) for item in value) + " ]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def read_toml(path: Path) -> dict[str, Camera]:
    """Cameras of a TOML calibration of any flavour, by `name` or else by table. Raises InputError."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"expected TOML in {path}, got: {error}") from None
    tables = document.get("cameras", document)
    cameras = {}
    for key, entry in tables.items():
        if key == "metadata" or not isinstance(entry, dict) or entry.get("ignore"):
            continue
        name = str(entry.get("name", key))
        if entry.get("fisheye"):
            raise InputError(f"{path}, camera {name}: a fisheye lens has no counterpart: undistort the films")
        with _Named(path, name):
            values = (entry["matrix"], entry["rotation"], entry["translation"], entry["distortions"])
            cameras[name] = _camera(*values, entry["size"], f"{path}, camera {name}")
    return _not_empty(cameras, path)


def qualisys_text(cameras: Cameras) -> str:
    """A .qca.txt calibration of Qualisys Track Manager; lengths are given in metres, millimetres there."""
    root = ElementTree.Element("calibration", {"source": "fourd", "type": "regular", "qtm-version": "2021.1"})
    ElementTree.SubElement(root, "results", {"std-dev": "0", "min-max-diff": "0"})
    tags = ElementTree.SubElement(root, "cameras")
    for name, camera in cameras.items():
        width, height = camera.size
        tag = ElementTree.SubElement(
            tags,
            "camera",
            {"active": "1", "avg-residual": "0", "serial": name, "viewrotation": "0", "model": "none"},
        )
        for window in ("fov_marker", "fov_marker_max", "fov_video", "fov_video_max"):
            edges = {"left": "0", "top": "0", "right": str(width - 1), "bottom": str(height - 1)}
            ElementTree.SubElement(tag, window, edges)
        axes, center = OPENCV_FROM_QUALISYS @ camera.R, camera.center * MILLIMETRES
        values = {"x": center[0], "y": center[1], "z": center[2]}
        values |= {f"r{i + 1}{j + 1}": axes[i, j] for i in range(3) for j in range(3)}
        ElementTree.SubElement(tag, "transform", _words(values))
        K = camera.K * PARTS_OF_PIXEL
        k1, k2, p1, p2, k3 = camera.distortion
        lens = {"sensorMinU": 0.0, "sensorMaxU": width * PARTS_OF_PIXEL - 1, "sensorMinV": 0.0}
        lens |= {"sensorMaxV": height * PARTS_OF_PIXEL - 1, "focalLengthU": K[0, 0], "focalLengthV": K[1, 1]}
        lens |= {"centerPointU": K[0, 2], "centerPointV": K[1, 2], "skew": K[0, 1]}
        lens |= {"radialDistortion1": k1, "radialDistortion2": k2, "radialDistortion3": k3}
        lens |= {"tangentalDistortion1": p1, "tangentalDistortion2": p2}
        ElementTree.SubElement(tag, "intrinsic", _words(lens))
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def read_qualisys(path: Path) -> dict[str, Camera]:
    """Cameras of a .qca.txt calibration, metres. Raises InputError.

    The window of the film (`fov_video`) is cut out of the sensor, as films are.
    """
    try:
        root = ElementTree.fromstring(path.read_text(encoding="utf-8"))
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise InputError(f"expected XML of Qualisys in {path}, got: {error}") from None
    cameras = {}
    for tag in root.findall("cameras/camera"):
        name = tag.get("serial", "")
        with _Named(path, name):
            window = {key: float(value) for key, value in _child(tag, "fov_video").items()}
            pose = {key: float(value) for key, value in _child(tag, "transform").items()}
            lens = _child(tag, "intrinsic")
            parts = {key: float(lens.get(key, 0.0)) / PARTS_OF_PIXEL for key in _LENS_KEYS}
            axes = np.array([[pose[f"r{i}{j}"] for j in (1, 2, 3)] for i in (1, 2, 3)])
            R = OPENCV_FROM_QUALISYS @ axes
            center = np.array([pose["x"], pose["y"], pose["z"]]) / MILLIMETRES
            K = np.array(
                [
                    [parts["focalLengthU"], parts["skew"], parts["centerPointU"] - window["left"]],
                    [0, parts["focalLengthV"], parts["centerPointV"] - window["top"]],
                    [0, 0, 1],
                ]
            )
            size = [window["right"] - window["left"] + 1, window["bottom"] - window["top"] + 1]
            distortion = [float(lens.get(key, 0.0)) for key in _DISTORTION_KEYS]
            cameras[name] = _camera(
                K, _rotation_vector(R), -R @ center, distortion, size, f"{path}, camera {name}"
            )
    return _not_empty(cameras, path)


_DISTORTION_KEYS = (
    "radialDistortion1",
    "radialDistortion2",
    "tangentalDistortion1",
    "tangentalDistortion2",
    "radialDistortion3",
)
_LENS_KEYS = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV", "skew")


def write_opencv(folder: Path, cameras: Cameras) -> None:
    """One OpenCV FileStorage `NAME.yml` per camera, with the keys of OpenCV's own calibration samples."""
    for name, camera in cameras.items():
        values: dict[str, Any] = {"image_width": camera.size[0], "image_height": camera.size[1]}
        values |= {"camera_matrix": camera.K, "distortion_coefficients": camera.distortion[None]}
        values |= {"R": camera.R, "T": camera.t[:, None]}
        _write_storage(folder / f"{name}.yml", values)


def read_opencv(path: Path) -> dict[str, Camera]:
    """Cameras of a folder of `NAME.yml`, or of one such file. Raises InputError."""
    files = sorted(path.glob("*.yml")) if path.is_dir() else [path]
    cameras = {}
    for file in files:
        with _Named(file, file.stem), _Storage(file) as storage:
            size = [storage.getNode(key).real() for key in ("image_width", "image_height")]
            R, lens = _matrix(storage, "R"), _matrix(storage, "distortion_coefficients")
            values = (_matrix(storage, "camera_matrix"), _rotation_vector(R), _matrix(storage, "T"), lens)
            cameras[file.stem] = _camera(*values, size, str(file))
    return _not_empty(cameras, path)


def write_easymocap(folder: Path, cameras: Cameras, bounds: Mapping[str, tuple[float, float]]) -> None:
    """intri.yml and extri.yml as EasyMocap has them, with EasyVolcap's sizes and depth bounds."""
    intrinsics: dict[str, Any] = {"names": list(cameras)}
    extrinsics: dict[str, Any] = {"names": list(cameras)}
    for name, camera in cameras.items():
        width, height = camera.size
        intrinsics |= {f"K_{name}": camera.K, f"H_{name}": float(height), f"W_{name}": float(width)}
        intrinsics |= {f"D_{name}": camera.distortion[:, None], f"dist_{name}": camera.distortion[:, None]}
        extrinsics |= {f"R_{name}": _rotation_vector(camera.R)[:, None], f"Rot_{name}": camera.R}
        near, far = bounds[name]
        extrinsics |= {f"T_{name}": camera.t[:, None], f"n_{name}": near, f"f_{name}": far}
    _write_storage(folder / "intri.yml", intrinsics)
    _write_storage(folder / "extri.yml", extrinsics)


def read_easymocap(path: Path) -> dict[str, Camera]:
    """Cameras of a folder with intri.yml and extri.yml. Raises InputError.

    EasyMocap's own files have no sizes; then a picture is taken to be twice its principal point.
    """
    folder = path if path.is_dir() else path.parent
    cameras = {}
    with _Storage(folder / "intri.yml") as intrinsics, _Storage(folder / "extri.yml") as extrinsics:
        names = intrinsics.getNode("names")
        for i in range(names.size()):
            name = names.at(i).string()
            with _Named(folder, name):
                K = _matrix(intrinsics, f"K_{name}")
                lens = "D" if not intrinsics.getNode(f"D_{name}").empty() else "dist"
                heights = intrinsics.getNode(f"H_{name}")
                size = [round(2 * K[0, 2] + 1), round(2 * K[1, 2] + 1)]
                if not heights.empty():
                    size = [intrinsics.getNode(f"W_{name}").real(), heights.real()]
                rotation = _rotation_vector(_matrix(extrinsics, f"Rot_{name}"))
                values = (
                    K,
                    rotation,
                    _matrix(extrinsics, f"T_{name}"),
                    _matrix(intrinsics, f"{lens}_{name}"),
                )
                cameras[name] = _camera(*values, size, f"{folder}, camera {name}")
    return _not_empty(cameras, path)


READERS = {
    **dict.fromkeys(TOML_FLAVOURS, read_toml),
    "qualisys": read_qualisys,
    "opencv": read_opencv,
    "easymocap": read_easymocap,
}


def write_toml(path: Path, cameras: Cameras, flavour: str) -> None:
    """Write `toml_text`."""
    write_text(path, toml_text(cameras, flavour))


def _rotation_vector(R: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.Rodrigues(np.asarray(R, dtype=np.float64))[0]).ravel()


def _camera(K: Any, rotation: Any, t: Any, distortion: Any, size: Any, where: str) -> Camera:
    R = np.asarray(cv2.Rodrigues(np.asarray(rotation, dtype=np.float64).reshape(3))[0])
    given = np.asarray(distortion, dtype=np.float64).ravel()
    if given.size > NUM_DISTORTION and np.any(given[NUM_DISTORTION:]):
        raise InputError(
            f"{where}: expected up to five lens coefficients, got {given.size}: undistort the films"
        )
    lens = np.zeros(NUM_DISTORTION)
    lens[: min(given.size, NUM_DISTORTION)] = given[:NUM_DISTORTION]
    matrix, shift = np.asarray(K, dtype=np.float64).reshape(3, 3), np.asarray(t, dtype=np.float64).reshape(3)
    camera = Camera(matrix, R, shift, (round(float(size[0])), round(float(size[1]))), lens)
    check_camera(camera, where)
    return camera


def _words(values: Mapping[str, float]) -> dict[str, str]:
    return {key: repr(float(value)) for key, value in values.items()}


def _child(tag: ElementTree.Element, name: str) -> ElementTree.Element:
    found = tag.find(name)
    if found is None:
        raise KeyError(name)
    return found


def _not_empty(cameras: dict[str, Camera], path: Path) -> dict[str, Camera]:
    if not cameras:
        raise InputError(f"expected cameras in {path}, found none: is it the right format?")
    return cameras


def _write_storage(path: Path, values: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        if isinstance(value, list):
            storage.startWriteStruct(key, cv2.FileNode_SEQ)
            for item in value:
                storage.write("", item)
            storage.endWriteStruct()
        else:
            storage.write(key, value)
    storage.release()


def _matrix(storage: cv2.FileStorage, key: str) -> np.ndarray:
    found = storage.getNode(key).mat()
    if found is None:
        raise KeyError(key)
    return np.asarray(found, dtype=np.float64)


class _Storage:
    """An OpenCV FileStorage for reading; a damaged one is refused with a sentence."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> cv2.FileStorage:
        if not self._path.is_file():
            raise InputError(f"expected a file at {self._path}, found nothing: check the path")
        self._storage = cv2.FileStorage()
        try:
            is_open = self._storage.open(str(self._path), cv2.FILE_STORAGE_READ)
        except cv2.error as error:
            raise InputError(f"expected an OpenCV FileStorage in {self._path}, got: {error.err}") from None
        if not is_open:
            raise InputError(f"expected an OpenCV FileStorage in {self._path}, got something else")
        return self._storage

    def __exit__(self, *_: object) -> None:
        self._storage.release()


class _Named:
    """Turns what goes wrong with one camera of a file into a sentence that names both."""

    def __init__(self, path: Path, name: str) -> None:
        self._where = f"{path}, camera {name}"

    def __enter__(self) -> None:
        return None

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        if isinstance(error, InputError) or not isinstance(
            error, KeyError | TypeError | ValueError | cv2.error
        ):
            return
        raise InputError(f"{self._where}: expected pose, matrix, lens and size, got {error!r}") from None
