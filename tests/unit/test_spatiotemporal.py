"""Clocks from moving points: exactness, derivatives, extreme cases, refusals."""

import dataclasses

import numpy as np
import pytest

from fourd.align.incremental import Delays, seed_cameras, triplet_errors
from fourd.align.joint_solve import cost_of, reduce, start_fit
from fourd.align.point_observations import connected, prepare_observations
from fourd.align.spatiotemporal import SpatiotemporalResult, refine_clocks
from fourd.align.spatiotemporal_options import SpatiotemporalOptions
from fourd.align.trajectory_fit import Clocks, Unknowns, linearise, scatter
from fourd.errors import InputError
from tests.unit.moving_rig import FPS, Rig, film, ring, wandering

OFFSETS_S = np.array([0, 0.031, 0.412, -0.155])


def solve(rig: Rig, reference: str = "cam00", **changes: object) -> SpatiotemporalResult:
    options = SpatiotemporalOptions(**changes)  # type: ignore[arg-type]
    return refine_clocks(rig.points, rig.cameras, rig.guesses, reference, options)


def errors_frames(result: SpatiotemporalResult, rig: Rig) -> np.ndarray:
    found = np.array([result.clocks[name].offset_s for name in rig.points.names])
    return (found - rig.offsets_s) * FPS


def prepared(rig: Rig) -> tuple:
    """A fit at clocks that are wrong, so that no derivative vanishes."""
    observations = prepare_observations(rig.points, rig.cameras)
    num = observations.num_cams
    clocks = Clocks(rig.offsets_s + 0.01 * np.arange(num), 1e-4 * np.arange(num), 0.01 * np.ones(num))
    observations = connected(observations, clocks.times(observations), np.ones(num, dtype=bool), 0.2, 1.0)
    fit = start_fit(observations, clocks, 1 / FPS, 0.2, "force")
    kind, cam = np.repeat(np.arange(3), num), np.tile(np.arange(num), 3)
    unknowns = Unknowns(kind, cam, np.zeros(3 * num), np.repeat([np.inf, 1e-4, 0.03], num))
    return fit, unknowns


@pytest.mark.parametrize("prior", ["force", "kinetic"])
def test_finds_sub_frame_offsets(prior: str) -> None:
    rig = film(wandering(12, 0), 12, OFFSETS_S)
    result = solve(rig, prior=prior)
    assert np.abs(errors_frames(result, rig)).max() < 0.02
    assert all(clock.status == "ok" for clock in result.clocks.values())
    assert 0.7 < result.noise_scale < 1.2
    assert result.condition_number < 100
    assert result.clocks["cam00"].sigma_s == 0
    assert result.clocks["cam00"].method == "reference"
    assert all(0 < result.clocks[name].sigma_s * FPS < 0.02 for name in rig.points.names[1:])
    assert len(result.pairs) == 6
    assert all(pair.status == "ok" for pair in result.pairs)


def test_trajectories_follow_the_points() -> None:
    paths = wandering(12, 0)
    result = solve(film(paths, 12, OFFSETS_S))
    trajectories = result.trajectories
    assert trajectories is not None
    number = np.arange(len(trajectories.point))
    time_s = (trajectories.first_s + trajectories.last_s) / 2
    truth = paths(trajectories.point[number], time_s)
    assert np.linalg.norm(trajectories.positions(number, time_s) - truth, axis=1).max() < 10
    assert np.isnan(trajectories.positions(number, trajectories.last_s + 1)).all()


def test_derivatives_match_finite_differences() -> None:
    fit, unknowns = prepared(film(wandering(4, 1), 4, OFFSETS_S, num_frames=20))
    lin = linearise(fit.observations, fit.grid, fit.coefficients, fit.clocks)
    step = 1e-6
    for p in range(len(unknowns.kind)):
        move = np.zeros(len(unknowns.kind))
        move[p] = step
        up, down = (
            linearise(fit.observations, fit.grid, fit.coefficients, fit.clocks.moved(unknowns, sign * move))
            for sign in (1, -1)
        )
        feature = (np.ones_like(fit.observations.own_s), fit.observations.own_s, fit.observations.row)
        factor = feature[unknowns.kind[p]] * (fit.observations.cam == unknowns.cam[p])
        difference = (up.residual - down.residual) / (2 * step)
        np.testing.assert_allclose(lin.by_time * factor[:, None], difference, rtol=1e-5, atol=1e-4)
    direction = np.random.default_rng(0).normal(size=fit.coefficients.shape)
    up, down = (
        linearise(fit.observations, fit.grid, fit.coefficients + sign * step * direction, fit.clocks)
        for sign in (1, -1)
    )
    moved = np.einsum("na,nad->nd", lin.basis, direction[lin.start[:, None] + np.arange(4)])
    difference = (up.residual - down.residual) / (2 * step)
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", lin.by_position, moved), difference, rtol=1e-5, atol=1e-3
    )


def test_gradient_of_the_reduced_cost_matches_finite_differences() -> None:
    fit, unknowns = prepared(film(wandering(4, 1), 4, OFFSETS_S, num_frames=20))
    lin = linearise(fit.observations, fit.grid, fit.coefficients, fit.clocks)
    reduced = reduce(fit, lin, unknowns, 0.0)
    # Along the path on which the trajectories follow the clocks the gradient is that of the Schur complement.
    step = 1e-7
    for p in range(len(unknowns.kind)):
        move = np.zeros(len(unknowns.kind))
        move[p] = step
        follow = (-reduced.eliminated @ move).reshape(-1, 3)
        costs = []
        for sign in (1, -1):
            state = dataclasses.replace(
                fit,
                clocks=fit.clocks.moved(unknowns, sign * move),
                coefficients=fit.coefficients + sign * follow,
            )
            at = linearise(fit.observations, fit.grid, state.coefficients, state.clocks)
            costs.append(cost_of(state, at, unknowns))
        assert (costs[0] - costs[1]) / (2 * step) == pytest.approx(
            2 * reduced.gradient[p], rel=1e-3, abs=1e-2
        )


def test_reduced_matrix_equals_dense_elimination() -> None:
    fit, unknowns = prepared(film(wandering(2, 1), 2, OFFSETS_S, num_frames=12))
    lin = linearise(fit.observations, fit.grid, fit.coefficients, fit.clocks)
    num = fit.grid.num_coefficients
    jacobian = np.zeros((len(lin.start), 2, num, 3))
    for a in range(4):
        jacobian[np.arange(len(lin.start)), :, lin.start + a] += lin.basis[:, a, None, None] * lin.by_position
    jacobian = jacobian.reshape(-1, num * 3)
    root = np.sqrt(np.repeat(fit.influence, 2))
    vectors = np.random.default_rng(0).normal(size=(len(lin.start), 3))
    by_scatter = scatter(lin, vectors, num)
    for a in range(4):
        np.subtract.at(by_scatter, lin.start + a, lin.basis[:, a, None] * vectors)
    assert np.abs(by_scatter).max() < 1e-12
    prior = fit.weighted_prior
    stiff = np.diag(np.repeat(prior[0], 3))
    for lag in range(1, 4):
        part = np.diag(np.repeat(prior[lag, :-lag], 3), -3 * lag)
        stiff += part + part.T
    features = np.stack([np.ones_like(fit.observations.own_s), fit.observations.own_s, fit.observations.row])
    by_clock = np.stack(
        [
            (lin.by_time * (features[kind] * (fit.observations.cam == cam))[:, None]).ravel()
            for kind, cam in zip(unknowns.kind, unknowns.cam, strict=True)
        ],
        axis=1,
    )
    weighted, clock = root[:, None] * jacobian, root[:, None] * by_clock
    normal = weighted.T @ weighted + stiff
    schur = clock.T @ clock + np.diag(fit.scale**2 / unknowns.sigma**2)
    schur -= clock.T @ weighted @ np.linalg.solve(normal, weighted.T @ clock)
    found = reduce(fit, lin, unknowns, 0.0).schur
    np.testing.assert_allclose(found, schur, rtol=1e-5, atol=1e-6 * np.abs(schur).max())


@pytest.mark.parametrize("offset_frames", [0.0, 1e-9, 1e-3])
def test_cameras_that_fire_together(offset_frames: float) -> None:
    """True time between observations 0 or almost: nothing is divided by it."""
    offsets_s = np.arange(4) * offset_frames / FPS
    rig = film(wandering(8, 2), 8, offsets_s, num_frames=45)
    result = solve(rig, start="joint")
    assert np.abs(errors_frames(result, rig)).max() < 0.02
    assert result.condition_number < 100


def test_order_in_time_may_change_without_a_step_in_the_cost() -> None:
    fit, unknowns = prepared(film(wandering(4, 1), 4, np.zeros(4), num_frames=20, noise_px=0.5))
    offsets_s = np.linspace(-1.5 / FPS, 1.5 / FPS, 241)
    costs = []
    for offset_s in offsets_s:
        clocks = dataclasses.replace(fit.clocks, offset_s=np.array([0, 0, offset_s, 0]))
        state = dataclasses.replace(fit, clocks=clocks)
        costs.append(
            cost_of(state, linearise(fit.observations, fit.grid, fit.coefficients, clocks), unknowns)
        )
    second = np.abs(np.diff(costs, 2))
    assert np.isfinite(costs).all()
    # A kink would stand out from the second differences around it.
    assert second.max() < 20 * np.median(second) + 1e-6 * max(costs)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_of_the_world_does_not_matter(scale: float) -> None:
    plain = film(wandering(8, 3), 8, OFFSETS_S, num_frames=45)
    scaled = film(wandering(8, 3), 8, OFFSETS_S, num_frames=45, scale=scale)
    a, b = solve(plain, start="joint"), solve(scaled, start="joint")
    np.testing.assert_allclose(
        [clock.offset_s for clock in b.clocks.values()],
        [clock.offset_s for clock in a.clocks.values()],
        rtol=1e-6,
        atol=1e-9,
    )
    assert b.prior_weight == pytest.approx(a.prior_weight / scale**2, rel=1e-4)


def test_two_cameras() -> None:
    rig = film(wandering(12, 4), 12, OFFSETS_S[:2])
    result = solve(rig)
    assert np.abs(errors_frames(result, rig)).max() < 0.05


def test_start_at_the_edge_of_the_search() -> None:
    rig = film(wandering(12, 0), 12, OFFSETS_S, start_frames=2.95)
    assert np.abs(errors_frames(solve(rig), rig)).max() < 0.02


def test_offset_beyond_the_search_is_refused() -> None:
    rig = film(wandering(12, 0), 12, OFFSETS_S, start_frames=0)
    far = dataclasses.replace(rig.guesses["cam02"], offset_s=OFFSETS_S[2] + 6 / FPS)
    rig.guesses["cam02"] = far
    result = solve(rig)
    status = result.clocks["cam02"].status
    assert "edge of the search" in status or "agree" in status
    others = [0, 1, 3]
    assert np.abs(errors_frames(result, rig)[others]).max() < 0.02
    doubtful = dataclasses.replace(far, sigma_s=3 / FPS)
    rig.guesses["cam02"] = doubtful
    assert np.abs(errors_frames(solve(rig), rig)).max() < 0.02


def test_outliers_and_occlusion() -> None:
    rig = film(wandering(12, 5), 12, OFFSETS_S)
    rng = np.random.default_rng(0)
    pixels = rig.points.pixels.copy()
    wrong = rng.random(len(pixels)) < 0.05
    pixels[wrong] = rng.uniform([0, 0], [1920, 1080], (wrong.sum(), 2))
    seen = rng.random(len(pixels)) > 0.3
    result = solve(rig.keep(seen, pixels=pixels))
    assert np.abs(errors_frames(result, rig)).max() < 0.02
    assert result.influence[wrong[seen]].mean() < 0.05
    assert result.influence[~wrong[seen]].mean() > 0.7


def test_points_at_rest_are_refused() -> None:
    center = np.random.default_rng(0).normal(0, 400, (10, 3)) + [0, 0, 900]
    result = solve(film(lambda point, _: center[point], 10, OFFSETS_S[:3], num_frames=40))
    for clock in result.clocks.values():
        assert clock.status != "ok"
        assert clock.score == 0
    assert "no motion" in result.clocks["cam01"].status
    assert result.trajectories is None


@pytest.mark.parametrize("start", ["incremental", "joint"])
def test_one_camera_that_sees_nothing_that_moves(start: str) -> None:
    rig = film(wandering(12, 0), 12, OFFSETS_S)
    result = solve(rig.keep(rig.points.cam != 2), start=start)
    assert "too few common points" in result.clocks["cam02"].status
    assert result.clocks["cam02"].offset_s == rig.guesses["cam02"].offset_s
    assert np.abs(errors_frames(result, rig)[[0, 1, 3]]).max() < 0.02


@pytest.mark.parametrize("start", ["incremental", "joint"])
def test_camera_of_another_event_is_refused(start: str) -> None:
    rig = film(wandering(12, 0), 12, OFFSETS_S)
    other = film(wandering(12, 77), 12, OFFSETS_S)
    strange = rig.points.cam == 1
    pixels = np.where(strange[:, None], other.points.pixels, rig.points.pixels)
    result = solve(rig.keep(np.ones(len(pixels), dtype=bool), pixels=pixels), start=start)
    assert result.clocks["cam01"].status != "ok"
    assert np.abs(errors_frames(result, rig)[[0, 2, 3]]).max() < 0.02


def test_reference_of_another_event_keeps_the_others_together() -> None:
    rig = film(wandering(12, 0), 12, OFFSETS_S)
    other = film(wandering(12, 77), 12, OFFSETS_S)
    pixels = np.where((rig.points.cam == 0)[:, None], other.points.pixels, rig.points.pixels)
    result = solve(rig.keep(np.ones(len(pixels), dtype=bool), pixels=pixels))
    assert result.clocks["cam00"].status != "ok"
    error = errors_frames(result, rig)[1:]
    assert np.abs(error - error[0]).max() < 0.02


@pytest.mark.parametrize("start", ["incremental", "joint"])
def test_islands_of_cameras_are_not_joined(start: str) -> None:
    """Two cameras see other points than the rest: nothing says when they were there."""
    rig = film(wandering(14, 0), 14, np.append(OFFSETS_S, 0.1))
    is_island = rig.points.cam >= 3
    result = solve(rig.keep(is_island == (rig.points.point >= 8)), start=start)
    assert [clock.status == "ok" for clock in result.clocks.values()] == [True, True, True, False, False]
    assert "too few common points" in result.clocks["cam03"].status
    assert np.abs(errors_frames(result, rig)[:3]).max() < 0.02


def test_uniform_motion_along_epipolar_lines_is_refused() -> None:
    """Two cameras, points that keep to their epipolar planes: any offset is explained by another depth."""
    first, second = ring(2)
    along = second.center - first.center
    along /= np.linalg.norm(along)
    rng = np.random.default_rng(0)
    center, speed = (
        rng.normal(0, 400, (12, 3)) + [0, 0, 900],
        rng.choice([-1, 1], 12) * rng.uniform(300, 900, 12),
    )

    def paths(point: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        return center[point] + (speed[point] * (time_s - 1))[:, None] * along

    result = solve(film(paths, 12, OFFSETS_S[:2]))
    assert "epipolar" in result.clocks["cam01"].status


def test_rolling_shutter_and_rate() -> None:
    readout_s = np.array([0.02, 0.01, 0.025, 0.015])
    rates = np.array([0, 80e-6, -60e-6, 0])
    rig = film(wandering(16, 6), 16, OFFSETS_S, readout_s=readout_s, rates=rates, noise_px=0.5)
    known = refine_clocks(
        rig.points,
        rig.cameras,
        rig.guesses,
        "cam00",
        readout_s=dict(zip(rig.points.names, readout_s, strict=True)),
    )
    assert np.abs(errors_frames(known, rig)).max() < 0.02
    found = solve(rig, estimate_readout=True, estimate_rate=True)
    assert np.abs(np.array(list(found.readout_s.values())) - readout_s).max() < 2e-3
    assert np.abs(errors_frames(found, rig)).max() < 0.05


def test_same_input_same_bytes() -> None:
    rig = film(wandering(6, 7), 6, OFFSETS_S[:3], num_frames=30)
    a, b = solve(rig), solve(rig)
    assert a.clocks == b.clocks
    assert a.influence.tobytes() == b.influence.tobytes()


def test_triplets_find_the_pair_that_is_wrong() -> None:
    offset_s = np.array([0, 0.1, 0.3, 0.4])
    delay_s = offset_s[None, :] - offset_s[:, None]
    delay_s[0, 1] += 0.5
    delay_s[1, 0] -= 0.5
    delays = Delays(delay_s, np.full((4, 4), 1e-3), np.ones((4, 4)), {})
    errors = triplet_errors(delays)
    assert errors[0, 1, 2] > 0.4
    assert errors[0, 2, 3] < 0.01
    assert np.isinf(errors[1, 1, 2])
    assert seed_cameras(delays) in ([0, 2, 3], [1, 2, 3])


def test_uncertainty_is_honest() -> None:
    """Errors over stated standard deviations, RMS over several draws, are near one."""
    ratios = []
    for seed in range(4):
        rig = film(wandering(10, seed), 10, OFFSETS_S, num_frames=40, noise_px=2.0, seed=seed)
        result = solve(rig, start="joint")
        sigma = np.array([result.clocks[name].sigma_s for name in rig.points.names]) * FPS
        ratios += list(errors_frames(result, rig)[1:] / sigma[1:])
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 2.0


def test_weight_is_estimated_from_noise_and_speed() -> None:
    """At a fixed noise, motion of twice the amplitude has four times the energy."""
    slow, quick = wandering(10, 8), wandering(10, 8)
    still = slow(np.arange(10), np.zeros(10))
    a = solve(film(slow, 10, OFFSETS_S), start="joint").prior_weight
    b = solve(
        film(lambda p, t: still[p] + 2 * (quick(p, t) - still[p]), 10, OFFSETS_S), start="joint"
    ).prior_weight
    assert a / b == pytest.approx(4, rel=0.4)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("sigma_px", 0.0, "positive sigma_px"),
        ("own_s", np.nan, "finite own_s"),
        ("pixels", np.inf, "finite own_s"),
    ],
)
def test_unusable_points_are_named(field: str, value: float, message: str) -> None:
    rig = film(wandering(3, 0), 3, OFFSETS_S[:2], num_frames=10)
    values = getattr(rig.points, field).copy()
    values[0] = value
    with pytest.raises(InputError, match=message):
        solve(rig.keep(np.ones(len(values), dtype=bool), **{field: values}))


def test_unusable_arguments_are_named() -> None:
    rig = film(wandering(3, 0), 3, OFFSETS_S[:2], num_frames=10)
    nothing = rig.keep(np.zeros(len(rig.cameras), dtype=bool))
    with pytest.raises(InputError, match="got none: nothing moves"):
        solve(nothing)
    with pytest.raises(InputError, match="first guess"):
        solve(rig, reference="cam09")
    with pytest.raises(InputError, match="prior force or kinetic|prior kinetic or force"):
        solve(rig, prior="magic")
    same_place = [rig.cameras[0]] * len(rig.cameras)
    with pytest.raises(InputError, match="different places"):
        refine_clocks(rig.points, same_place, rig.guesses, "cam00")
    with pytest.raises(InputError, match="entries in cameras"):
        refine_clocks(rig.points, rig.cameras[1:], rig.guesses, "cam00")
