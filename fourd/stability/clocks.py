"""Clocks and moving points: no time between observations, no motion, everything at the edge of the search."""

import dataclasses
from collections.abc import Callable

import numpy as np

from fourd.align.audio_delay import estimate_audio_delay
from fourd.align.clock import CameraClock
from fourd.align.motion_prior import DIMENSION, RIDGE, BandedNormal, make_grid, prior_blocks
from fourd.align.moving_points import MovingPoints
from fourd.align.options import AlignOptions
from fourd.align.sampling import check_coverage, choose_start, match_frames
from fourd.align.sound import RATE_HZ, check_sound, prepare_sound
from fourd.align.spatiotemporal import SpatiotemporalResult, refine_clocks
from fourd.camera import Camera
from fourd.geometry import look_at
from fourd.stability.case import Outcome, judge, judge_refusal, make_cases, reason_of, relative_difference

FPS = 30.0
NUM_POINTS, NUM_FRAMES = 12, 40
SIZE = (1920, 1080)
OFFSETS_S = np.array([0.0, 0.031, 0.412, -0.155])
MAX_FRAMES = 0.05
EPS = float(np.finfo(np.float64).eps)

Paths = Callable[[np.ndarray, np.ndarray], np.ndarray]


def _wandering(point: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """(N, 3) metres: smooth paths of a person's size and speed."""
    rng = np.random.default_rng(4)
    frequency, phase = rng.uniform(0.3, 1.5, (3, NUM_POINTS, 3)), rng.uniform(0, 6, (3, NUM_POINTS, 3))
    amplitude, middle = rng.uniform(0.05, 0.2, (3, NUM_POINTS, 3)), rng.normal(0, 0.4, (NUM_POINTS, 3))
    angle = 2 * np.pi * frequency[:, point] * time_s[:, None] + phase[:, point]
    return middle[point] + (amplitude[:, point] * np.sin(angle)).sum(axis=0)


def _standing(point: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    return _wandering(point, 0 * time_s)


def _ring(count: int) -> list[Camera]:
    K = np.array([[1500.0, 0, 959.5], [0, 1500, 539.5], [0, 0, 1]])
    cameras = []
    for angle in 2 * np.pi * np.arange(count) / 5:
        R, t = look_at(
            np.array([3 * np.cos(angle), 3 * np.sin(angle), 0.5]), np.zeros(3), np.array([0, 0, 1.0])
        )
        cameras.append(Camera(K, R, t, SIZE))
    return cameras


def _solve(offsets_s: np.ndarray, start_frames: float, paths: Paths = _wandering) -> SpatiotemporalResult:
    """Clocks from what the cameras see of the paths; first guesses are this far off, to either side."""
    rng = np.random.default_rng(0)
    frame, point = (axis.ravel() for axis in np.meshgrid(np.arange(NUM_FRAMES), np.arange(NUM_POINTS)))
    ring = _ring(len(offsets_s))
    pixels = [
        camera.project(paths(point, offset + frame / FPS))[0] + rng.normal(0, 1, (len(frame), 2))
        for camera, offset in zip(ring, offsets_s, strict=True)
    ]
    count = len(ring)
    names = tuple(f"cam{i:02d}" for i in range(count))
    points = MovingPoints(
        names=names,
        cam=np.repeat(np.arange(count), len(frame)),
        point=np.tile(point, count),
        frame=np.tile(frame, count),
        own_s=np.tile(frame / FPS, count),
        pixels=np.concatenate(pixels),
        sigma_px=np.ones(count * len(frame)),
    )
    cameras = [camera for camera in ring for _ in frame]
    off = np.where(np.arange(count) % 2 == 0, start_frames, -start_frames) / FPS
    off[0] = 0
    guesses = {name: CameraClock(float(o + d)) for name, o, d in zip(names, offsets_s, off, strict=True)}
    return refine_clocks(points, cameras, guesses, "cam00")


def _judge_clocks(result: SpatiotemporalResult, offsets_s: np.ndarray) -> Outcome:
    found = np.array([clock.offset_s for clock in result.clocks.values()])
    error = float(np.abs(found - offsets_s).max() * FPS)
    sound = all(clock.status == "ok" for clock in result.clocks.values())
    got = f"within {error:.3f} frames" + ("" if sound else ", a camera refused")
    return judge(sound and error < MAX_FRAMES, got, condition_number=result.condition_number)


def _statuses(result: SpatiotemporalResult) -> str | None:
    """Why cameras are refused, None if one that should be is not."""
    reasons = [clock.status for name, clock in result.clocks.items() if name != "cam00"]
    return None if "ok" in reasons else "; ".join(sorted(set(reasons)))


def observations_at_equal_times() -> Outcome:
    """The clocks: no time between observations of two cameras is no difficulty."""
    offsets = np.zeros(4)
    return _judge_clocks(_solve(offsets, 1.5), offsets)


def observations_a_picosecond_apart() -> Outcome:
    """The clocks, as without the picosecond: the prior divides by no time between observations."""
    offsets = 1e-12 * np.arange(4)
    return _judge_clocks(_solve(offsets, 1.5), offsets)


def all_offsets_at_the_edge_of_the_search() -> Outcome:
    """The clocks."""
    return _judge_clocks(_solve(OFFSETS_S, 2.99), OFFSETS_S)


def all_offsets_beyond_the_search() -> Outcome:
    """Refused, but for cameras whose guesses are off by the same: these are right against each other."""
    clocks = _solve(OFFSETS_S, 9.0).clocks.values()
    errors = [c.offset_s - o for c, o in zip(clocks, OFFSETS_S, strict=True) if c.status == "ok"]
    spread = float(np.ptp(errors) * FPS) if errors else 0.0
    reasons = sorted({clock.status for clock in clocks} - {"ok"})
    return judge_refusal("; ".join(reasons) if reasons and spread < MAX_FRAMES else None)


def nothing_that_moves() -> Outcome:
    """Refused: there is no motion to tell time from."""
    return judge_refusal(_statuses(_solve(OFFSETS_S, 1.0, _standing)), "motion")


def _prior_solve(weight: float) -> Outcome:
    """A trajectory from noisy positions under a prior of some weight, banded against dense."""
    time_s = np.linspace(0, 0.5, 30)
    grid = make_grid(np.zeros(30, np.int64), time_s, time_s, 1 / FPS)
    count = grid.num_coefficients
    data = np.zeros((4, count, 3, 3))
    data[0] = np.eye(3)
    prior = weight * prior_blocks(grid, "force")
    dense = np.eye(count)
    for lag in range(4):
        dense += np.diag(prior[lag, : count - lag], lag) + (
            np.diag(prior[lag, : count - lag], -lag) if lag else 0
        )
    side = np.random.default_rng(0).normal(size=(count, 3))
    found = BandedNormal(data, prior).solve(side.ravel()).reshape(count, 3)
    # Long double is the judge: both solves lose the digits that the condition takes.
    expected = _solve_extended(dense, side)
    condition = float(np.linalg.cond(dense))
    error = relative_difference(found, expected)
    # The ridge that keeps the factor positive moves the solution too.
    bound = 10 * EPS * condition + 2 * DIMENSION * RIDGE
    return judge(error < bound, f"within {error:.1g}", condition_number=condition)


def _solve_extended(matrix: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Solution with residuals in extended precision: the float64 solution, refined until it stands."""
    solution = np.linalg.solve(matrix, side).astype(np.longdouble)
    for _ in range(10):
        residual = side - matrix.astype(np.longdouble) @ solution
        solution = solution + np.linalg.solve(matrix, residual.astype(np.float64))
    return solution.astype(np.float64)


def motion_prior_of_no_weight() -> Outcome:
    """As exact as the condition allows."""
    return _prior_solve(1e-12)


def stiff_motion_prior() -> Outcome:
    """As exact as the condition allows."""
    return _prior_solve(1e3)


def two_pictures_at_one_time() -> Outcome:
    """The earlier of two pictures with one time stamp, and a time for every frame."""
    common_s = np.array([0.0, 1 / 30, 1 / 30, 1 / 15])
    frames, dt_s = match_frames(common_s, FPS, 3, 0.0)
    return judge(frames.tolist() == [0, 1, 3] and bool(np.abs(dt_s).max() < 1e-9), f"{frames.tolist()}")


def _coverage(first_s: float, last_s: float) -> str | None:
    common_s = np.arange(first_s, last_s, 1 / FPS)
    _, dt_s = match_frames(common_s, FPS, 60, 0.0)
    status = check_coverage("cam01", "film.mp4", common_s, dt_s, FPS, 0.0, 0.75)
    return None if status == "ok" else status


def camera_that_starts_late() -> Outcome:
    """Left out: it starts too late, and by how much."""
    return judge_refusal(_coverage(0.5, 3.0), "starts too late")


def camera_that_ends_early() -> Outcome:
    """Left out: it ends too early, and by how much."""
    return judge_refusal(_coverage(-1.0, 1.5), "ends too early")


def camera_of_another_day() -> Outcome:
    """Left out: it filmed at another time."""
    return judge_refusal(_coverage(86400.0, 86403.0), "another time")


def films_that_do_not_overlap() -> Outcome:
    """Refused: which two do not."""
    clocks = {"cam00": CameraClock(0.0), "cam01": CameraClock(100.0)}
    pts = {name: np.arange(60) / FPS for name in clocks}
    return judge_refusal(reason_of(choose_start, clocks, pts, FPS, 30), "cam01")


def clock_of_a_thousandth_too_fast() -> Outcome:
    """Own and common time convert into each other to rounding, after a year."""
    clock = CameraClock(1.7e9, 1000.0)
    own = np.array([0.0, 3.2e7])
    error = relative_difference(clock.own_time(clock.common_time(own)), own)
    return judge(error < 1e-13, f"within {error:.1g}", error)


def _sound(first_s: float, duration_s: float, seed: int) -> np.ndarray:
    """What one of two microphones hears of a noisy place, with a noise of its own."""
    rng = np.random.default_rng(9)
    count = int(16 * RATE_HZ)
    knots = np.arange(0, count + 4000, 4000)
    place = (
        0.1 * np.interp(np.arange(count), knots, rng.uniform(0.1, 1, len(knots))) * rng.standard_normal(count)
    )
    first = round(first_s * RATE_HZ)
    piece = place[first : first + int(duration_s * RATE_HZ)]
    return (piece + 0.02 * np.random.default_rng(seed).standard_normal(len(piece))).astype(np.float32)


def _listen(delay_s: float, max_delay_s: float) -> tuple[float, str]:
    left, right = (prepare_sound(_sound(s, 8.0, i), RATE_HZ) for i, s in enumerate((1.0, 1.0 + delay_s)))
    options = dataclasses.replace(AlignOptions(), max_delay_s=max_delay_s)
    delay = estimate_audio_delay(left, right, ("cam00", "cam01"), options).delay
    return delay.delay_s, delay.status


def sound_delayed_to_the_edge_of_the_search() -> Outcome:
    """The delay."""
    found, status = _listen(3.0, 3.0)
    return judge(status == "ok" and abs(found - 3) < 1e-3, f"{found:.4f} s, {status}")


def sound_delayed_beyond_the_search() -> Outcome:
    """Refused: no delay stands out."""
    found, status = _listen(4.0, 3.0)
    return judge_refusal(None if status == "ok" else status, "stands out")


def sound_of_one_level() -> Outcome:
    """Refused: silent."""
    return judge_refusal(check_sound(np.full(RATE_HZ, 0.25, np.float32), RATE_HZ), "silent")


CASES = make_cases(
    "clocks",
    observations_at_equal_times,
    observations_a_picosecond_apart,
    all_offsets_at_the_edge_of_the_search,
    all_offsets_beyond_the_search,
    nothing_that_moves,
    motion_prior_of_no_weight,
    stiff_motion_prior,
    two_pictures_at_one_time,
    camera_that_starts_late,
    camera_that_ends_early,
    camera_of_another_day,
    films_that_do_not_overlap,
    clock_of_a_thousandth_too_fast,
    sound_delayed_to_the_edge_of_the_search,
    sound_delayed_beyond_the_search,
    sound_of_one_level,
)
