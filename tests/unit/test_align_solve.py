import dataclasses
import itertools

from fourd.align.clock import PairDelay
from fourd.align.solve import merge_pairs

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
