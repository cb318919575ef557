"""Cameras and sparse points from a COLMAP model, text or binary."""

from pathlib import Path

# OpenCV must be loaded before pycolmap: the other order aborts the process when a PNG is written.
import cv2  # noqa: F401
import numpy as np

from fourd.camera import Camera, check_camera
from fourd.errors import InputError
from fourd.sfm.importers.colmap_check import check_binary_model
from fourd.sfm.importers.imported import ImportedCameras, group_by_camera

# COLMAP's top-left pixel centre is (0.5, 0.5), ours (0, 0).
PIXEL_CENTER = 0.5

# Positions in COLMAP's parameter vector of fx, fy, cx, cy and of our k1 k2 p1 p2 k3.
# Source: COLMAP, "Camera Models" (documentation) and src/colmap/sensor/models.h.
PARAMETER_ORDER: dict[str, tuple[tuple[int, int, int, int], tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), ()),
    "PINHOLE": ((0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3,)),
    "RADIAL": ((0, 0, 1, 2), (3, 4)),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7)),
}


def read_colmap(path: Path) -> ImportedCameras:
    """Read the model in folder `path`: cameras, images and points3D, .bin or .txt.

    Raises InputError for a damaged model, a camera model without a counterpart here, or images
    that cannot be told apart.
    """
    import pycolmap

    check_binary_model(path)
    try:
        model = pycolmap.Reconstruction(str(path))
    except (ValueError, IndexError, RuntimeError) as error:
        raise InputError(
            f"expected a whole COLMAP model in {path} (cameras, images, points3D), got: "
            f"{str(error).splitlines()[0][:200]}: export the model again"
        ) from None
    images = {image.name: image for image in model.images.values() if image.has_pose}
    by_image = {name: _camera_from_image(images[name], f"{path}, image {name}") for name in sorted(images)}
    tracks, numbers, camera_of_image = group_by_camera(by_image, str(path))
    num_unposed = model.num_images() - len(images)
    notes = (f"{num_unposed} images have no pose and are left out",) if num_unposed else ()
    camera_of_id = {image.image_id: camera_of_image[name] for name, image in images.items()}
    points, counts = _read_points(model, camera_of_id, list(tracks))
    return ImportedCameras(path, tracks, numbers, points, counts, notes=notes)


def _camera_from_image(image, where: str) -> Camera:
    model_name = image.camera.model.name
    if model_name not in PARAMETER_ORDER:
        raise InputError(
            f"{where}: expected one of the camera models {', '.join(PARAMETER_ORDER)}, got {model_name}: "
            "undistort the images or calibrate with OPENCV"
        )
    pinhole, lens = PARAMETER_ORDER[model_name]
    values = np.asarray(image.camera.params, dtype=np.float64)
    fx, fy, cx, cy = values[list(pinhole)]
    K = np.array([[fx, 0, cx - PIXEL_CENTER], [0, fy, cy - PIXEL_CENTER], [0, 0, 1]])
    distortion = np.zeros(5)
    distortion[: len(lens)] = values[list(lens)]
    cam_from_world = np.asarray(image.cam_from_world().matrix(), dtype=np.float64)
    size = (int(image.camera.width), int(image.camera.height))
    camera = Camera(K, cam_from_world[:, :3], cam_from_world[:, 3], size, distortion)
    check_camera(camera, where)
    return camera


def _read_points(
    model, camera_of_id: dict[int, str], names: list[str]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """(N, 3) points in the order of their ids, and per camera in how many images each was seen."""
    ids = sorted(model.points3D)
    points = np.array([model.points3D[i].xyz for i in ids], dtype=np.float64).reshape(-1, 3)
    counts = {name: np.zeros(len(ids), dtype=np.int64) for name in names}
    for row, point_id in enumerate(ids):
        for image_id in {element.image_id for element in model.points3D[point_id].track.elements}:
            if image_id in camera_of_id:
                counts[camera_of_id[image_id]][row] += 1
    return points, counts
