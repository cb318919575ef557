"""What every importer returns, and the naming rule that turns image names into cameras."""

import dataclasses
import re
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.geometry import nearest_rotation

FRAME_STEM = re.compile(r"(?:frame|image|img)?[_-]?(\d+)", re.IGNORECASE)

# Files that store an axis matrix are often written with four decimals.
AXES_TOLERANCE = 5e-3


@dataclasses.dataclass(frozen=True)
class DepthBounds:
    """near, far: z, far may be infinite;  are_percentiles: of sparse points, so some pixels lie outside."""

    near: float
    far: float
    are_percentiles: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class ImportedCameras:
    """Cameras of one calibration file in the file's own world, with our axes and pixel centres.

    cameras: name -> one camera (it stands still) or one per frame of its own
    image_numbers: camera name -> number of the image that each of its cameras belongs to, for files
    that name images; without an entry the cameras are those of frames 0, 1, 2 ...
    has_film_frames: the numbers are frames of the film, counted from 0
    left_out: camera name -> why the file has no camera for it
    points: (N, 3) sparse points, if the file has them
    num_observations: camera name -> (N,) images of that camera in which each point was seen; empty where
    all points come from input cameras
    bounds: camera name -> depths of what it films, in the file's units
    up: (3,) world direction that is up, if the file says so
    metres_per_unit: metric scale of the file's world, if the file says so
    notes: what a user should know about how the file was read
    """

    path: Path
    cameras: Mapping[str, tuple[Camera, ...]]
    image_numbers: Mapping[str, tuple[int, ...]] = dataclasses.field(default_factory=dict)
    points: np.ndarray | None = None
    num_observations: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    bounds: Mapping[str, DepthBounds] = dataclasses.field(default_factory=dict)
    up: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    has_film_frames: bool = False
    left_out: Mapping[str, str] = dataclasses.field(default_factory=dict)
    metres_per_unit: float | None = None


def assign_image_names(names: Iterable[str], where: str) -> dict[str, tuple[str, int]]:
    """Image name -> (camera name, the image's number in that camera, 0 for a camera's only image).

    With one folder (or none) every image is a camera, named by its stem: `cam00.png`. With several
    folders, a numbered image belongs to the camera named by its folder: `cam00/000012.png`.
    where: file for the error message
    Raises InputError if two images claim the same camera and number.
    """
    paths = {name: PurePosixPath(name.replace("\\", "/")) for name in names}
    has_many_folders = len({path.parent for path in paths.values()}) > 1
    assigned: dict[str, tuple[str, int]] = {}
    owners: dict[tuple[str, int], str] = {}
    for name, path in sorted(paths.items()):
        number = FRAME_STEM.fullmatch(path.stem)
        if has_many_folders and path.parent.name and number:
            key = (path.parent.name, int(number.group(1)))
        else:
            key = (path.stem, 0)
        if key in owners:
            raise InputError(
                f"{where}: expected one image per camera and frame, got {owners[key]!r} and {name!r} for "
                f"camera {key[0]}: name the images cam00.png or cam00/000012.png"
            )
        owners[key] = name
        assigned[name] = key
    return assigned


def group_by_camera(
    cameras: Mapping[str, Camera], where: str
) -> tuple[dict[str, tuple[Camera, ...]], dict[str, tuple[int, ...]], dict[str, str]]:
    """Cameras by image name -> by camera name: cameras in the order of the images' numbers, these
    numbers, and the camera name of each image. Raises InputError as `assign_image_names`.
    """
    assigned = assign_image_names(cameras, where)
    numbered: dict[str, dict[int, Camera]] = {}
    for image_name, (name, number) in assigned.items():
        numbered.setdefault(name, {})[number] = cameras[image_name]
    numbers = {name: tuple(sorted(numbered[name])) for name in sorted(numbered)}
    tracks = {name: tuple(numbered[name][n] for n in numbers[name]) for name in numbers}
    return tracks, numbers, {image: name for image, (name, _) in assigned.items()}


def pose_from_axes(axes: np.ndarray, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R, t cam_from_world from a camera's axes and centre in the world.

    axes: (3, 3) columns x right, y down, z forward;  center: (3,)
    Columns within a rounding of orthonormal are made so; others are passed on for `check_camera`
    to refuse.
    """
    R = axes.T
    if np.isfinite(R).all() and np.abs(R @ R.T - np.eye(3)).max() < AXES_TOLERANCE and np.linalg.det(R) > 0:
        R = nearest_rotation(R)
    return R, -R @ center
