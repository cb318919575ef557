"""Observations of moving points, made ready for the joint solve of clocks and trajectories."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from fourd.align.moving_points import MovingPoints
from fourd.camera import Camera
from fourd.errors import InputError

MIN_OBSERVATIONS_PER_POINT = 8
MIN_OBSERVATIONS_PER_VIEW = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Observations:
    """N sightings of M trajectories in a world that is centred and scaled to the ring of cameras.

    num_cams: C;  cam: (N,) int64 in 0..C-1;  point: (N,) int64 in 0..M-1;  own_s: (N,) float64 s
    row: (N,) 0 at the top of the picture, 1 at its bottom (a rolling shutter reads later rows later)
    pixels: (N, 2) px without lens distortion;  sigma_px: (N,);  projection: (N, 3, 4) px from world
    source: (N,) int64 number of the observation in the MovingPoints it came from
    origin, unit: source world = unit * world + origin
    """

    num_cams: int
    cam: np.ndarray
    point: np.ndarray
    own_s: np.ndarray
    row: np.ndarray
    pixels: np.ndarray
    sigma_px: np.ndarray
    projection: np.ndarray
    source: np.ndarray
    origin: np.ndarray
    unit: float

    def take(self, index: np.ndarray, point: np.ndarray | None = None) -> "Observations":
        """Some of the observations, optionally under other point numbers."""
        return dataclasses.replace(
            self,
            cam=self.cam[index],
            point=self.point[index] if point is None else point,
            own_s=self.own_s[index],
            row=self.row[index],
            pixels=self.pixels[index],
            sigma_px=self.sigma_px[index],
            projection=self.projection[index],
            source=self.source[index],
        )


def prepare_observations(points: MovingPoints, cameras: Sequence[Camera]) -> Observations:
    """Remove the lens, centre and scale the world.

    cameras: one per observation; the same object may stand for many
    Raises InputError for lengths that differ, values that are not finite, cameras in one place.
    """
    _check(points, cameras)
    distinct = {id(camera): camera for camera in cameras}
    centers = np.stack([camera.center for camera in distinct.values()])
    origin = centers.mean(axis=0)
    unit = float(np.sqrt(((centers - origin) ** 2).sum(axis=1).mean()))
    if not unit > 1e-9 * float(np.abs(centers).max(initial=0)):
        raise InputError(
            "moving points: expected cameras in different places, got all in one: depth and time cannot be "
            "told apart; check the camera poses"
        )
    pixels = np.empty((len(points.cam), 2))
    projection = np.empty((len(points.cam), 3, 4))
    row = np.empty(len(points.cam))
    identity = np.fromiter((id(camera) for camera in cameras), dtype=np.int64, count=len(cameras))
    order = np.argsort(identity, kind="stable")
    for index in np.split(order, np.flatnonzero(np.diff(identity[order])) + 1):
        camera = distinct[int(identity[index[0]])]
        offset = (camera.R @ origin + camera.t) / unit
        projection[index] = camera.K @ np.column_stack([camera.R, offset])
        pixels[index] = camera.rays(points.pixels[index])[:, :2] @ camera.K[:2, :2].T + camera.K[:2, 2]
        row[index] = (points.pixels[index, 1] + 0.5) / camera.size[1]
    return Observations(
        num_cams=len(points.names),
        cam=points.cam,
        point=points.point,
        own_s=points.own_s,
        row=row,
        pixels=pixels,
        sigma_px=points.sigma_px,
        projection=projection,
        source=np.arange(len(points.cam)),
        origin=origin,
        unit=unit,
    )


def _check(points: MovingPoints, cameras: Sequence[Camera]) -> None:
    count = len(points.cam)
    if count == 0:
        raise InputError("moving points: expected observations, got none: nothing moves in these films")
    lengths = {"point": points.point, "own_s": points.own_s, "pixels": points.pixels}
    for name, values in {**lengths, "sigma_px": points.sigma_px, "cameras": cameras}.items():
        if len(values) != count:
            raise InputError(f"moving points: expected {count} entries in {name}, got {len(values)}")
    finite = (np.isfinite(a).all() for a in (points.own_s, points.pixels, points.sigma_px))
    if not all(finite) or not (points.sigma_px > 0).all():
        raise InputError(
            "moving points: expected finite own_s and pixels and positive sigma_px: leave bad points out"
        )


def connected(
    observations: Observations, time_s: np.ndarray, cams: np.ndarray, reach_s: float, gap_s: float
) -> Observations:
    """What some cameras say about trajectories that at least two of them see at about the same time.

    time_s: (N,) common time by the clocks so far;  cams: (C,) bool
    reach_s: an observation counts if another camera sees the point within this time
    gap_s: a trajectory that nobody sees for longer is two, as nothing ties its ends together
    Points are numbered anew; the result may be empty.
    """
    index = np.flatnonzero(cams[observations.cam])
    index = index[np.lexsort((observations.cam[index], time_s[index], observations.point[index]))]
    index = index[_seconds_to_other_camera(observations, time_s, index) <= reach_s]
    time, point = time_s[index], observations.point[index]
    is_new = np.ones(len(index), dtype=bool)
    is_new[1:] = (np.diff(point) != 0) | (np.diff(time) > gap_s)
    run = np.cumsum(is_new) - 1
    num_runs = int(run[-1]) + 1 if len(run) else 0
    per_view = np.zeros((num_runs, observations.num_cams), dtype=np.int64)
    np.add.at(per_view, (run, observations.cam[index]), 1)
    is_good = ((per_view >= MIN_OBSERVATIONS_PER_VIEW).sum(axis=1) >= 2) & (
        per_view.sum(axis=1) >= MIN_OBSERVATIONS_PER_POINT
    )
    keep = is_good[run]
    number = np.cumsum(is_good) - 1
    return observations.take(index[keep], number[run[keep]])


def most_moving(observations: Observations, count: int) -> Observations:
    """The trajectories that move most in the pictures, at most `count` of them."""
    num_points = int(observations.point.max(initial=-1)) + 1
    if num_points <= count:
        return observations
    track = observations.point * observations.num_cams + observations.cam
    num_tracks = num_points * observations.num_cams
    seen = np.maximum(np.bincount(track, minlength=num_tracks), 1)
    spread = np.zeros(num_tracks)
    for axis in range(2):
        mean = np.bincount(track, observations.pixels[:, axis], num_tracks) / seen
        spread += np.bincount(track, (observations.pixels[:, axis] - mean[track]) ** 2, num_tracks)
    per_point = spread.reshape(num_points, -1).sum(axis=1)
    chosen = np.zeros(num_points, dtype=bool)
    chosen[np.argsort(-per_point, kind="stable")[:count]] = True
    number = np.cumsum(chosen) - 1
    index = np.flatnonzero(chosen[observations.point])
    return observations.take(index, number[observations.point[index]])


def _seconds_to_other_camera(observations: Observations, time_s: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Time to the nearest sighting of the same point by another camera; index is sorted by point, time."""
    if len(index) == 0:
        return np.zeros(0)
    cam, point, time = observations.cam[index], observations.point[index], time_s[index]
    starts = np.concatenate([[0], np.flatnonzero((np.diff(cam) != 0) | (np.diff(point) != 0)) + 1])
    ends = np.concatenate([starts[1:], [len(index)]])
    run = np.repeat(np.arange(len(starts)), ends - starts)
    before, after = starts[run] - 1, ends[run]
    nearest = np.full(len(index), np.inf)
    for other in (before, after):
        inside = np.clip(other, 0, len(index) - 1)
        known = (other == inside) & (point[inside] == point)
        nearest = np.where(known, np.minimum(nearest, np.abs(time - time[inside])), nearest)
    return nearest
