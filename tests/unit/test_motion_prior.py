"""Splines on a fixed grid, the energy of motion, and the banded solve."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fourd.align.motion_prior import (
    BandedNormal,
    SplineGrid,
    basis_values,
    interval_energy,
    make_grid,
    multiply_prior,
    prior_blocks,
    prior_ranks,
)


def two_trajectories(spacing_s: float = 0.5) -> SplineGrid:
    point = np.array([0, 0, 1, 1])
    return make_grid(point, np.array([0.2, 3.0, -2.0, -1.0]), np.array([0.3, 4.1, -1.5, 0.4]), spacing_s)


def greville(grid: SplineGrid, trajectory: int) -> np.ndarray:
    """Times at which coefficients must be sampled to reproduce a straight line."""
    count = int(np.diff(grid.base)[trajectory])
    return (grid.first[trajectory] + np.arange(count) - 1.0) * grid.spacing_s


def dense(grid: SplineGrid, blocks: np.ndarray) -> np.ndarray:
    matrix = np.diag(blocks[0])
    for lag in range(1, 4):
        part = np.diag(blocks[lag, :-lag], -lag)
        matrix += part + part.T
    return matrix


@given(st.floats(0, 1))
def test_basis_sums_to_one(u: float) -> None:
    assert basis_values(np.array([u])).sum() == pytest.approx(1)
    assert basis_values(np.array([u]), 1).sum() == pytest.approx(0, abs=1e-12)
    assert basis_values(np.array([u])).min() >= 0


@pytest.mark.parametrize("derivative", [0, 1])
def test_basis_derivatives_match_finite_differences(derivative: int) -> None:
    u, step = np.linspace(0.1, 0.9, 9), 1e-6
    difference = basis_values(u + step, derivative) - basis_values(u - step, derivative)
    np.testing.assert_allclose(basis_values(u, derivative + 1), difference / (2 * step), atol=1e-8)


@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_trajectory_is_smooth_across_knots(derivative: int) -> None:
    grid = two_trajectories()
    coefficients = np.random.default_rng(0).normal(size=(grid.num_coefficients, 3))
    knots = (grid.first[0] + np.arange(1, 8)) * grid.spacing_s
    zeros = np.zeros(7, dtype=np.int64)
    before = grid.evaluate(coefficients, zeros, knots - 1e-9, derivative)
    after = grid.evaluate(coefficients, zeros, knots + 1e-9, derivative)
    np.testing.assert_allclose(before, after, atol=1e-6)


@pytest.mark.parametrize("order", [1, 2])
def test_interval_energy_is_the_integral(order: int) -> None:
    u = (np.arange(20000) + 0.5) / 20000
    values = basis_values(u, order)
    np.testing.assert_allclose(interval_energy(order), values.T @ values / 20000, rtol=1e-6, atol=1e-8)


def test_kinetic_energy_of_uniform_motion() -> None:
    grid = two_trajectories()
    velocity = np.array([2.0, -1.0, 0.5])
    coefficients = np.zeros((grid.num_coefficients, 3))
    coefficients[: grid.base[1]] = greville(grid, 0)[:, None] * velocity + [1, 2, 3]
    energy = (coefficients * multiply_prior(prior_blocks(grid, "kinetic"), coefficients)).sum()
    duration_s = (grid.base[1] - 3) * grid.spacing_s
    assert energy == pytest.approx(duration_s * velocity @ velocity)
    at = grid.evaluate(coefficients, np.zeros(1, dtype=np.int64), np.array([1.3]))
    np.testing.assert_allclose(at[0], 1.3 * velocity + [1, 2, 3])
    force = multiply_prior(prior_blocks(grid, "force"), coefficients)
    assert np.abs(force).max() < 1e-9


@pytest.mark.parametrize("prior", ["kinetic", "force"])
def test_rank_is_that_of_the_matrix(prior: str) -> None:
    grid = two_trajectories()
    matrix = dense(grid, prior_blocks(grid, prior))
    assert 3 * np.linalg.matrix_rank(matrix) == prior_ranks(grid, prior).sum()
    c = np.random.default_rng(1).normal(size=(grid.num_coefficients, 3))
    np.testing.assert_allclose(multiply_prior(prior_blocks(grid, prior), c), matrix @ c, rtol=1e-9, atol=1e-9)


def test_prior_does_not_join_trajectories() -> None:
    grid = two_trajectories()
    matrix = dense(grid, prior_blocks(grid, "force"))
    edge = grid.base[1]
    assert not matrix[:edge, edge:].any()


def test_banded_solve_equals_dense() -> None:
    grid = two_trajectories()
    rng = np.random.default_rng(2)
    num = grid.num_coefficients
    data = np.zeros((4, num, 3, 3))
    full = np.zeros((num, 3, num, 3))
    for trajectory in range(2):
        for start in range(grid.base[trajectory], grid.base[trajectory + 1] - 3):
            rows = rng.normal(size=(2, 3))
            square, basis = rows.T @ rows, rng.random(4)
            for a in range(4):
                for b in range(4):
                    full[start + a, :, start + b] += basis[a] * basis[b] * square
                    if b >= a:
                        data[b - a, start + a] += basis[a] * basis[b] * square
    prior = 0.3 * prior_blocks(grid, "kinetic")
    matrix = full.reshape(num * 3, num * 3) + np.kron(dense(grid, prior), np.eye(3))
    right = rng.normal(size=num * 3)
    normal = BandedNormal(data, prior)
    np.testing.assert_allclose(normal.solve(right), np.linalg.solve(matrix, right), rtol=1e-6, atol=1e-8)
    assert normal.log_determinants.sum() == pytest.approx(np.linalg.slogdet(matrix)[1], rel=1e-9)


def test_times_outside_are_moved_to_the_ends() -> None:
    grid = two_trajectories()
    coefficients = np.random.default_rng(3).normal(size=(grid.num_coefficients, 3))
    point = np.zeros(2, dtype=np.int64)
    ends = grid.evaluate(coefficients, point, np.array([grid.first[0] * 0.5, 4.5]))
    beyond = grid.evaluate(coefficients, point, np.array([-100.0, 100.0]))
    np.testing.assert_allclose(beyond, ends)
