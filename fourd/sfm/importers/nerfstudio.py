"""Cameras from nerfstudio's transforms.json."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fourd.camera import Camera, check_camera
from fourd.errors import InputError
from fourd.io import read_json
from fourd.sfm.importers.imported import ImportedCameras, group_by_camera, pose_from_axes

# OpenGL camera axes (x right, y up, z backward) to OpenCV's.
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])

# nerfstudio keeps COLMAP's pixel centres: it shoots the ray of pixel (0, 0) through (0.5, 0.5).
PIXEL_CENTER = 0.5

PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
LENS_KEYS = ("k1", "k2", "p1", "p2", "k3")


def read_nerfstudio(path: Path) -> ImportedCameras:
    """Read frames with `transform_matrix` (world_from_cam, OpenGL axes) and `file_path`.

    Intrinsics stand at the top or in a frame, which wins: fl_x, fl_y, cx, cy, w, h, k1, k2, k3,
    p1, p2. The poses are used as written: `applied_transform` tells how the file's world was made
    from COLMAP's, and any world is as good as another here.
    Raises InputError for fisheye models, missing intrinsics or unusable poses.
    """
    document = read_json(path)
    frames = document.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(
            f"{path}: expected a list of `frames` with `transform_matrix`, got {str(frames)[:60]}"
        )
    by_image: dict[str, Camera] = {}
    for i, frame in enumerate(frames):
        name = frame.get("file_path")
        if not isinstance(name, str) or not name or name in by_image:
            raise InputError(f"{path}, frame {i}: expected a `file_path` of its own, got {name!r}")
        by_image[name] = _camera_from_frame({**document, **frame}, f"{path}, image {name}")
    tracks, numbers, _ = group_by_camera(by_image, str(path))
    is_transformed = "applied_transform" in document
    notes = ("applied_transform is not undone: the file's world is kept",) if is_transformed else ()
    return ImportedCameras(path, tracks, numbers, notes=notes)


def _camera_from_frame(values: Mapping[str, Any], where: str) -> Camera:
    model = values.get("camera_model", "OPENCV")
    if model not in PERSPECTIVE_MODELS or values.get("k4"):
        lens = f"{model} with k4" if values.get("k4") else model
        raise InputError(
            f"{where}: expected a perspective camera model with k1 k2 k3 p1 p2 at most, got {lens}: "
            "undistort the images"
        )
    try:
        size = (int(values["w"]), int(values["h"]))
        focal_x = _focal_x(values, size[0])
        focal_y = float(values["fl_y"]) if "fl_y" in values else focal_x
        cx, cy = float(values.get("cx", size[0] / 2)), float(values.get("cy", size[1] / 2))
        distortion = np.array([float(values.get(key, 0)) for key in LENS_KEYS])
        world_from_cam = np.asarray(values["transform_matrix"], dtype=np.float64)[:3].reshape(3, 4)
    except (LookupError, OverflowError, TypeError, ValueError) as error:
        raise InputError(
            f"{where}: expected w, h, fl_x (or camera_angle_x) and a 4x4 transform_matrix, got {error!r}: "
            "add them at the top of the file or to the frame"
        ) from None
    K = np.array([[focal_x, 0, cx - PIXEL_CENTER], [0, focal_y, cy - PIXEL_CENTER], [0, 0, 1]])
    R, t = pose_from_axes(world_from_cam[:, :3] @ OPENCV_FROM_OPENGL, world_from_cam[:, 3])
    camera = Camera(K, R, t, size, distortion)
    check_camera(camera, where)
    return camera


def _focal_x(values: Mapping[str, Any], width: int) -> float:
    if "fl_x" in values:
        return float(values["fl_x"])
    return width / 2 / float(np.tan(float(values["camera_angle_x"]) / 2))
