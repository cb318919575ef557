"""Charts as SVG for page and paper: series differ by dash and mark, not by colour alone."""

import dataclasses
import math
from collections.abc import Sequence

from fourd.report.html import Markup, join, tag

WIDTH, HEIGHT = 720, 290
LEFT, RIGHT, TOP, BOTTOM = 62, 14, 12, 42
# Dash patterns and marks repeat with different periods, so that 20 series have different looks.
DASHES = ("", "7 3", "2 3", "9 3 2 3", "12 4")
MARKS = ("circle", "square", "triangle", "diamond")
NUM_COLOURS = 6
MARKS_PER_LINE = 7


@dataclasses.dataclass(frozen=True)
class Series:
    """One line of a chart; None in `y` is a gap. `is_ours` draws it stronger."""

    label: str
    x: Sequence[float]
    y: Sequence[float | None]
    is_ours: bool = False


@dataclasses.dataclass(frozen=True)
class Axis:
    """From world to page along one direction. `is_log` needs positive values, `is_whole` has whole ticks."""

    low: float
    high: float
    start: float
    end: float
    is_log: bool = False
    is_whole: bool = False

    def place(self, value: float) -> float:
        low, high = self.low, self.high
        if self.is_log:
            low, high, value = math.log10(low), math.log10(high), math.log10(value)
        return self.start + (value - low) / ((high - low) or 1.0) * (self.end - self.start)

    def ticks(self) -> list[float]:
        if self.is_log:
            return log_ticks(self.low, self.high)
        return [t for t in nice_ticks(self.low, self.high) if not self.is_whole or t == round(t)]


def nice_ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About `count` multiples of 1, 2 or 5 times a power of ten within the range."""
    span = (high - low) or abs(high) or 1.0
    raw = span / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [round(i * step, 12) for i in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Powers of ten within the range, with 2 and 5 times them where there are fewer than three."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for factors in ((1,), (1, 2, 5)):
        ticks = [f * 10.0**p for p in powers for f in factors if low <= f * 10.0**p <= high]
        if len(ticks) >= 3:
            return ticks
    return ticks if len(ticks) > 1 else nice_ticks(low, high)


def fit_axes(
    series: Sequence[Series],
    x_log: bool = False,
    y_log: bool = False,
    x_from_zero: bool = False,
    y_from_zero: bool = False,
) -> tuple[Axis, Axis] | None:
    """Axes around all points, None if there is none."""
    points = [p for s in series for p in known_points(s, x_log, y_log)]
    if not points:
        return None
    xs, ys = [p[0] for p in points], [p[1] for p in points]
    low_x, high_x = min(xs), max(xs)
    low_y, high_y = min(ys), max(ys)
    margin = (high_y - low_y) * 0.06 or abs(high_y) * 0.1 or 1.0
    if y_log:
        low_y, high_y = low_y / 1.3, high_y * 1.3
    else:
        low_y, high_y = (min(0.0, low_y) if y_from_zero else low_y - margin), high_y + margin
    if x_log:
        low_x, high_x = low_x / 1.25, high_x * 1.25
    elif x_from_zero:
        low_x, high_x = min(0.0, low_x), high_x * 1.03
    elif low_x == high_x:
        low_x, high_x = low_x - 0.5, high_x + 0.5
    is_whole = all(x == round(x) for x in xs)
    return Axis(low_x, high_x, LEFT, WIDTH - RIGHT, x_log, is_whole), Axis(
        low_y, high_y, HEIGHT - BOTTOM, TOP, y_log
    )


def known_points(series: Series, x_log: bool = False, y_log: bool = False) -> list[tuple[float, float]]:
    """Points that can be drawn; only positive ones on a logarithmic axis."""
    return [
        (x, y)
        for x, y in zip(series.x, series.y, strict=True)
        if y is not None
        and math.isfinite(y)
        and math.isfinite(x)
        and (x > 0 or not x_log)
        and (y > 0 or not y_log)
    ]


def look(index: int, series: Series) -> dict[str, str | None]:
    """Attributes of a line: its colour class and dashes."""
    if series.is_ours:
        return {"class_": "line ours", "stroke_dasharray": None}
    return {"class_": f"line c{index % NUM_COLOURS}", "stroke_dasharray": DASHES[index % len(DASHES)] or None}


def mark(index: int, x: float, y: float, is_ours: bool = False, size: float = 3.6) -> Markup:
    """A small shape at a point; the shape goes with the series."""
    name = "mark ours" if is_ours else f"mark c{index % NUM_COLOURS}"
    shape = MARKS[index % len(MARKS)]
    if shape == "circle":
        return tag("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=size, class_=name)
    if shape == "square":
        side = 2 * size - 1
        return tag(
            "rect", x=f"{x - side / 2:.1f}", y=f"{y - side / 2:.1f}", width=side, height=side, class_=name
        )
    corners = {
        "triangle": ((0, -1.25), (1.15, 0.85), (-1.15, 0.85)),
        "diamond": ((0, -1.3), (1.3, 0), (0, 1.3), (-1.3, 0)),
    }[shape]
    points = " ".join(f"{x + size * a:.1f},{y + size * b:.1f}" for a, b in corners)
    return tag("polygon", points=points, class_=name)


def frame(x_axis: Axis, y_axis: Axis, x_label: str, y_label: str) -> Markup:
    """Grid, ticks and names of both axes."""
    parts = []
    bottom = y_axis.start
    for value in y_axis.ticks():
        y = y_axis.place(value)
        parts.append(tag("line", x1=LEFT, x2=WIDTH - RIGHT, y1=f"{y:.1f}", y2=f"{y:.1f}", class_="grid"))
        parts.append(tag("text", f"{value:g}", x=LEFT - 7, y=f"{y + 4:.1f}", text_anchor="end"))
    for value in x_axis.ticks():
        x = x_axis.place(value)
        parts.append(tag("line", x1=f"{x:.1f}", x2=f"{x:.1f}", y1=bottom, y2=bottom + 4, class_="axis"))
        parts.append(tag("text", f"{value:g}", x=f"{x:.1f}", y=bottom + 17, text_anchor="middle"))
    middle = (TOP + bottom) / 2
    parts += [
        tag("line", x1=LEFT, x2=WIDTH - RIGHT, y1=bottom, y2=bottom, class_="axis"),
        tag(
            "text", x_label, x=(LEFT + WIDTH - RIGHT) / 2, y=bottom + 36, text_anchor="middle", class_="name"
        ),
        tag(
            "text",
            y_label,
            x=14,
            y=middle,
            text_anchor="middle",
            class_="name",
            transform=f"rotate(-90 14 {middle})",
        ),
    ]
    return join(parts)


def draw_line(index: int, series: Series, x_axis: Axis, y_axis: Axis) -> Markup:
    """The line in pieces between gaps, with a few marks on it."""
    pieces: list[list[str]] = [[]]
    for x, y in zip(series.x, series.y, strict=True):
        if y is None or not math.isfinite(y):
            pieces.append([])
        else:
            pieces[-1].append(f"{x_axis.place(x):.1f},{y_axis.place(y):.1f}")
    points = known_points(series)
    step = max(1, len(points) // MARKS_PER_LINE)
    # Series start their marks at different places, so that equal lines still show both.
    chosen = points[(index * step // 3) % step :: step] if points else []
    return join(
        [
            tag("polyline", points=" ".join(piece), **look(index, series))
            for piece in pieces
            if len(piece) > 1
        ],
        [mark(index, x_axis.place(x), y_axis.place(y), series.is_ours) for x, y in chosen],
    )


def legend(series: Sequence[Series]) -> Markup:
    """What each line is, with its dash and mark."""
    items = []
    for i, one in enumerate(series):
        sample = tag(
            "svg",
            tag("line", x1=1, x2=33, y1=7, y2=7, **look(i, one)),
            mark(i, 17, 7, one.is_ours),
            width=34,
            height=14,
            viewBox="0 0 34 14",
            aria_hidden="true",
        )
        items.append(tag("li", sample, one.label))
    return tag("ul", items, class_="legend")


def canvas(content: Markup, description: str, height: float = HEIGHT) -> Markup:
    """The SVG element, in a box that scrolls on narrow screens so that its text stays readable."""
    return tag(
        "div",
        tag("svg", content, viewBox=f"0 0 {WIDTH} {height:g}", role="img", aria_label=description),
        class_="scroll chart",
        tabindex=0,
        role="group",
        aria_label=description,
    )


def line_chart(
    series: Sequence[Series],
    x_label: str,
    y_label: str,
    description: str,
    y_from_zero: bool = False,
) -> Markup:
    """Lines over a common x, with a legend. An empty chart says so."""
    axes = fit_axes(series, y_from_zero=y_from_zero)
    if axes is None:
        return tag("p", "Nothing to draw: no finite value.", class_="none")
    lines = [draw_line(i, one, *axes) for i, one in enumerate(series)]
    return join(canvas(join(frame(*axes, x_label, y_label), lines), description), legend(series))


def bar_chart(rows: Sequence[tuple[str, float, str]], description: str) -> Markup:
    """Horizontal bars from zero, one per (name, value, value as text); they shrink with the screen."""
    largest = max((value for _, value, _ in rows), default=0.0) or 1.0
    bars = [
        (
            tag("span", name),
            tag("span", tag("span", class_="bar", style=f"width:{100 * value / largest:.1f}%")),
            tag("span", text, class_="num"),
        )
        for name, value, text in rows
    ]
    return tag("div", bars, class_="bars", role="group", aria_label=description)


def scatter_chart(
    points: Sequence[tuple[str, float, float]],
    front: Sequence[int],
    x_label: str,
    y_label: str,
    description: str,
    is_log: bool = False,
) -> Markup:
    """Points (name, x, y) and a line of steps through those that no other beats; empty names are not written.

    is_log: both axes are logarithmic, else x begins at 0
    """
    one = Series("", [p[1] for p in points], [p[2] for p in points])
    axes = fit_axes([one], x_log=is_log, y_log=is_log, x_from_zero=not is_log)
    if axes is None:
        return tag("p", "Nothing to draw: no finite value.", class_="none")
    x_axis, y_axis = axes
    drawn = [i for i, p in enumerate(points) if not is_log or min(p[1:]) > 0]
    at = {i: (x_axis.place(points[i][1]), y_axis.place(points[i][2])) for i in drawn}
    corners: list[tuple[float, float]] = []
    for x, y in (at[i] for i in front if i in at):
        corners += [(x, corners[-1][1])] if corners else []
        corners.append((x, y))
    steps = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
    parts = [tag("polyline", points=steps, class_="line front")]
    best = set(front)
    parts += [mark(0 if i in best else 1, x, y, is_ours=i in best) for i, (x, y) in at.items()]
    parts += place_names([(points[i][0], *at[i]) for i in at])
    return canvas(join(frame(x_axis, y_axis, x_label, y_label), parts), description)


def place_names(names: Sequence[tuple[str, float, float]]) -> list[Markup]:
    """Texts beside their points (name, x, y), on the side with more room, moved where they would overlap."""
    taken: list[tuple[float, float, float]] = []
    texts = []
    for name, x, y in names:
        width = 6.8 * len(name)
        side = -1 if x + width + 10 > WIDTH else 1
        left = x + 8 if side > 0 else x - 8 - width
        for offset in (-6, 17, -20, 31, -34):
            if not any(abs(y + offset - b) < 13 and left < e and s < left + width for s, e, b in taken):
                break
        taken.append((left, left + width, y + offset))
        anchor = "start" if side > 0 else "end"
        texts.append(tag("text", name, x=f"{x + 8 * side:.1f}", y=f"{y + offset:.1f}", text_anchor=anchor))
    return texts
