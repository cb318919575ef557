"""Trajectories as cubic splines of the common clock, and the energy of their motion.

A trajectory is X(t) = sum_i b_i(t) c_i over uniform cubic B-splines whose knots do not depend on the
cameras' clocks. The prior is the integral of |X'|^2 (least kinetic energy) or |X''|^2 (least force):
a fixed quadratic form of the coefficients, without any division by the time between observations.
The trajectories do not touch each other, so that every matrix is block banded: block (i, i + lag),
lag 0..3, couples neighbouring coefficients only.
"""

import dataclasses

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

DEGREE = 3
NUM_BASIS = DEGREE + 1
DIMENSION = 3
RIDGE = 1e-12

# Row a: coefficients of 1, u, u^2, u^3 of the a-th basis function that is not zero on an interval.
_BASIS = (
    np.array([[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]]) / 6
)
ORDER_OF_PRIOR = {"kinetic": 1, "force": 2}


def basis_values(u: np.ndarray, derivative: int = 0) -> np.ndarray:
    """The four cubic B-splines that are not zero on an interval, or their derivatives.

    u: (N,) position in the interval, 0..1, unit spacing of the knots
    Returns (N, 4); multiply by spacing_s ** -derivative for derivatives in time.
    Source: C. de Boor, A Practical Guide to Splines, chapter 10 (uniform knots).
    """
    polynomial = _BASIS
    for _ in range(derivative):
        polynomial = polynomial[:, 1:] * np.arange(1, polynomial.shape[1])
    powers = u[:, None] ** np.arange(polynomial.shape[1])
    return powers @ polynomial.T


def interval_energy(order: int) -> np.ndarray:
    """(4, 4) integral over one interval of unit length of products of order-th derivatives."""
    # Gauss-Legendre with four nodes is exact to degree 7; the products have degree 6 at most.
    nodes, weights = np.polynomial.legendre.leggauss(NUM_BASIS)
    values = basis_values((nodes + 1) / 2, order)
    return values.T @ (values * (weights / 2)[:, None])


@dataclasses.dataclass(frozen=True, eq=False)
class SplineGrid:
    """Where the coefficients of M trajectories lie: M runs, one behind the other.

    spacing_s: distance of the knots;  first: (M,) int64 number of the first interval, which begins at
    first * spacing_s on the common clock;  base: (M + 1,) int64 first coefficient of each trajectory
    """

    spacing_s: float
    first: np.ndarray
    base: np.ndarray

    @property
    def num_coefficients(self) -> int:
        return int(self.base[-1])

    def per_coefficient(self, values: np.ndarray) -> np.ndarray:
        """(K,) values of the trajectories (M,), at each of their coefficients."""
        return np.repeat(values, np.diff(self.base))

    def per_trajectory(self, values: np.ndarray) -> np.ndarray:
        """(M,) sums of values (K,) over the coefficients of each trajectory."""
        return np.add.reduceat(values, self.base[:-1])

    def locate(self, point: np.ndarray, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First of the four coefficients and position in the interval, (N,) int64 and (N,) in 0..1.

        Times outside a trajectory's knots are moved to its ends.
        """
        num_intervals = np.diff(self.base)[point] - DEGREE
        u = np.clip(time_s / self.spacing_s - self.first[point], 0, num_intervals)
        interval = np.minimum(u.astype(np.int64), num_intervals - 1)
        return self.base[point] + interval, u - interval

    def evaluate(
        self, coefficients: np.ndarray, point: np.ndarray, time_s: np.ndarray, derivative: int = 0
    ) -> np.ndarray:
        """Positions (or derivatives in time) of trajectories.

        coefficients: (K, 3) world units;  point: (N,) int64;  time_s: (N,) common clock
        Returns (N, 3) world units, per s^derivative.
        """
        start, u = self.locate(point, time_s)
        values = basis_values(u, derivative) * self.spacing_s**-derivative
        return np.einsum("na,nad->nd", values, coefficients[start[:, None] + np.arange(NUM_BASIS)])


def make_grid(point: np.ndarray, first_s: np.ndarray, last_s: np.ndarray, spacing_s: float) -> SplineGrid:
    """Knots that cover all times an observation may take.

    point: (N,) int64 in 0..M-1, each at least once;  first_s, last_s: (N,) earliest and latest time
    """
    num_points = int(point.max()) + 1
    earliest = np.full(num_points, np.inf)
    latest = np.full(num_points, -np.inf)
    np.minimum.at(earliest, point, first_s)
    np.maximum.at(latest, point, last_s)
    first = np.floor(earliest / spacing_s).astype(np.int64)
    num_intervals = np.maximum(np.ceil(latest / spacing_s).astype(np.int64) - first, 1)
    base = np.concatenate([[0], np.cumsum(num_intervals + DEGREE)])
    return SplineGrid(spacing_s, first, base)


def prior_blocks(grid: SplineGrid, prior: str) -> np.ndarray:
    """The energy of all trajectories as a quadratic form, (4, K): entry [lag, i] couples i and i + lag.

    prior: `kinetic` (integral of |X'|^2, world units^2 / s) or `force` (|X''|^2, world units^2 / s^3)
    """
    order = ORDER_OF_PRIOR[prior]
    element = interval_energy(order) * grid.spacing_s ** (1 - 2 * order)
    is_interval = np.ones(grid.num_coefficients)
    for missing in range(1, NUM_BASIS):
        is_interval[grid.base[1:] - missing] = 0
    blocks = np.zeros((NUM_BASIS, grid.num_coefficients))
    for lag in range(NUM_BASIS):
        for a in range(NUM_BASIS - lag):
            blocks[lag, a:] += element[a, a + lag] * is_interval[: grid.num_coefficients - a]
    return blocks


def prior_ranks(grid: SplineGrid, prior: str) -> np.ndarray:
    """(M,) directions that the prior sees: all but constant (and, for force, uniform) motion."""
    return DIMENSION * (np.diff(grid.base) - ORDER_OF_PRIOR[prior])


def multiply_prior(blocks: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """(K, 3) product of the prior's matrix (4, K) with coefficients (K, 3)."""
    product = blocks[0, :, None] * coefficients
    for lag in range(1, NUM_BASIS):
        product[:-lag] += blocks[lag, :-lag, None] * coefficients[lag:]
        product[lag:] += blocks[lag, :-lag, None] * coefficients[:-lag]
    return product


class BandedNormal:
    """Cholesky factor of (data blocks + prior), all trajectories at once, in O(K).

    data: (4, K, 3, 3) symmetric blocks, [lag, i] couples coefficients i and i + lag
    prior: (4, K) the same for all three axes, weights included
    A tiny ridge keeps a trajectory in place whose observations are all outliers.
    """

    def __init__(self, data: np.ndarray, prior: np.ndarray) -> None:
        num = data.shape[1]
        ridge = RIDGE * float(np.trace(data[0], axis1=1, axis2=2).mean())
        # LAPACK's lower band: row r holds the elements (column + r, column).
        band = np.zeros((DIMENSION * NUM_BASIS, num, DIMENSION))
        for lag in range(NUM_BASIS):
            block = data[lag] + prior[lag][:, None, None] * np.eye(DIMENSION)
            if lag == 0:
                block += ridge * np.eye(DIMENSION)
            for column in range(DIMENSION):
                for row in range(DIMENSION):
                    below = DIMENSION * lag + row - column
                    if below >= 0:
                        band[below, :, column] = block[:, row, column]
        self._factor = cholesky_banded(band.reshape(DIMENSION * NUM_BASIS, -1), lower=True)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """(K * 3, ...) solutions for right sides of the same shape."""
        return cho_solve_banded((self._factor, True), right)

    @property
    def log_determinants(self) -> np.ndarray:
        """(K,) shares of the coefficients in the logarithm of the determinant."""
        return 2 * np.log(self._factor[0]).reshape(-1, DIMENSION).sum(axis=1)
