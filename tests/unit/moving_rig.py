"""A ring of cameras around points on smooth random paths, with true clocks."""

import dataclasses
from collections.abc import Callable

import numpy as np

from fourd.align.clock import CameraClock
from fourd.align.moving_points import MovingPoints
from fourd.camera import Camera
from fourd.geometry import look_at

FPS = 30.0
SIZE = (1920, 1080)
K = np.array([[1500.0, 0, 959.5], [0, 1500, 539.5], [0, 0, 1]])

Paths = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True, eq=False)
class Rig:
    """offsets_s: (C,) true;  guesses: clocks to start from;  cameras: one per observation"""

    points: MovingPoints
    cameras: list[Camera]
    offsets_s: np.ndarray
    guesses: dict[str, CameraClock]

    def keep(self, chosen: np.ndarray, **changes: np.ndarray) -> "Rig":
        """Some of the observations, some of their values replaced."""
        index = np.flatnonzero(chosen)
        fields = {
            field.name: changes.get(field.name, getattr(self.points, field.name))[index]
            for field in dataclasses.fields(MovingPoints)
            if field.name != "names"
        }
        points = MovingPoints(self.points.names, **fields)
        return dataclasses.replace(self, points=points, cameras=[self.cameras[i] for i in index])


def wandering(num_points: int, seed: int) -> Paths:
    """Paths of a person's size and speed, mm: sums of three sinusoids per axis."""
    rng = np.random.default_rng(seed)
    frequency = rng.uniform(0.3, 1.5, (3, num_points, 3))
    phase = rng.uniform(0, 2 * np.pi, frequency.shape)
    amplitude = rng.uniform(50, 200, frequency.shape)
    center = rng.normal(0, 400, (num_points, 3)) + [0, 0, 900]

    def at(point: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi * frequency[:, point] * time_s[:, None] + phase[:, point]
        return center[point] + (amplitude[:, point] * np.sin(angle)).sum(axis=0)

    return at


def ring(num_cams: int, scale: float = 1.0, radius: float = 3000.0) -> list[Camera]:
    """Cameras on a circle that look at its middle; world units are mm * scale."""
    cameras = []
    for cam in range(num_cams):
        angle = 2 * np.pi * cam / max(num_cams, 5)
        center = np.array([radius * np.cos(angle), radius * np.sin(angle), 1400.0])
        R, t = look_at(center, np.array([0, 0, 900.0]), np.array([0, 0, 1.0]))
        cameras.append(Camera(K, R, t * scale, SIZE))
    return cameras


def film(
    paths: Paths,
    num_points: int,
    offsets_s: np.ndarray,
    noise_px: float = 1.0,
    num_frames: int = 60,
    start_frames: float = 1.5,
    scale: float = 1.0,
    readout_s: np.ndarray | None = None,
    rates: np.ndarray | None = None,
    seed: int = 0,
) -> Rig:
    """What a ring of cameras sees of the paths, and first guesses of the clocks that are off.

    start_frames: the guesses alternate between this much too late and too early, frames
    """
    rng = np.random.default_rng(seed)
    num_cams = len(offsets_s)
    readout_s = np.zeros(num_cams) if readout_s is None else readout_s
    rates = np.zeros(num_cams) if rates is None else rates
    frame, point = (axis.ravel() for axis in np.meshgrid(np.arange(num_frames), np.arange(num_points)))
    columns: dict[str, list[np.ndarray]] = {"cam": [], "pixels": []}
    cameras: list[Camera] = []
    for cam, camera in enumerate(ring(num_cams, scale)):
        time_s = offsets_s[cam] + (1 + rates[cam]) * frame / FPS
        pixels = camera.project(paths(point, time_s) * scale)[0]
        for _ in range(4):
            row = (pixels[:, 1] + 0.5) / SIZE[1]
            pixels = camera.project(paths(point, time_s + readout_s[cam] * row) * scale)[0]
        columns["cam"].append(np.full(len(frame), cam))
        columns["pixels"].append(pixels + rng.normal(0, noise_px, pixels.shape))
        cameras += [camera] * len(frame)
    names = tuple(f"cam{cam:02d}" for cam in range(num_cams))
    points = MovingPoints(
        names=names,
        cam=np.concatenate(columns["cam"]),
        point=np.tile(point, num_cams),
        frame=np.tile(frame, num_cams),
        own_s=np.tile(frame / FPS, num_cams),
        pixels=np.concatenate(columns["pixels"]),
        sigma_px=np.full(num_cams * len(frame), max(noise_px, 0.1)),
    )
    off = np.where(np.arange(num_cams) % 2 == 0, start_frames, -start_frames) / FPS
    off[0] = 0
    guesses = {name: CameraClock(float(offsets_s[cam] + off[cam])) for cam, name in enumerate(names)}
    return Rig(points, cameras, offsets_s, guesses)
