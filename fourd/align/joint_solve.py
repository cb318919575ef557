"""Levenberg-Marquardt on clocks and trajectories, with the prior's weight estimated on the way."""

import dataclasses

import numpy as np

from fourd.align.motion_prior import (
    DIMENSION,
    BandedNormal,
    make_grid,
    multiply_prior,
    prior_blocks,
    prior_ranks,
)
from fourd.align.point_observations import Observations
from fourd.align.trajectory_fit import (
    RAYLEIGH_MEDIAN,
    ROBUST_WIDTH,
    Clocks,
    Fit,
    Linearised,
    Unknowns,
    data_blocks,
    linearise,
    robust_influence,
    scatter,
    squared_lengths,
    time_factors,
)

# The noise may turn out this much smaller than stated, not less: a perfect fit has no scale.
MIN_SCALE = 0.1
# Mean influence of an observation with normal noise under the Cauchy loss of ROBUST_WIDTH 3.
INLIER_INFLUENCE = 0.84
WEIGHT_RANGE = 1e10
MIN_FREEDOM = 0.02
LINEAR_ROUNDS = 4
MIN_LINEAR_DEPTH = 0.1
# A trajectory's own energy counts as much as the common one when the data determine this many directions.
SHRINKAGE = 30.0
MAX_STEPS = 8
EXTRA_ROUNDS = 12
COST_TOLERANCE = 1e-4


def start_fit(
    observations: Observations, clocks: Clocks, spacing_s: float, margin_s: float, prior: str
) -> Fit:
    """Trajectories at fixed clocks, by linear least squares; noise and the prior's weight from the data.

    spacing_s: distance of the knots;  margin_s: how far any observation's time may still move
    """
    times = clocks.times(observations)
    grid = make_grid(observations.point, times - margin_s, times + margin_s, spacing_s)
    num = grid.num_coefficients
    fit = Fit(
        observations=observations,
        grid=grid,
        prior=prior_blocks(grid, prior),
        ranks=prior_ranks(grid, prior),
        clocks=clocks,
        coefficients=np.zeros((num, DIMENSION)),
        weight=np.zeros(len(grid.first)),
        scale=1.0,
        influence=np.ones(len(times)),
    )
    lin = linearise(observations, grid, fit.coefficients, clocks)
    depth = np.ones(len(times))
    for turn in range(LINEAR_ROUNDS):
        rows, right = _linear_rows(observations, depth)
        flat = dataclasses.replace(lin, by_position=rows)
        data = data_blocks(flat, fit.influence, num)
        if turn == 0:
            fit = dataclasses.replace(fit, weight=np.full(len(grid.first), _neutral_weight(data, fit.prior)))
        b = scatter(flat, np.einsum("n,nki,nk->ni", fit.influence, rows, right), num)
        solution = BandedNormal(data, fit.weighted_prior).solve(b.ravel()).reshape(num, DIMENSION)
        fit = dataclasses.replace(fit, coefficients=solution)
        lin = linearise(observations, grid, solution, clocks)
        position = grid.evaluate(solution, observations.point, times)
        third = observations.projection[:, 2]
        depth = np.maximum(np.einsum("nj,nj->n", third[:, :3], position) + third[:, 3], MIN_LINEAR_DEPTH)
        fit = with_estimates(fit, lin, data)
    return fit


def _linear_rows(observations: Observations, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2, 3) rows and (N, 2) right sides of pixel * depth = projection, divided by a known depth."""
    projection, pixels = observations.projection, observations.pixels
    rows = projection[:, :2, :3] - pixels[:, :, None] * projection[:, 2:, :3]
    right = pixels * projection[:, 2:, 3] - projection[:, :2, 3]
    divisor = depth * observations.sigma_px
    return rows / divisor[:, None, None], right / divisor[:, None]


def _neutral_weight(data: np.ndarray, blocks: np.ndarray) -> float:
    """The weight at which data and prior are equally stiff."""
    return float(np.trace(data[0], axis1=1, axis2=2).sum() / (DIMENSION * blocks[0].sum()))


def with_estimates(fit: Fit, lin: Linearised, data: np.ndarray) -> Fit:
    """The same state with noise, weights and influences renewed: one round of their fixed point.

    The noise comes from the median residual, corrected for the parameters that the fit spent; the weight
    from the energy that trajectories have per direction that the data determine. Each trajectory has its
    own, drawn towards the common one like SHRINKAGE more directions.
    Source: D. MacKay, "Bayesian Interpolation", 1992, on the weights alpha and beta.
    """
    step = 1e-3
    prior = fit.weighted_prior
    upper = BandedNormal(data, prior * np.exp(step)).log_determinants
    lower = BandedNormal(data, prior * np.exp(-step)).log_determinants
    by_prior = fit.grid.per_trajectory(upper - lower) / (2 * step)
    spent = fit.coefficients.size - by_prior.sum()
    num_inliers = min(fit.influence.sum() / INLIER_INFLUENCE, len(lin.residual))
    freedom = max(1 - spent / (2 * num_inliers), MIN_FREEDOM)
    median = float(np.median(np.sqrt(squared_lengths(lin, 1.0))))
    scale = max(median / RAYLEIGH_MEDIAN / np.sqrt(freedom), MIN_SCALE)
    product = fit.coefficients * multiply_prior(fit.prior, fit.coefficients)
    energy = np.maximum(fit.grid.per_trajectory(product.sum(axis=1)), 0)
    determined = np.clip(fit.ranks - by_prior, 1e-6 * fit.ranks, None)
    common = energy.sum() / determined.sum()
    energy_each = (energy + SHRINKAGE * common) / (determined + SHRINKAGE)
    neutral = _neutral_weight(data, fit.prior)
    weight = np.clip(
        scale**2 / np.maximum(energy_each, 1e-300), neutral / WEIGHT_RANGE, neutral * WEIGHT_RANGE
    )
    return dataclasses.replace(fit, weight=weight, scale=scale, influence=robust_influence(lin, scale))


@dataclasses.dataclass(frozen=True, eq=False)
class Reduced:
    """The step of the clocks after elimination of the trajectories, and what it came from.

    schur: (P, P) normal matrix of the clocks;  gradient: (P,);  coupling: (K * 3, P)
    """

    normal: BandedNormal
    residual_side: np.ndarray
    coupling: np.ndarray
    eliminated: np.ndarray
    schur: np.ndarray
    gradient: np.ndarray

    def coefficients_step(self, clock_step: np.ndarray) -> np.ndarray:
        """(K, 3) step of the trajectories that belongs to a step (P,) of the clocks."""
        step = -self.normal.solve(self.residual_side) - self.eliminated @ clock_step
        return step.reshape(-1, DIMENSION)


def reduce(fit: Fit, lin: Linearised, unknowns: Unknowns, damping: float) -> Reduced:
    """Normal equations with the trajectories eliminated (Schur complement)."""
    num = fit.grid.num_coefficients
    influence = fit.influence
    data = data_blocks(lin, influence, num)
    diagonal = np.arange(DIMENSION)
    data[0][:, diagonal, diagonal] *= 1 + damping
    prior = fit.weighted_prior
    normal = BandedNormal(data, prior)
    weighted = influence[:, None] * lin.residual
    side = scatter(lin, np.einsum("nki,nk->ni", lin.by_position, weighted), num)
    side += multiply_prior(prior, fit.coefficients)
    num_unknowns = len(unknowns.kind)
    coupling = np.zeros((num * DIMENSION, num_unknowns))
    stiffness = np.zeros((num_unknowns, num_unknowns))
    gradient = np.zeros(num_unknowns)
    cross = influence[:, None] * np.einsum("nki,nk->ni", lin.by_position, lin.by_time)
    speed = influence * (lin.by_time**2).sum(axis=1)
    pull = (lin.by_time * weighted).sum(axis=1)
    factors = time_factors(fit.observations, unknowns)
    for p, (index, factor) in enumerate(factors):
        part = dataclasses.replace(lin, start=lin.start[index], basis=lin.basis[index])
        coupling[:, p] = scatter(part, cross[index] * factor[:, None], num).ravel()
        gradient[p] = pull[index] @ factor
        for q, (_, other) in enumerate(factors):
            if unknowns.cam[p] == unknowns.cam[q]:
                stiffness[p, q] = (speed[index] * factor) @ other
    known = fit.scale**2 / unknowns.sigma**2
    gradient += known * (fit.clocks.at(unknowns) - unknowns.guess)
    stiffness += np.diag(known)
    eliminated = normal.solve(coupling)
    schur = stiffness - coupling.T @ eliminated
    gradient -= eliminated.T @ side.ravel()
    return Reduced(normal, side.ravel(), coupling, eliminated, schur, gradient)


def cost_of(fit: Fit, lin: Linearised, unknowns: Unknowns) -> float:
    """Robust squared residuals plus the prior's energy plus what is known of the clocks."""
    squared = squared_lengths(lin, fit.scale)
    loss = (fit.scale * ROBUST_WIDTH) ** 2 * float(np.log1p(squared / ROBUST_WIDTH**2).sum())
    energy = float((fit.coefficients * multiply_prior(fit.weighted_prior, fit.coefficients)).sum())
    away = (fit.clocks.at(unknowns) - unknowns.guess) / unknowns.sigma
    return loss + energy + fit.scale**2 * float(away @ away)


def improve(fit: Fit, unknowns: Unknowns, lower: np.ndarray, upper: np.ndarray, tolerance: float) -> Fit:
    """Steps at fixed weight and noise, the clock parameters kept within a box (P,).

    tolerance: relative decrease of the cost at which to stop
    """
    lin = linearise(fit.observations, fit.grid, fit.coefficients, fit.clocks)
    fit = dataclasses.replace(fit, influence=robust_influence(lin, fit.scale))
    cost = cost_of(fit, lin, unknowns)
    damping = 1e-6
    for _ in range(MAX_STEPS):
        reduced = reduce(fit, lin, unknowns, damping)
        trial = _stepped(fit, reduced, unknowns, lower, upper, damping)
        trial_lin = linearise(fit.observations, fit.grid, trial.coefficients, trial.clocks)
        trial_cost = cost_of(trial, trial_lin, unknowns)
        if not trial_cost < cost:
            damping = max(damping, 1e-6) * 100
            if damping > 1e6:
                break
            continue
        decrease = (cost - trial_cost) / max(cost, 1e-300)
        cost, lin = trial_cost, trial_lin
        fit = dataclasses.replace(trial, influence=robust_influence(lin, fit.scale))
        damping = damping / 10
        if decrease < tolerance:
            break
    return fit


def _stepped(
    fit: Fit, reduced: Reduced, unknowns: Unknowns, lower: np.ndarray, upper: np.ndarray, damping: float
) -> Fit:
    now = fit.clocks.at(unknowns)
    step = np.clip(now - solve_clocks(reduced.schur, reduced.gradient, damping), lower, upper) - now
    coefficients = fit.coefficients + reduced.coefficients_step(step)
    return dataclasses.replace(fit, clocks=fit.clocks.moved(unknowns, step), coefficients=coefficients)


def solve_clocks(schur: np.ndarray, gradient: np.ndarray, damping: float) -> np.ndarray:
    """Damped solution; directions that the data do not see are left where they are."""
    diagonal = np.sqrt(np.maximum(np.diag(schur), 1e-300))
    scaled = schur / np.outer(diagonal, diagonal) + damping * np.eye(len(schur))
    return np.linalg.lstsq(scaled, gradient / diagonal, rcond=1e-12)[0] / diagonal


@dataclasses.dataclass(frozen=True, eq=False)
class Limits:
    """How far the clock parameters (P,) may go: in all, and in one round."""

    lower: np.ndarray
    upper: np.ndarray
    box: np.ndarray


def solve_jointly(fit: Fit, unknowns: Unknowns, limits: Limits, tolerance: float) -> Fit:
    """Rounds of steps inside a box of half a frame, the prior's weight and the noise renewed after each.

    tolerance: the rounds end when no parameter moves by more than this share of its box
    The box moves with the clocks, within the limits.
    """
    num_rounds = int(np.ceil((limits.upper - limits.lower) / limits.box).max(initial=0)) + EXTRA_ROUNDS
    for _ in range(num_rounds):
        before = fit.clocks.at(unknowns)
        lower = np.maximum(before - limits.box, limits.lower)
        upper = np.minimum(before + limits.box, limits.upper)
        fit = renew_weight(improve(fit, unknowns, lower, upper, COST_TOLERANCE))
        if np.all(np.abs(fit.clocks.at(unknowns) - before) <= tolerance * limits.box):
            break
    return fit


def renew_weight(fit: Fit) -> Fit:
    """The same state with weight, noise and influences estimated at it."""
    lin = linearise(fit.observations, fit.grid, fit.coefficients, fit.clocks)
    return with_estimates(fit, lin, data_blocks(lin, fit.influence, fit.grid.num_coefficients))


def clock_covariance(fit: Fit, unknowns: Unknowns) -> tuple[np.ndarray, float]:
    """(P, P) covariance of the clock parameters and the condition number of their normal matrix.

    The larger of two estimates: from the curvature alone, which trusts that residuals are independent,
    and with the scatter of the gradients from trajectory to trajectory, which does not.
    Source: P. Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 1967;
    one cluster per trajectory.
    """
    lin = linearise(fit.observations, fit.grid, fit.coefficients, fit.clocks)
    schur = reduce(fit, lin, unknowns, 0.0).schur
    if len(schur) == 0:
        return schur, 1.0
    # A rate counts by the time it moves in the course of the film, so that all are seconds.
    factors = time_factors(fit.observations, unknowns)
    reach = np.array([np.sqrt(np.mean(f**2)) if len(f) else 1.0 for _, f in factors])
    condition = float(np.linalg.cond(schur / np.outer(reach, reach)))
    inverse = _pseudo_inverse(schur)
    pull = fit.influence * (lin.by_time * lin.residual).sum(axis=1)
    num_points = len(fit.grid.first)
    gradients = np.zeros((num_points, len(factors)))
    for p, (index, factor) in enumerate(factors):
        gradients[:, p] = np.bincount(fit.observations.point[index], pull[index] * factor, num_points)
    curvature = fit.scale**2 * inverse
    sandwich = inverse @ (gradients.T @ gradients) @ inverse * (num_points / max(num_points - 1, 1))
    grow = np.sqrt(np.maximum(np.diag(sandwich) / np.maximum(np.diag(curvature), 1e-300), 1.0))
    return curvature * np.outer(grow, grow), condition


def _pseudo_inverse(schur: np.ndarray) -> np.ndarray:
    """Inverse of the scaled matrix; a direction without curvature gets an enormous variance, not zero."""
    diagonal = np.sqrt(np.maximum(np.diag(schur), 1e-300))
    values, vectors = np.linalg.eigh(schur / np.outer(diagonal, diagonal))
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    return inverse / np.outer(diagonal, diagonal)
