"""One group of cameras solved together, and what speaks against a camera's clock."""

import dataclasses

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from fourd.align.joint_solve import Limits, clock_covariance, solve_jointly, start_fit
from fourd.align.point_observations import Observations, connected, most_moving
from fourd.align.spatiotemporal_options import SpatiotemporalOptions
from fourd.align.trajectory_fit import Clocks, Fit, Unknowns, linearise, squared_lengths

OFFSET, RATE, READOUT = range(3)
MIN_OBSERVATIONS = 30
MIN_POINTS = 2
# What is known beforehand: crystals of phones, and the slowest of rolling shutters.
RATE_SIGMA = 100e-6
READOUT_SIGMA_S = 0.03
# An observation counts if another camera sees the point within REACH frames; trajectories are cut at gaps.
REACH_FRAMES = 4
GAP_FRAMES = 15
INLIER_SIGMA = 4.0
# Noise above this many times the stated one is no noise: a camera that does not belong raises it for all.
MAX_SCALE = 3.0
EDGE = 1e-3
# Shares of half a frame by which clocks may still move when a solve ends; rough where few points serve.
TOLERANCE = 4e-4
ROUGH_TOLERANCE = 0.04


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """All observations and what is known of the clocks beforehand.

    frame_s: (C,) distance of two frames;  search_s: (C,) how far an offset may move from the guess
    """

    observations: Observations
    guess: Clocks
    frame_s: np.ndarray
    search_s: np.ndarray
    options: SpatiotemporalOptions

    @property
    def spacing_s(self) -> float:
        """Distance of the knots, s."""
        return self.options.knot_spacing_frames * float(np.median(self.frame_s))


@dataclasses.dataclass(frozen=True, eq=False)
class GroupFit:
    """A solved group. cams: (G,) cameras in it;  sigma_s: (C,) of a frame's common time, NaN outside it

    anchor: the camera whose clock stayed as it was;  reasons: camera -> why its clock is not determined
    """

    fit: Fit | None
    cams: np.ndarray
    anchor: int
    sigma_s: np.ndarray
    inliers: np.ndarray
    condition_number: float
    reasons: dict[int, str]


def solve_group(
    problem: Problem, clocks: Clocks, cams: np.ndarray, anchor: int, max_points: int | None = None
) -> GroupFit:
    """Clocks and trajectories of some cameras, from given clocks; the anchor's clock stays.

    cams: (G,) int64 cameras;  max_points: use only this many trajectories, those that move most
    A camera that sees too little with the others gets a reason and keeps its clock.
    """
    observations, poor = _common_observations(problem, clocks, cams)
    if max_points is not None:
        observations = most_moving(observations, max_points)
    inside = np.array([cam for cam in cams if cam not in poor], dtype=np.int64)
    sigma_s = np.full(len(problem.frame_s), np.nan)
    inliers = np.zeros(len(problem.frame_s))
    if len(inside) < 2:
        reasons = {int(cam): poor.get(int(cam), "no other camera sees its points") for cam in cams}
        return GroupFit(None, inside, anchor, sigma_s, inliers, np.inf, reasons)
    anchor = anchor if anchor in inside else int(inside[0])
    clocks = _anchored(clocks, problem.guess, anchor)
    unknowns = _unknowns(problem, inside, anchor)
    margin_s = float(2 * problem.search_s.max())
    fit = start_fit(observations, clocks, problem.spacing_s, margin_s, problem.options.prior)
    limits = _limits(problem, unknowns, anchor)
    fit = solve_jointly(fit, unknowns, limits, TOLERANCE if max_points is None else ROUGH_TOLERANCE)
    covariance, condition = clock_covariance(fit, unknowns)
    for cam in inside:
        sigma_s[cam] = _sigma_of_frame(observations, unknowns, covariance, cam)
    lin = linearise(observations, fit.grid, fit.coefficients, fit.clocks)
    squared = squared_lengths(lin, min(fit.scale, MAX_SCALE))
    for cam in inside:
        inliers[cam] = float(np.mean(squared[observations.cam == cam] < INLIER_SIGMA**2))
    group = GroupFit(fit, inside, anchor, sigma_s, inliers, condition, {})
    return dataclasses.replace(group, reasons=poor | _doubts(problem, group, unknowns, limits))


def _common_observations(
    problem: Problem, clocks: Clocks, cams: np.ndarray
) -> tuple[Observations, dict[int, str]]:
    """Observations of points that two cameras of the group see; cameras with too few are left out."""
    poor: dict[int, str] = {}
    times = clocks.times(problem.observations)
    slowest = float(problem.frame_s[cams].max())
    while True:
        mask = np.zeros(len(problem.frame_s), dtype=bool)
        mask[[cam for cam in cams if cam not in poor]] = True
        observations = connected(
            problem.observations, times, mask, REACH_FRAMES * slowest, GAP_FRAMES * slowest
        )
        found = {}
        for cam in np.flatnonzero(mask):
            seen = observations.cam == cam
            num_points = len(np.unique(observations.point[seen]))
            if seen.sum() < MIN_OBSERVATIONS or num_points < MIN_POINTS:
                found[int(cam)] = (
                    f"too few common points: {num_points} moving points seen {seen.sum()} times together "
                    f"with another camera, {MIN_POINTS} points and {MIN_OBSERVATIONS} times are needed"
                )
        found = found or _apart(observations)
        poor |= found
        if not found:
            return observations, poor


def _apart(observations: Observations) -> dict[int, str]:
    """Cameras that no chain of common points joins with most of the others.

    Such an island may shift in time as a whole; only its prior would hold it.
    """
    num_points = int(observations.point.max(initial=-1)) + 1
    sees = np.zeros((observations.num_cams, num_points))
    sees[observations.cam, observations.point] = 1
    island = connected_components(csr_array(sees @ sees.T), directed=False)[1]
    main = np.argmax(np.bincount(island[observations.cam])) if num_points else 0
    return {
        int(cam): "too few common points: it shares none with the main group of cameras"
        for cam in np.unique(observations.cam)
        if island[cam] != main
    }


def _anchored(clocks: Clocks, guess: Clocks, anchor: int) -> Clocks:
    """All clocks moved together so that the anchor's is the one given."""
    shift_s = guess.offset_s[anchor] - clocks.offset_s[anchor]
    rate, readout_s = clocks.rate.copy(), clocks.readout_s.copy()
    rate[anchor] = guess.rate[anchor]
    return Clocks(clocks.offset_s + shift_s, rate, readout_s)


def _unknowns(problem: Problem, inside: np.ndarray, anchor: int) -> Unknowns:
    options, guess = problem.options, problem.guess
    others = inside[inside != anchor]
    blocks = [(OFFSET, others, guess.offset_s, np.inf)]
    if options.estimate_rate:
        blocks.append((RATE, others, guess.rate, RATE_SIGMA))
    if options.estimate_readout:
        blocks.append((READOUT, inside, guess.readout_s, READOUT_SIGMA_S))
    return Unknowns(
        kind=np.concatenate([np.full(len(cams), kind) for kind, cams, _, _ in blocks]),
        cam=np.concatenate([cams for _, cams, _, _ in blocks]),
        guess=np.concatenate([values[cams] for _, cams, values, _ in blocks]),
        sigma=np.concatenate([np.full(len(cams), sigma) for _, cams, _, sigma in blocks]),
    )


def _limits(problem: Problem, unknowns: Unknowns, anchor: int) -> Limits:
    """Offsets within the search, rates and readouts within ten and three standard deviations."""
    search_s = problem.search_s[unknowns.cam] + problem.search_s[anchor]
    reach = np.where(unknowns.kind == OFFSET, search_s, 10 * RATE_SIGMA)
    reach = np.where(unknowns.kind == READOUT, 3 * READOUT_SIGMA_S, reach)
    lower = unknowns.guess - reach
    lower = np.where(unknowns.kind == READOUT, np.maximum(lower, 0), lower)
    box = np.where(unknowns.kind == RATE, RATE_SIGMA, problem.frame_s[unknowns.cam] / 2)
    return Limits(lower, unknowns.guess + reach, box)


def _sigma_of_frame(
    observations: Observations, unknowns: Unknowns, covariance: np.ndarray, cam: int
) -> float:
    """Standard deviation of the common time of a frame in the middle of what the camera saw."""
    own = observations.own_s[observations.cam == cam]
    factor = np.array([1.0, float(own.mean()), 0.0])[unknowns.kind] * (unknowns.cam == cam)
    return float(np.sqrt(max(factor @ covariance @ factor, 0.0)))


def _doubts(problem: Problem, group: GroupFit, unknowns: Unknowns, limits: Limits) -> dict[int, str]:
    """Cameras of a solved group whose clocks cannot be trusted, and why."""
    assert group.fit is not None
    options = problem.options
    now = group.fit.clocks.at(unknowns)
    at_edge = (now - limits.lower < EDGE * limits.box) | (limits.upper - now < EDGE * limits.box)
    reasons: dict[int, str] = {}
    for cam in group.cams:
        frame_s = float(problem.frame_s[cam])
        frames = float(group.sigma_s[cam]) / frame_s
        if group.inliers[cam] < options.min_inliers:
            reasons[int(cam)] = (
                f"only {100 * group.inliers[cam]:.0f} % of its observations agree with the other cameras at "
                "any offset: its cost has no valley"
            )
        elif frames > options.max_sigma_frames:
            reasons[int(cam)] = _why_uncertain(group.fit, int(cam), frame_s, frames)
        elif np.any(at_edge & (unknowns.cam == cam) & (unknowns.kind == OFFSET)):
            reasons[int(cam)] = (
                f"its offset lies at the edge of the search, {problem.search_s[cam] / frame_s:.3g} frames "
                "from the guess"
            )
    return reasons


def _why_uncertain(fit: Fit, cam: int, frame_s: float, sigma_frames: float) -> str:
    lin = linearise(fit.observations, fit.grid, fit.coefficients, fit.clocks)
    step = np.sqrt((lin.by_time[fit.observations.cam == cam] ** 2).sum(axis=1)) * frame_s
    speed = float(np.median(step)) / fit.scale
    if speed < 1:
        return (
            f"no motion: its points move {speed:.2g} times the noise from frame to frame, and its clock "
            f"stays uncertain by {sigma_frames:.2g} frames"
        )
    return (
        f"the motion does not determine its clock: points move along epipolar lines or too few agree, and it "
        f"stays uncertain by {sigma_frames:.2g} frames"
    )
