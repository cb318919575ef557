"""A generated person of 31 joints who walks a curve, filmed by a ring of cameras whose clocks are known."""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from fourd.align.moving_points import MovingPoints
from fourd.camera import Camera
from fourd.geometry import look_at

SIZE = (1920, 1080)
FOCAL_PX = 1500.0
RADIUS_MM = 3000.0
FPS = 30.0
NUM_JOINTS = 31
# The whole frames by which the ten cameras of the reference setting start late.
OFFSET_FRAMES = np.array([0, 1, 29, 5, 16, 3, 27, 2, 18, 4])


@dataclasses.dataclass(frozen=True)
class Setting:
    """start_frames: largest error of the first guesses;  hidden, wrong: shares of the observations

    strangers: this many cameras film another person each
    """

    num_cams: int = 10
    seconds: float = 3.0
    noise_px: float = 2.0
    start_frames: float = 2.0
    hidden: float = 0.0
    wrong: float = 0.0
    strangers: int = 0


@dataclasses.dataclass(frozen=True, eq=False)
class Take:
    """What the cameras saw. offsets_s, guesses_s: (C,) true and first;  strangers: of other events"""

    points: MovingPoints
    cameras: list[Camera]
    offsets_s: np.ndarray
    guesses_s: np.ndarray
    strangers: tuple[int, ...]


def skeleton() -> tuple[list[int], list[tuple[float, float, float]]]:
    """Parents and bones (mm, z up) of pelvis, spine, head, two legs and two arms."""
    parents, bones = [-1], [(0.0, 0.0, 950.0)]

    def add(parent: int, *bone: float) -> int:
        parents.append(parent)
        bones.append((bone[0], bone[1], bone[2]))
        return len(parents) - 1

    chest = add(add(add(0, 0, 0, 120), 0, 0, 140), 0, 0, 160)
    add(add(add(chest, 0, 0, 120), 0, 20, 110), 0, 30, 110)
    for side in (-1, 1):
        ankle = add(add(add(0, side * 95, 0, -40), side * 10, 0, -420), 0, 0, -420)
        add(ankle, 0, -60, -40)
        add(add(ankle, 0, 150, -50), 0, 60, 0)
    for side in (-1, 1):
        elbow = add(add(add(chest, side * 90, 0, 60), side * 100, 0, 0), side * 60, 0, -270)
        add(add(add(elbow, side * 20, 40, -240), 0, 30, -90), side * 30, 20, -30)
    return parents, bones


def walking_person(seed: int) -> Callable[[np.ndarray], np.ndarray]:
    """Joint positions (T, 31, 3) mm at times (T,) s.

    The pelvis goes 1.2 m/s round a circle of 0.5 to 0.9 m; every joint turns by three sinusoids of 0.4 to
    2.2 Hz and about 10 degrees per axis. Hands and feet reach 3 m/s and 30 m/s^2.
    """
    rng = np.random.default_rng(seed)
    parents, bones = skeleton()
    frequency = rng.uniform(0.4, 2.2, (NUM_JOINTS, 3, 3, 1))
    phase = rng.uniform(0, 2 * np.pi, frequency.shape)
    amplitude = rng.normal(0, 0.07, frequency.shape)
    circle_mm = rng.uniform(500, 900)
    turn = 1200 / circle_mm * rng.choice([-1, 1])
    begin = rng.uniform(0, 2 * np.pi)

    def at(time_s: np.ndarray) -> np.ndarray:
        angles = (amplitude * np.sin(2 * np.pi * frequency * time_s + phase)).sum(axis=2)
        heading = begin + turn * time_s
        step = 30 * np.sin(2 * np.pi * 1.8 * time_s)
        turns: list[Rotation] = []
        joints = np.zeros((len(time_s), NUM_JOINTS, 3))
        for joint, (parent, bone) in enumerate(zip(parents, bones, strict=True)):
            own = Rotation.from_rotvec(angles[joint].T)
            if parent < 0:
                turns.append(Rotation.from_rotvec(np.outer(heading, [0, 0, 1.0])) * own)
                circle = [circle_mm * np.cos(heading), circle_mm * np.sin(heading), bone[2] + step]
                joints[:, joint] = np.stack(circle, axis=1)
            else:
                turns.append(turns[parent] * own)
                joints[:, joint] = joints[:, parent] + turns[parent].apply(np.asarray(bone))
        return joints

    return at


def film(setting: Setting, seed: int) -> Take:
    """One take; the cameras stand on a circle of 3 m at 36 degrees from each other, 1.4 m high."""
    rng = np.random.default_rng([seed, 1])
    num = setting.num_cams
    offsets_s = (OFFSET_FRAMES[:num] + rng.uniform(-0.5, 0.5, num)) / FPS
    offsets_s -= offsets_s[0]
    guesses_s = offsets_s + rng.uniform(-1, 1, num) * setting.start_frames / FPS
    guesses_s[0] = 0
    strangers = tuple(range(1, 1 + 2 * setting.strangers, 2))
    K = np.array([[FOCAL_PX, 0, (SIZE[0] - 1) / 2], [0, FOCAL_PX, (SIZE[1] - 1) / 2], [0, 0, 1]])
    own_s = np.arange(int(setting.seconds * FPS)) / FPS
    parts, cameras = [], []
    for cam in range(num):
        angle = 2 * np.pi * cam / len(OFFSET_FRAMES)
        center = np.array([RADIUS_MM * np.cos(angle), RADIUS_MM * np.sin(angle), 1400])
        R, t = look_at(center, np.array([0, 0, 900.0]), np.array([0, 0, 1.0]))
        camera = Camera(K, R, t, SIZE)
        person = walking_person(seed + 1000 * (cam + 1) if cam in strangers else seed)
        pixels = camera.project(person(own_s + offsets_s[cam]))[0]
        pixels += rng.normal(0, 1, pixels.shape) * setting.noise_px
        wrong = rng.random(pixels.shape[:2]) < setting.wrong
        pixels[wrong] = rng.uniform([0, 0], SIZE, (int(wrong.sum()), 2))
        frame, point = np.nonzero(rng.random(pixels.shape[:2]) >= setting.hidden)
        parts.append((np.full(len(frame), cam), point, frame, own_s[frame], pixels[frame, point]))
        cameras += [camera] * len(frame)
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    sigma_px = np.full(len(cameras), max(setting.noise_px, 0.1))
    points = MovingPoints(tuple(f"cam{cam:02d}" for cam in range(num)), *columns, sigma_px)
    return Take(points, cameras, offsets_s, guesses_s, strangers)
