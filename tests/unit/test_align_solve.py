import dataclasses
import itertools

import numpy as np
import pytest

from fourd.align.clock import CameraClock, Offsets, PairDelay
from fourd.align.request import ClockRequest
from fourd.align.sampling import TOO_SHORT
from fourd.align.solve import merge_pairs, needs_vision, solve_all
from fourd.align.spatiotemporal_options import SpatiotemporalOptions
from fourd.align.vision_options import VisionOptions
from fourd.film_cameras import FilmCameras

NAMES = ("a", "b", "c", "d", "e")


def pair_of(left: str, right: str, late_s: dict[str, float], method: str, sigma_s: float = 2e-3) -> PairDelay:
    """The delay of two cameras of which some seem late, s."""
    delay_s = late_s.get(right, 0.0) - late_s.get(left, 0.0)
    return PairDelay(left, right, delay_s, sigma_s, 0.9, method, 0.0, time_s=1.0, rate_sigma_ppm=1.0)


def all_pairs(late_s: dict[str, float], method: str) -> list[PairDelay]:
    return [pair_of(left, right, late_s, method) for left, right in itertools.combinations(NAMES, 2)]


def delays(pairs: list[PairDelay]) -> dict[tuple[str, str], float]:
    return {(pair.left, pair.right): round(pair.delay_s, 6) for pair in pairs}


def test_what_sound_and_sight_agree_on_is_their_weighted_mean() -> None:
    heard, seen = pair_of("a", "b", {}, "audio"), pair_of("a", "b", {"b": 3e-3}, "vision", sigma_s=1e-3)
    (merged,), notes = merge_pairs([heard], [seen])
    assert merged.method == "audio+vision" and notes == ()
    assert abs(merged.delay_s - 3e-3 * 0.8) < 1e-12


def test_sight_is_taken_where_the_sound_of_a_film_lies_beside_its_pictures() -> None:
    merged, notes = merge_pairs(all_pairs({"c": 0.1}, "audio"), all_pairs({}, "vision"))
    assert set(delays(merged).values()) == {0.0} and len(notes) == 4
    assert all("sight is taken" in note for note in notes)


def test_sight_is_taken_where_a_pair_heard_an_echo() -> None:
    heard = all_pairs({}, "audio")
    heard[2] = dataclasses.replace(heard[2], delay_s=0.1)
    merged, notes = merge_pairs(heard, all_pairs({}, "vision"))
    assert set(delays(merged).values()) == {0.0} and len(notes) == 1


def test_sound_is_taken_where_sight_does_not_add_up() -> None:
    """A walk looks alike one step later: some pairs of a camera are a step off, others are not."""
    seen = {key: pair for key, pair in zip(delays(all_pairs({}, "x")), all_pairs({}, "vision"), strict=True)}
    for key in (("a", "c"), ("b", "c")):
        seen[key] = dataclasses.replace(seen[key], delay_s=0.157)
    merged, notes = merge_pairs(all_pairs({}, "audio"), list(seen.values()))
    assert set(delays(merged).values()) == {0.0} and len(notes) == 2
    assert all("sound is taken" in note for note in notes)


def test_a_pair_that_nothing_checks_is_taken_from_sight() -> None:
    (merged,), notes = merge_pairs(
        [pair_of("a", "b", {}, "audio")], [pair_of("a", "b", {"b": 0.1}, "vision")]
    )
    assert merged.delay_s == 0.1 and len(notes) == 1


@pytest.mark.parametrize("heldout", [(), ("tap",)])
def test_nobody_looks_at_a_film_that_is_too_short(heldout: tuple[str, ...]) -> None:
    clocks = {name: CameraClock(0.0, sigma_s=1e-4, method="audio") for name in NAMES}
    clocks["tap"] = CameraClock(0.0, score=0.0, method="audio", status=f"{TOO_SHORT}: it lasts 3 frames")
    request = ClockRequest(("tap", *NAMES), heldout)
    audio = Offsets("a", clocks, None, tuple(all_pairs({}, "audio")))
    vision = VisionOptions()
    assert needs_vision(audio, request, vision) == ""
    found = solve_all(
        request, audio, FilmCameras({}, np.zeros((0, 3))), {}, vision, SpatiotemporalOptions()
    ).offsets
    assert found.clocks["tap"] == clocks["tap"] and list(found.clocks) == ["tap", *NAMES]
    assert all(found.clocks[name].status == "ok" for name in NAMES)
