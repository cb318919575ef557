"""Persons joined across views and triangulated."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from fourd.baselines.humans.pose import NUM_LANDMARKS, Pose
from fourd.camera import Camera
from fourd.geometry import triangulate

# Shoulders, elbows, wrists, hips, knees, ankles: what decides whether two finds are one person.
LIMBS = np.array([11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28])
# A landmark of an average person may lie this far off, as a share of the person's extent in the picture.
TOLERANCE_SHARE = 0.06
# Landmarks that the network hardly sees place nothing.
MIN_VISIBILITY = 0.2
MIN_LIMBS = 6

Find = tuple[str, int]


@dataclasses.dataclass(frozen=True, eq=False)
class Person:
    """One person at one moment.

    points: (33, 3) float64 landmarks, world units, NaN where fewer than two views agree
    weights: (33,) how well each is known: the sum of the visibilities that placed it
    finds: the views that show the person, with the index of its pose there
    """

    points: np.ndarray
    weights: np.ndarray
    finds: tuple[Find, ...]


def find_people(poses: Mapping[str, Sequence[Pose]], cameras: Mapping[str, Camera]) -> list[Person]:
    """Persons that at least two views agree on, those with most views first.

    poses: persons found in each camera's picture;  cameras: ideal pinholes
    Each two finds of different views are a guess; the one that most views share is taken with all of
    its finds, and so on with the finds that are left. Of guesses with as many views the one with the
    smallest error is taken.
    """
    finds = [(name, i) for name, found in poses.items() for i in range(len(found))]
    guesses = {
        pair: _misses(pair, finds, poses, cameras)
        for pair in itertools.combinations(finds, 2)
        if pair[0][0] != pair[1][0]
    }
    left = set(finds)
    people: list[Person] = []
    while True:
        supports = [_supporters(*guess, left) for guess in guesses.items() if left.issuperset(guess[0])]
        supports = [found for found in supports if found[0]]
        if not supports:
            return people
        chosen, _ = min(supports, key=lambda found: (-len(found[0]), found[1]))
        left -= set(chosen)
        person = triangulate_person(chosen, poses, cameras)
        if np.isfinite(person.points[LIMBS, 0]).sum() >= MIN_LIMBS:
            people.append(person)


def _misses(
    pair: tuple[Find, Find],
    finds: Sequence[Find],
    poses: Mapping[str, Sequence[Pose]],
    cameras: Mapping[str, Camera],
) -> dict[Find, float]:
    """How far the points that two finds give lie from each find, smaller than the tolerance."""
    pixels = np.stack([poses[name][i].pixels[LIMBS] for name, i in pair])
    points = triangulate([cameras[name] for name, _ in pair], pixels)
    misses = {(name, i): _miss(poses[name][i], points, cameras[name]) for name, i in finds}
    return {find: miss for find, miss in misses.items() if miss < TOLERANCE_SHARE}


def _supporters(
    pair: tuple[Find, Find], misses: Mapping[Find, float], left: set[Find]
) -> tuple[tuple[Find, ...], float]:
    """The nearest find of each view that agrees with a guess, and the mean miss; none without the pair."""
    chosen: dict[str, Find] = {}
    for find, miss in misses.items():
        if find in left and miss < misses.get(chosen.get(find[0], ("", 0)), np.inf):
            chosen[find[0]] = find
    found = tuple(sorted(chosen.values()))
    if not set(pair) <= set(found):
        return (), np.inf
    return found, float(np.mean([misses[find] for find in found]))


def _miss(pose: Pose, points: np.ndarray, camera: Camera) -> float:
    """Median distance of limbs from projected points, as a share of the person's extent in the picture."""
    pixels, _ = camera.project(points)
    misses = np.linalg.norm(pixels - pose.pixels[LIMBS], axis=1)
    # Points behind the camera cannot agree.
    misses = np.where(np.isfinite(misses), misses, np.inf)
    return float(np.median(misses)) / max(pose.extent_px, 1e-9)


def triangulate_person(
    finds: Sequence[Find], poses: Mapping[str, Sequence[Pose]], cameras: Mapping[str, Camera]
) -> Person:
    """Each landmark from the views that agree on it: a network may swap left and right in one of them."""
    pixels = np.stack([poses[name][i].pixels for name, i in finds])
    visibility = np.stack([poses[name][i].visibility for name, i in finds])
    extents = np.array([poses[name][i].extent_px for name, i in finds])
    rigs = [cameras[name] for name, _ in finds]
    best_count = np.zeros(NUM_LANDMARKS)
    best_agrees = np.zeros((len(finds), NUM_LANDMARKS), bool)
    for a, b in itertools.combinations(range(len(finds)), 2):
        points = triangulate([rigs[a], rigs[b]], pixels[[a, b]])
        projected = np.stack([camera.project(points)[0] for camera in rigs])
        misses = np.linalg.norm(projected - pixels, axis=2)
        agrees = (misses < TOLERANCE_SHARE * extents[:, None]) & (visibility > MIN_VISIBILITY)
        count = (agrees * visibility).sum(axis=0)
        better = agrees[a] & agrees[b] & (count > best_count)
        best_count[better] = count[better]
        best_agrees[:, better] = agrees[:, better]
    points = np.full((NUM_LANDMARKS, 3), np.nan)
    for views in np.unique(best_agrees.T, axis=0):
        same = (views == best_agrees.T).all(axis=1)
        if views.sum() >= 2:
            index = np.flatnonzero(views)
            points[same] = triangulate([rigs[i] for i in index], pixels[np.ix_(index, np.flatnonzero(same))])
    best_count[~np.isfinite(points[:, 0])] = 0
    return Person(points, best_count, tuple(finds))
