"""The cameras seen from above, as SVG."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fourd.report.charts import WIDTH, nice_ticks
from fourd.report.html import Markup, join, tag
from fourd.report.numbers import show

MARGIN = 44
MIN_HEIGHT, MAX_HEIGHT = 220, 560
WEDGE = 30.0


def draw_map(scene_map: Mapping[str, Any], metres_per_unit: float | None) -> Markup:
    """Sparse points, ways of the films, a wedge per camera, ahead is up; a scale where metres are known."""
    everything = np.array(
        [p for entry in (*scene_map["cameras"], *scene_map["trajectories"]) for p in entry["path"]], float
    ).reshape(-1, 2)
    if not len(everything):
        return tag("p", "No camera could be placed, so there is no map.", class_="none")
    points = np.array(scene_map["points"], float).reshape(-1, 2)
    low, high = _bounds(everything, points)
    scale = min((WIDTH - 2 * MARGIN) / (high - low)[0], (MAX_HEIGHT - 2 * MARGIN) / (high - low)[1])
    height = max(MIN_HEIGHT, (high - low)[1] * scale + 2 * MARGIN)
    middle = (low + high) / 2

    def place(point: Sequence[float]) -> tuple[float, float]:
        x, y = (np.asarray(point, float) - middle) * scale
        return float(WIDTH / 2 + x), float(height / 2 - y)

    parts = [
        tag("circle", cx=f"{x:.0f}", cy=f"{y:.0f}", r=1.1, class_="point")
        for x, y in map(place, points.tolist())
    ]
    parts += [_path(entry["path"], place, "flight") for entry in scene_map["trajectories"]]
    for camera in scene_map["cameras"]:
        parts.append(_path(camera["path"], place, "walk"))
        parts.append(_wedge(camera, place))
    parts += _labels([(c["name"], place(c["path"][0]), c["heading"]) for c in scene_map["cameras"]])
    if metres_per_unit:
        parts.append(_scale_bar(scale / metres_per_unit, height))
    return tag(
        "div",
        tag(
            "svg",
            parts,
            viewBox=f"0 0 {WIDTH} {height:.0f}",
            role="img",
            aria_label="Map of the cameras seen from above",
        ),
        class_="scroll chart",
        tabindex=0,
        role="group",
        aria_label="Map of the cameras",
    )


def _bounds(cameras: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners around all cameras and most of the points near them."""
    low, high = cameras.min(axis=0), cameras.max(axis=0)
    if len(points):
        inner_low, inner_high = np.percentile(points, (5, 95), axis=0)
        low, high = np.minimum(low, inner_low), np.maximum(high, inner_high)
    # A straight row of cameras still needs a map of some height.
    span = np.maximum(high - low, 0.25 * max(float((high - low).max()), 1e-9))
    middle = (low + high) / 2
    return middle - span / 2, middle + span / 2


def _path(path: Sequence[Sequence[float]], place: Any, name: str) -> Markup | None:
    if len(path) < 2:
        return None
    return tag("polyline", points=" ".join("{:.1f},{:.1f}".format(*place(p)) for p in path), class_=name)


def _wedge(camera: Mapping[str, Any], place: Any) -> Markup:
    x, y = place(camera["path"][0])
    angle = math.atan2(-camera["heading"][1], camera["heading"][0])
    half = math.radians(min(camera["fov_deg"], 120) / 2)
    corners = [(x, y)] + [
        (x + WEDGE * math.cos(angle + side * half), y + WEDGE * math.sin(angle + side * half))
        for side in (-1, 1)
    ]
    kind = "held" if camera["role"] == "held out" else "input"
    outline = " ".join(f"{a:.1f},{b:.1f}" for a, b in corners)
    return join(
        tag("polygon", points=outline, class_=f"wedge {kind}"),
        tag("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=4, class_=f"camera {kind}"),
    )


def _labels(
    cameras: Sequence[tuple[str, tuple[float, float], Sequence[float]]],
) -> list[Markup]:
    """Names behind the cameras, moved down where they would lie on another."""
    taken: list[tuple[float, float]] = []
    labels = []
    for name, (x, y), heading in sorted(cameras, key=lambda c: (c[1][1], c[1][0])):
        length = math.hypot(*heading) or 1.0
        at_x, at_y = x - 15 * heading[0] / length, y + 17 * heading[1] / length + 4
        while any(abs(at_x - a) < 44 and abs(at_y - b) < 13 for a, b in taken):
            at_y += 13
        taken.append((at_x, at_y))
        labels.append(tag("text", name, x=f"{at_x:.1f}", y=f"{at_y:.1f}", text_anchor="middle"))
    return labels


def _scale_bar(pixels_per_metre: float, height: float) -> Markup:
    metres = nice_ticks(0, 160 / pixels_per_metre, 2)[-1] or 160 / pixels_per_metre
    end = 16 + metres * pixels_per_metre
    y = height - 14
    return join(
        tag("line", x1=16, x2=f"{end:.1f}", y1=y, y2=y, class_="axis bold"),
        tag("text", f"{show(metres, 2)} m", x=16, y=y - 6),
    )
