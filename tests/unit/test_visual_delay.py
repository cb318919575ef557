"""Offsets from moving points: closed cases with points, cameras and clocks that are known."""

import dataclasses
import itertools

import numpy as np
import pytest

from fourd.align.clock_graph import solve_clocks
from fourd.align.moving_tracks import MovingTracks, no_tracks
from fourd.align.track_groups import group_tracks, join_observations
from fourd.align.vision_options import VisionOptions
from fourd.align.visual_delay import (
    estimate_visual_delay,
    match_tracks,
    measure_angles,
    rays_of_tracks,
    score_votes,
)
from fourd.camera import Camera
from fourd.film_cameras import FilmCamera
from fourd.geometry import look_at

SIZE = (640, 360)
NUM_FRAMES, FPS = 60, 30.0


def make_film(name: str, angle_deg: float) -> FilmCamera:
    angle = np.radians(angle_deg)
    R, t = look_at(
        np.array([5 * np.sin(angle), -5 * np.cos(angle), 1.5]), np.array([0, 0, 1.0]), np.array([0, 0, 1.0])
    )
    K = np.array([[500.0, 0, 319.5], [0, 500, 179.5], [0, 0, 1]])
    return FilmCamera(name, SIZE, np.array([0]), (Camera(K, R, t, SIZE),), is_static=True)


def make_motion(film: FilmCamera, offset_s: float, seed: int = 0, noise_px: float = 0.3) -> MovingTracks:
    """Forty points that swing and walk, seen by one film; the same seed is the same event."""
    event, own = np.random.default_rng(seed), np.random.default_rng([seed, int(film.name[3:])])
    start, speed = event.uniform(-1, 1, (40, 3)), event.uniform(-0.6, 0.6, (40, 3))
    swing, rate = event.uniform(0.05, 0.2, (40, 3)), event.uniform(3, 9, (40, 3))
    looks = event.normal(0, 1, (40, 128)).astype(np.float32)
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    pts_s = np.arange(NUM_FRAMES) / FPS
    time_s = (pts_s + offset_s)[:, None, None]
    points = start + speed * time_s + swing * np.sin(rate * time_s) + np.array([0, 0, 1.0])
    pixels = film.cameras[0].project(points)[0] + own.normal(0, noise_px, (NUM_FRAMES, 40, 2))
    # Points come and go: each is seen for half of the film.
    first = own.integers(0, NUM_FRAMES // 2, 40)
    frame = np.concatenate([np.arange(f, f + NUM_FRAMES // 2) for f in first])
    track = np.repeat(np.arange(40), NUM_FRAMES // 2)
    noisy = looks + own.normal(0, 0.02, looks.shape).astype(np.float32)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    span = (float(pts_s[0]), float(pts_s[-1]))
    return MovingTracks(
        film.name, "ok", span, track, frame, pts_s[frame], pixels[frame, track], noisy, np.arange(40)
    )


def estimate(one, other, films, search=(-1.5, 1.5), options=None):
    rays = rays_of_tracks(one, films[0]), rays_of_tracks(other, films[1])
    return estimate_visual_delay(one, other, rays, search, options or VisionOptions())


@pytest.mark.parametrize("delay_s", [0.0, 0.311, -0.747])
def test_delay_of_two_films_to_a_part_of_a_frame(delay_s):
    films = make_film("cam00", 0), make_film("cam01", 15)
    # An event is at own time p in a film that started p earlier: offset_s is the film's start.
    match = estimate(make_motion(films[0], 0.2), make_motion(films[1], 0.2 + delay_s), films)
    assert match.delay.status == "ok"
    assert match.delay.delay_s == pytest.approx(delay_s, abs=0.05 / FPS)
    assert match.delay.sigma_s < 0.1 / FPS
    assert match.delay.score > 0.9


def test_swapped_films_give_the_opposite_delay():
    films = make_film("cam00", 0), make_film("cam01", 15)
    motions = make_motion(films[0], 0.0), make_motion(films[1], 0.4)
    forth = estimate(*motions, films).delay
    back = estimate(*motions[::-1], films[::-1]).delay
    assert forth.delay_s == pytest.approx(-back.delay_s, abs=0.02 / FPS)


def test_other_event_is_refused():
    films = make_film("cam00", 0), make_film("cam01", 15)
    match = estimate(make_motion(films[0], 0.0, seed=1), make_motion(films[1], 0.0, seed=2), films)
    assert match.delay.status != "ok" and match.delay.score < 0.5
    assert len(match.tracks) == 0


def test_points_that_look_alike_but_belong_to_another_event_are_refused():
    """Wrong matches vote for anything: the same descriptors on other paths give no offset."""
    films = make_film("cam00", 0), make_film("cam01", 15)
    one, other = make_motion(films[0], 0.0, seed=1), make_motion(films[1], 0.0, seed=2)
    other = dataclasses.replace(other, descriptors=one.descriptors)
    match = estimate(one, other, films)
    assert "no offset stands out" in match.delay.status


def test_film_in_which_nothing_moves_is_named():
    films = make_film("cam00", 0), make_film("cam01", 15)
    match = estimate(make_motion(films[0], 0.0), no_tracks("cam01", "nothing in it moves"), films)
    assert match.delay.status == "cam01: nothing in it moves"


def test_angles_are_zero_at_the_true_offset_and_nan_without_overlap():
    films = make_film("cam00", 0), make_film("cam01", 15)
    motions = [make_motion(film, 0.0, noise_px=0.0) for film in films]
    rays = [rays_of_tracks(m, f) for m, f in zip(motions, films, strict=True)]
    pairs = match_tracks(*motions)
    assert len(pairs) > 30 and (pairs[:, 0] == pairs[:, 1]).all()
    angles = measure_angles(pairs, np.array([0.0, 0.1, 5.0]), *rays)
    overlapping = np.isfinite(angles[:, 0])
    assert angles[overlapping, 0].max() < 1e-9
    assert np.nanmedian(angles[:, 1]) > 1e-3
    assert np.isnan(angles[:, 2]).all()


def test_world_scale_changes_nothing():
    films = make_film("cam00", 0), make_film("cam01", 15)
    motions = make_motion(films[0], 0.0), make_motion(films[1], 0.3)
    large = [
        dataclasses.replace(f, cameras=(dataclasses.replace(f.cameras[0], t=f.cameras[0].t * 1e6),))
        for f in films
    ]
    assert estimate(*motions, films).delay.delay_s == pytest.approx(
        estimate(*motions, large).delay.delay_s, abs=1e-9
    )


def test_all_films_together_and_their_common_points():
    offsets = {"cam00": 0.0, "cam01": 0.21, "cam02": -0.35, "cam03": 0.08}
    films = {name: make_film(name, 12.0 * i) for i, name in enumerate(offsets)}
    motions = {name: make_motion(films[name], offset) for name, offset in offsets.items()}
    matches = [
        estimate(motions[a], motions[b], (films[a], films[b])) for a, b in itertools.combinations(films, 2)
    ]
    clocks, _ = solve_clocks(list(films), [m.delay for m in matches], "cam00")
    for name, offset in offsets.items():
        assert clocks[name].offset_s == pytest.approx(offset, abs=0.05 / FPS)
    for group in group_tracks(matches):
        assert len({name for name, _ in group}) == len(group)
        assert len({track for _, track in group}) == 1
    points = join_observations(list(films), motions, matches)
    assert points.names == tuple(films)
    assert int(points.point.max()) + 1 > 30
    pairs_seen = {(int(p), int(c)) for p, c in zip(points.point, points.cam, strict=True)}
    assert len(pairs_seen) > 2 * (int(points.point.max()) + 1)


@pytest.mark.parametrize(("votes", "elsewhere", "is_sure"), [(40, 10, True), (40, 38, False), (4, 0, False)])
def test_score_needs_votes_and_a_lead(votes, elsewhere, is_sure):
    assert (score_votes(votes, elsewhere) >= 0.5) == is_sure
