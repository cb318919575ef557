"""Spatiotemporal bundle adjustment: clocks of cameras from the motion of points that several of them see.

docs/spatiotemporal.md derives the formulation. After M. Vo, S. Narasimhan, Y. Sheikh, "Spatiotemporal
Bundle Adjustment for Dynamic 3D Reconstruction", CVPR 2016, with trajectories that are continuous in time.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from fourd.align.clock import PPM, CameraClock, PairDelay
from fourd.align.clock_group import INLIER_SIGMA, GroupFit, Problem, solve_group
from fourd.align.incremental import grow, measure_delays
from fourd.align.motion_prior import ORDER_OF_PRIOR, SplineGrid
from fourd.align.moving_points import MovingPoints
from fourd.align.point_observations import prepare_observations
from fourd.align.spatiotemporal_options import SpatiotemporalOptions
from fourd.align.trajectory_fit import Clocks, Fit, linearise, squared_lengths
from fourd.camera import Camera
from fourd.errors import InputError

STARTS = ("incremental", "joint")
# A clock that is uncertain by this much of a frame gets half the score of a certain one.
HALF_SCORE_FRAMES = 0.25


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectories:
    """Paths of the moving points over the common clock.

    point: (M,) int64 number of each trajectory's point; a point out of sight for long has several
    first_s, last_s: (M,) common time between which it was seen
    """

    grid: SplineGrid
    coefficients: np.ndarray
    point: np.ndarray
    first_s: np.ndarray
    last_s: np.ndarray

    def positions(self, trajectory: np.ndarray, common_s: np.ndarray) -> np.ndarray:
        """(N, 3) world positions of trajectories (N,) in 0..M-1 at times (N,); NaN when out of sight."""
        world = self.grid.evaluate(self.coefficients, trajectory, common_s)
        seen = (self.first_s[trajectory] <= common_s) & (common_s <= self.last_s[trajectory])
        return np.where(seen[:, None], world, np.nan)


@dataclasses.dataclass(frozen=True, eq=False)
class SpatiotemporalResult:
    """Refined clocks and what came with them.

    clocks: one per camera; status says why a camera is refused (then its clock is the one given)
    readout_s: time from the first to the last row of a picture, per camera
    trajectories: None where no two cameras could be joined;  influence: (N,) 0..1 per observation given,
    small for outliers, 0 where it was not used
    prior_weight: (pixel residuals in stated sigmas)^2 per unit of motion energy (world units, seconds)
    noise_scale: noise found over noise stated;  reprojection_error_px: RMS over inliers
    condition_number: of the normal matrix of the clocks after elimination of the trajectories
    """

    clocks: dict[str, CameraClock]
    readout_s: dict[str, float]
    trajectories: Trajectories | None
    influence: np.ndarray
    prior_weight: float
    noise_scale: float
    reprojection_error_px: float
    condition_number: float
    pairs: tuple[PairDelay, ...]


def refine_clocks(
    points: MovingPoints,
    cameras: Sequence[Camera],
    clocks: Mapping[str, CameraClock],
    reference: str,
    options: SpatiotemporalOptions | None = None,
    readout_s: Mapping[str, float] | None = None,
) -> SpatiotemporalResult:
    """Clocks to a small part of a frame, from first guesses that are a few frames off.

    cameras: one per observation, in its order; the same object may stand for many
    clocks: a guess per camera; the search goes max(search_frames, 3 sigma_s) to both sides
    reference: its clock stays as it is, unless it is refused: then the others keep that of one of them
    readout_s: rolling-shutter time of a picture per camera, 0 where not given
    Cameras that cannot be placed are refused in their status. Raises InputError for unusable input.
    """
    options = options or SpatiotemporalOptions()
    problem = _make_problem(points, cameras, clocks, reference, options, readout_s or {})
    anchor = points.names.index(reference)
    everyone = list(range(len(points.names)))
    start, group, reasons, pairs = problem.guess, everyone, {}, ()
    if options.start == "incremental" and len(everyone) > 2:
        rough = dataclasses.replace(options, estimate_rate=False, estimate_readout=False)
        rough_problem = dataclasses.replace(problem, options=rough)
        delays = measure_delays(rough_problem, problem.guess)
        start, group, reasons = grow(rough_problem, problem.guess, delays)
        pairs = delays.to_pairs(points.names)
        group = group or everyone
    result, more = _solve_until_sound(problem, start, group, anchor)
    reasons = {cam: why for cam, why in (reasons | more).items() if cam not in result.cams}
    return _assemble(points, clocks, problem, result, reasons, anchor, pairs)


def _solve_until_sound(
    problem: Problem, clocks: Clocks, group: list[int], anchor: int
) -> tuple[GroupFit, dict[int, str]]:
    """Joint solves, each without the most doubtful camera of the one before."""
    refused: dict[int, str] = {}
    while True:
        result = solve_group(problem, clocks, np.array(group, dtype=np.int64), anchor)
        refused |= result.reasons
        doubtful = [cam for cam in result.reasons if cam in result.cams]
        if result.fit is None or not doubtful:
            return result, refused
        if len(doubtful) >= len(result.cams) - 1:
            # Not one clock is determined against another: a smaller group would fare no better.
            for cam in result.cams.tolist():
                refused.setdefault(cam, "no other camera's clock is determined against it")
            return dataclasses.replace(result, fit=None, cams=result.cams[:0]), refused
        worst = max(doubtful, key=lambda cam: (-result.inliers[cam], result.sigma_s[cam]))
        group = [cam for cam in result.cams.tolist() if cam != worst]


def _make_problem(
    points: MovingPoints,
    cameras: Sequence[Camera],
    clocks: Mapping[str, CameraClock],
    reference: str,
    options: SpatiotemporalOptions,
    readout_s: Mapping[str, float],
) -> Problem:
    missing = [name for name in points.names if name not in clocks]
    if missing or reference not in points.names:
        raise InputError(
            f"clocks: expected a first guess for each of {', '.join(points.names)} and the reference among "
            f"them, got none for {', '.join(missing) or '-'} and reference {reference}"
        )
    if options.prior not in ORDER_OF_PRIOR or options.start not in STARTS:
        raise InputError(
            f"align: expected prior {' or '.join(ORDER_OF_PRIOR)} and start {' or '.join(STARTS)}, "
            f"got {options.prior} and {options.start}"
        )
    observations = prepare_observations(points, cameras)
    given = [clocks[name] for name in points.names]
    guess = Clocks(
        offset_s=np.array([clock.offset_s for clock in given]),
        rate=np.array([clock.rate_ppm * PPM for clock in given]),
        readout_s=np.array([readout_s.get(name, 0.0) for name in points.names]),
    )
    frame_s = _frame_distances(points)
    search_s = np.maximum(options.search_frames * frame_s, 3 * np.array([c.sigma_s for c in given]))
    search_s[points.names.index(reference)] = 0
    return Problem(observations, guess, frame_s, search_s, options)


def _frame_distances(points: MovingPoints) -> np.ndarray:
    """(C,) median time from frame to frame, s; the median of the others where a camera has one frame."""
    frame_s = np.full(len(points.names), np.nan)
    for cam in range(len(points.names)):
        frames, first = np.unique(points.frame[points.cam == cam], return_index=True)
        own_s = points.own_s[points.cam == cam][first]
        if len(frames) > 1:
            frame_s[cam] = np.median(np.diff(own_s) / np.diff(frames))
    if not np.any(frame_s > 0):
        raise InputError("moving points: expected several frames per camera, got one: nothing can be aligned")
    return np.where(frame_s > 0, frame_s, np.median(frame_s[frame_s > 0]))


def _assemble(
    points: MovingPoints,
    given: Mapping[str, CameraClock],
    problem: Problem,
    group: GroupFit,
    reasons: dict[int, str],
    anchor: int,
    pairs: tuple[PairDelay, ...],
) -> SpatiotemporalResult:
    clocks = {}
    fitted = problem.guess if group.fit is None else group.fit.clocks
    for cam, name in enumerate(points.names):
        if group.fit is None or cam not in group.cams:
            why = reasons.get(cam, "it cannot be joined with any other camera")
            clocks[name] = dataclasses.replace(given[name], score=0.0, status=why)
            continue
        frames = group.sigma_s[cam] / problem.frame_s[cam]
        clocks[name] = CameraClock(
            offset_s=float(fitted.offset_s[cam]),
            rate_ppm=float(fitted.rate[cam] / PPM),
            sigma_s=float(group.sigma_s[cam]),
            score=float(group.inliers[cam] / (1 + (frames / HALF_SCORE_FRAMES) ** 2)),
            method="reference" if cam == anchor else "vision",
        )
    influence = np.zeros(len(points.cam))
    result = SpatiotemporalResult(
        clocks=clocks,
        readout_s=dict(zip(points.names, fitted.readout_s.tolist(), strict=True)),
        trajectories=None,
        influence=influence,
        prior_weight=float("nan"),
        noise_scale=float("nan"),
        reprojection_error_px=float("nan"),
        condition_number=group.condition_number,
        pairs=pairs,
    )
    if group.fit is None:
        return result
    observations, unit = group.fit.observations, group.fit.observations.unit
    influence[observations.source] = group.fit.influence
    lin = linearise(observations, group.fit.grid, group.fit.coefficients, group.fit.clocks)
    inlier = squared_lengths(lin, group.fit.scale) < INLIER_SIGMA**2
    pixels = (lin.residual * observations.sigma_px[:, None])[inlier]
    return dataclasses.replace(
        result,
        trajectories=_trajectories(points, group.fit),
        prior_weight=float(np.median(group.fit.weight)) / unit**2,
        noise_scale=group.fit.scale,
        reprojection_error_px=float(np.sqrt((pixels**2).sum(axis=1).mean())),
    )


def _trajectories(points: MovingPoints, fit: Fit) -> Trajectories:
    observations = fit.observations
    times = fit.clocks.times(observations)
    num = len(fit.grid.first)
    first_s, last_s = np.full(num, np.inf), np.full(num, -np.inf)
    np.minimum.at(first_s, observations.point, times)
    np.maximum.at(last_s, observations.point, times)
    point = np.zeros(num, dtype=np.int64)
    point[observations.point] = points.point[observations.source]
    world = fit.coefficients * observations.unit + observations.origin
    return Trajectories(fit.grid, world, point, first_s, last_s)
