"""Rows of all held-out cameras joined, and the table that people read."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from fourd.baselines import LABELS
from fourd.errors import InputError
from fourd.evaluate import summary
from fourd.evaluate.camera import COLUMNS
from fourd.evaluate.contact_sheet import stack_sheets
from fourd.evaluate.depth import CONSENSUS, SURFACE
from fourd.evaluate.score import ESTIMATES, MASKS
from fourd.evaluate.summary import Summary, differences, summarize_all, summarize_rows, summary_rows
from fourd.io import read_csv, read_image, write_csv, write_png, write_text

OURS = "ours"
METRICS = {
    "mse": ("MSE", "{:.1f}"),
    "psnr_db": ("PSNR, dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "ms_ssim": ("MS-SSIM", "{:.3f}"),
    "lpips_alex": ("LPIPS (AlexNet)", "{:.3f}"),
    "lpips_vgg": ("LPIPS (VGG)", "{:.3f}"),
    "fid": ("FID", "{:.1f}"),
    "frechet_alex": ("Frechet (AlexNet conv5)", "{:.3f}"),
    "kernel_alex": ("kernel (AlexNet conv5)", "{:.4f}"),
    "frechet_vgg": ("Frechet (VGG conv5)", "{:.3f}"),
    "kernel_vgg": ("kernel (VGG conv5)", "{:.4f}"),
}
REGIONS = {
    "full": "Full frame",
    "dynamic": "Dynamic region",
    "seen_1": "seen by an input",
    "seen_2": "seen by two inputs",
    "inferred": "inferred",
    "outside_hull": "outside the cameras",
}
MASK_METRICS = {"mask_iou": "IoU", "mask_precision": "precision", "mask_recall": "recall"}
DEPTH_METRICS = {
    "depth_coverage": ("covered", "{:.1%}"),
    "depth_error": ("median error", "{:.2%}"),
    "depth_within_1": ("within 1 %", "{:.1%}"),
    "depth_within_5": ("within 5 %", "{:.1%}"),
}
DEPTHS = {CONSENSUS: "consensus", SURFACE: "consensus over background"}
SOURCES = {"truth": "true masks", "pipeline": "masks of the workflow"}
CONVENTIONS = (
    "MSE of 8-bit values, mean over channels. SSIM and MS-SSIM: Gaussian window of 11 px, sigma 1.5 px, "
    "data range 255, mean over channels; DSSIM is 1 - SSIM or half of that. LPIPS: version 0.1. "
    "Frechet and kernel distances: of all frames of a camera as a set, by the mean activation of the "
    "network's last convolution; they are not FID. All three depend on the number of frames, so they "
    "hold between methods of one table only. Flicker: "
    "mean absolute difference, grey levels, between the changes of render and truth from one evaluated "
    "frame to the next.",
    "[a, b]: 95 % interval of the mean for other cameras and moments of this event, by bootstrap over "
    f"cameras with all their frames ({summary.NUM_RESAMPLES} resamples, seed {summary.SEED}), stretched to "
    "Student's distribution for the number of cameras; with one camera, over its frames. "
    "PSNR less ours compares frame by frame, so what makes a camera hard for every method cancels.",
    "Seen: the surface, by the workflow's depth of the view, lies in the pictures of one or two inputs and "
    "nothing in the view hides it there. Inferred: no estimate covers the pixel, or the background does "
    "with depth continued from around a hole. Outside the cameras: the view looks at the surface from more "
    "than 5 degrees outside the cone of the directions from there to the inputs.",
)

Row = Mapping[str, str]
Summaries = Mapping[tuple[str, str, str], tuple[Summary | None, str]]


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


def draw_table(rows: Sequence[Row], summaries: Summaries) -> str:
    """Markdown: the metrics by method in the full and the dynamic region, other regions, and notes."""
    methods = [method for method in _unique(rows, "method") if method not in ESTIMATES]
    lines = []
    for region in ("full", "dynamic"):
        of_region = [row for row in rows if row["region"] == region]
        title = REGIONS[region]
        if region != "full":
            sources = [SOURCES.get(source, source) for source in _unique(of_region, "region_source")]
            title += f" ({', '.join(sources)})"
        views = _unique(of_region, "view")
        frames = {(row["view"], row["frame"]) for row in of_region if row["value"] and row["metric"] == "mse"}
        lines += [
            f"{title}: mean and standard deviation over {len(frames)} frames of {', '.join(views)}, "
            "[95 % interval]",
            "",
            *_method_table(of_region, summaries, region, methods),
            "",
            f"{title}: mean PSNR in dB by camera",
            "",
            *_camera_table(of_region, views, methods),
            "",
        ]
    lines += [*_mask_lines(summaries), *_depth_lines(summaries)]
    lines += ["Mean PSNR in dB by region, with its share of the frame; flicker in grey levels", ""]
    lines += [*_region_table(rows, summaries, methods), "", *_notes(summaries)]
    return "\n".join(lines)


def _method_table(
    rows: Sequence[Row], summaries: Summaries, region: str, methods: Sequence[str]
) -> list[str]:
    metrics = [m for m in METRICS if any(key[0] == region and key[2] == m for key in summaries)]
    lines = _header(["method", *(METRICS[metric][0] for metric in metrics), "PSNR less ours, dB"])
    psnr = [row for row in rows if row["metric"] == "psnr_db"]
    for method in methods:
        cells = [LABELS.get(method, method)]
        for metric in metrics:
            found, _ = summaries.get((region, method, metric), (None, ""))
            cells.append(_cell(found, METRICS[metric][1]))
        less = None if method == OURS else summarize_rows(differences(psnr, method, OURS), "")
        lines.append(_line([*cells, _cell(less, "{:+.2f}")]))
    return lines


def _cell(found: Summary | None, form: str) -> str:
    """`mean +- std [low, high]`, without what is not defined; `-` without a value."""
    if found is None:
        return "-"
    # A deviation of infinite values (identical images) is none.
    text = form.format(found.mean)
    if not math.isnan(found.std):
        text += " +- " + form.replace("+", "").format(found.std)
    return text if math.isnan(found.low) else f"{text} [{form.format(found.low)}, {form.format(found.high)}]"


def _mask_lines(summaries: Summaries) -> list[str]:
    """How well the workflow's own masks meet the true ones, where there are any."""
    found = [
        (text, summaries.get(("dynamic", MASKS, metric), (None, ""))[0])
        for metric, text in MASK_METRICS.items()
    ]
    words = [f"{text} {one.mean:.3f}" for text, one in found if one is not None]
    return (
        [f"The workflow's own masks of what moves against the true ones: {', '.join(words)}", ""]
        if words
        else []
    )


def _depth_lines(summaries: Summaries) -> list[str]:
    """How far the workflow's depth lies from the true one, where somebody knows it."""
    regions = dict.fromkeys(region for region, method, _ in summaries if method in DEPTHS)
    if not regions:
        return []
    lines = ["Depth of the workflow against the true one: share of |found - true| / true", ""]
    lines += _header(["depth", "region", *(name for name, _ in DEPTH_METRICS.values())])
    for method, label in DEPTHS.items():
        for region in regions:
            cells = [label, REGIONS.get(region, region)]
            for metric, (_, form) in DEPTH_METRICS.items():
                found, _ = summaries.get((region, method, metric), (None, ""))
                cells.append("-" if found is None else form.format(found.mean))
            lines.append(_line(cells))
    return [*lines, ""]


def _camera_table(rows: Sequence[Row], views: Sequence[str], methods: Sequence[str]) -> list[str]:
    lines = _header(["method", *views])
    for method in methods:
        chosen = [row for row in rows if row["method"] == method and row["metric"] == "psnr_db"]
        values = [[float(r["value"]) for r in chosen if r["view"] == view and r["value"]] for view in views]
        means = [f"{summary.summarize(v)[0]:.2f}" if v else "-" for v in values]
        lines.append(_line([LABELS.get(method, method), *means]))
    return lines


def _region_table(rows: Sequence[Row], summaries: Summaries, methods: Sequence[str]) -> list[str]:
    regions = [region for region in _unique(rows, "region") if region != "static"]
    shares = [f"{REGIONS.get(r, r)} ({_share_of_frame(rows, r):.1%})" for r in regions]
    lines = _header(["method", *shares, "flicker, static", "flicker, dynamic"])
    columns = [(region, "psnr_db", "{:.2f}") for region in regions]
    columns += [("static", "flicker", "{:.2f}"), ("dynamic", "flicker", "{:.2f}")]
    for method in methods:
        cells = [LABELS.get(method, method)]
        for region, metric, form in columns:
            found, _ = summaries.get((region, method, metric), (None, ""))
            cells.append("-" if found is None else form.format(found.mean))
        lines.append(_line(cells))
    return lines


def _share_of_frame(rows: Sequence[Row], region: str) -> float:
    """Pixels of a region over those of the full frame, all frames together."""
    counts = {
        (row["region"], row["view"], row["frame"]): int(row["num_pixels"])
        for row in rows
        if row["metric"] == "mse" and row["region"] in ("full", region)
    }
    total = sum(count for key, count in counts.items() if key[0] == "full")
    return sum(count for key, count in counts.items() if key[0] == region) / max(total, 1)


def _notes(summaries: Summaries) -> list[str]:
    """The conventions, and each reason or remark once with the methods or the metric that it is about."""
    about: dict[str, dict[str, None]] = {}
    for (region, method, metric), (found, note) in summaries.items():
        if note and region == "full" and method not in ESTIMATES:
            is_of_metric = found is None and metric != "psnr_db"
            name = METRICS[metric][0] if is_of_metric else LABELS.get(method, method)
            about.setdefault(note, {})[name] = None
    lines = [f"- {', '.join(names)}: {note}" for note, names in about.items()]
    return [*lines, *(f"- {text}" for text in CONVENTIONS), ""]


def _unique(rows: Sequence[Row], key: str) -> list[str]:
    return list(dict.fromkeys(row[key] for row in rows))


def _header(cells: Sequence[str]) -> list[str]:
    return [_line(cells), _line(["---"] * len(cells))]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def run_collect(
    inputs: Sequence[Path],
    sheets: Sequence[Path],
    output: Path,
    output_summary: Path,
    output_table: Path,
    output_sheet: Path,
) -> str:
    """Write the joined rows, their summary, the table and the joined contact sheet; return the table.

    Raises InputError.
    """
    rows = [row for path in inputs for row in read_metrics(path)]
    summaries = summarize_all(rows)
    nothing = "No held-out camera could be placed, so nothing is scored.\n"
    table = draw_table(rows, summaries) if rows else nothing
    write_csv(output, COLUMNS, rows)
    write_csv(output_summary, summary.COLUMNS, summary_rows(summaries))
    write_text(output_table, table)
    write_png(output_sheet, stack_sheets([read_image(path) for path in sheets]))
    return table
