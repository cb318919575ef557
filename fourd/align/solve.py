"""`solve`: one clock for all cameras from what was heard and, where that leaves doubt, seen.

Input cameras are placed first. Held-out cameras are then placed against their finished clocks, so
nothing about an input camera depends on a held-out one.
"""

import dataclasses
import itertools
import logging
import math
from collections.abc import Mapping, Sequence

import numpy as np

from fourd.align.clock import PPM, CameraClock, Offsets, PairDelay
from fourd.align.clock_graph import attach_clock, correct_sound_travel, count_closing, solve_clocks
from fourd.align.epipolar_motion import EpipolarMatch, compare_motion
from fourd.align.listen import SAME_RECORDING, TRAVEL_SIGMA_S
from fourd.align.motion_maps import MotionMaps
from fourd.align.moving_tracks import MovingTracks
from fourd.align.request import ClockRequest
from fourd.align.sampling import TOO_SHORT
from fourd.align.spatiotemporal import refine_clocks
from fourd.align.spatiotemporal_options import SpatiotemporalOptions
from fourd.align.track_groups import join_observations
from fourd.align.vision_options import VisionOptions
from fourd.align.visual_delay import TrackRays, VisualMatch, estimate_visual_delay, rays_of_tracks
from fourd.camera import Camera
from fourd.film_cameras import FilmCamera, FilmCameras
from fourd.geometry import convergence_point

log = logging.getLogger(__name__)

# Around what sound says, sight searches this far: echoes and unheard travel are shorter.
NEAR_SOUND_S = 0.25
# Sound and sight of one pair, or a pair and the joint solution, that differ by more contradict each other.
MAX_SIGMAS = 4.0
MIN_JOINT_POINTS = 10
# Points of one body err together, so the joint solution is less certain than their number says: on two
# rendered events with truth its errors are twice what it claims.
JOINT_SIGMA_FACTOR = 2.0


def needs_vision(audio: Offsets, request: ClockRequest, options: VisionOptions) -> str:
    """Why sight is needed besides sound, empty if it is not."""
    if options.use == "never":
        return ""
    if options.use == "always":
        return "align_vision.use is `always`"
    looked_at = [name for name in request.names if not audio.clocks[name].status.startswith(TOO_SHORT)]
    silent = [name for name in looked_at if audio.clocks[name].status != "ok"]
    if silent:
        return f"sound does not place {', '.join(silent)}"
    limit_s = options.max_sound_sigma_frames / request.fps
    doubtful = [name for name in looked_at if audio.clocks[name].sigma_s > limit_s]
    return f"sound leaves doubt about {', '.join(doubtful)}" if doubtful else ""


def sound_pairs(audio: Offsets, films: FilmCameras) -> list[PairDelay]:
    """The delays by sound, without its travel where the cameras are metric, else with a doubt for it."""
    known = {name: film for name, film in films.cameras.items() if film.status == "ok"}
    usable = [p for p in audio.pairs if p.status == "ok"]
    if films.metres_per_unit is None or len(known) < 2:
        return [dataclasses.replace(p, sigma_s=math.hypot(p.sigma_s, TRAVEL_SIGMA_S)) for p in usable]
    middle = {name: film.cameras[len(film.cameras) // 2] for name, film in known.items()}
    centers = {name: camera.center * films.metres_per_unit for name, camera in middle.items()}
    source = convergence_point(list(middle.values())) * films.metres_per_unit
    return list(
        correct_sound_travel([p for p in usable if {p.left, p.right} <= set(centers)], centers, source)
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Motion:
    """What moves in one film, as points that are followed and as maps."""

    tracks: MovingTracks
    maps: MotionMaps


def compare_films(
    pairs: Sequence[tuple[str, str]],
    motions: Mapping[str, Motion],
    films: Mapping[str, FilmCamera],
    audio: Offsets,
    options: VisionOptions,
) -> list[VisualMatch | EpipolarMatch]:
    """What sight says about pairs of films: near what sound says, or everywhere where it is silent.

    Where no points match, because the views are too far apart, the motion on epipolar planes may tell.
    """
    rays: dict[str, TrackRays] = {
        name: rays_of_tracks(motions[name].tracks, films[name])
        for name in sorted({name for pair in pairs for name in pair})
    }
    matches: list[VisualMatch | EpipolarMatch] = []
    for left, right in pairs:
        one, other = audio.clocks[left], audio.clocks[right]
        search = (-options.max_delay_s, options.max_delay_s)
        if one.status == other.status == "ok":
            heard = other.offset_s - one.offset_s
            search = (heard - NEAR_SOUND_S, heard + NEAR_SOUND_S)
        tracks = motions[left].tracks, motions[right].tracks
        match: VisualMatch | EpipolarMatch = estimate_visual_delay(
            *tracks, (rays[left], rays[right]), search, options
        )
        if match.delay.status != "ok":
            wide = compare_motion(motions[left].maps, motions[right].maps, search, options.min_visual_score)
            match = wide if wide.delay.status == "ok" else match
        delay = match.delay
        log.info("%s %s: %.4f s, score %.2f: %s", left, right, delay.delay_s, delay.score, delay.status)
        matches.append(match)
    return matches


def merge_pairs(
    heard: Sequence[PairDelay], seen: Sequence[PairDelay]
) -> tuple[list[PairDelay], tuple[str, ...]]:
    """One delay per pair of cameras from sound and sight, and notes where the two contradict each other.

    Agreeing delays are weighted by their variances. Of contradicting ones that is taken with which more
    triplets of cameras close; of equals sight: a film's sound may lie beside its pictures, and an echo or
    other music can deceive it. Sight errs where a walk of few steps looks alike one step later.
    """
    merged = {(p.left, p.right): p for p in heard if p.status == "ok"}
    contradicted: dict[tuple[str, str], tuple[PairDelay, float]] = {}
    for pair in seen:
        if pair.status != "ok":
            continue
        key = (pair.left, pair.right)
        sound = merged.get(key)
        if sound is None:
            merged[key] = pair
            continue
        # Sight knows the delay at its time_s only; sound knows how it changes.
        difference_s = pair.delay_s - sound.delay_s - sound.rate_ppm * PPM * pair.time_s
        if abs(difference_s) > MAX_SIGMAS * math.hypot(sound.sigma_s, pair.sigma_s):
            contradicted[key] = pair, difference_s
            continue
        weights = np.array([sound.sigma_s, pair.sigma_s]) ** -2.0
        merged[key] = dataclasses.replace(
            sound,
            delay_s=sound.delay_s + float(weights[1] / weights.sum()) * difference_s,
            sigma_s=float(weights.sum() ** -0.5),
            score=max(sound.score, pair.score),
            method="audio+vision",
        )
    by_sound = count_closing(list(merged.values()))
    by_sight = count_closing(list((merged | {key: pair for key, (pair, _) in contradicted.items()}).values()))
    notes = []
    for key, (pair, difference_s) in contradicted.items():
        is_seen = by_sight[key] >= by_sound[key]
        merged[key] = pair if is_seen else merged[key]
        reason = "sight is taken" if is_seen else "sound is taken, with which more triplets of cameras close"
        notes.append(
            f"{pair.left} and {pair.right}: sight differs from sound by {1e3 * difference_s:+.1f} ms, more "
            f"than their doubts allow; {reason}"
        )
    return list(merged.values()), tuple(notes)


def refine_jointly(
    clocks: Mapping[str, CameraClock],
    reference: str,
    matches: Sequence[VisualMatch | EpipolarMatch],
    motions: Mapping[str, Motion],
    films: Mapping[str, FilmCamera],
    options: SpatiotemporalOptions,
) -> tuple[dict[str, CameraClock], tuple[str, ...]]:
    """Clocks after the spatiotemporal bundle adjustment of all moving points, and notes.

    A camera that the joint solution refuses, or moves further than its doubt allows, keeps its clock.
    """
    names = [name for name, clock in clocks.items() if clock.status == "ok"]
    tracks = {name: motions[name].tracks for name in names}
    points = join_observations(names, tracks, [m for m in matches if isinstance(m, VisualMatch)])
    num_points = int(points.point.max()) + 1 if len(points.point) else 0
    if num_points < MIN_JOINT_POINTS or len(names) < 2:
        return dict(clocks), (
            f"no joint refinement: {num_points} moving points are seen by two cameras or more",
        )
    cameras: list[Camera] = []
    for cam, frame in zip(points.cam, points.frame, strict=True):
        camera = films[names[cam]].at(int(frame))
        assert camera is not None, "motion is only looked for where the camera is known"
        cameras.append(camera)
    result = refine_clocks(points, cameras, {name: clocks[name] for name in names}, reference, options)
    refined, notes = dict(clocks), []
    for name in names:
        before, after = clocks[name], result.clocks[name]
        allowed_s = MAX_SIGMAS * math.hypot(before.sigma_s, after.sigma_s) + 1e-3
        if name == reference:
            continue
        if after.status != "ok":
            notes.append(f"{name} keeps its clock: the joint solution says {after.status}")
        elif abs(after.offset_s - before.offset_s) > allowed_s:
            change_ms = 1e3 * (after.offset_s - before.offset_s)
            notes.append(f"{name} keeps its clock: the joint solution would move it by {change_ms:+.1f} ms")
        else:
            # Two estimates with mostly different errors: sound travels, tracks slide on turning bodies.
            sigmas_s = np.array([before.sigma_s, JOINT_SIGMA_FACTOR * after.sigma_s]) + 1e-9
            weights = sigmas_s**-2 / (sigmas_s**-2).sum()
            refined[name] = dataclasses.replace(
                before,
                offset_s=float(weights @ [before.offset_s, after.offset_s]),
                sigma_s=float((sigmas_s**-2).sum() ** -0.5),
                method="vision" if before.method == "vision" else "audio+vision",
            )
    return refined, tuple(notes)


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """offsets: final, without `start_s`;  matches: what sight says about each pair, for the plot"""

    offsets: Offsets
    matches: tuple[VisualMatch | EpipolarMatch, ...] = ()


def solve_all(
    request: ClockRequest,
    audio: Offsets,
    films: FilmCameras,
    motions: Mapping[str, Motion],
    vision: VisionOptions,
    spatiotemporal: SpatiotemporalOptions,
) -> Solution:
    """The clocks of all cameras; one that can be placed neither by sound nor by sight says why.

    motions: by camera; not used where sound suffices
    """
    heard = sound_pairs(audio, films)
    given_up = {n for n, c in audio.clocks.items() if c.status.startswith((SAME_RECORDING, TOO_SHORT))}
    inputs = [name for name in request.inputs if name not in given_up]
    reason = needs_vision(audio, request, vision)
    notes = [*audio.notes, f"sight is used: {reason}" if reason else "sight is not used: sound suffices"]
    seen: list[VisualMatch | EpipolarMatch] = []
    if reason:
        pairs = list(itertools.combinations(inputs, 2))
        seen = compare_films(pairs, motions, films.cameras, audio, vision)
    merged, more = merge_pairs(heard, [match.delay for match in seen])
    notes += more
    clocks, more = solve_clocks(inputs, merged, audio.reference)
    notes += more
    reference = next((n for n, c in clocks.items() if c.method == "reference"), audio.reference)
    if seen:
        clocks, more = refine_jointly(clocks, reference, seen, motions, films.cameras, spatiotemporal)
        notes += more
    fixed = dict(clocks)
    clocks |= {name: audio.clocks[name] for name in given_up}
    for name in request.heldout:
        if name in given_up:
            continue
        against: list[VisualMatch | EpipolarMatch] = []
        if reason:
            pairs = [(other, name) for other in inputs if fixed[other].status == "ok"]
            against = compare_films(pairs, motions, films.cameras, audio, vision)
        mine = [p for p in heard if name in (p.left, p.right)]
        merged_mine, more = merge_pairs(mine, [match.delay for match in against])
        clocks[name] = attach_clock(name, merged_mine, fixed)
        seen += against
        notes += more
    ordered = {name: _with_reasons(clocks[name], audio.clocks[name]) for name in request.names}
    evidence = (*audio.pairs, *(match.delay for match in seen))
    return Solution(Offsets(reference, ordered, None, evidence, tuple(notes)), tuple(seen))


def _with_reasons(clock: CameraClock, heard: CameraClock) -> CameraClock:
    """A camera that is left out says first what is wrong with its sound."""
    if clock.status == "ok" or heard.status in ("ok", clock.status):
        return clock
    return dataclasses.replace(clock, status=f"{heard.status}; {clock.status}")
