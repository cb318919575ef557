"""How much later one film started than another, by motion on epipolar planes, without correspondences.

All that moves in one epipolar plane moves in that plane for the other camera too, whatever it looks like
from there. So the motion of a film is summed over a pencil of planes around the baseline; at the right
offset the two tables (plane, time) rise and fall together. It works where the views are too far apart
for any feature to match, and says less than tracks where they do.

After the motion barcodes of G. Ben-Artzi, M. Werman, S. Peleg, "Event Retrieval Using Motion Barcodes",
ICIP 2015, on epipolar lines; here with amounts of motion in place of bits and known cameras.
"""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from fourd.align.clock import PairDelay
from fourd.align.motion_maps import MotionMaps
from fourd.camera import Camera
from fourd.geometry import convergence_point

NUM_PLANES = 96
COARSE_STEP_S, FINE_STEP_S = 1 / 60, 1 / 240
SMOOTH_FRAMES = 1.0
# Films that share less time than this are not compared, s.
MIN_OVERLAP_S, MIN_COMMON = 0.5, 6
# Peaks this far from the highest one belong to other offsets, s.
PEAK_GAP_S = 0.12
# The highest peak above the next one, in units of atanh(correlation) * sqrt(seconds): what other events,
# and films played backwards, reach by chance, and what they never do (benches/visual_sync.py).
CHANCE_MARGIN, SURE_MARGIN = 0.2, 0.5
# Groups of neighbouring planes that are left out in turn: what they change tells the uncertainty.
NUM_GROUPS = 8
SIGMA_FLOOR_FRAMES = 0.3


@dataclasses.dataclass(frozen=True, eq=False)
class EpipolarMatch:
    """A pair's delay and what speaks for it.

    offsets_s, correlation: (L,) the search, NaN where the films share too little time
    evidence: (L,) atanh(correlation) * sqrt(common seconds)
    """

    delay: PairDelay
    offsets_s: np.ndarray
    correlation: np.ndarray
    evidence: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class _Pencil:
    """Half-planes around the line through both cameras; angle 0 is where they look."""

    origin: np.ndarray
    forward: np.ndarray
    side: np.ndarray
    target: np.ndarray

    def angles(self, camera: Camera) -> np.ndarray:
        """(h, w) angle of each pixel's point at the depth of the target, rad.

        A hand-held camera leaves the line by centimetres; points near the target keep their angles.
        """
        width, height = camera.size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
        depth = max(float(camera.forward @ (self.target - camera.center)), 0.0)
        points = camera.unproject(pixels, np.full((height, width), depth)) - self.origin
        return np.arctan2(points @ self.side, points @ self.forward)


def compare_motion(
    left: MotionMaps, right: MotionMaps, search_s: tuple[float, float], min_score: float = 0.5
) -> EpipolarMatch:
    """The delay between two films by how motion on their common epipolar planes rises and falls.

    search_s: least and largest offset_s of right minus left;  min_score: of a delay that is believed
    The delay's status says why there is none.
    """
    offsets = np.arange(search_s[0], search_s[1] + COARSE_STEP_S / 2, COARSE_STEP_S)
    silent = next((f"{m.name}: {m.status}" for m in (left, right) if m.status != "ok"), None)
    if silent:
        return _refused(left, right, silent, offsets)
    tables = motion_on_planes(left, right)
    if tables is None:
        return _refused(left, right, "they share no epipolar plane: one camera sees the other", offsets)
    correlation = _correlate(tables, left.own_s, right.own_s, offsets)
    common = np.minimum(left.own_s[-1], right.own_s[-1] + offsets) - np.maximum(
        left.own_s[0], right.own_s[0] + offsets
    )
    evidence = np.arctanh(np.clip(correlation, -0.999, 0.999)) * np.sqrt(np.maximum(common, 0))
    if not np.isfinite(evidence).any():
        return _refused(left, right, f"the films share less than {MIN_OVERLAP_S:g} s", offsets)
    at = int(np.nanargmax(evidence))
    far = np.abs(offsets - offsets[at]) > PEAK_GAP_S
    other = float(np.nanmax(evidence[far], initial=0.0, where=np.isfinite(evidence[far])))
    margin = float(evidence[at]) - other
    # A peak just past chance is as likely wrong as right; at min_score it is not yet believed.
    score = float(np.clip((margin - CHANCE_MARGIN) / (SURE_MARGIN - CHANCE_MARGIN), 0, 1))
    if score < min_score or not 0 < at < len(offsets) - 1:
        reason = (
            f"no offset stands out: motion agrees {evidence[at]:.2f} at {offsets[at]:+.2f} s, "
            f"{other:.2f} at another"
        )
        delay = PairDelay(left.name, right.name, 0.0, 0.0, score, "vision", status=reason)
        return EpipolarMatch(delay, offsets, correlation, evidence)
    delay_s, sigma_s = _refine(tables, left.own_s, right.own_s, float(offsets[at]))
    shared = (
        max(left.own_s[0] - delay_s, right.own_s[0]) + min(left.own_s[-1] - delay_s, right.own_s[-1])
    ) / 2
    delay = PairDelay(left.name, right.name, delay_s, sigma_s, score, "vision", time_s=float(shared))
    return EpipolarMatch(delay, offsets, correlation, evidence)


def motion_on_planes(left: MotionMaps, right: MotionMaps) -> tuple[np.ndarray, np.ndarray] | None:
    """(F_left, NUM_PLANES) and (F_right, NUM_PLANES) float32 motion on the epipolar planes both see.

    Roots are taken, so that many pixels of one mover do not drown another. None without common planes.
    """
    pencil = _make_pencil(left.cameras, right.cameras)
    if pencil is None:
        return None
    known = {id(camera): pencil.angles(camera) for film in (left, right) for camera in film.cameras}
    angles = [[known[id(camera)] for camera in film.cameras] for film in (left, right)]
    # Each film's range is that of its usual frame: shake makes the outermost planes come and go.
    lowest = max(float(np.median([a.min() for a in film])) for film in angles)
    highest = min(float(np.median([a.max() for a in film])) for film in angles)
    if highest <= lowest:
        return None
    tables = []
    for film, maps in zip(angles, (left.maps, right.maps), strict=True):
        rows = [_sum_over_planes(m, a, lowest, highest) for m, a in zip(maps, film, strict=True)]
        table = np.sqrt(np.stack(rows)).astype(np.float32)
        # Over time, too: between frames the spline averages noise away, which would favour offsets of half
        # a frame over whole ones.
        tables.append(cv2.GaussianBlur(table, (0, 0), sigmaX=1.0, sigmaY=SMOOTH_FRAMES))
    return tables[0], tables[1]


def _make_pencil(left: Sequence[Camera], right: Sequence[Camera]) -> _Pencil | None:
    origin = np.mean([c.center for c in left], axis=0)
    baseline = np.mean([c.center for c in right], axis=0) - origin
    length = float(np.linalg.norm(baseline))
    middle = left[len(left) // 2], right[len(right) // 2]
    view = middle[0].forward + middle[1].forward
    if length == 0:
        return None
    baseline /= length
    forward = view - baseline * (view @ baseline)
    if np.linalg.norm(forward) < 1e-3:
        return None
    forward /= np.linalg.norm(forward)
    target = convergence_point(middle)
    if any(float(c.forward @ (target - c.center)) <= 0 for c in middle):
        # The axes part: what both see is far away against their distance.
        target = origin + 100 * length * forward
    return _Pencil(origin, forward, np.cross(baseline, forward), target)


def _sum_over_planes(motion: np.ndarray, angles: np.ndarray, lowest: float, highest: float) -> np.ndarray:
    """(NUM_PLANES,) sums of the motion, each pixel shared between the two nearest planes."""
    position = (angles - lowest) / (highest - lowest) * NUM_PLANES - 0.5
    below = np.floor(position).astype(int)
    share = position - below
    at = (below >= 0) & (below < NUM_PLANES - 1) & (motion > 0)
    amount = motion[at] / 255.0
    first = np.bincount(below[at], amount * (1 - share[at]), NUM_PLANES)
    return first + np.bincount(below[at] + 1, amount * share[at], NUM_PLANES)


def _correlate(
    tables: tuple[np.ndarray, np.ndarray], left_s: np.ndarray, right_s: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """(L,) normalised correlation over planes and common times, NaN where too few are common."""
    spline = CubicSpline(right_s, tables[1], axis=0)
    result = np.full(len(offsets), np.nan)
    for index, offset in enumerate(offsets):
        times = left_s - offset
        common = (times >= right_s[0]) & (times <= right_s[-1])
        if common.sum() < MIN_COMMON or np.ptp(times[common]) < MIN_OVERLAP_S:
            continue
        a, b = tables[0][common], spline(times[common])
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        scale = float(np.sqrt((a * a).sum() * (b * b).sum()))
        result[index] = float((a * b).sum()) / scale if scale > 0 else 0.0
    return result


def _refine(
    tables: tuple[np.ndarray, np.ndarray], left_s: np.ndarray, right_s: np.ndarray, around_s: float
) -> tuple[float, float]:
    """Offset of the peak to a part of a frame, and its standard deviation (jackknife over planes)."""
    fine = around_s + np.arange(-1.5 * COARSE_STEP_S, 1.5 * COARSE_STEP_S + FINE_STEP_S / 2, FINE_STEP_S)

    def peak(planes: np.ndarray) -> float:
        values = _correlate((tables[0][:, planes], tables[1][:, planes]), left_s, right_s, fine)
        at = int(np.clip(np.nanargmax(values), 1, len(values) - 2))
        before, here, after = values[at - 1 : at + 2]
        bend = before - 2 * here + after
        return float(
            fine[at] + (np.clip((before - after) / (2 * bend), -1, 1) * FINE_STEP_S if bend < 0 else 0)
        )

    group = np.arange(NUM_PLANES) * NUM_GROUPS // NUM_PLANES
    without = np.array([peak(np.flatnonzero(group != i)) for i in range(NUM_GROUPS)])
    spread = float(np.sqrt((NUM_GROUPS - 1) * np.mean((without - without.mean()) ** 2)))
    frame_s = max(float(np.median(np.diff(left_s))), float(np.median(np.diff(right_s))))
    return peak(np.arange(NUM_PLANES)), float(np.hypot(spread, SIGMA_FLOOR_FRAMES * frame_s))


def _refused(left: MotionMaps, right: MotionMaps, reason: str, offsets: np.ndarray) -> EpipolarMatch:
    delay = PairDelay(left.name, right.name, 0.0, 0.0, 0.0, "vision", status=reason)
    none = np.full(len(offsets), np.nan)
    return EpipolarMatch(delay, offsets, none, none)
