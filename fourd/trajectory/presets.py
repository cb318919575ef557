"""The pinholes of a film by the kind of its path.

arc          along the path through the cameras, `path_from` to `path_to`
hold         stays at `position` of that path
orbit        a circle around what the cameras look at, at their usual height and distance, over `turn_deg`
             around their middle (none: as far as the cameras reach, all around where they do)
dolly        from `position` straight towards what is looked at, by `closer` of the distance; `keep_size`
             widens the field of view so that what is looked at keeps its size
bullet_time  at `path_from` while time runs, along the path while it stands at `time_frame`, then at `path_to`
follow       from `position`, moving as the point `look_at` does
cameras      from each of the named `cameras` to the next
keys         through stated poses

`look_at` turns any of them to a point, fixed or moving with the scene's frames.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.geometry import look_at
from fourd.trajectory import TrajectorySpec, bullet_moment, scene_frames
from fourd.trajectory.arc_path import ArcPath, average_track, checked_up, common_point
from fourd.trajectory.spline import PoseSpline, even_places, smooth_progress
from fourd.trajectory.timing import EASINGS, film_shares, locate

if TYPE_CHECKING:
    from fourd.sfm.cameras import SceneCameras

# Cameras that leave no larger gap than this stand all around.
WIDEST_GAP_OF_RING_DEG = 100.0


def place_cameras(spec: TrajectorySpec, scene: "SceneCameras", size: tuple[int, int]) -> list[Camera]:
    """The ideal pinhole of every frame of the film.

    size: of the film, (width, height) px; pixels are square, the principal point is central (but for
    the eyes of a stereo film) and, unless stated, the field of view over the diagonal is interpolated
    from the neighbouring cameras'
    Raises InputError when the cameras or the keys do not make the path.
    """
    shown = scene_frames(spec, scene.num_frames)
    film = _PLACES[spec.kind](spec, scene, shown, size)
    if spec.look_at is not None and spec.kind != "follow":
        points = look_points(spec, scene, shown)
        film = [_turned(c, point, scene.up) for c, point in zip(film, points, strict=True)]
    if spec.fov_deg is not None:
        focal = focal_of_fov(spec.fov_deg, size[1])
        film = [_with_focal(camera, focal) for camera in film]
    if spec.stereo is not None and spec.eye != "middle":
        side = -0.5 if spec.eye == "left" else 0.5
        film = [_eye(camera, side * spec.stereo) for camera in film]
    return film


def focal_of_fov(fov_deg: float, height: int) -> float:
    """Focal length, px, of a vertical field of view over a picture's height, px."""
    return height / 2 / float(np.tan(np.radians(fov_deg) / 2))


def fov_of_focal(focal_px: float, height: int) -> float:
    """Vertical field of view, degrees; the inverse of `focal_of_fov`."""
    return float(np.degrees(2 * np.arctan2(height, 2 * focal_px)))


def world_point(spec: TrajectorySpec, scene: "SceneCameras", point: Sequence[float]) -> np.ndarray:
    """(3,) of the scene's world; points of a path in `world: source` are brought there."""
    given = np.asarray(point, dtype=np.float64)
    return (given - scene.origin) / scene.scale if spec.world == "source" else given


def look_points(spec: TrajectorySpec, scene: "SceneCameras", shown: Sequence[int]) -> np.ndarray:
    """(N, 3) the point looked at in every frame of the film; a moving one stays outside its keys."""
    assert spec.look_at is not None
    if not isinstance(spec.look_at[0], dict):
        return np.repeat(world_point(spec, scene, spec.look_at)[None], len(shown), axis=0)
    frames = np.array([key["frame"] for key in spec.look_at], dtype=np.float64)
    points = np.stack([world_point(spec, scene, key["point"]) for key in spec.look_at])
    if len(frames) == 1:
        return np.repeat(points, len(shown), axis=0)
    return PchipInterpolator(frames, points)(np.clip(np.array(shown, np.float64), frames[0], frames[-1]))


def subject_of(spec: TrajectorySpec, scene: "SceneCameras", shown: Sequence[int]) -> np.ndarray:
    """(3,) what the film is about: the first point looked at, or where the cameras' axes meet."""
    if spec.look_at is not None:
        return look_points(spec, scene, shown)[0]
    tracks = [scene.tracks[name] for name in scene.inputs]
    point = common_point([average_track(track) for track in tracks], tracks)
    if point is None:
        raise InputError(
            f"trajectory: a path of kind {spec.kind} needs a point to look at, and the cameras look at none "
            "in common: state it as look_at"
        )
    return point


def _path(scene: "SceneCameras") -> ArcPath:
    return ArcPath([scene.tracks[name] for name in scene.inputs], scene.up)


def _runs(spec: TrajectorySpec, length: int) -> np.ndarray:
    run = np.linspace(0.0, 1.0, length) if length > 1 else np.array([0.5])
    return run * run * (3 - 2 * run) if spec.ease else run


def _hold(spec: TrajectorySpec, scene: "SceneCameras", shown: Sequence[int], size) -> list[Camera]:
    path = _path(scene)
    position = path.middle_share() if spec.position is None else spec.position
    return [path.camera_at(position, size)] * len(shown)


def _arc(spec: TrajectorySpec, scene: "SceneCameras", shown: Sequence[int], size) -> list[Camera]:
    path = _path(scene)
    shares = spec.path_from + (spec.path_to - spec.path_from) * _runs(spec, len(shown))
    return [path.camera_at(float(share), size) for share in shares]


def _bullet_time(spec: TrajectorySpec, scene: "SceneCameras", shown: Sequence[int], size) -> list[Camera]:
    path, stop = _path(scene), bullet_moment(spec, scene.num_frames)[1]
    run = np.clip((np.array(film_shares(len(shown))) - stop) / 0.5, 0, 1)
    run = run * run * (3 - 2 * run) if spec.ease else run
    return [path.camera_at(float(s), size) for s in spec.path_from + (spec.path_to - spec.path_from) * run]


def _orbit(spec: TrajectorySpec, scene: "SceneCameras", shown: Sequence[int], size) -> list[Camera]:
    cameras = [average_track(scene.tracks[name]) for name in scene.inputs]
    subject, up = subject_of(spec, scene, shown), checked_up(np.asarray(scene.up, dtype=np.float64))
    offsets = np.stack([camera.center - subject for camera in cameras])
    heights = offsets @ up
    level = offsets - heights[:, None] * up
    radius, height = float(np.median(np.linalg.norm(level, axis=1))), float(np.median(heights))
    if radius <= 1e-6 * float(np.linalg.norm(offsets, axis=1).max()):
        raise InputError(
            "trajectory: the cameras stand above what they look at, an orbit needs them around it"
        )
    ahead = level[0] / np.linalg.norm(level[0])
    basis = np.stack([ahead, np.cross(up, ahead)])
    angles = np.sort(np.arctan2(level @ basis[1], level @ basis[0]))
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    reach = 2 * np.pi - gaps[widest]
    middle = angles[widest] + gaps[widest] + reach / 2
    turn = reach if spec.turn_deg is None else np.radians(spec.turn_deg)
    is_closed = spec.turn_deg is None and np.degrees(gaps[widest]) <= WIDEST_GAP_OF_RING_DEG
    length = len(shown)
    # A full turn ends one step before its beginning, so that the film can be played in a loop.
    run = np.arange(length) / length if is_closed else _runs(spec, length)
    turn = 2 * np.pi if is_closed else turn
    focal = np.exp(np.mean([np.log(c.focal_px / np.hypot(*c.size)) for c in cameras])) * np.hypot(*size)
    film = []
    for angle in middle + turn * (run - 0.5):
        around = np.array([np.cos(angle), np.sin(angle)]) @ basis
        film.append(_pinhole(subject + radius * around + height * up, subject, up, float(focal), size))
    return film


def _dolly(spec: TrajectorySpec, scene: "SceneCameras", shown: Sequence[int], size) -> list[Camera]:
    start, subject = _hold(spec, scene, shown[:1], size)[0], subject_of(spec, scene, shown)
    film = []
    for run in _runs(spec, len(shown)):
        left = 1 - spec.closer * float(run)
        center = subject + (start.center - subject) * left
        camera = dataclasses.replace(start, t=-start.R @ center)
        film.append(_with_focal(camera, start.focal_px * left) if spec.keep_size else camera)
    return film


def _follow(spec: TrajectorySpec, scene: "SceneCameras", shown: Sequence[int], size) -> list[Camera]:
    start, points = _hold(spec, scene, shown[:1], size)[0], look_points(spec, scene, shown)
    offset = start.center - points.mean(axis=0)
    return [_pinhole(point + offset, point, scene.up, start.focal_px, size) for point in points]


def _cameras(spec: TrajectorySpec, scene: "SceneCameras", shown: Sequence[int], size) -> list[Camera]:
    keys = tuple({"camera": name} for name in spec.cameras)
    return _keys(dataclasses.replace(spec, keys=keys), scene, shown, size)


def _keys(spec: TrajectorySpec, scene: "SceneCameras", shown: Sequence[int], size) -> list[Camera]:
    poses = [_pose_of_key(key, spec, scene, size) for key in spec.keys]
    centers, rotations, focals = (np.stack(column) for column in zip(*poses, strict=True))
    spline = PoseSpline(centers, rotations, np.log(focals))
    has_places = "at" in spec.keys[0]
    at = np.array([key["at"] for key in spec.keys]) if has_places else even_places(spline.distance)
    # Stated places are obeyed; only a path without them starts and stops by itself.
    shares = np.array(film_shares(len(shown))) if has_places else _runs(spec, len(shown))
    stretch, part = _progress(spec, at, spline.knots, shares)
    film = []
    for center, R, log_focal in zip(*spline.poses_at(stretch, part), strict=True):
        film.append(Camera(_matrix(float(np.exp(log_focal)), size), R, -R @ center, size))
    return film


def _progress(
    spec: TrajectorySpec, at: np.ndarray, knots: np.ndarray, shares: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    is_plain = not any("ease" in key for key in spec.keys)
    if len(at) > 1 and is_plain and (np.diff(at) > 0).all():
        return smooth_progress(at, knots, shares)
    found = [locate(at.tolist(), float(share)) for share in shares]
    eased = [
        EASINGS[spec.keys[index].get("ease", "linear")](part) if part < 1 else part for index, part in found
    ]
    return np.array([index for index, _ in found], dtype=np.int64), np.array(eased)


def _pose_of_key(
    key, spec: TrajectorySpec, scene: "SceneCameras", size
) -> tuple[np.ndarray, np.ndarray, float]:
    """Centre, cam_from_world rotation and focal length, px, of a key."""
    cameras = {name: scene.tracks[name] for name in (*scene.inputs, *getattr(scene, "heldout", ()))}
    if "camera" in key and key["camera"] not in cameras:
        raise InputError(
            f"trajectory: key camera {key['camera']!r}: expected one of {', '.join(cameras)}: check the name"
        )
    if "camera" in key:
        camera = average_track(cameras[key["camera"]])
        center, R = camera.center, camera.R
        focal = camera.focal_px / float(np.hypot(*camera.size)) * float(np.hypot(*size))
    else:
        center, R = world_point(spec, scene, key["position"]), None
        near = min(
            (average_track(scene.tracks[name]) for name in scene.inputs),
            key=lambda camera: float(np.linalg.norm(camera.center - center)),
        )
        focal = near.focal_px / float(np.hypot(*near.size)) * float(np.hypot(*size))
        if "rotation" in key:
            R = Rotation.from_quat(key["rotation"], scalar_first=True).as_matrix()
    if "look_at" in key:
        R = _rotation_to(center, world_point(spec, scene, key["look_at"]), scene.up)
    elif R is None:
        R = _rotation_to(center, subject_of(spec, scene, [0]), scene.up)
    return center, R, focal_of_fov(key["fov_deg"], size[1]) if "fov_deg" in key else focal


def _rotation_to(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    try:
        return look_at(center, target, np.asarray(up, dtype=np.float64))[0]
    except ValueError:
        raise InputError(
            f"trajectory: the view at {np.round(center, 3).tolist()} cannot look at "
            f"{np.round(target, 3).tolist()} and stay level: move one of them, or state a rotation"
        ) from None


def _pinhole(center: np.ndarray, target: np.ndarray, up: np.ndarray, focal: float, size) -> Camera:
    R = _rotation_to(center, target, up)
    return Camera(_matrix(focal, size), R, -R @ center, size)


def _turned(camera: Camera, target: np.ndarray, up: np.ndarray) -> Camera:
    R = _rotation_to(camera.center, target, up)
    return dataclasses.replace(camera, R=R, t=-R @ camera.center)


def _matrix(focal: float, size: tuple[int, int]) -> np.ndarray:
    return np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])


def _with_focal(camera: Camera, focal: float) -> Camera:
    return dataclasses.replace(camera, K=_matrix(focal, camera.size))


def _eye(camera: Camera, side: float) -> Camera:
    """The camera moved to its right, world units; its picture is shifted so that depth 1 stays in place.

    The world unit is the cameras' usual distance to the scene, which so appears in the screen.
    """
    K = camera.K.copy()
    K[0, 2] += camera.K[0, 0] * side
    return dataclasses.replace(camera, K=K, t=camera.t - np.array([side, 0.0, 0.0]))


_PLACES: dict[str, Callable[..., list[Camera]]] = {
    "arc": _arc,
    "hold": _hold,
    "orbit": _orbit,
    "dolly": _dolly,
    "bullet_time": _bullet_time,
    "follow": _follow,
    "cameras": _cameras,
    "keys": _keys,
}
