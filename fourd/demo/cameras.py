"""The people who film: where they stand, how their hands shake, which lens; exact at any time."""

import numpy as np
from scipy.spatial.transform import Rotation

from fourd.camera import Camera, CameraTrack
from fourd.demo.options import DemoOptions, camera_index, camera_names
from fourd.geometry import look_at

UP = np.array([0.0, 0.0, 1.0])
TARGET = np.array([0.0, 0.1, 1.0])
MAX_SHAKE_SIGMA = 2.5
_NUM_TONES = 6


def _shake(rng: np.random.Generator, time_s: float) -> np.ndarray:
    """(6,) smooth motion of the hand, unit deviation, never beyond MAX_SHAKE_SIGMA.

    A sum of tones between 0.3 and 4 Hz whose size falls with frequency, as tremor of a held camera.
    """
    frequency = np.exp(rng.uniform(np.log(0.3), np.log(4.0), (6, _NUM_TONES)))
    weight = 1 / np.sqrt(frequency)
    weight *= np.sqrt(2 / (weight**2).sum(axis=1, keepdims=True))
    phase = rng.uniform(0, 2 * np.pi, (6, _NUM_TONES))
    value = (weight * np.sin(2 * np.pi * frequency * time_s + phase)).sum(axis=1)
    return MAX_SHAKE_SIGMA * np.tanh(value / MAX_SHAKE_SIGMA)


def arc_position(angle_deg: float, distance: float, height: float) -> np.ndarray:
    """(3,) point on the arc around the action; 0 degrees is in front, positive to the right."""
    angle = np.radians(angle_deg)
    return np.array([distance * np.sin(angle), -distance * np.cos(angle), height])


def _intrinsics(focal_px: float, size: tuple[int, int]) -> np.ndarray:
    return np.array([[focal_px, 0, (size[0] - 1) / 2], [0, focal_px, (size[1] - 1) / 2], [0, 0, 1.0]])


def camera_at(name: str, time_s: float, options: DemoOptions) -> Camera:
    """One hand-held camera at any instant of the event, seconds (0 = synchronised frame 0).

    Raises InputError if there is no such camera.
    """
    index = camera_index(name, options)
    rng = np.random.default_rng([options.seed, 100, index])
    share = index / (options.num_cameras - 1) - 0.5
    distance = options.distance_m + rng.uniform(-0.3, 0.3)
    height = options.eye_height_m + rng.uniform(-0.12, 0.12)
    target = TARGET + rng.uniform(-1, 1, 3) * (0.18, 0.1, 0.06)
    roll_deg = rng.uniform(-1.5, 1.5)
    # Focal lengths jump between neighbours, as between people's phones.
    lens = (0.18 + 0.61803 * index + rng.uniform(-0.05, 0.05)) % 1.0
    focal_px = (360 + 100 * lens) * options.width / 480
    motion = _shake(rng, time_s)
    center = arc_position(share * options.arc_deg, distance, height)
    R, _ = look_at(center, target, UP)
    wobble = np.radians(options.shake_deg * motion[3:] + (0, 0, roll_deg))
    R = Rotation.from_rotvec(wobble).as_matrix() @ R
    center = center + options.shake_m * motion[:3]
    size = (options.width, options.height)
    return Camera(_intrinsics(focal_px, size), R, -R @ center, size)


def clip_times(options: DemoOptions) -> np.ndarray:
    """(num_frames,) seconds of the synchronised frames."""
    return np.arange(options.num_frames) / options.fps


def middle_time(options: DemoOptions) -> float:
    """Seconds; the figures cross here."""
    return (options.num_frames - 1) / 2 / options.fps


def camera_tracks(options: DemoOptions) -> dict[str, CameraTrack]:
    """Truth of every camera at every synchronised frame."""
    return {
        name: CameraTrack(name, tuple(camera_at(name, t, options) for t in clip_times(options)))
        for name in camera_names(options)
    }


def orbit_cameras(options: DemoOptions) -> list[Camera]:
    """Steady cameras along the arc, between the people who film, for a frozen-time orbit."""
    count = options.num_orbit_views
    size, cameras = (options.width, options.height), []
    for index in range(count):
        share = 0.0 if count == 1 else index / (count - 1) - 0.5
        center = arc_position(0.94 * share * options.arc_deg, options.distance_m, options.eye_height_m + 0.05)
        R, t = look_at(center, TARGET, UP)
        cameras.append(Camera(_intrinsics(400 * options.width / 480, size), R, t, size))
    return cameras
