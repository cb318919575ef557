"""Smooth curves through camera poses that never run past a pose and back."""

from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

Array = np.ndarray


class PoseSpline:
    """A centripetal cubic spline through poses, on R^3 x SO(3).

    The knots grow by the square root of the distance between poses (which takes places and
    directions together), the tangents are Catmull and Rom's. A tangent is shortened where its
    Bezier control point would lie farther away than the neighbouring pose, and is zero where it
    would point back; so in every stretch the curve stays between the two planes through its ends
    that are perpendicular to the chord. Rotations are joined in the same way by de Casteljau's
    algorithm with great-circle steps.
    Source: Barry and Goldman, SIGGRAPH 1988 (Catmull-Rom splines); Yuksel, Schaefer and Keyser,
    Computer-Aided Design 43(7), 2011 (centripetal knots); Shoemake, SIGGRAPH 1985 (rotations).
    """

    def __init__(self, centers: Array, rotations: Array, log_focal: Array) -> None:
        """centers: (N, 3);  rotations: (N, 3, 3) cam_from_world;  log_focal: (N,), N at least 1."""
        self._centers = np.asarray(centers, dtype=np.float64)
        self._turned: Any = Rotation.from_matrix(rotations).inv()
        self._log_focal = np.asarray(log_focal, dtype=np.float64)
        chords = np.diff(self._centers, axis=0)
        turns = (self._turned[:-1].inv() * self._turned[1:]).as_rotvec() if len(centers) > 1 else chords
        extent = 2 * float(np.linalg.norm(self._centers - self._centers.mean(axis=0), axis=1).max())
        distance = np.hypot(np.linalg.norm(chords, axis=1) / (extent or 1.0), np.linalg.norm(turns, axis=1))
        self.distance = np.concatenate([[0.0], np.cumsum(distance)])
        steps = np.sqrt(distance)
        self.knots = np.concatenate([[0.0], np.cumsum(steps)])
        self._moves = _bezier_arms(chords, steps)
        self._turns = _bezier_arms(turns, steps)

    def poses_at(self, stretch: Array, part: Array) -> tuple[Array, Array, Array]:
        """Poses in stretches between keys.

        stretch: (M,) int, number of the key before;  part: (M,) 0 to 1, how far in the stretch
        Returns centers (M, 3), rotations (M, 3, 3) cam_from_world, log_focal (M,).
        """
        if len(self._centers) == 1:
            first = np.zeros(len(stretch), dtype=np.int64)
            return self._centers[first], self._turned[first].inv().as_matrix(), self._log_focal[first]
        s = np.asarray(part, dtype=np.float64)[:, None]
        before, after = self._centers[stretch], self._centers[stretch + 1]
        leaves, arrives = self._moves[0][stretch], self._moves[1][stretch]
        centers = (
            (1 - s) ** 3 * before
            + 3 * (1 - s) ** 2 * s * (before + leaves)
            + 3 * (1 - s) * s**2 * (after - arrives)
            + s**3 * after
        )
        corners = [self._turned[stretch], self._turned[stretch + 1]]
        corners[1:1] = [
            corners[0] * Rotation.from_rotvec(self._turns[0][stretch]),
            corners[1] * Rotation.from_rotvec(-self._turns[1][stretch]),
        ]
        while len(corners) > 1:
            corners = [_slerp(a, b, s) for a, b in zip(corners, corners[1:], strict=False)]
        a, b = self._log_focal[stretch], self._log_focal[stretch + 1]
        smooth = s[:, 0] ** 2 * (3 - 2 * s[:, 0])
        return centers, corners[0].inv().as_matrix(), a + (b - a) * smooth


def even_places(distance: Array) -> Array:
    """Places of the keys in the film, 0 to 1, at which the view moves evenly; equal steps if it stands."""
    total = float(distance[-1])
    return distance / total if total > 0 else np.linspace(0.0, 1.0, len(distance))


def smooth_progress(at: Array, knots: Array, shares: Array) -> tuple[Array, Array]:
    """Stretch and part of the film's places when the speed changes smoothly at the keys.

    at: (N,) strictly rising places of the keys, N at least 2;  knots: (N,) of the spline;  shares: (M,)
    The knot value is a monotone cubic of the place in the film: the view never goes back.
    """
    shares = np.clip(shares, at[0], at[-1])
    stretch = np.clip(np.searchsorted(at, shares, side="right") - 1, 0, len(at) - 2)
    step = np.diff(knots)[stretch]
    part = (shares - at[stretch]) / np.diff(at)[stretch]
    travelled = PchipInterpolator(at, knots)(shares) - knots[stretch]
    np.divide(travelled, step, out=part, where=step > 0)
    return stretch, np.clip(part, 0.0, 1.0)


def _bezier_arms(chords: Array, steps: Array) -> tuple[Array, Array]:
    """Control points of every stretch as seen from its two ends: (N - 1, 3) each.

    chords: (N - 1, 3) from key to key, in a frame both ends share;  steps: (N - 1,) knot distances
    """
    count = len(chords) + 1
    tangents = np.zeros((count, 3))
    for i in range(1, count - 1):
        before, after = steps[i - 1], steps[i]
        if before > 0 and after > 0:
            slopes = chords[i - 1] / before, chords[i] / after
            tangents[i] = (after * slopes[0] + before * slopes[1]) / (before + after)
    for end, inner, stretch in ((0, 1, 0), (count - 1, count - 2, count - 2)):
        if count > 1 and steps[stretch] > 0:
            tangents[end] = 1.5 * chords[stretch] / steps[stretch] - 0.5 * tangents[inner]
    for i in range(count):
        factor = 1.0
        for stretch in (i - 1, i):
            if not 0 <= stretch < count - 1:
                continue
            chord, arm = chords[stretch], tangents[i] * steps[stretch] / 3
            length = float(np.linalg.norm(arm))
            if length > 0:
                reach = float(np.linalg.norm(chord)) / length
                factor = min(factor, reach) if arm @ chord > 0 else 0.0
        tangents[i] *= factor
    arms = steps[:, None] / 3
    return tangents[:-1] * arms, tangents[1:] * arms


def _slerp(a: Rotation, b: Rotation, s: Array) -> Rotation:
    return a * Rotation.from_rotvec((a.inv() * b).as_rotvec() * s)
