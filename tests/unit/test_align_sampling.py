import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd.align.clock import CameraClock
from fourd.align.sampling import TOO_SHORT, check_coverage, choose_start, find_too_short, match_frames
from fourd.errors import InputError


def film(num_frames: int = 60, fps: float = 30.0) -> np.ndarray:
    return np.arange(num_frames) / fps


@given(
    num_source=st.integers(1, 40),
    source_fps=st.sampled_from([15.0, 24.0, 29.97, 30.0, 60.0]),
    fps=st.sampled_from([24.0, 25.0, 30.0, 60.0]),
    start_s=st.floats(-2, 2),
    seed=st.integers(0, 1000),
)
def test_matched_frame_is_the_nearest_in_time(num_source, source_fps, fps, start_s, seed):
    jitter = np.random.default_rng(seed).uniform(-0.3, 0.3, num_source)
    common_s = (np.arange(num_source) + jitter) / source_fps
    source_frame, dt_s = match_frames(common_s, fps, 20, start_s)
    distance = np.abs(common_s[None] - (start_s + np.arange(20) / fps)[:, None])
    np.testing.assert_allclose(np.abs(dt_s), distance.min(axis=1), atol=2e-6)
    np.testing.assert_allclose(distance[np.arange(20), source_frame], np.abs(dt_s), atol=1e-12)


def test_halfway_start_takes_every_frame_once():
    source_frame, dt_s = match_frames(film(31), 30, 30, 0.5 / 30)
    np.testing.assert_array_equal(source_frame, np.arange(30))
    np.testing.assert_allclose(dt_s, -0.5 / 30)


def test_convention_start_is_the_common_time_of_scene_frame_0():
    source_frame, dt_s = match_frames(film(40), 30, 5, 0.1)
    np.testing.assert_array_equal(source_frame, [3, 4, 5, 6, 7])
    np.testing.assert_allclose(dt_s, 0, atol=1e-12)


def coverage(common_s: np.ndarray, num_frames: int, start_s: float = 0.0, max_dt_frames: float = 0.75) -> str:
    _, dt_s = match_frames(common_s, 30, num_frames, start_s)
    return check_coverage("cam03", "a.mp4", common_s, dt_s, 30, start_s, max_dt_frames)


def test_whole_coverage_is_ok():
    assert coverage(film(), 60) == "ok"
    assert coverage(film(), 58, start_s=0.6 / 30) == "ok"
    assert coverage(film(30, fps=15), 59, max_dt_frames=1) == "ok"


@pytest.mark.parametrize(
    "common_s, num_frames, reason",
    [
        (film() + 0.1, 60, r"shows scene frames 3\.0 to 62\.0 .*starts too late for frame 0, by 0\.10 s"),
        (film(50), 60, r"ends too early for frame 59, by 0\.33 s"),
        (film() + 10, 60, "none of the wanted 0 to 59: it was filmed at another time"),
        (film() - 10, 60, "none of the wanted 0 to 59"),
        (
            np.delete(film(), [20, 21]),
            60,
            r"within 0\.75 frames of scene frame 20, .*1\.00 frames .*and 2 scene",
        ),
        (film(20, fps=10), 58, r"scene frame 1, the nearest is 1\.00 frames"),
    ],
)
def test_what_is_missing_is_said(common_s, num_frames, reason):
    found = coverage(common_s, num_frames)
    assert found.startswith("camera cam03: ") and re.search(reason, found), found


def test_a_mistaken_tap_is_too_short_for_the_scene():
    films = {"a": film(60), "tap": film(3), "b": film(90), "one": film(1), "c": film(30), "last": film(2)}
    inputs = ["a", "tap", "b", "one", "c"]
    found = find_too_short(films, inputs, 30, 60)
    assert list(found) == ["tap", "one", "last"]
    assert found["tap"].startswith(f"{TOO_SHORT}: it lasts 3 of 60 frames at 30 fps")
    # A film that a held-out camera made says nothing about the others.
    assert list(find_too_short(films | {"last": film(60)}, inputs, 30, 60)) == ["tap", "one"]


@pytest.mark.parametrize(("fps", "num_frames"), [(30, 7), (24, 5), (60, 13)])
def test_half_of_the_scene_is_not_too_short(fps, num_frames):
    assert find_too_short({"a": film(), "b": film(), "c": film(4)}, ["a", "b", "c"], fps, num_frames) == {}
    assert "c" in find_too_short({"a": film(), "b": film(), "c": film(2)}, ["a", "b", "c"], fps, num_frames)


def test_where_half_of_the_films_are_short_the_scene_is_too_long():
    films = {"a": film(60), "b": film(3), "c": film(60), "d": film(4)}
    assert find_too_short(films, list(films), 30, 60) == {}
    assert find_too_short(dict.fromkeys("abc", film(60)), list("abc"), 30, 600) == {}


def clocks_of(*offsets_s: float, **bad: str) -> dict[str, CameraClock]:
    clocks = {f"cam{i:02d}": CameraClock(offset_s) for i, offset_s in enumerate(offsets_s)}
    return clocks | {name: CameraClock(0.0, status=status) for name, status in bad.items()}


def test_scene_starts_when_all_cameras_film():
    clocks = clocks_of(0.0, -1.0, 0.5, lost="no sound")
    films = dict.fromkeys(clocks, film(90))
    assert choose_start(clocks, films, 30, 40) == pytest.approx(0.5, abs=1e-9)


@settings(deadline=None, max_examples=25)
@given(phases=st.lists(st.floats(0, 1), min_size=2, max_size=5), fps=st.sampled_from([24.0, 30.0]))
def test_phase_is_the_best_there_is(phases, fps):
    clocks = clocks_of(*(phase / 30 for phase in phases))
    films = dict.fromkeys(clocks, film(60))
    start_s = choose_start(clocks, films, fps, 20)

    def cost(start: float) -> float:
        common = (clock.common_time(films[name]) for name, clock in clocks.items())
        return sum(float((match_frames(times, fps, 20, start)[1] ** 2).sum()) for times in common)

    earliest = max(phases) / 30
    assert earliest - 1e-12 <= start_s <= earliest + 1 / fps + 1e-12
    best = min(cost(start) for start in np.linspace(earliest, earliest + 1 / fps, 300))
    assert cost(start_s) <= best + 20 * len(phases) * (0.02 / fps) ** 2


def test_films_that_just_suffice_are_enough():
    clocks = clocks_of(0.0, 0.25 / 30)
    films = {"cam00": film(21), "cam01": film(20)}
    start_s = choose_start(clocks, films, 30, 20)
    assert start_s == pytest.approx(0.25 / 30, abs=1e-9)
    for name in films:
        assert (
            np.abs(match_frames(clocks[name].common_time(films[name]), 30, 20, start_s)[1]).max() < 0.5 / 30
        )


def test_rates_count():
    clocks = {"cam00": CameraClock(0.0), "cam01": CameraClock(0.0, rate_ppm=-50000)}
    films = dict.fromkeys(clocks, film(100))
    with pytest.raises(InputError, match="there are 95: set num_frames to 95 or less"):
        choose_start(clocks, films, 30, 100)


def test_short_or_missing_overlap_is_refused():
    films = {"cam00": film(90), "cam01": film(90)}
    with pytest.raises(
        InputError, match="80 frames at 30 fps .*start of cam01 and the end of cam00 there are 60"
    ):
        choose_start(clocks_of(0.0, 1.0), films, 30, 80)
    with pytest.raises(InputError, match="there are 0: take one of the two out"):
        choose_start(clocks_of(0.0, 10.0), films, 30, 80)
    with pytest.raises(InputError, match=r"placed in time, got none \(lost: no sound\)"):
        choose_start(clocks_of(lost="no sound"), {"lost": film(9)}, 30, 2)
