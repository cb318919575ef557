"""What the page must know of the scene besides its pictures: moments, places, cameras, points."""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd.camera import Camera, CameraTrack
from fourd.io import SCHEMA_VERSION, Archive
from fourd.paths.hull import describe_view
from fourd.sfm.cameras import SceneCameras
from fourd.trajectory import TrajectorySpec
from fourd.trajectory.presets import place_cameras
from fourd.viewer.lattice import REAL_SHARE
from fourd.views import View

MAX_POINTS = 1500
# Points farther than this from the middle of the cameras, in their largest distance from it, are left out.
MAP_REACH = 4.0
DIGITS = 6
# Poses of the path that the page knows between two of its views: it moves as the films do.
POSES_PER_GAP = 8


def describe_scene(
    name: str,
    scene: SceneCameras,
    views: Sequence[View],
    fused: Sequence[str],
    inverse_depth_max: float,
    points: np.ndarray,
    width: int,
) -> dict[str, Any]:
    """The manifest of the page.

    views: of the lattice, in path order, all of the same moments;  fused: cameras by their number in maps
    inverse_depth_max: 1 / world unit, what 255 in a map means;  points: (N, 3) world units
    width: largest side of a rendered picture, px; real pictures are smaller by REAL_SHARE
    """
    frames = [entry.scene_frame for entry in views[0].frames]
    middle = np.mean([track.at(0).center for track in scene.tracks.values()], axis=0)
    way = way_between(scene, len(views), views[0].size)
    return {
        "schema_version": SCHEMA_VERSION,
        "scene": name,
        "fps": scene.fps,
        "num_frames": scene.num_frames,
        "frames": frames,
        "size": list(views[0].size),
        "up": _rounded(scene.up),
        "inverse_depth_max": inverse_depth_max,
        "fused": list(fused),
        "views": [
            {
                "name": view.name,
                "share": round(i / (len(views) - 1), DIGITS),
                **_pose(view.frames[0].camera),
            }
            for i, view in enumerate(views)
        ],
        "way": [_pose(camera) for camera in way],
        "outside": find_outside(way, scene, frames),
        "cameras": [
            _describe_camera(track, name in scene.heldout, frames, width)
            for name, track in scene.tracks.items()
        ],
        "points": _rounded(thin_points(points, middle, scene)),
    }


def way_between(scene: SceneCameras, num_views: int, size: tuple[int, int]) -> list[Camera]:
    """Pinholes of the films' path, evenly along it, POSES_PER_GAP from each view to the next."""
    shares = np.linspace(0, 1, POSES_PER_GAP * (num_views - 1) + 1)
    held = [TrajectorySpec(kind="hold", position=float(share), num_frames=1) for share in shares]
    return [place_cameras(spec, scene, size)[0] for spec in held]


def find_outside(way: Sequence[Camera], scene: SceneCameras, frames: Sequence[int]) -> list[list[int]]:
    """For every pose the moments, counted from 0, at which it is no view that the cameras can know."""
    at_moments = [[scene.tracks[name].at(frame) for name in scene.inputs] for frame in frames]
    return [
        [i for i, inputs in enumerate(at_moments) if describe_view(camera, inputs)["is_outside"]]
        for camera in way
    ]


def _describe_camera(
    track: CameraTrack, is_heldout: bool, frames: Sequence[int], width: int
) -> dict[str, Any]:
    poses = [_pose(track.at(frame)) for frame in (frames if not track.is_static else frames[:1])]
    return {
        "name": track.name,
        "is_heldout": is_heldout,
        "size": list(track.size),
        "picture": list(picture_size(track.size, width)),
        "poses": poses,
    }


def picture_size(size: tuple[int, int], width: int) -> tuple[int, int]:
    """Size of a real picture on the page. width: largest side of a rendered one, px."""
    scale = REAL_SHARE * min(1.0, width / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def read_points(path: Path) -> np.ndarray:
    """(N, 3) float64 world units from sfm/points.npz."""
    with contextlib.closing(Archive(path)) as archive:
        return archive["points"]


def thin_points(points: np.ndarray, middle: np.ndarray, scene: SceneCameras) -> np.ndarray:
    """At most MAX_POINTS of the points near the cameras, evenly taken."""
    centers = np.stack([track.at(0).center for track in scene.tracks.values()])
    reach = MAP_REACH * float(np.linalg.norm(centers - middle, axis=1).max())
    near = points[np.linalg.norm(points - middle, axis=1) <= reach]
    return near[:: max(1, -(-len(near) // MAX_POINTS))]


def _pose(camera: Camera) -> dict[str, Any]:
    """Intrinsics as focal lengths and principal point in px of `size`, cam_from_world, row by row."""
    K = camera.K
    return {
        "intrinsics": _rounded(np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])),
        "R": _rounded(camera.R.ravel()),
        "t": _rounded(camera.t),
    }


def _rounded(values: np.ndarray) -> list[Any]:
    return np.round(np.asarray(values, np.float64), DIGITS).tolist()
