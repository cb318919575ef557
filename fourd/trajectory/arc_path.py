"""The curve through the places where people filmed, and the pinhole at any point of it."""

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from fourd.camera import Camera, CameraTrack
from fourd.errors import InputError
from fourd.geometry import angle_deg, convergence_point, look_at

# Samples per station-to-station segment of the table that turns path length into position.
_LENGTH_SAMPLES = 64
# A level horizon needs a view that is not along `up`; nearer than this the cameras' own up is used.
_MIN_ANGLE_TO_UP_DEG = 20.0
# Cameras converge when the common point lies this near to the middle of their pictures.
_MAX_ANGLE_TO_TARGET_DEG = 45.0


class ArcPath:
    """The curve through the mean places of cameras, with direction and focal length along it.

    Around a point that the cameras look at, the curve is drawn in azimuth, elevation and distance,
    so two cameras are joined by an arc and not by its chord; elsewhere it is drawn in Cartesian
    coordinates. Each coordinate is a monotone cubic (PCHIP) of the main one: between two cameras
    it never leaves their range. Cameras that would make the curve steeper than 45 degrees (one
    above the other in a wall or dome of cameras) count as one, at their mean place.
    Source: Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5(2), 1984 (as in SciPy).
    """

    def __init__(self, tracks: Sequence[CameraTrack], up: np.ndarray) -> None:
        cameras = [average_track(track) for track in tracks]
        up = checked_up(np.asarray(up, dtype=np.float64))
        _check_places(cameras)
        centers = np.stack([camera.center for camera in cameras])
        forward = np.stack([camera.forward for camera in cameras])
        image_up = np.stack([-camera.R[1] for camera in cameras])
        point = common_point(cameras, tracks)
        if point is None:
            self._chart: _PolarChart | _FlatChart = _FlatChart(
                forward.mean(axis=0), image_up.mean(axis=0), up
            )
            looks = forward
        else:
            self._chart = _PolarChart(point, up, centers)
            looks = centers + forward * np.linalg.norm(point - centers, axis=1)[:, None]
        self._looks_at_point = point is not None
        coordinates = self._chart.from_world(centers)
        main = int(np.argmax(np.ptp(coordinates, axis=0)))
        groups = _merge_steep(coordinates, main)
        knots = _group_means(coordinates, groups)[:, main]
        leveled = _min_angle_to(up, forward) >= _MIN_ANGLE_TO_UP_DEG
        ups = np.repeat(up[None], len(cameras), axis=0) if leveled else image_up
        log_focal = np.log([[camera.focal_px / np.hypot(*camera.size)] for camera in cameras])
        columns = np.concatenate([coordinates, looks, ups, log_focal], axis=1)
        self._curve = PchipInterpolator(knots, _group_means(columns, groups))
        self._knots = knots
        self._table = np.unique(
            np.concatenate(
                [np.linspace(a, b, _LENGTH_SAMPLES) for a, b in zip(knots, knots[1:], strict=False)]
            )
        )
        steps = np.linalg.norm(np.diff(self._chart.to_world(self._curve(self._table)[:, :3]), axis=0), axis=1)
        self._length = np.concatenate([[0.0], np.cumsum(steps)])

    def middle_share(self) -> float:
        """Share of the path halfway between the two middle cameras (next to the middle one if odd)."""
        left = (len(self._knots) - 1) // 2
        middle = (self._knots[left] + self._knots[left + 1]) / 2
        return float(np.interp(middle, self._table, self._length) / self._length[-1])

    def camera_at(self, share: float, size: tuple[int, int]) -> Camera:
        """The level pinhole at a share (0 to 1) of the path's length. Raises InputError."""
        knot = np.interp(share * self._length[-1], self._length, self._table)
        values = self._curve(knot)
        center = self._chart.to_world(values[:3])
        target = values[3:6] if self._looks_at_point else center + values[3:6]
        try:
            R, t = look_at(center, target, values[6:9])
        except ValueError:
            raise InputError(
                f"trajectory: at {share:.3f} of the path the neighbouring cameras look straight up or down "
                "and disagree about which side is up: choose path_from and path_to around it"
            ) from None
        focal = float(np.exp(values[9])) * float(np.hypot(*size))
        K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
        return Camera(K, R, t, size)


class _PolarChart:
    """Azimuth (rad, growing to the right as seen by the cameras), elevation (rad), -log distance.

    The cut of the circle is in the middle of the largest gap between cameras.
    """

    def __init__(self, origin: np.ndarray, up: np.ndarray, centers: np.ndarray) -> None:
        self._origin = origin
        level = _any_level_direction(up)
        self._basis = np.stack([level, np.cross(up, level), up])
        azimuth = np.sort(self.from_world(centers)[:, 0])
        gaps = np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi))
        widest = int(np.argmax(gaps))
        opposite = azimuth[widest] + gaps[widest] / 2 + np.pi
        first = np.cos(opposite) * self._basis[0] + np.sin(opposite) * self._basis[1]
        self._basis = np.stack([first, np.cross(up, first), up])

    def from_world(self, points: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis((points - self._origin) @ self._basis.T, -1, 0)
        distance = np.sqrt(x * x + y * y + z * z)
        return np.stack([np.arctan2(y, x), np.arcsin(z / distance), -np.log(distance)], axis=-1)

    def to_world(self, coordinates: np.ndarray) -> np.ndarray:
        azimuth, elevation, nearness = np.moveaxis(coordinates, -1, 0)
        level = np.cos(elevation)
        unit = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
        return self._origin + (unit * np.exp(-nearness)[..., None]) @ self._basis


class _FlatChart:
    """Right, up and forward of the mean camera, world units."""

    def __init__(self, forward: np.ndarray, image_up: np.ndarray, up: np.ndarray) -> None:
        # Cameras that look to all sides have no mean direction: any level one orders them.
        if np.linalg.norm(forward) < 1e-6:
            forward = _any_level_direction(up)
        steep = _min_angle_to(up, forward) < _MIN_ANGLE_TO_UP_DEG
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, image_up if steep else up)
        right /= np.linalg.norm(right)
        self._basis = np.stack([right, np.cross(right, forward), forward])

    def from_world(self, points: np.ndarray) -> np.ndarray:
        return points @ self._basis.T

    def to_world(self, coordinates: np.ndarray) -> np.ndarray:
        return coordinates @ self._basis


def average_track(track: CameraTrack) -> Camera:
    """The camera at its mean place, rotation and focal length over the clip."""
    R = Rotation.from_matrix(np.stack([camera.R for camera in track.cameras])).mean().as_matrix()
    center = np.mean([camera.center for camera in track.cameras], axis=0)
    K = np.mean([camera.K for camera in track.cameras], axis=0)
    return Camera(K, R, -R @ center, track.size)


def _any_level_direction(up: np.ndarray) -> np.ndarray:
    level = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return level / np.linalg.norm(level)


def _min_angle_to(up: np.ndarray, directions: np.ndarray) -> float:
    """Smallest angle, degrees, between the vertical line and directions (..., 3)."""
    angles = angle_deg(directions, up)
    return float(np.minimum(angles, 180 - angles).min())


def checked_up(up: np.ndarray) -> np.ndarray:
    """The direction (3,) at length 1. Raises InputError if it is none."""
    length = float(np.linalg.norm(up))
    if up.shape != (3,) or not np.isfinite(length) or length == 0:
        raise InputError(
            f"cameras: up must be a direction of three numbers, got {up.tolist()}: fix cameras.json"
        )
    return up / length


def _check_places(cameras: Sequence[Camera]) -> None:
    if len(cameras) < 2:
        raise InputError(
            f"trajectory: expected at least 2 input cameras to move between, got {len(cameras)}: add cameras"
        )
    centers = np.stack([camera.center for camera in cameras])
    extent = float(np.ptp(centers, axis=0).max())
    if extent <= 1e-9 * float(np.abs(centers).max()):
        raise InputError(
            "trajectory: expected input cameras at different places, but all stand in one: there is no path "
            "between them, check the calibration's translations"
        )


def common_point(cameras: Sequence[Camera], tracks: Sequence[CameraTrack]) -> np.ndarray | None:
    """The point that the cameras look at, or None where they look in parallel or apart."""
    point = convergence_point(cameras)
    offsets = np.stack([point - camera.center for camera in cameras])
    distances = np.linalg.norm(offsets, axis=1)
    extent = float(np.ptp([camera.center for camera in cameras], axis=0).max())
    if not np.isfinite(distances).all() or distances.min() <= 0.05 * extent:
        return None
    off_axis = angle_deg(offsets, np.stack([camera.forward for camera in cameras]))
    # One camera that looks elsewhere does not make a gathering of cameras parallel.
    if np.median(off_axis) > _MAX_ANGLE_TO_TARGET_DEG:
        return None
    nearest = np.median([track.near for track in tracks])
    return point if np.median(distances) > nearest else None


def _merge_steep(coordinates: np.ndarray, main: int) -> list[list[int]]:
    """Cameras in path order, grouped so that no step is longer across the main coordinate than along it.

    coordinates: (N, 3) of a chart. Returns at least two groups of indices.
    """
    groups = [[int(i)] for i in np.argsort(coordinates[:, main], kind="stable")]
    least = 1e-6 * float(np.ptp(coordinates[:, main]))
    while len(groups) > 2:
        steps = np.abs(np.diff(_group_means(coordinates, groups), axis=0))
        along = steps[:, main].copy()
        steps[:, main] = 0
        steepness = (np.linalg.norm(steps, axis=1) + least) / np.maximum(along, 1e-3 * least)
        worst = int(np.argmax(steepness))
        if steepness[worst] <= 1:
            break
        groups[worst : worst + 2] = [groups[worst] + groups[worst + 1]]
    return groups


def _group_means(values: np.ndarray, groups: Sequence[Sequence[int]]) -> np.ndarray:
    return np.stack([values[list(group)].mean(axis=0) for group in groups])
