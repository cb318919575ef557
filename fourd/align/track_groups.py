"""Which tracks of which films are one and the same moving point."""

from collections.abc import Mapping, Sequence

import numpy as np

from fourd.align.moving_points import MovingPoints
from fourd.align.moving_tracks import MovingTracks
from fourd.align.visual_delay import VisualMatch

# KLT positions on moving, turning surfaces.
SIGMA_PX = 1.0


def group_tracks(matches: Sequence[VisualMatch]) -> list[list[tuple[str, int]]]:
    """Groups of (camera, track) that matches connect, largest first.

    Each camera is in a group with one track at most: the match that would add a second one is dropped.
    Matches of more certain pairs of films come first.
    """
    group_of: dict[tuple[str, int], dict[str, int]] = {}
    ordered = sorted(matches, key=lambda m: (m.delay.sigma_s, m.delay.left, m.delay.right))
    for match in ordered:
        for a, b in match.tracks.tolist():
            left, right = (match.delay.left, a), (match.delay.right, b)
            one = group_of.setdefault(left, dict([left]))
            two = group_of.setdefault(right, dict([right]))
            if one is two or one.keys() & two.keys():
                continue
            one.update(two)
            for name, track in two.items():
                group_of[name, track] = one
    groups = {id(group): sorted(group.items()) for group in group_of.values() if len(group) > 1}
    return sorted(groups.values(), key=lambda group: (-len(group), group))


def join_observations(
    names: Sequence[str], motions: Mapping[str, MovingTracks], matches: Sequence[VisualMatch]
) -> MovingPoints:
    """The moving points that two or more films saw; cameras in the order of `names`."""
    used = [m for m in matches if {m.delay.left, m.delay.right} <= set(names) and m.delay.status == "ok"]
    cam, point, frame, own_s, pixels = [], [], [], [], []
    for number, group in enumerate(group_tracks(used)):
        for name, track in group:
            motion = motions[name]
            at = motion.track == track
            cam.append(np.full(at.sum(), list(names).index(name)))
            point.append(np.full(at.sum(), number))
            frame.append(motion.frame[at])
            own_s.append(motion.own_s[at])
            pixels.append(motion.pixels[at])
    if not cam:
        none = np.zeros(0, np.int64)
        return MovingPoints(tuple(names), none, none, none, np.zeros(0), np.zeros((0, 2)), np.zeros(0))
    return MovingPoints(
        tuple(names), np.concatenate(cam), np.concatenate(point), np.concatenate(frame),
        np.concatenate(own_s), np.concatenate(pixels), np.full(sum(map(len, own_s)), SIGMA_PX),
    )  # fmt: skip
