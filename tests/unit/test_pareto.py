"""The front of error against time that the benches draw."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from benches.pareto import on_front, plot_curves, plot_front
from fourd import io

POINTS = st.lists(st.tuples(st.floats(0, 10), st.floats(0.1, 10)), min_size=1, max_size=12)


@given(POINTS)
def test_every_point_is_on_the_front_or_beaten_by_one_that_is(points):
    error, seconds = np.array(points).T
    front = on_front(error, seconds)
    assert front.any()
    for e, s, is_best in zip(error, seconds, front, strict=True):
        beats = (error <= e) & (seconds <= s) & ((error < e) | (seconds < s))
        assert is_best == (not beats.any())
        assert is_best or (beats & front).any()


def test_points_within_the_scatter_of_times_stay():
    error, seconds = [1.0, 0.99, 0.5], [1.0, 0.98, 1.0]
    assert on_front(error, seconds, slack=0.05).tolist() == [False, True, True]
    assert on_front([1.0, 0.99], [1.0, 0.98], slack=0.05).all()
    assert not on_front([np.nan, 1.0], [0.1, 1.0])[0]


def test_picture_shows_the_front_and_the_default(tmp_path):
    rows = [{"setting": f"s{i}", "error": 1 / i, "cpu_seconds": i} for i in range(1, 5)]
    plot_front(tmp_path / "front.png", rows, "setting", "s2")
    picture = io.read_image(tmp_path / "front.png")
    assert picture.shape[0] > 300 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


def test_picture_shows_a_curve_per_setting(tmp_path):
    rows = [
        {"setting": name, "error": e / t, "cpu_seconds": t}
        for name, e in (("a", 1), ("b", 2))
        for t in (9, 3)
    ]
    coloured = []
    for shown in (rows, rows[:2]):
        plot_curves(tmp_path / "curves.png", shown, "setting", "a")
        picture = io.read_image(tmp_path / "curves.png").astype(int)
        coloured.append((picture.max(axis=2) - picture.min(axis=2) > 60).sum())
    assert coloured[0] > coloured[1] > 100
