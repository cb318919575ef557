"""Chapters on quality: the table of scores, curves, error against run time, training."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fourd.evaluate.table import DEPTH_METRICS, DEPTHS, MASK_METRICS
from fourd.report.charts import Series, line_chart, scatter_chart
from fourd.report.html import Markup, figure, join, more, section, table, tag
from fourd.report.numbers import plural, show, show_seconds
from fourd.report.scores import (
    OURS,
    Scores,
    curves,
    headline_metric,
    is_higher_better,
    method_label,
    metric_label,
)

Document = Mapping[str, Any]
SET_METRICS = ("fid", "frechet_", "kernel_")
SOURCES = {"truth": "true masks", "pipeline": "masks of the workflow"}
REGIONS = {
    "full": "Full frame",
    "dynamic": "What moves",
    "static": "What stands still",
    "seen_1": "Seen by an input",
    "seen_2": "Seen by two inputs",
    "outside_hull": "From outside the cameras",
}


def region_title(region: str, source: str = "") -> str:
    """`Full frame`, `Dynamic region (true masks)`."""
    title = REGIONS.get(region, region.replace("_", " ").capitalize())
    return f"{title} ({SOURCES.get(source, source)})" if source and region != "full" else title


def score_chapter(document: Document, scores: Scores | None) -> Markup:
    """Table by method, region and metric; by camera; curves over the frames."""
    rows = document["scores"]["rows"]
    if scores is None or not rows:
        text = "Nothing is scored: the scene has no held-out camera, or none of them could be placed."
        return section(
            "scores", "Scores", "How close the films come to what a camera saw there.", tag("p", text)
        )
    regions = list(dict.fromkeys((row["region"], row["region_source"]) for row in rows))
    metric = headline_metric(scores.names["metric"])
    views = scores.names["view"]
    return section(
        "scores",
        "Scores",
        f"How close each method comes to what {plural(len(views), 'held-out camera')} filmed: mean ± "
        "standard deviation over all frames [95 % interval of the mean], the best of a column in bold. Good: "
        "ours leads, above all where things move.",
        [
            _method_table([r for r in rows if (r["region"], r["region_source"]) == pair], region_title(*pair))
            for pair in regions[:2]
        ],
        _mask_line(document["scores"]["masks"]),
        _depth_table(document["scores"]["depths"]),
        _set_table(rows),
        _region_table(rows, metric),
        tag("ul", [tag("li", note) for note in document["scores"]["notes"]], class_="notes"),
        _view_table(document["scores"]["by_view"], metric, views),
        [
            figure(_curve_chart(scores, region, metric), f"{region_title(region, source)}, frame by frame.")
            for region, source in regions[:2]
        ]
        if metric
        else None,
        more("Curves of the other regions and metrics", _other_curves(scores, regions, metric)),
    )


def _mask_line(masks: Mapping[str, float | None]) -> Markup | None:
    """The workflow's own masks against true ones."""
    words = [f"{text} {show(masks[key])}" for key, text in MASK_METRICS.items() if masks.get(key) is not None]
    text = "The workflow's own masks of what moves, against the true ones: "
    return tag("p", text + ", ".join(words) + ".") if words else None


def _depth_table(rows: Sequence[Document]) -> Markup | None:
    """The workflow's own depth against the true one."""
    cell = {(row["method"], row["region"], row["metric"]): row["mean"] for row in rows}
    regions = dict.fromkeys(row["region"] for row in rows)
    body = [
        (
            DEPTHS[method],
            region_title(region),
            *(
                "-" if (mean := cell.get((method, region, metric))) is None else form.format(mean)
                for metric, (_, form) in DEPTH_METRICS.items()
            ),
        )
        for method, region in itertools.product(DEPTHS, regions)
        if any(cell.get((method, region, metric)) is not None for metric in DEPTH_METRICS)
    ]
    title = "The workflow's depth against the true one, as shares of the true depth"
    header = ("depth", "region", *(name for name, _ in DEPTH_METRICS.values()))
    return table(header, body, title, range(2, 6)) if body else None


def _set_table(rows: Sequence[Document]) -> Markup | None:
    """Distances of all pictures of a camera as a set."""
    chosen = [row for row in rows if row["metric"].startswith(SET_METRICS) and row["mean"] is not None]
    if not chosen:
        return None
    num_views = max(row["num_values"] for row in chosen)
    return _metric_table(chosen, f"All pictures of a camera as a set, {plural(num_views, 'camera')}")


def _method_table(rows: Sequence[Document], title: str) -> Markup:
    rows = [row for row in rows if not row["metric"].startswith(SET_METRICS)]
    num_frames = max(row["num_values"] + row["num_infinite"] for row in rows)
    return _metric_table(rows, f"{title}, {plural(num_frames, 'frame')}")


def _metric_table(rows: Sequence[Document], title: str) -> Markup:
    # A metric that could not be measured is named in the notes; it needs no column of dashes.
    metrics = list(dict.fromkeys(r["metric"] for r in rows if r["num_values"] + r["num_infinite"]))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    cell = {(row["method"], row["metric"]): row for row in rows}
    best, decimals = {}, {}
    for metric in metrics:
        means = [cell[m, metric]["mean"] for m in methods if (m, metric) in cell]
        known = [mean for mean in means if mean is not None]
        best[metric] = (max if is_higher_better(metric) else min)(known, default=None)
        decimals[metric] = num_decimals(known)
    body = [
        (
            tag("b", method_label(method)) if method == OURS else method_label(method),
            *(_score_cell(cell.get((method, metric)), best[metric], decimals[metric]) for metric in metrics),
        )
        for method in methods
    ]
    arrows = [f"{metric_label(m)} {'↑' if is_higher_better(m) else '↓'}" for m in metrics]
    return table(("method", *arrows), body, title, range(1, 99))


def num_decimals(values: Sequence[float]) -> int:
    """Digits behind the point for a column of such values: 0 from a thousand on, 3 below ten."""
    largest = max(map(abs, values), default=0.0)
    return sum(largest < limit for limit in (1000, 100, 10))


def _score_cell(row: Document | None, best: float | None, decimals: int) -> Markup | str:
    if row is None:
        return "-"
    if row["mean"] is None:
        return "∞" if row["num_infinite"] else "-"
    text = f"{row['mean']:.{decimals}f}"
    spread = tag("small", f" ± {row['sd']:.{decimals}f}")
    identical = tag("small", f" ({row['num_infinite']} identical)") if row["num_infinite"] else None
    if row["low"] is not None and row["high"] is not None:
        spread = join(
            spread, tag("br"), tag("small", f"[{row['low']:.{decimals}f}, {row['high']:.{decimals}f}]")
        )
    return join(tag("b", text) if row["mean"] == best else text, spread, identical)


def _region_table(rows: Sequence[Document], headline: str | None) -> Markup | None:
    """The headline metric in every region, and what is only measured in some of them."""
    everywhere = {row["metric"] for row in rows if row["region"] == "full"}
    known = [row for row in rows if row["mean"] is not None]
    columns = dict.fromkeys((r["region"], r["metric"]) for r in known if r["metric"] == headline)
    columns |= dict.fromkeys((r["region"], r["metric"]) for r in known if r["metric"] not in everywhere)
    if len(columns) < 2:
        return None
    mean = {(row["method"], row["region"], row["metric"]): row["mean"] for row in known}
    methods = list(dict.fromkeys(row["method"] for row in rows))
    digits = {c: num_decimals([v for key, v in mean.items() if key[1:] == c]) for c in columns}
    body = [
        (method_label(m), *(f"{mean[m, *c]:.{digits[c]}f}" if (m, *c) in mean else "-" for c in columns))
        for m in methods
    ]
    titles = [
        region_title(region)
        if metric == headline
        else f"{metric_label(metric)}: {region_title(region).lower()}"
        for region, metric in columns
    ]
    title = f"{metric_label(str(headline))} by region, and what is measured in some regions only"
    return table(("method", *titles), body, title, range(1, 99))


def _view_table(rows: Sequence[Document], metric: str | None, views: Sequence[str]) -> Markup | None:
    full = {(r["view"], r["method"]): r for r in rows if r["metric"] == metric and r["region"] == "full"}
    if metric is None or len(views) < 2 or not full:
        return None
    methods = list(dict.fromkeys(method for _, method in full))
    empty = {"mean": None}
    body = [
        (method_label(m), *(show(full.get((view, m), empty)["mean"], 4) for view in views)) for m in methods
    ]
    return table(
        ("method", *views), body, f"{metric_label(metric)} of the full frame by camera", range(1, 99)
    )


def _curve_chart(scores: Scores, region: str, metric: str, view: str | None = None) -> Markup:
    return line_chart(
        curves(scores, region, metric, view),
        "frame",
        metric_label(metric),
        f"{metric_label(metric)} of every method over the frames, {region}{f', {view}' if view else ''}",
    )


def _other_curves(scores: Scores, regions: Sequence[tuple[str, str]], headline: str | None) -> list[Markup]:
    shown = {(region, headline) for region, _ in regions[:2]}
    figures = [
        figure(
            _curve_chart(scores, region, metric), f"{region_title(region, source)}: {metric_label(metric)}."
        )
        for region, source in regions
        for metric in scores.names["metric"]
        if (region, metric) not in shown and not metric.startswith((*SET_METRICS, "mask_", "depth_"))
    ]
    views = scores.names["view"]
    if headline and len(views) > 1 and regions:
        region = regions[0][0]
        figures += [
            figure(_curve_chart(scores, region, headline, view), f"{view} alone: {metric_label(headline)}.")
            for view in views
        ]
    return figures


def progress_chapter(document: Document, validation: Sequence[tuple[str, str]]) -> Markup:
    """Training curves and pictures, and error against run time.

    validation: (sentence, data URI) of samples kept apart
    """
    timing = document["error_time"]
    metric = timing["metric"]
    body: list[Markup | None] = []
    full = [p for p in timing["points"] if p["region"] == "full"]
    if full and metric:
        sign = 1 if is_higher_better(metric) else -1
        front, best = [], -np.inf
        for i, point in enumerate(full):
            if sign * point["value"] > best:
                best = sign * point["value"]
                front.append(i)
        chart = scatter_chart(
            [(method_label(p["method"]), p["run_time_s"], p["value"]) for p in full],
            front,
            "run time from raw footage, s",
            metric_label(metric),
            f"{metric_label(metric)} of held-out cameras against run time",
        )
        text = (
            "The best picture of a held-out camera so far, by run time (pauses left out). The first one was "
            f"there after {show_seconds(timing['first_s'])}, the best after {show_seconds(timing['best_s'])}."
        )
        if timing["unknown_methods"]:
            names = ", ".join(map(method_label, timing["unknown_methods"]))
            text += f" Not drawn, having no score or no run time of their own: {names}."
        body.append(figure(chart, text))
    else:
        body.append(
            tag("p", "Scores or run times are missing, so that they cannot be joined.", class_="none")
        )
    for level in document["training"]:
        body.append(_training_figure(level))
    body += [figure(tag("img", src=uri, alt=text), text) for text, uri in validation]
    return section(
        "progress",
        "Error against time",
        "What each minute of work bought, from raw footage to the last epoch. Good: the line still rises "
        "where the time is spent.",
        body,
    )


def _training_figure(level: Document) -> Markup:
    columns = level["columns"]
    x = columns.get("epoch") or []
    psnr = [key for key in columns if "psnr" in key]
    losses = [key for key in columns if key not in {*psnr, "epoch", "step", "seconds", "skipped_steps"}]
    parts = []
    for keys, name in ((psnr, "PSNR, dB"), (losses, "loss")):
        series = [
            Series(
                key.removesuffix("_psnr_db").replace("_", " "), x, columns[key], key.startswith("validation")
            )
            for key in keys
            if any(value is not None for value in columns[key])
        ]
        if series:
            title = f"Level {level['level']}: {name} by epoch"
            parts.append(line_chart(series, "epoch", name, title, y_from_zero=name == "loss"))
    seconds = [s for s in columns.get("seconds", []) if s is not None]
    took = f" Training took {show_seconds(max(seconds))}." if seconds else ""
    text = (
        f"Training of level {level['level']} by epoch. Validation is on samples kept apart; paste is the "
        f"same without a network.{took}"
    )
    return figure(parts, text)
