"""The table of the stage `evaluate`: means by method, region and metric, whatever their names are."""

import csv
import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd.baselines import LABELS
from fourd.errors import InputError
from fourd.evaluate.table import METRICS
from fourd.io import read_csv
from fourd.report.charts import Series
from fourd.report.numbers import finite, parse

OURS = "ours"
MAX_CURVE_POINTS = 200
_KEYS = ("view", "frame", "method", "region", "region_source", "metric")


@dataclasses.dataclass(frozen=True, eq=False)
class Scores:
    """All rows of metrics.csv as columns. Names stand in the order in which they first appear.

    names: column -> its distinct texts;  codes: column -> (N,) int32, indices into `names`
    values: (N,) float64, NaN where a region is empty, infinite where images are identical
    """

    names: Mapping[str, list[str]]
    codes: Mapping[str, np.ndarray]
    values: np.ndarray

    def code(self, column: str, name: str) -> int:
        return self.names[column].index(name)


def read_scores(path: Path, views: Collection[str] | None = None) -> Scores:
    """Read metrics.csv row by row: a long event has millions.

    views: rows of others are of an earlier scene and left out;  None: all are read
    Raises InputError for missing columns.
    """
    seen: dict[str, dict[str, int]] = {key: {} for key in _KEYS}
    codes: dict[str, list[int]] = {key: [] for key in _KEYS}
    values: list[float] = []
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        header = next(reader, [])
        missing = [key for key in (*_KEYS, "value") if key not in header]
        if missing:
            raise InputError(
                f"expected a column {missing[0]} in {path}, got {', '.join(header) or 'an empty file'}: "
                "delete it and evaluate again"
            )
        columns = [(header.index(key), seen[key], codes[key].append) for key in _KEYS]
        at_view, at_value = header.index("view"), header.index("value")
        for row in reader:
            if views is not None and row[at_view] not in views:
                continue
            for at, known, append in columns:
                append(known.setdefault(row[at], len(known)))
            values.append(float(row[at_value] or "nan"))
    return Scores(
        {key: list(known) for key, known in seen.items()},
        {key: np.array(column, np.int32) for key, column in codes.items()},
        np.array(values, np.float64),
    )


def summarize(scores: Scores, by: Sequence[str]) -> list[dict[str, Any]]:
    """One row per combination of the columns `by`: mean, sample standard deviation and counts.

    Means are over finite values; `num_infinite` counts the others (identical images), `num_empty` the
    frames in which the region has no pixel. mean and sd are None without a finite value, sd is 0 for one.
    """
    if not len(scores.values):
        return []
    sizes = [max(1, len(scores.names[key])) for key in by]
    combined = np.ravel_multi_index([scores.codes[key] for key in by], sizes)
    groups, index = np.unique(combined, return_inverse=True)
    is_finite = np.isfinite(scores.values)
    values = np.where(is_finite, scores.values, 0.0)
    count = np.bincount(index, is_finite)
    mean = np.bincount(index, values) / np.maximum(count, 1)
    deviations = np.where(is_finite, values - mean[index], 0.0) ** 2
    sd = np.sqrt(np.bincount(index, deviations) / np.maximum(count - 1, 1))
    infinite = np.bincount(index, np.isinf(scores.values))
    empty = np.bincount(index, np.isnan(scores.values))
    rows = []
    for i, code in enumerate(groups):
        keys = [scores.names[key][at] for key, at in zip(by, np.unravel_index(code, sizes), strict=True)]
        rows.append(
            {
                **dict(zip(by, keys, strict=True)),
                "mean": float(mean[i]) if count[i] else None,
                "sd": float(sd[i]) if count[i] else None,
                "num_values": int(count[i]),
                "num_infinite": int(infinite[i]),
                "num_empty": int(empty[i]),
            }
        )
    return rows


def add_summary(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Put `low` and `high`, the 95 % interval, and `note` of summary.csv into rows; None where unknown."""
    known = {}
    if path.is_file():
        known = {(row["region"], row["method"], row["metric"]): row for row in read_csv(path)}
    for row in rows:
        found = known.get((row["region"], row["method"], row["metric"]), {})
        row["low"], row["high"] = finite(parse(found.get("low"))), finite(parse(found.get("high")))
        row["note"] = found.get("note") or None


def read_notes(path: Path) -> list[str]:
    """The list below the table that `evaluate` prints: what its numbers mean, and why some are missing."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return [line.removeprefix("- ") for line in lines if line.startswith("- ")]


def headline_metric(metrics: Sequence[str]) -> str | None:
    """The metric that stands for the others where there is room for one: PSNR, else the first."""
    return next((m for m in metrics if "psnr" in m), metrics[0] if metrics else None)


def is_higher_better(metric: str) -> bool:
    """PSNR and every SSIM but DSSIM; all else is an error or a distance."""
    return "psnr" in metric or ("ssim" in metric and "dssim" not in metric)


def method_label(method: str) -> str:
    """The name of a method in tables."""
    return LABELS.get(method, method.replace("_", " "))


def metric_label(metric: str) -> str:
    """The name of a metric in tables."""
    return METRICS[metric][0] if metric in METRICS else metric.replace("_", " ")


def curves(scores: Scores, region: str, metric: str, view: str | None = None) -> list[Series]:
    """A line per method over the frames; the mean over the views unless one is named.

    Long clips are averaged in equal runs of frames, so that a line has at most `MAX_CURVE_POINTS` points.
    """
    frames = np.array([int(f) if f.lstrip("-").isdigit() else -1 for f in scores.names["frame"]])
    frame_of_row = frames[scores.codes["frame"]]
    keep = np.isfinite(scores.values) & (frame_of_row >= 0)
    keep &= scores.codes["region"] == scores.code("region", region)
    keep &= scores.codes["metric"] == scores.code("metric", metric)
    if view is not None:
        keep &= scores.codes["view"] == scores.code("view", view)
    shown = np.unique(frame_of_row[keep])
    if len(shown) < 2:
        return []
    run = -(-len(shown) // MAX_CURVE_POINTS)
    bins = np.arange(len(shown)) // run
    x = np.bincount(bins, shown) / np.bincount(bins)
    series = []
    for code, method in enumerate(scores.names["method"]):
        chosen = keep & (scores.codes["method"] == code)
        if not chosen.any():
            continue
        index = bins[np.searchsorted(shown, frame_of_row[chosen])]
        total = np.bincount(index, scores.values[chosen], minlength=len(x))
        count = np.bincount(index, minlength=len(x))
        y = [finite(t / c) if c else None for t, c in zip(total, count, strict=True)]
        series.append(Series(method_label(method), x.tolist(), y, method == OURS))
    return series


def ranked_frames(scores: Scores, view: str) -> list[tuple[int, float]]:
    """(frame, value) of one view, worst first, by the headline metric of our method in the full frame.

    Empty where the view, the method or the metric is not in the table.
    """
    metric = headline_metric(scores.names["metric"])
    wanted = {"view": view, "method": OURS, "metric": metric, "region": "full"}
    if any(name not in scores.names[column] for column, name in wanted.items()):
        return []
    keep = np.isfinite(scores.values)
    for column, name in wanted.items():
        keep &= scores.codes[column] == scores.code(column, str(name))
    found = {
        scores.names["frame"][code]: float(value)
        for code, value in zip(scores.codes["frame"][keep], scores.values[keep], strict=True)
    }
    sign = 1 if is_higher_better(str(metric)) else -1
    return sorted(((int(f), v) for f, v in found.items() if f.isdigit()), key=lambda p: (sign * p[1], p[0]))
