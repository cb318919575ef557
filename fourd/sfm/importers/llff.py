"""Cameras from LLFF's poses_bounds.npy, as in Neural 3D Video and NVIDIA Dynamic Scenes."""

from pathlib import Path

import numpy as np

from fourd.camera import Camera, check_camera
from fourd.errors import InputError
from fourd.sfm.importers.imported import DepthBounds, ImportedCameras, pose_from_axes

# Columns of the stored matrix are down, right, backward; ours are right, down, forward.
# Source: LLFF, README, "Using your own poses without running COLMAP".
OPENCV_FROM_LLFF = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

MEDIA_SUFFIXES = (".png", ".jpg", ".jpeg", ".mp4", ".mov", ".mkv")


def read_llff(path: Path) -> ImportedCameras:
    """Read (N, 17): a row-major 3 x 5 [axes | centre | height, width, focal], then near and far.

    Cameras are named by the sorted images (or videos) beside the file where their number is N,
    else cam00, cam01 ... The principal point is the image centre.
    Raises InputError for another shape or unusable numbers.
    """
    try:
        table = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"expected a numpy array in {path}, got: {error}: write the file anew") from None
    if table.ndim != 2 or table.shape[1] != 17 or not np.issubdtype(table.dtype, np.floating):
        raise InputError(
            f"{path}: expected numbers of shape (N, 17), a 3x5 matrix and two depths per camera, got "
            f"{table.dtype} {table.shape}: is this poses_bounds.npy?"
        )
    names, notes = _name_cameras(path, len(table))
    cameras, bounds = {}, {}
    for name, row in zip(names, table.astype(np.float64), strict=True):
        where = f"{path}, camera {name}"
        cameras[name] = (_camera_from_matrix(row[:15].reshape(3, 5), where),)
        near, far = row[15:]
        if not 0 < near < far < np.inf:
            raise InputError(f"{where}: expected depths 0 < near < far, got near {near} and far {far}")
        bounds[name] = DepthBounds(float(near), float(far), are_percentiles=True)
    return ImportedCameras(path, cameras, bounds=bounds, notes=notes)


def _camera_from_matrix(matrix: np.ndarray, where: str) -> Camera:
    if not np.isfinite(matrix).all() or (matrix[:2, 4] < 1).any():
        raise InputError(f"{where}: expected finite numbers and a size, got {matrix.tolist()}")
    height, width, focal = matrix[:, 4]
    R, t = pose_from_axes(matrix[:, :3] @ OPENCV_FROM_LLFF, matrix[:, 3])
    # The centre of the image is (w / 2, h / 2) from its corner, which lies half a pixel before (0, 0).
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    camera = Camera(K, R, t, (round(width), round(height)))
    check_camera(camera, where)
    return camera


def _name_cameras(path: Path, num_cameras: int) -> tuple[list[str], tuple[str, ...]]:
    for folder in (path.parent, path.parent / "images"):
        media = folder.iterdir() if folder.is_dir() else ()
        stems = sorted(file.stem for file in media if file.suffix.lower() in MEDIA_SUFFIXES)
        if len(stems) == num_cameras == len(set(stems)):
            return stems, (f"cameras are named by the {num_cameras} sorted files in {folder}",)
    names = [f"cam{i:02d}" for i in range(num_cameras)]
    return names, (f"no {num_cameras} images stand beside {path}: cameras are named {names[0]} ... by row",)
