"""Gains and gammas that give static points one colour in all cameras: robust least squares.

Per camera c, channel and sampled frame k a level v in 0..1 becomes exp(g) * v^gamma, with one gamma
per camera and a log gain g that may change from frame to frame. In logarithms a point that cameras
a and b see says g_a + gamma_a L_a = g_b + gamma_b L_b. Both sides are noisy, so a residual is divided
by its own deviation, which grows with the gammas: plain least squares would shrink them instead.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import scipy.sparse

from fourd.frames.observations import ColourPairs

# Deviation of a patch's colour between two views: levels, and share of the level.
_NOISE_LEVELS = 1.5
_NOISE_SHARE = 0.04
# What cameras do unless the pictures say otherwise (natural logarithm): gains and gammas near 1,
# gains that change this much over the length of the clip.
_PRIOR_GAIN, _PRIOR_GAMMA, _PRIOR_DRIFT = 0.5, 0.25, 0.1
_CAUCHY = 2.0
_NUM_ITERATIONS = 30


@dataclasses.dataclass(frozen=True, eq=False)
class ColourModel:
    """Corrections of cameras at sampled frames: level v in 0..1 becomes gain * v ** gamma.

    log_gain: (C, K, 3), gamma: (C, 3), of C cameras at K frames
    log_gain_variance: (C, K, 3), gamma_variance: (C, 3), covariance: (C, K, 3); 0 for fixed cameras
    """

    names: tuple[str, ...]
    frames: tuple[int, ...]
    log_gain: np.ndarray
    gamma: np.ndarray
    log_gain_variance: np.ndarray
    gamma_variance: np.ndarray
    covariance: np.ndarray

    def corrected(self, camera: int, levels: np.ndarray) -> np.ndarray:
        """(K, 3, N) corrected levels 0-255, not clipped, of (N,) levels above 0."""
        log_level = np.log(levels / 255)
        return 255 * np.exp(self.log_gain[camera][:, :, None] + self.gamma[camera][None, :, None] * log_level)

    def sigma_levels(self, camera: int, levels: np.ndarray) -> np.ndarray:
        """(K, 3, N) standard deviation of `corrected`, levels."""
        log_level = np.log(levels / 255)
        variance = (
            self.log_gain_variance[camera][:, :, None]
            + 2 * self.covariance[camera][:, :, None] * log_level
            + self.gamma_variance[camera][None, :, None] * log_level**2
        )
        return self.corrected(camera, levels) * np.sqrt(np.maximum(variance, 0))


def fit_colours(
    observed: Sequence[ColourPairs],
    names: Sequence[str],
    frames: Sequence[int],
    fixed: Mapping[str, tuple[np.ndarray, np.ndarray]],
) -> ColourModel:
    """Corrections of all cameras, jointly, given those of the fixed ones.

    names: free and fixed cameras;  frames: rising, those of `observed`
    fixed: name -> log_gain (K, 3) and gamma (3,) that stay; at least one
    """
    shape = (len(names), len(frames))
    log_gain, gamma = np.zeros((*shape, 3)), np.ones((shape[0], 3))
    for name, (given_gain, given_gamma) in fixed.items():
        log_gain[list(names).index(name)], gamma[list(names).index(name)] = given_gain, given_gamma
    variances = np.zeros((*shape, 3)), np.zeros((shape[0], 3)), np.zeros((*shape, 3))
    free = np.array([name not in fixed for name in names])
    for channel in range(3):
        rows = _Rows(observed, names, frames, channel)
        solved = _solve(rows, np.column_stack([log_gain[..., channel], gamma[:, channel]]), free)
        parameters, covariance = solved
        log_gain[..., channel], gamma[:, channel] = parameters[:, :-1], parameters[:, -1]
        for camera in range(shape[0]):
            own = covariance[camera]
            variances[0][camera, :, channel] = np.diag(own)[:-1]
            variances[1][camera, channel] = own[-1, -1]
            variances[2][camera, :, channel] = own[:-1, -1]
    return ColourModel(tuple(names), tuple(frames), log_gain, gamma, *variances)


class _Rows:
    """Observations of one channel: a and b index cameras, k the frame; log levels and their noise."""

    def __init__(
        self, observed: Sequence[ColourPairs], names: Sequence[str], frames: Sequence[int], channel: int
    ) -> None:
        columns: list[list[np.ndarray]] = [[], [], [], [], []]
        for pairs in observed:
            left, right = pairs.left_levels[:, channel], pairs.right_levels[:, channel]
            known = np.isfinite(left) & np.isfinite(right)
            indices = (
                list(names).index(pairs.left),
                list(names).index(pairs.right),
                list(frames).index(pairs.frame),
            )
            for column, index in zip(columns, indices, strict=False):
                column.append(np.full(known.sum(), index))
            columns[3].append(left[known])
            columns[4].append(right[known])
        a, b, k, left, right = (np.concatenate(column) if column else np.zeros(0) for column in columns)
        self.a, self.b, self.k = (index.astype(np.int64) for index in (a, b, k))
        self.log_a, self.log_b = np.log(left / 255), np.log(right / 255)
        self.noise_a, self.noise_b = (
            np.hypot(_NOISE_SHARE, _NOISE_LEVELS / level) for level in (left, right)
        )

    def residuals(self, parameters: np.ndarray) -> tuple[np.ndarray, scipy.sparse.csr_matrix]:
        """(N,) residuals in deviations and their derivatives by the (C, K + 1) parameters."""
        gamma_a, gamma_b = parameters[self.a, -1], parameters[self.b, -1]
        difference = (
            parameters[self.a, self.k]
            + gamma_a * self.log_a
            - parameters[self.b, self.k]
            - gamma_b * self.log_b
        )
        deviation = np.hypot(gamma_a * self.noise_a, gamma_b * self.noise_b)
        residual = difference / deviation
        shrink = residual / deviation**2
        values = np.stack(
            [
                1 / deviation,
                self.log_a / deviation - shrink * gamma_a * self.noise_a**2,
                -1 / deviation,
                -self.log_b / deviation - shrink * gamma_b * self.noise_b**2,
            ],
            axis=1,
        )
        width = parameters.shape[1]
        columns = [
            self.a * width + self.k,
            self.a * width + width - 1,
            self.b * width + self.k,
            self.b * width + width - 1,
        ]
        starts = np.arange(len(residual) + 1) * 4
        shape = (len(residual), parameters.size)
        jacobian = scipy.sparse.csr_matrix((values.ravel(), np.stack(columns, axis=1).ravel(), starts), shape)
        return residual, jacobian


def _prior(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix of the prior and its gradient: near identity, slow over time."""
    num_cameras, width = parameters.shape
    num_frames = width - 1
    drift = np.diff(np.eye(num_frames), axis=0) * np.sqrt(max(1, num_frames - 1)) / _PRIOR_DRIFT
    one = np.zeros((width, width))
    one[:num_frames, :num_frames] = drift.T @ drift + np.eye(num_frames) / (_PRIOR_GAIN**2 * num_frames)
    one[-1, -1] = 1 / _PRIOR_GAMMA**2
    identity = np.append(np.zeros(num_frames), 1.0)
    gradient = (parameters - identity) @ one
    return np.kron(np.eye(num_cameras), one), gradient.ravel()


def _solve(rows: _Rows, start: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton with Cauchy weights. Returns (C, K + 1) parameters and (C, K + 1, K + 1) covariances.

    start: (C, K + 1) log gains and gamma;  free: (C,) which cameras are solved for
    """
    parameters = start.copy()
    num_cameras, width = parameters.shape
    solved_for = np.repeat(free, width)
    normal = np.eye(int(solved_for.sum()))
    for _ in range(_NUM_ITERATIONS):
        residual, jacobian = rows.residuals(parameters)
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-3) if len(residual) else 1.0
        weight = 1 / (1 + (residual / (_CAUCHY * scale)) ** 2) / scale**2
        prior, prior_gradient = _prior(parameters)
        weighted = jacobian.multiply(weight[:, None]).tocsr()
        normal = ((jacobian.T @ weighted).toarray() + prior)[np.ix_(solved_for, solved_for)]
        gradient = (weighted.T @ residual + prior_gradient)[solved_for]
        step = np.linalg.solve(normal, gradient)
        change = np.zeros(parameters.size)
        change[solved_for] = -step
        parameters = parameters + change.reshape(parameters.shape)
        parameters[:, -1] = np.clip(parameters[:, -1], 0.3, 3.0)
        if np.abs(step).max(initial=0) < 1e-7:
            break
    inverse = np.zeros((parameters.size, parameters.size))
    inverse[np.ix_(solved_for, solved_for)] = np.linalg.inv(normal)
    blocks = inverse.reshape(num_cameras, width, num_cameras, width)
    return parameters, np.stack([blocks[c, :, c] for c in range(num_cameras)])
