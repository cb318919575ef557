"""Rows of all held-out cameras joined, and the table that people read."""

import logging
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

from fourd.baselines import LABELS
from fourd.errors import InputError
from fourd.evaluate.camera import COLUMNS
from fourd.evaluate.contact_sheet import stack_sheets
from fourd.io import read_csv, read_image, write_csv, write_png, write_text

METRICS = {"mse": ("MSE", "{:.1f}"), "psnr_db": ("PSNR, dB", "{:.2f}"), "ssim": ("SSIM", "{:.3f}")}
SOURCES = {"truth": "true masks", "pipeline": "masks of the workflow"}

logger = logging.getLogger(__name__)
Row = Mapping[str, str]


def read_metrics(path: Path) -> list[dict[str, str]]:
    """Rows of one camera's CSV, none of a camera that was left out.

    Raises InputError if there is no file or it has other columns.
    """
    if not path.is_file():
        raise InputError(f"expected the scores of a camera at {path}, found nothing: evaluate it first")
    rows = read_csv(path)
    header = path.read_text(encoding="utf-8").partition("\n")[0].strip().split(",")
    if header != list(COLUMNS):
        given = ", ".join(header)
        raise InputError(
            f"expected rows with {', '.join(COLUMNS)} in {path}, got {given}: "
            "delete it and evaluate the camera again"
        )
    return rows


def summarize(values: Sequence[float]) -> tuple[float, float]:
    """Mean and sample standard deviation (0 for one value); infinite values make both infinite and NaN."""
    mean = statistics.fmean(values)
    if len(values) < 2:
        return mean, 0.0
    return mean, statistics.stdev(values) if math.isfinite(mean) else math.nan


def draw_table(rows: Sequence[Row]) -> str:
    """Markdown: mean and deviation over frames and cameras per method, then PSNR per camera."""
    lines = []
    for region in _unique(rows, "region"):
        of_region = [row for row in rows if row["region"] == region]
        title = "Full frame" if region == "full" else f"{region.capitalize()} region"
        if region != "full":
            sources = [SOURCES.get(source, source) for source in _unique(of_region, "region_source")]
            title += f" ({', '.join(sources)})"
        views = _unique(of_region, "view")
        frames = {(row["view"], row["frame"]) for row in of_region if row["value"]}
        lines += [f"{title}: mean and standard deviation over {len(frames)} frames of {', '.join(views)}", ""]
        lines += _method_table(of_region)
        lines += ["", f"{title}: mean PSNR in dB by camera", ""]
        lines += _camera_table(of_region, views)
        lines.append("")
    return "\n".join(lines)


def _method_table(rows: Sequence[Row]) -> list[str]:
    lines = [
        _line(["method", *(label for label, _ in METRICS.values())]),
        _line(["---"] * (1 + len(METRICS))),
    ]
    for method in _unique(rows, "method"):
        cells = [LABELS.get(method, method)]
        for metric, (_, form) in METRICS.items():
            values = _values(rows, method=method, metric=metric)
            # A deviation of infinite values (identical images) is none.
            known = [form.format(v) for v in summarize(values) if not math.isnan(v)] if values else ["-"]
            cells.append(" +- ".join(known))
        lines.append(_line(cells))
    return lines


def _camera_table(rows: Sequence[Row], views: Sequence[str]) -> list[str]:
    lines = [_line(["method", *views]), _line(["---"] * (1 + len(views)))]
    for method in _unique(rows, "method"):
        cells = [LABELS.get(method, method)]
        for view in views:
            values = _values(rows, method=method, metric="psnr_db", view=view)
            cells.append(f"{summarize(values)[0]:.2f}" if values else "-")
        lines.append(_line(cells))
    return lines


def _unique(rows: Sequence[Row], key: str) -> list[str]:
    return list(dict.fromkeys(row[key] for row in rows))


def _values(rows: Sequence[Row], **wanted: str) -> list[float]:
    chosen = [row for row in rows if all(row[key] == value for key, value in wanted.items())]
    return [float(row["value"]) for row in chosen if row["value"]]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def run_collect(
    inputs: Sequence[Path], sheets: Sequence[Path], output: Path, output_table: Path, output_sheet: Path
) -> str:
    """Write the joined rows, the table and the joined contact sheet; return the table. Raises InputError."""
    rows = [row for path in inputs for row in read_metrics(path)]
    table = draw_table(rows) if rows else "No held-out camera could be placed, so nothing is scored.\n"
    write_csv(output, COLUMNS, rows)
    write_text(output_table, table)
    write_png(output_sheet, stack_sheets([read_image(path) for path in sheets]))
    return table
