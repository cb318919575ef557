"""Clocks and trajectories together: Gauss-Newton with the trajectories eliminated.

The unknowns are the spline coefficients of all trajectories and a handful of clock parameters. An
observation at own time s of camera c is the projection of X(offset_c + (1 + rate_c) s + readout_c row),
which is smooth in both. The matrix of the coefficients is banded, so that the Schur complement, a small
dense matrix in the clocks alone, costs a time that is linear in the number of observations.
"""

import dataclasses

import numpy as np

from fourd.align.motion_prior import DIMENSION, NUM_BASIS, SplineGrid, basis_values
from fourd.align.point_observations import Observations

# Cauchy loss, in standard deviations of a pixel coordinate.
ROBUST_WIDTH = 3.0
# Median of the length of a 2-vector of unit normal noise.
RAYLEIGH_MEDIAN = float(np.sqrt(2 * np.log(2)))
# A point behind its camera counts as an outlier of this many standard deviations.
BEHIND = 1e3
MIN_DEPTH = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Clocks:
    """(C,) float64 arrays: common time = offset_s + (1 + rate) * own_s + readout_s * row."""

    offset_s: np.ndarray
    rate: np.ndarray
    readout_s: np.ndarray

    def times(self, observations: Observations) -> np.ndarray:
        cam = observations.cam
        own = (1 + self.rate[cam]) * observations.own_s
        return self.offset_s[cam] + own + self.readout_s[cam] * observations.row

    def moved(self, unknowns: "Unknowns", step: np.ndarray) -> "Clocks":
        """Clocks after a step (P,) of the unknown parameters."""
        values = np.stack([self.offset_s, self.rate, self.readout_s])
        values[unknowns.kind, unknowns.cam] += step
        return Clocks(*values)

    def at(self, unknowns: "Unknowns") -> np.ndarray:
        """(P,) values of the unknown parameters."""
        return np.stack([self.offset_s, self.rate, self.readout_s])[unknowns.kind, unknowns.cam]


@dataclasses.dataclass(frozen=True, eq=False)
class Unknowns:
    """Which clock parameters are free. kind: (P,) 0 offset, 1 rate, 2 readout;  cam: (P,) int64

    guess, sigma: (P,) what is known of them beforehand; sigma is infinite for offsets
    """

    kind: np.ndarray
    cam: np.ndarray
    guess: np.ndarray
    sigma: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """Trajectories and clocks that explain the observations, and how well.

    prior: (4, K) energy without weights;  ranks: (M,) directions it sees;  coefficients: (K, 3)
    weight: (M,) of each trajectory's energy against squared residuals in stated sigmas
    scale: noise in units of the stated sigma;  influence: (N,) 0..1, small for outliers
    """

    observations: Observations
    grid: SplineGrid
    prior: np.ndarray
    ranks: np.ndarray
    clocks: Clocks
    coefficients: np.ndarray
    weight: np.ndarray
    scale: float
    influence: np.ndarray

    @property
    def weighted_prior(self) -> np.ndarray:
        """(4, K) the prior as it enters the normal equations."""
        return self.prior * self.grid.per_coefficient(self.weight)


@dataclasses.dataclass(frozen=True, eq=False)
class Linearised:
    """Residuals in stated sigmas and their derivatives at one state.

    residual: (N, 2);  by_position: (N, 2, 3);  by_time: (N, 2) per second;  is_front: (N,) bool
    start: (N,) first coefficient;  basis: (N, 4)
    """

    residual: np.ndarray
    by_position: np.ndarray
    by_time: np.ndarray
    is_front: np.ndarray
    start: np.ndarray
    basis: np.ndarray


def linearise(
    observations: Observations, grid: SplineGrid, coefficients: np.ndarray, clocks: Clocks
) -> Linearised:
    """Reprojection residuals of the trajectories at the observations' times, with derivatives."""
    start, u = grid.locate(observations.point, clocks.times(observations))
    local = coefficients[start[:, None] + np.arange(NUM_BASIS)]
    basis = basis_values(u)
    position = np.einsum("na,nad->nd", basis, local)
    velocity = np.einsum("na,nad->nd", basis_values(u, 1), local) / grid.spacing_s
    projection = observations.projection
    in_cam = np.einsum("nij,nj->ni", projection[:, :, :3], position) + projection[:, :, 3]
    is_front = in_cam[:, 2] > MIN_DEPTH
    depth = np.where(is_front, in_cam[:, 2], 1.0)
    pixels = in_cam[:, :2] / depth[:, None]
    sigma = observations.sigma_px[:, None]
    by_position = projection[:, :2, :3] - pixels[:, :, None] * projection[:, 2:, :3]
    by_position *= (is_front / (depth * observations.sigma_px))[:, None, None]
    residual = np.where(is_front[:, None], (pixels - observations.pixels) / sigma, 0.0)
    by_time = np.einsum("nij,nj->ni", by_position, velocity)
    return Linearised(residual, by_position, by_time, is_front, start, basis)


def squared_lengths(lin: Linearised, scale: float) -> np.ndarray:
    """(N,) squared residuals in units of the noise."""
    squared = (lin.residual**2).sum(axis=1) / scale**2
    return np.where(lin.is_front, squared, BEHIND**2)


def robust_influence(lin: Linearised, scale: float) -> np.ndarray:
    """(N,) weights of iterated least squares for the Cauchy loss, 0 behind the camera."""
    return np.where(lin.is_front, 1 / (1 + squared_lengths(lin, scale) / ROBUST_WIDTH**2), 0.0)


def data_blocks(lin: Linearised, influence: np.ndarray, num: int) -> np.ndarray:
    """(4, K, 3, 3) normal matrix of the coefficients without the prior."""
    blocks = np.zeros((NUM_BASIS, num, DIMENSION, DIMENSION))
    square = np.einsum("n,nki,nkj->nij", influence, lin.by_position, lin.by_position)
    for lag in range(NUM_BASIS):
        for a in range(NUM_BASIS - lag):
            product = lin.basis[:, a] * lin.basis[:, a + lag]
            for i in range(DIMENSION):
                for j in range(i, DIMENSION):
                    added = np.bincount(lin.start + a, product * square[:, i, j], num)
                    blocks[lag, :, i, j] += added
                    if i != j:
                        blocks[lag, :, j, i] += added
    return blocks


def scatter(lin: Linearised, vectors: np.ndarray, num: int) -> np.ndarray:
    """(K, 3) sums of basis * vectors (N, 3) at the coefficients that each observation touches."""
    total = np.zeros((num, DIMENSION))
    for a in range(NUM_BASIS):
        for d in range(DIMENSION):
            total[:, d] += np.bincount(lin.start + a, lin.basis[:, a] * vectors[:, d], num)
    return total


def time_factors(observations: Observations, unknowns: Unknowns) -> list[tuple[np.ndarray, np.ndarray]]:
    """Per parameter: the observations (index) whose time it moves, and by how much."""
    features = (np.ones_like(observations.own_s), observations.own_s, observations.row)
    by_cam = [np.flatnonzero(observations.cam == cam) for cam in range(observations.num_cams)]
    return [
        (by_cam[cam], features[kind][by_cam[cam]])
        for kind, cam in zip(unknowns.kind, unknowns.cam, strict=True)
    ]
