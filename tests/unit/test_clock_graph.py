import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd.align.clock import PPM, CameraClock, PairDelay
from fourd.align.clock_graph import (
    SOUND_M_S,
    attach_clock,
    correct_sound_travel,
    drop_inconsistent,
    largest_group,
    solve_clocks,
)

NAMES = ("a", "b", "c", "d", "e")


def true_clocks(seed: int = 0, rate_ppm: float = 100.0) -> dict[str, CameraClock]:
    rng = np.random.default_rng(seed)
    clocks = {
        n: CameraClock(float(rng.uniform(-10, 10)), float(rng.uniform(-rate_ppm, rate_ppm))) for n in NAMES
    }
    return clocks | {"a": CameraClock(0.0)}


def pair_of(
    left: str, right: str, clocks: dict[str, CameraClock], sigma_s: float = 1e-4, **changes
) -> PairDelay:
    """The exact relation left_s = delay + (1 + rate) right_s of two clocks."""
    one, two = clocks[left], clocks[right]
    delay_s = float(one.own_time(np.array(two.offset_s)))
    rate_ppm = ((1 + two.rate_ppm * PPM) / (1 + one.rate_ppm * PPM) - 1) / PPM
    pair = PairDelay(left, right, delay_s, sigma_s, 0.9, "audio", rate_ppm, time_s=20.0, rate_sigma_ppm=1.0)
    return dataclasses.replace(pair, **changes)


def all_pairs(clocks: dict[str, CameraClock]) -> list[PairDelay]:
    return [pair_of(left, right, clocks) for left, right in itertools.combinations(NAMES, 2)]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_exact_pairs_give_exact_clocks(seed: int) -> None:
    truth = true_clocks(seed)
    solved, notes = solve_clocks(NAMES, all_pairs(truth), "a")
    assert notes == ()
    for name in NAMES:
        # The weak prior on rates pulls by (1 ppm / 100 ppm)^2.
        assert solved[name].offset_s == pytest.approx(truth[name].offset_s, abs=2e-6)
        assert solved[name].rate_ppm == pytest.approx(truth[name].rate_ppm, abs=0.05)
        assert solved[name].status == "ok"
    assert solved["a"] == CameraClock(0.0, method="reference")


def test_wrong_pair_is_dropped_and_named() -> None:
    truth = true_clocks(1)
    pairs = all_pairs(truth)
    pairs[5] = dataclasses.replace(pairs[5], delay_s=pairs[5].delay_s + 0.5)
    kept, notes = drop_inconsistent(pairs)
    assert pairs[5] not in kept and len(kept) == len(pairs) - 1
    assert len(notes) == 1 and pairs[5].left in notes[0] and "0.500 s" in notes[0]
    solved, _ = solve_clocks(NAMES, pairs, "a")
    assert all(abs(solved[n].offset_s - truth[n].offset_s) < 1e-4 for n in NAMES)


def test_loops_close_with_any_direction_and_rate() -> None:
    truth = true_clocks(2)
    pairs = [pair_of("b", "a", truth), pair_of("b", "c", truth), pair_of("c", "a", truth)]
    # At 10 s of delay, rates of 100 ppm are 1 ms: the loop is carried exactly, not by adding delays.
    assert drop_inconsistent(pairs, tolerance_s=0.0)[0] == pairs


def test_weakest_pair_goes_when_three_contradict() -> None:
    truth = true_clocks(3)
    pairs = [pair_of("a", "b", truth), pair_of("b", "c", truth, score=0.6), pair_of("a", "c", truth)]
    pairs[1] = dataclasses.replace(pairs[1], delay_s=pairs[1].delay_s + 1)
    assert drop_inconsistent(pairs)[0] == [pairs[0], pairs[2]]


def test_larger_group_is_kept_and_others_say_why() -> None:
    truth = true_clocks(4)
    pairs = [pair_of("a", "b", truth), pair_of("c", "d", truth), pair_of("d", "e", truth)]
    pairs.append(pair_of("a", "c", truth, status="no delay stands out"))
    assert largest_group(NAMES, pairs[:3]) == ("c", "d", "e")
    solved, notes = solve_clocks(NAMES, pairs, "a")
    assert [solved[n].status == "ok" for n in NAMES] == [False, False, True, True, True]
    assert solved["c"].method == "reference" and "relative to c" in notes[0]
    assert "not connected" in solved["b"].status


def test_camera_that_fits_none_is_left_out() -> None:
    truth = true_clocks(5)
    pairs = [p for p in all_pairs(truth) if "e" not in (p.left, p.right)]
    pairs.append(pair_of("a", "e", truth, status="no delay stands out"))
    solved, _ = solve_clocks(NAMES, pairs, "a")
    assert "fits none of 1" in solved["e"].status and "stands out" in solved["e"].status
    assert solved["e"].score == 0
    alone, notes = solve_clocks(("a", "b"), [], "a")
    assert all(clock.status != "ok" for clock in alone.values()) and "no two cameras" in notes[0]


def test_equal_groups_by_order() -> None:
    truth = true_clocks(6)
    assert largest_group(NAMES, [pair_of("d", "e", truth), pair_of("b", "c", truth)]) == ("b", "c")


def test_rates_that_nobody_measured_are_zero() -> None:
    truth = true_clocks(7, rate_ppm=0.0)
    pairs = [dataclasses.replace(p, rate_sigma_ppm=None) for p in all_pairs(truth)]
    solved, _ = solve_clocks(NAMES, pairs, "a")
    assert all(clock.rate_ppm == 0.0 for clock in solved.values())
    assert solved["b"].offset_s == pytest.approx(truth["b"].offset_s, abs=1e-9)


def test_sigma_is_the_scatter_of_repeated_solves() -> None:
    truth = true_clocks(8, rate_ppm=0.0)
    rng = np.random.default_rng(0)
    errors, sigmas = [], []
    for _ in range(200):
        pairs = [
            dataclasses.replace(
                p, delay_s=p.delay_s + 1e-3 * rng.standard_normal(), sigma_s=1e-3, rate_sigma_ppm=None
            )
            for p in all_pairs(truth)
        ]
        solved, _ = solve_clocks(NAMES, pairs, "a")
        errors.append(solved["c"].offset_s - truth["c"].offset_s)
        sigmas.append(solved["c"].sigma_s)
    # 5 cameras, all pairs: the variance of a difference is 2 / 5 of one pair's.
    assert np.std(errors) == pytest.approx(math.sqrt(0.4) * 1e-3, rel=0.25)
    assert np.mean(sigmas) == pytest.approx(np.std(errors), rel=0.35)


def test_attached_clock_changes_nothing_else() -> None:
    truth = true_clocks(9)
    fixed = {name: truth[name] for name in NAMES[:4]}
    pairs = [pair_of("e", name, truth) for name in NAMES[:4]]
    clock = attach_clock("e", pairs, fixed)
    assert clock.offset_s == pytest.approx(truth["e"].offset_s, abs=2e-6)
    assert clock.rate_ppm == pytest.approx(truth["e"].rate_ppm, abs=0.05)
    wrong = dataclasses.replace(pairs[0], delay_s=pairs[0].delay_s + 2)
    assert attach_clock("e", [wrong, *pairs[1:]], fixed).offset_s == pytest.approx(clock.offset_s, abs=1e-5)


def test_attached_clock_is_refused_when_pairs_contradict() -> None:
    truth = true_clocks(9)
    fixed = {name: truth[name] for name in NAMES[:4]}
    pairs = [pair_of("e", name, truth) for name in NAMES[:2]]
    wrong = dataclasses.replace(pairs[0], delay_s=pairs[0].delay_s + 2)
    assert "contradict" in attach_clock("e", [wrong, pairs[1]], fixed).status
    assert "compared with no other" in attach_clock("e", [], fixed).status


def test_convention_sound_reaches_the_farther_camera_later() -> None:
    source = np.array([0.0, 0.0, 0.0])
    centers = {"left": np.array([34.3, 0, 0]), "right": np.array([0, 3.43, 0])}
    clocks = {"left": CameraClock(1.0), "right": CameraClock(3.0)}
    # A sound made at common time 10 is heard 0.1 s and 0.01 s later.
    heard = {n: 10 + float(np.linalg.norm(centers[n] - source)) / SOUND_M_S for n in centers}
    own = {n: float(clocks[n].own_time(np.array(heard[n]))) for n in centers}
    measured = PairDelay("left", "right", own["left"] - own["right"], 1e-3, 1.0, "audio")
    assert measured.delay_s == pytest.approx(2.09)
    (corrected,) = correct_sound_travel([measured], centers, source)
    assert corrected.delay_s == pytest.approx(2.0)
    assert correct_sound_travel([measured], {"left": centers["left"]}, source) == (measured,)
