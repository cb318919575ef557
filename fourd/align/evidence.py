"""The picture behind align/offsets.json: what each pair of films heard, and the clocks that follow."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fourd.align.audio_delay import SoundMatch
from fourd.align.clock import Offsets
from fourd.align.epipolar_motion import EpipolarMatch
from fourd.align.visual_delay import VisualMatch

_DPI = 80
_ROW_INCHES = 1.7
_USED, _UNUSED, _REFUSED = "#1f6fb4", "#b8b8b8", "#c43c2c"
# A row per pair; of very many cameras the weakest pairs are those worth looking at.
_MAX_ROWS = 60


def draw_evidence(
    offsets: Offsets, matches: Sequence[SoundMatch | VisualMatch | EpipolarMatch]
) -> np.ndarray:
    """(H, W, 3) uint8 RGB: a table of the clocks, then what each pair of films says.

    offsets: the clocks, by whatever method;  matches: of sound or of sight, may be empty
    For sound, its correlation and the delays of its windows; for sight, the votes of moving points and
    how far they are off their epipolar planes, or how motion on those planes agrees. Of more
    than 60 pairs those with the lowest scores.
    """
    shown = list(matches)
    if len(shown) > _MAX_ROWS:
        weakest = sorted(shown, key=lambda match: match.delay.score)[:_MAX_ROWS]
        shown = [match for match in shown if any(match is other for other in weakest)]
    table_inches = 0.9 + 0.24 * len(offsets.clocks)
    height = table_inches + _ROW_INCHES * len(shown)
    with matplotlib.rc_context({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(12, height), dpi=_DPI, layout="constrained")
        rows = figure.add_gridspec(
            1 + len(shown), 2, height_ratios=[table_inches] + [_ROW_INCHES] * len(shown)
        )
        _draw_table(figure.add_subplot(rows[0, :]), offsets)
        for index, match in enumerate(shown, start=1):
            axes = figure.add_subplot(rows[index, 0]), figure.add_subplot(rows[index, 1])
            if isinstance(match, EpipolarMatch):
                _draw_agreement(axes[0], match)
                axes[1].axis("off")
            elif isinstance(match, VisualMatch):
                _draw_votes(axes[0], match)
                _draw_valley(axes[1], match)
            else:
                _draw_search(axes[0], match)
                _draw_windows(axes[1], match)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    return np.array(canvas.buffer_rgba())[:, :, :3].copy()


def _draw_table(axes: Axes, offsets: Offsets) -> None:
    axes.axis("off")
    cells = [
        [
            name,
            f"{clock.offset_s:+.4f}" if clock.status == "ok" else "",
            f"{clock.rate_ppm:+.1f}" if clock.status == "ok" else "",
            f"{clock.sigma_s * 1e3:.2f}" if clock.status == "ok" else "",
            f"{clock.score:.2f}",
            clock.method,
            clock.status if len(clock.status) < 110 else clock.status[:107] + "...",
        ]
        for name, clock in offsets.clocks.items()
    ]
    table = axes.table(
        cellText=cells,
        colLabels=["camera", "offset, s", "rate, ppm", "sigma, ms", "score", "method", "status"],
        colWidths=[0.08, 0.08, 0.07, 0.07, 0.05, 0.08, 0.57],
        cellLoc="left",
        loc="center",
    )
    table.auto_set_font_size(False)
    for cell in table.get_celld().values():
        cell.set_linewidth(0.3)
    for row, clock in enumerate(offsets.clocks.values(), start=1):
        if clock.status != "ok":
            table[row, 6].get_text().set_color(_REFUSED)


def _draw_votes(axes: Axes, match: VisualMatch) -> None:
    """Votes of pairs of tracks against delay, the chosen delay marked."""
    delay = match.delay
    color = _USED if delay.status == "ok" else _REFUSED
    axes.set_title(f"{delay.left} - {delay.right}: score {delay.score:.2f}", loc="left", color=color)
    axes.plot(match.offsets_s, match.votes, color="#555555", linewidth=0.6)
    if delay.status == "ok":
        axes.plot(delay.delay_s, match.votes.max(), "v", color=color, markersize=6)
    axes.set_ylabel("votes")
    axes.set_xlabel("delay, s")


def _draw_agreement(axes: Axes, match: EpipolarMatch) -> None:
    """Agreement of the motion on epipolar planes against delay."""
    delay = match.delay
    color = _USED if delay.status == "ok" else _REFUSED
    axes.set_title(
        f"{delay.left} - {delay.right}: {delay.delay_s:+.4f} s by motion on planes, score {delay.score:.2f}",
        loc="left",
        color=color,
    )
    axes.plot(match.offsets_s, match.evidence, color="#555555", linewidth=0.6)
    axes.axvline(delay.delay_s, color=color, linewidth=0.8)
    axes.set_ylabel("agreement")
    axes.set_xlabel("delay, s")


def _draw_valley(axes: Axes, match: VisualMatch) -> None:
    """Angle off the epipolar planes around the chosen delay, or why there is none."""
    delay = match.delay
    if delay.status != "ok":
        axes.axis("off")
        axes.text(0.02, 0.5, delay.status, transform=axes.transAxes, color=_REFUSED)
        return
    axes.plot((match.fine_s - delay.delay_s) * 1e3, np.degrees(np.sqrt(match.cost)), color=_USED)
    axes.axvspan(-delay.sigma_s * 1e3, delay.sigma_s * 1e3, color=_USED, alpha=0.15)
    axes.set_title(
        f"{delay.delay_s:+.5f} s +- {delay.sigma_s * 1e3:.2f} ms, {len(match.tracks)} pairs of tracks",
        loc="left",
    )
    axes.set_xlabel("difference, ms")
    axes.set_ylabel("off plane, deg")


def _draw_search(axes: Axes, match: SoundMatch) -> None:
    """Correlation of the bands against delay, the chosen delay marked."""
    delay = match.delay
    color = _USED if delay.status == "ok" else _REFUSED
    axes.set_title(f"{delay.left} - {delay.right}: score {delay.score:.2f}", loc="left", color=color)
    axes.set_ylabel("correlation, sd")
    axes.set_xlabel("delay, s")
    if match.line is None:
        axes.text(0.02, 0.5, delay.status, transform=axes.transAxes, color=_REFUSED)
        return
    axes.plot(match.search_s, match.search, color="#555555", linewidth=0.6)
    at = float(match.line.delay_s)
    peak = int(np.abs(match.search_s - at).argmin())
    axes.plot(at, match.search[peak], "v", color=color, markersize=6)


def _draw_windows(axes: Axes, match: SoundMatch) -> None:
    """Delay of every window against time, and the line through those that agree."""
    if match.line is None or match.windows is None:
        axes.axis("off")
        return
    windows, line = match.windows, match.line
    error_ms = (windows.delay_s - line.delay_s) * 1e3
    size = 6 + 0.6 * windows.weight
    axes.scatter(windows.time_s[~line.is_used], error_ms[~line.is_used], size[~line.is_used], color=_UNUSED)
    axes.scatter(windows.time_s[line.is_used], error_ms[line.is_used], size[line.is_used], color=_USED)
    ends = np.array([windows.time_s[0], windows.time_s[-1]])
    axes.plot(ends, (line.at(ends) - line.delay_s) * 1e3, color=_USED, linewidth=0.8)
    used = error_ms[line.is_used]
    margin = max(1.0, 2 * float(np.ptp(used)))
    axes.set_ylim(float(used.min()) - margin, float(used.max()) + margin)
    rate = f"{line.rate_ppm:+.1f} ppm" if line.rate_sigma_ppm is not None else "rate not told"
    what = "waveforms" if match.is_wave else "bands"
    axes.set_title(
        f"{line.delay_s:+.5f} s +- {line.sigma_s * 1e3:.3f} ms, {rate}, {int(line.is_used.sum())} of "
        f"{len(windows.time_s)} windows, by {what}",
        loc="left",
    )
    axes.set_xlabel(f"time of {match.delay.right}, s")
    axes.set_ylabel("difference, ms")
