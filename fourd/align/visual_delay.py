"""How much later one film started than another, by what both see move.

Tracks of moving points are matched by their looks alone, at whatever times they were seen. A matched
pair of tracks that is one and the same point lies on common epipolar planes at the right offset, and
at few others: its angle off the plane, as a function of the offset, has a valley there. Every pair of
tracks votes with its valley; wrong matches vote for anything. Around the highest vote the offset is
the one at which the angles of the pairs that agree vary least.

After the frame-level search of M. Vo, S. Narasimhan, Y. Sheikh, "Spatiotemporal Bundle Adjustment for
Dynamic 3D Reconstruction", CVPR 2016, section 4, with votes over unverified matches in place of
verified correspondences.
"""

import dataclasses

import numba
import numpy as np

from fourd.align.clock import PairDelay
from fourd.align.moving_tracks import MovingTracks
from fourd.align.vision_options import VisionOptions
from fourd.film_cameras import FilmCamera

COARSE_STEP_S = 1 / 60
# The refined search: this far around the highest vote, in these steps.
FINE_RANGE_S, FINE_STEP_S = 0.05, 5e-4
MIN_COMMON = 6
CONSTANT_SHARE = 0.95
MATCH_RATIO = 0.85
# Votes this far from the highest one belong to other offsets.
PEAK_GAP_S = 0.1
# A right offset is voted for this much more often than any other (benches/visual_sync.py).
MIN_DISTINCTNESS, SURE_DISTINCTNESS = 1.2, 1.7
MIN_VOTES, SURE_VOTES = 3.0, 12.0
NUM_RESAMPLES = 100
SIGMA_FLOOR_S = 5e-4


@dataclasses.dataclass(frozen=True, eq=False)
class VisualMatch:
    """A pair's delay and what speaks for it.

    offsets_s, votes: (L,) the search;  tracks: (P, 2) matched tracks that agree with the delay
    fine_s, cost: (K,) the refined search, variance of the angle in rad^2
    """

    delay: PairDelay
    offsets_s: np.ndarray
    votes: np.ndarray
    tracks: np.ndarray
    fine_s: np.ndarray
    cost: np.ndarray

    def turned(self) -> "VisualMatch":
        """The same with left and right exchanged."""
        old = self.delay
        delay = dataclasses.replace(
            old, left=old.right, right=old.left, delay_s=-old.delay_s, time_s=old.time_s + old.delay_s
        )
        return VisualMatch(
            delay, -self.offsets_s[::-1], self.votes[::-1], self.tracks[:, ::-1], -self.fine_s[::-1],
            self.cost[::-1],
        )  # fmt: skip


def match_tracks(left: MovingTracks, right: MovingTracks) -> np.ndarray:
    """(M, 2) int64 tracks of both films that look alike, each pair once, sorted.

    A descriptor must be clearly nearer to its match than to any descriptor of another track.
    """
    if len(left.descriptors) == 0 or len(right.descriptors) == 0:
        return np.zeros((0, 2), np.int64)
    similarity = left.descriptors @ right.descriptors.T
    nearest = similarity.argmax(axis=1)
    best = similarity[np.arange(len(nearest)), nearest]
    matched_track = right.descriptor_track[nearest]
    second = np.full(len(nearest), -1.0, np.float32)
    for first in range(0, len(nearest), 512):
        rows = slice(first, first + 512)
        is_same = right.descriptor_track[None] == matched_track[rows, None]
        second[rows] = np.where(is_same, -1, similarity[rows]).max(axis=1)
    back = left.descriptor_track[similarity.argmax(axis=0)]
    # Unit vectors: the squared distance is 2 - 2 * similarity.
    is_distinct = (1 - best) < MATCH_RATIO**2 * (1 - second)
    is_mutual = back[nearest] == left.descriptor_track
    chosen = is_distinct | (is_mutual & (2 - 2 * best < 0.25))
    pairs = np.stack([left.descriptor_track, matched_track], axis=1)[chosen]
    return np.unique(pairs, axis=0) if len(pairs) else np.zeros((0, 2), np.int64)


@dataclasses.dataclass(frozen=True, eq=False)
class TrackRays:
    """Observations as rays: (N, 3) unit directions and centres, world; first: (T + 1,) of each track."""

    direction: np.ndarray
    center: np.ndarray
    own_s: np.ndarray
    first: np.ndarray


def rays_of_tracks(motion: MovingTracks, film: FilmCamera) -> TrackRays:
    """All observations of a film's tracks as rays in the world."""
    direction, center = np.zeros((len(motion.frame), 3)), np.zeros((len(motion.frame), 3))
    for frame in np.unique(motion.frame):
        camera = film.at(int(frame))
        assert camera is not None, "motion is only looked for where the camera is known"
        at = motion.frame == frame
        rays = camera.rays(motion.pixels[at]) @ camera.R
        direction[at] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        center[at] = camera.center
    first = np.searchsorted(motion.track, np.arange(motion.num_tracks + 1))
    return TrackRays(direction, center, motion.own_s, first)


@numba.njit(cache=True)
def _off_plane(direction, center, other_direction, other_center):  # pragma: no cover
    """Signed angle of a ray off the plane through the other ray and both centres, rad."""
    bx, by, bz = (
        other_center[0] - center[0],
        other_center[1] - center[1],
        other_center[2] - center[2],
    )
    nx = by * other_direction[2] - bz * other_direction[1]
    ny = bz * other_direction[0] - bx * other_direction[2]
    nz = bx * other_direction[1] - by * other_direction[0]
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if length == 0.0:
        return np.inf
    return (direction[0] * nx + direction[1] * ny + direction[2] * nz) / length


@numba.njit(cache=True)
def _track_angles(ld, lc, lt, rd, rc, rt, offset_s, out):  # pragma: no cover
    """Angles of the left track's observations against the right track moved by an offset; their number."""
    count, k = 0, 0
    direction, center = np.empty(3), np.empty(3)
    for i in range(len(lt)):
        own = lt[i] - offset_s
        if own < rt[0] or own > rt[-1]:
            continue
        while k + 2 < len(rt) and rt[k + 1] < own:
            k += 1
        share = (own - rt[k]) / (rt[k + 1] - rt[k])
        for axis in range(3):
            direction[axis] = rd[k, axis] + share * (rd[k + 1, axis] - rd[k, axis])
            center[axis] = rc[k, axis] + share * (rc[k + 1, axis] - rc[k, axis])
        out[count] = _off_plane(ld[i], lc[i], direction, center)
        count += 1
    return count


@numba.njit(cache=True)
def _pair_angles(pairs, offsets, ld, lc, lt, lf, rd, rc, rt, rf, squared):  # pragma: no cover
    """(P, L) median angle, or variance of the angle, of each pair at each offset; NaN without overlap."""
    result = np.full((len(pairs), len(offsets)), np.nan)
    buffer = np.empty(len(lt))
    for p in range(len(pairs)):
        a, b = pairs[p]
        left, right = slice(lf[a], lf[a + 1]), slice(rf[b], rf[b + 1])
        for q in range(len(offsets)):
            count = _track_angles(
                ld[left], lc[left], lt[left], rd[right], rc[right], rt[right], offsets[q], buffer
            )
            if count >= MIN_COMMON:
                values = buffer[:count]
                if squared:
                    result[p, q] = np.mean(values * values) - CONSTANT_SHARE * np.mean(values) ** 2
                else:
                    result[p, q] = np.median(np.abs(values))
    return result


def measure_angles(
    pairs: np.ndarray, offsets_s: np.ndarray, left: TrackRays, right: TrackRays, squared: bool = False
) -> np.ndarray:
    """(P, L) angle off the epipolar plane, rad, of each pair of tracks at each offset.

    The median over the common times, or with `squared` the variance and a little of the squared mean: an
    error of the cameras shifts all angles of a track alike, and must not pull the offset. NaN where a
    pair has fewer than MIN_COMMON common times. The right track is interpolated between its frames.
    """
    return _pair_angles(
        pairs, offsets_s, left.direction, left.center, left.own_s, left.first,
        right.direction, right.center, right.own_s, right.first, squared,
    )  # fmt: skip


def estimate_visual_delay(
    left: MovingTracks,
    right: MovingTracks,
    rays: tuple[TrackRays, TrackRays],
    search_s: tuple[float, float],
    options: VisionOptions,
) -> VisualMatch:
    """The delay between two films by what moves in both.

    rays: `rays_of_tracks` of both;  search_s: least and largest offset_s of right minus left
    The delay's status says why there is none: nothing moves, nothing matches, no offset stands out.
    """
    # The film with more frames is interpolated; of equals the later by name, so that order says nothing.
    if (_frame_s(left), right.name) < (_frame_s(right), left.name):
        turned = estimate_visual_delay(right, left, (rays[1], rays[0]), (-search_s[1], -search_s[0]), options)
        return turned.turned()
    pairs = match_tracks(left, right)
    offsets = np.arange(search_s[0], search_s[1] + COARSE_STEP_S / 2, COARSE_STEP_S)
    silent = next((f"{m.name}: {m.status}" for m in (left, right) if m.status != "ok"), None)
    if silent or len(pairs) == 0:
        reason = silent or "no moving point of one film is found again in the other"
        return _refused(left, right, reason, offsets, np.zeros(len(offsets)))
    valley = np.radians(options.valley_deg)
    votes = np.nansum(np.clip(1 - measure_angles(pairs, offsets, *rays) / valley, 0, None), axis=0)
    at = int(votes.argmax())
    elsewhere = votes[np.abs(offsets - offsets[at]) > PEAK_GAP_S].max(initial=0.0)
    score = score_votes(float(votes[at]), float(elsewhere))
    if score < options.min_visual_score:
        reason = (
            f"no offset stands out: {votes[at]:.1f} votes for {offsets[at]:+.2f} s, {elsewhere:.1f} for "
            "another"
        )
        return _refused(left, right, reason, offsets, votes, score)
    agree = pairs[measure_angles(pairs, offsets[at : at + 1], *rays)[:, 0] < valley]
    fine = offsets[at] + np.arange(-FINE_RANGE_S, FINE_RANGE_S + FINE_STEP_S / 2, FINE_STEP_S)
    squared = measure_angles(agree, fine, *rays, squared=True)
    complete = np.isfinite(squared).all(axis=1)
    if not complete.any():
        return _refused(
            left, right, "matched tracks are too short to refine the offset", offsets, votes, score
        )
    delay_s, sigma_s = _refine(fine, np.minimum(squared[complete], valley**2))
    seen = np.isin(right.track, agree[:, 1])
    time_s = float(right.own_s[seen].mean())
    delay = PairDelay(left.name, right.name, delay_s, sigma_s, score, "vision", time_s=time_s)
    return VisualMatch(delay, offsets, votes, agree, fine, squared[complete].mean(axis=0))


def _frame_s(motion: MovingTracks) -> float:
    """Usual time from frame to frame, s, to a microsecond; 0 where nothing was seen."""
    times = np.unique(motion.own_s)
    return round(float(np.median(np.diff(times))), 6) if len(times) > 1 else 0.0


def score_votes(votes: float, elsewhere: float) -> float:
    """0 to 1: how sure it is that the offset with the most votes is right."""
    distinct = (votes / max(elsewhere, 1e-9) - MIN_DISTINCTNESS) / (SURE_DISTINCTNESS - MIN_DISTINCTNESS)
    many = (votes - MIN_VOTES) / (SURE_VOTES - MIN_VOTES)
    return float(np.clip(min(distinct, many), 0, 1))


def _refine(fine: np.ndarray, costs: np.ndarray) -> tuple[float, float]:
    """Offset of least cost and its standard deviation by resampling pairs of tracks.

    fine: (K,) s;  costs: (P, K) of each pair
    """

    def lowest(cost: np.ndarray) -> float:
        at = int(np.clip(cost.argmin(), 1, len(cost) - 2))
        before, here, after = cost[at - 1 : at + 2]
        bend = before - 2 * here + after
        return float(
            fine[at] + (np.clip((before - after) / (2 * bend), -1, 1) * FINE_STEP_S if bend > 0 else 0)
        )

    rng = np.random.default_rng(0)
    count = len(costs)
    drawn = [lowest(costs[rng.integers(0, count, count)].mean(axis=0)) for _ in range(NUM_RESAMPLES)]
    # Points of one body move together: they are fewer witnesses than they seem.
    return lowest(costs.mean(axis=0)), float(np.hypot(2 * np.std(drawn), SIGMA_FLOOR_S))


def _refused(
    left: MovingTracks,
    right: MovingTracks,
    reason: str,
    offsets: np.ndarray,
    votes: np.ndarray,
    score: float = 0.0,
) -> VisualMatch:
    delay = PairDelay(left.name, right.name, 0.0, 0.0, score, "vision", status=reason)
    none = np.zeros(0)
    return VisualMatch(delay, offsets, votes, np.zeros((0, 2), np.int64), none, none)
