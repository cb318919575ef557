"""Error against run time: which settings no other beats, as a picture and a column."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd import io


def on_front(error: np.ndarray, seconds: np.ndarray, slack: float = 0.0) -> np.ndarray:
    """(N,) bool: no other point is better in both by more than a share `slack`, NaN is never on it.

    error, seconds: (N,), smaller is better. Times of one run scatter by some percent: `slack` says how much.
    """
    error, seconds = np.asarray(error, float), np.asarray(seconds, float)
    better_error = error[None] < error[:, None] * (1 - slack)
    better_time = seconds[None] < seconds[:, None] * (1 - slack)
    equal_error, equal_time = error[None] <= error[:, None], seconds[None] <= seconds[:, None]
    beaten = ((better_error & equal_time) | (better_time & equal_error)).any(axis=1)
    return ~beaten & np.isfinite(error) & np.isfinite(seconds)


def plot_front(
    path: Path | str,
    rows: Sequence[Mapping[str, Any]],
    name: str,
    default: str,
    error: str = "error",
    seconds: str = "cpu_seconds",
) -> None:
    """PNG of all settings, the front as a line, the default as a ring.

    rows: those of the bench's table;  name: column with the setting's name;  default: its value there
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    x = np.array([float(row[seconds]) for row in rows])
    y = np.array([float(row[error]) for row in rows])
    front = np.flatnonzero(on_front(y, x))
    front = front[np.argsort(x[front])]
    figure = Figure(figsize=(8, 5), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.plot(x[front], y[front], color="0.6", drawstyle="steps-post", label="best at its time")
    axes.scatter(x, y, s=20, color="C0")
    for row, a, b in zip(rows, x, y, strict=True):
        axes.annotate(str(row[name]), (a, b), xytext=(4, 4), textcoords="offset points", fontsize=8)
        if row[name] == default:
            axes.scatter([a], [b], s=140, facecolors="none", edgecolors="C3", label="default")
    axes.set_xscale("log")
    axes.set_xlabel(f"{seconds} (log)")
    axes.set_ylabel(error)
    axes.legend()
    canvas.draw()
    io.write_png(path, np.asarray(canvas.buffer_rgba())[..., :3])


def plot_curves(
    path: Path | str,
    rows: Sequence[Mapping[str, Any]],
    name: str,
    default: str,
    error: str = "error",
    seconds: str = "cpu_seconds",
) -> None:
    """PNG of settings that get better with time, a curve each, the default's bold.

    Arguments as `plot_front`; a setting has a row per time.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    curves = {
        setting: sorted((float(r[seconds]), float(r[error])) for r in rows if str(r[name]) == setting)
        for setting in dict.fromkeys(str(row[name]) for row in rows)
    }
    figure = Figure(figsize=(10, 5), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    # In the order in which the curves end, from the worst, as they lie above each other.
    for setting, points in sorted(curves.items(), key=lambda item: -item[1][-1][1]):
        label, width = f"{points[-1][1]:.4g}  {setting}", 3 if setting == default else 1
        axes.plot(*zip(*points, strict=True), marker="o", linewidth=width, label=label)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(f"{seconds} (log)")
    axes.set_ylabel(f"{error} (log)")
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize=8, title="at the end")
    canvas.draw()
    io.write_png(path, np.asarray(canvas.buffer_rgba())[..., :3])
