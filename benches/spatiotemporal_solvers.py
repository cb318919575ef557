"""Formulations and solvers of the joint problem of clocks and trajectories, side by side on a small take.

    python -m benches.spatiotemporal_solvers --output DIR

Spline and discrete prior (each sighting its own position, squared steps divided by time + epsilon), solved
by the project's elimination, by scipy's sparse trust region and, where it is installed, by Ceres through
pyceres. All get the same start and the weight that the project estimated. Writes
spatiotemporal_solvers.csv (errors, seconds) and spatiotemporal_condition.csv (condition number of the whole
normal matrix against the time between two cameras).
"""

import argparse
import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix, csr_matrix

from benches.articulated_motion import FPS, Setting, Take, film
from fourd import io
from fourd.align.joint_solve import Limits, solve_jointly, start_fit
from fourd.align.motion_prior import NUM_BASIS, basis_values
from fourd.align.point_observations import connected, prepare_observations
from fourd.align.trajectory_fit import Clocks, Fit, Unknowns, linearise

EPSILONS_S = (1e-3, 1e-6)
SMALL = Setting(num_cams=4, seconds=1.5, noise_px=2.0, start_frames=2.0)
NUM_POINTS = 8
TOLERANCE = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class Start:
    """The state that all begin with; offsets may move by box_s to both sides."""

    take: Take
    fit: Fit
    unknowns: Unknowns
    box_s: float


def make_start(seed: int, prior: str, setting: Setting = SMALL, guesses_s: np.ndarray | None = None) -> Start:
    take = film(setting, seed)
    guesses_s = take.guesses_s if guesses_s is None else guesses_s
    observations = prepare_observations(take.points, take.cameras)
    observations = observations.take(np.flatnonzero(observations.point % 4 == 1))
    num = len(guesses_s)
    clocks = Clocks(guesses_s.copy(), np.zeros(num), np.zeros(num))
    everyone = np.ones(num, dtype=bool)
    observations = connected(observations, clocks.times(observations), everyone, 0.2, 0.5)
    fit = start_fit(observations, clocks, 1 / FPS, 0.2, prior)
    unknowns = Unknowns(np.zeros(num - 1, int), np.arange(1, num), guesses_s[1:], np.full(num - 1, np.inf))
    return Start(take, fit, unknowns, 1.5 * setting.start_frames / FPS)


def solve_eliminated(start: Start) -> Fit:
    guess = start.unknowns.guess
    limits = Limits(guess - start.box_s, guess + start.box_s, np.full(len(guess), 0.5 / FPS))
    return solve_jointly(start.fit, start.unknowns, limits, 4e-4)


def spline_system(fit: Fit, unknowns: Unknowns) -> tuple[Callable, Callable, np.ndarray]:
    """Residuals and sparse Jacobian of the spline problem in (offsets, coefficients), and the start."""
    num_clocks, num = len(unknowns.kind), fit.grid.num_coefficients
    prior_rows = _prior_rows(fit)

    def unpack(x: np.ndarray) -> tuple[np.ndarray, Clocks]:
        clocks = fit.clocks.moved(unknowns, x[:num_clocks] - fit.clocks.at(unknowns))
        return x[num_clocks:].reshape(num, 3), clocks

    def residuals(x: np.ndarray) -> np.ndarray:
        coefficients, clocks = unpack(x)
        lin = linearise(fit.observations, fit.grid, coefficients, clocks)
        return np.concatenate([lin.residual.ravel(), prior_rows @ x[num_clocks:]])

    def jacobian(x: np.ndarray) -> csr_matrix:
        coefficients, clocks = unpack(x)
        lin = linearise(fit.observations, fit.grid, coefficients, clocks)
        count = len(lin.start)
        row = np.broadcast_to((2 * np.arange(count))[:, None] + np.arange(2), (count, 2))
        cam = fit.observations.cam
        column = np.broadcast_to(cam[:, None] - 1, (count, 2))
        moves = np.broadcast_to((cam > 0)[:, None], (count, 2))
        rows, columns, values = [row[moves]], [column[moves]], [lin.by_time[moves]]
        for a in range(NUM_BASIS):
            for d in range(3):
                rows.append(row.ravel())
                columns.append(np.repeat(num_clocks + 3 * (lin.start + a) + d, 2))
                values.append((lin.basis[:, a, None] * lin.by_position[:, :, d]).ravel())
        prior = prior_rows.tocoo()
        rows.append(2 * count + prior.row)
        columns.append(num_clocks + prior.col)
        values.append(prior.data)
        shape = (2 * count + prior_rows.shape[0], num_clocks + 3 * num)
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return coo_matrix(entries, shape=shape).tocsr()

    return residuals, jacobian, np.concatenate([fit.clocks.at(unknowns), fit.coefficients.ravel()])


def _prior_rows(fit: Fit) -> csr_matrix:
    """(R, 3 K) rows whose squares sum to the least-kinetic-energy prior: velocity at Gauss nodes."""
    nodes, weights = np.polynomial.legendre.leggauss(NUM_BASIS)
    velocity = basis_values((nodes + 1) / 2, 1) / fit.grid.spacing_s
    rows, columns, values, count = [], [], [], 0
    for trajectory, weight in enumerate(fit.weight):
        for start in range(fit.grid.base[trajectory], fit.grid.base[trajectory + 1] - 3):
            for node in range(NUM_BASIS):
                factor = np.sqrt(weight * weights[node] / 2 * fit.grid.spacing_s)
                for d in range(3):
                    rows += [count] * NUM_BASIS
                    columns += [3 * (start + a) + d for a in range(NUM_BASIS)]
                    values += list(factor * velocity[node])
                    count += 1
    return csr_matrix((values, (rows, columns)), shape=(count, 3 * fit.grid.num_coefficients))


def discrete_system(fit: Fit, unknowns: Unknowns, epsilon_s: float) -> tuple[Callable, Callable, np.ndarray]:
    """The same for the discrete prior: unknown are the offsets and one position per sighting."""
    observations = fit.observations
    num_clocks, count = len(unknowns.kind), len(observations.cam)
    row = 2 * np.arange(count)

    def parts(x: np.ndarray) -> tuple:
        clocks = fit.clocks.moved(unknowns, x[:num_clocks] - fit.clocks.at(unknowns))
        position, times = x[num_clocks:].reshape(count, 3), clocks.times(observations)
        order = np.lexsort((times, observations.point))
        same = observations.point[order[1:]] == observations.point[order[:-1]]
        before, after = order[:-1][same], order[1:][same]
        gap_s = np.abs(times[after] - times[before]) + epsilon_s
        factor = np.sqrt(fit.weight[observations.point[after]] / gap_s)
        return position, before, after, gap_s, factor

    def project(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        matrix = observations.projection
        in_cam = np.einsum("nij,nj->ni", matrix[:, :, :3], position) + matrix[:, :, 3]
        pixels = in_cam[:, :2] / in_cam[:, 2:]
        slope = (matrix[:, :2, :3] - pixels[:, :, None] * matrix[:, 2:, :3]) / in_cam[:, 2, None, None]
        return (pixels - observations.pixels) / observations.sigma_px[:, None], slope

    def residuals(x: np.ndarray) -> np.ndarray:
        position, before, after, _, factor = parts(x)
        steps = factor[:, None] * (position[after] - position[before])
        return np.concatenate([project(position)[0].ravel(), steps.ravel()])

    def jacobian(x: np.ndarray) -> csr_matrix:
        position, before, after, gap_s, factor = parts(x)
        slope = project(position)[1] / observations.sigma_px[:, None, None]
        by_gap = -0.5 * (factor / gap_s)[:, None] * (position[after] - position[before])
        rows, columns, values = [], [], []
        for d in range(3):
            rows += [row, row + 1]
            columns += [num_clocks + 3 * np.arange(count) + d] * 2
            values += [slope[:, 0, d], slope[:, 1, d]]
            at = 2 * count + 3 * np.arange(len(after)) + d
            for end, sign in ((before, -1.0), (after, 1.0)):
                rows.append(at)
                columns.append(num_clocks + 3 * end + d)
                values.append(sign * factor)
                cam = observations.cam[end]
                rows.append(at[cam > 0])
                columns.append(cam[cam > 0] - 1)
                values.append(sign * by_gap[cam > 0, d])
        shape = (2 * count + 3 * len(after), num_clocks + 3 * count)
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return coo_matrix(entries, shape=shape).tocsr()

    position = fit.grid.evaluate(fit.coefficients, observations.point, fit.clocks.times(observations))
    return residuals, jacobian, np.concatenate([fit.clocks.at(unknowns), position.ravel()])


def solve_scipy(system: tuple[Callable, Callable, np.ndarray], start: Start) -> np.ndarray:
    """(P,) offsets."""
    residuals, jacobian, x = system
    reach = np.full(len(x), np.inf)
    reach[: len(start.unknowns.kind)] = start.box_s
    result = least_squares(
        residuals,
        x,
        jacobian,
        bounds=(x - reach, x + reach),
        x_scale="jac",
        ftol=TOLERANCE,
        xtol=1e-10,
        max_nfev=100,
    )
    return result.x[: len(start.unknowns.kind)]


def error_frames(take: Take, offsets_s: np.ndarray) -> float:
    return float(np.abs(offsets_s - take.offsets_s[1:]).max() * FPS)


def _ceres_costs(pyceres, fit: Fit, epsilon_s: float) -> tuple[type, type]:
    """Cost functions of an observation and of a step between two positions of one point."""
    observations = fit.observations
    matrix, pixels, sigma_px = observations.projection, observations.pixels, observations.sigma_px
    own_s, cams = observations.own_s, observations.cam

    class Sighting(pyceres.CostFunction):
        def __init__(self, k: int) -> None:
            super().__init__()
            self.k = k
            self.set_num_residuals(2)
            self.set_parameter_block_sizes([3])

        def Evaluate(self, parameters: list, residuals: np.ndarray, jacobians: list | None) -> bool:  # noqa: N802
            k = self.k
            in_cam = matrix[k, :, :3] @ parameters[0] + matrix[k, :, 3]
            at = in_cam[:2] / in_cam[2]
            residuals[:] = (at - pixels[k]) / sigma_px[k]
            if jacobians is not None and jacobians[0] is not None:
                slope = (matrix[k, :2, :3] - at[:, None] * matrix[k, 2:, :3]) / (in_cam[2] * sigma_px[k])
                jacobians[0][:] = slope.ravel()
            return True

    class Step(pyceres.CostFunction):
        def __init__(self, before: int, after: int) -> None:
            super().__init__()
            self.ends = before, after
            self.root = np.sqrt(fit.weight[observations.point[before]])
            self.set_num_residuals(3)
            self.is_same = cams[before] == cams[after]
            self.set_parameter_block_sizes([3, 3] if self.is_same else [3, 3, 1, 1])

        def Evaluate(self, parameters: list, residuals: np.ndarray, jacobians: list | None) -> bool:  # noqa: N802
            before, after = self.ends
            gap_s = own_s[after] - own_s[before]
            gap_s += 0.0 if self.is_same else parameters[3][0] - parameters[2][0]
            sign = 1.0 if gap_s >= 0 else -1.0
            gap_s = abs(gap_s) + epsilon_s
            factor = self.root / np.sqrt(gap_s)
            residuals[:] = factor * (parameters[1] - parameters[0])
            if jacobians is not None:
                by_gap = -0.5 * sign * residuals / gap_s
                slopes = (-factor * np.eye(3), factor * np.eye(3), -by_gap, by_gap)
                for slot, slope in zip(jacobians, slopes, strict=False):
                    if slot is not None:
                        slot[:] = slope.ravel()
            return True

    return Sighting, Step


def solve_ceres(fit: Fit, box_s: float, epsilon_s: float, num_orders: int = 4) -> np.ndarray | None:
    """Offsets by Ceres with the discrete prior, sorted anew `num_orders` times; None without pyceres."""
    try:
        import pyceres
    except ImportError:
        return None
    sighting, step = _ceres_costs(pyceres, fit, epsilon_s)
    observations = fit.observations
    own_s, cams = observations.own_s, observations.cam
    offsets = [np.array([value]) for value in fit.clocks.offset_s]
    times = fit.clocks.times(observations)
    positions = [row.copy() for row in fit.grid.evaluate(fit.coefficients, observations.point, times)]
    for _ in range(num_orders):
        times = np.array([offsets[cam][0] for cam in cams]) + own_s
        order = np.lexsort((times, observations.point))
        problem = pyceres.Problem()
        for k in range(len(positions)):
            problem.add_residual_block(sighting(k), None, [positions[k]])
        for before, after in zip(order[:-1], order[1:], strict=True):
            if observations.point[before] == observations.point[after]:
                blocks = [positions[before], positions[after]]
                if cams[before] != cams[after]:
                    blocks += [offsets[cams[before]], offsets[cams[after]]]
                problem.add_residual_block(step(int(before), int(after)), None, blocks)
        problem.set_parameter_block_constant(offsets[0])
        for offset, guess in zip(offsets[1:], fit.clocks.offset_s[1:], strict=True):
            if problem.has_parameter_block(offset):
                problem.set_parameter_lower_bound(offset, 0, guess - box_s)
                problem.set_parameter_upper_bound(offset, 0, guess + box_s)
        options = pyceres.SolverOptions()
        options.linear_solver_type = pyceres.LinearSolverType.SPARSE_NORMAL_CHOLESKY
        options.max_num_iterations = 50
        options.function_tolerance = TOLERANCE
        options.num_threads = 1
        options.minimizer_progress_to_stdout = False
        pyceres.solve(options, problem, pyceres.SolverSummary())
    return np.array([offset[0] for offset in offsets[1:]])


def compare_solvers(num_seeds: int) -> list[dict]:
    """Largest error and processor seconds of each way, per take, from near and from far."""
    rows = []
    for start_frames in (0.3, 2.0):
        for seed in range(num_seeds):
            start = make_start(seed, "kinetic", dataclasses.replace(SMALL, start_frames=start_frames))
            rows += _compare(seed, start_frames, start)
    return rows


def _compare(seed: int, start_frames: float, start: Start) -> list[dict]:
    began = time.process_time()
    eliminated = solve_eliminated(start)
    rows = [
        _row(seed, start_frames, "spline, eliminated", start, eliminated.clocks.offset_s[1:], began),
    ]
    # The others do not estimate the weight: they are given the one found.
    fit = dataclasses.replace(start.fit, weight=eliminated.weight)
    began = time.process_time()
    found = solve_scipy(spline_system(fit, start.unknowns), start)
    rows.append(_row(seed, start_frames, "spline, scipy", start, found, began))
    for epsilon_s in EPSILONS_S:
        began = time.process_time()
        found = solve_scipy(discrete_system(fit, start.unknowns, epsilon_s), start)
        rows.append(_row(seed, start_frames, f"discrete {epsilon_s:g} s, scipy", start, found, began))
        began = time.process_time()
        found = solve_ceres(fit, start.box_s, epsilon_s)
        if found is not None:
            rows.append(_row(seed, start_frames, f"discrete {epsilon_s:g} s, ceres", start, found, began))
    return rows


def _row(
    seed: int, start_frames: float, name: str, start: Start, offsets_s: np.ndarray, began: float
) -> dict:
    row = {
        "take": seed,
        "start_frames": start_frames,
        "way": name,
        "error": error_frames(start.take, offsets_s),
        "cpu_seconds": time.process_time() - began,
    }
    print(row, flush=True)
    return row


def condition_table() -> list[dict]:
    """Condition number of the whole normal matrix when two cameras fire a time dt apart."""
    rows = []
    setting = dataclasses.replace(SMALL, num_cams=3, seconds=0.5)
    for dt_s in (1e-2, 1e-3, 1e-4, 1e-6, 1e-9, 0.0):
        start = make_start(0, "kinetic", setting, np.array([0.0, dt_s, 0.012]))
        # Not further than half a frame, so that the matrices describe the same scene.
        fit = start.fit
        systems = {"spline": spline_system(fit, start.unknowns)}
        for epsilon_s in (*EPSILONS_S, 1e-9):
            systems[f"discrete {epsilon_s:g} s"] = discrete_system(fit, start.unknowns, epsilon_s)
        row: dict = {"dt_s": dt_s}
        for name, (_, jacobian, x) in systems.items():
            matrix = jacobian(x).toarray()
            matrix /= np.linalg.norm(matrix, axis=0)
            row[name] = float(np.linalg.cond(matrix) ** 2)
        print(row, flush=True)
        rows.append(row)
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--num-seeds", type=int, default=3)
    args = parser.parse_args(argv)
    rows = condition_table()
    io.write_csv(args.output / "spatiotemporal_condition.csv", tuple(rows[0]), rows)
    rows = compare_solvers(args.num_seeds)
    io.write_csv(args.output / "spatiotemporal_solvers.csv", tuple(rows[0]), rows)


if __name__ == "__main__":
    main()
