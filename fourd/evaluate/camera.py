"""One held-out camera: every method's frames against what the camera filmed."""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd.baselines import METHODS, Evidence, Method, Unavailable
from fourd.evaluate import EvaluateOptions
from fourd.evaluate.contact_sheet import SheetRow, amplified_error, draw_sheet
from fourd.evaluate.evidence import EvidenceReader, Sources
from fourd.evaluate.regions import surface_regions
from fourd.evaluate.score import ALL_FRAMES, Frame, Scorer, score_image, score_masks, score_true_depth
from fourd.image import label_image
from fourd.io import write_csv, write_png
from fourd.render import with_progress
from fourd.views import LEFT_OUT, read_view

COLUMNS = (
    "view",
    "frame",
    "dt_s",
    "method",
    "region",
    "region_source",
    "metric",
    "value",
    "num_pixels",
    "note",
)
NEIGHBOURS = ("nn_same_time", "nn_all_times")
BODIES = "bodies of MakeHuman by landmarks of BlazePose, over SfM densified"
# Regions that the workflow's own estimates define, whatever the truth is.
OWN_REGIONS = ("seen_1", "seen_2", "inferred", "outside_hull")


__all__ = ["COLUMNS", "EvidenceReader", "Sources", "run_camera", "score_image"]


def list_methods(others: Sequence[str]) -> dict[str, Method]:
    """All methods in the order of the table; those of other programs stand before ours."""
    methods = {name: method for name, method in METHODS.items() if name != "ours"}
    methods |= {name: functools.partial(_take_other, name) for name in others}
    return methods | {"ours": METHODS["ours"]}


def _take_other(name: str, evidence: Evidence) -> np.ndarray:
    return evidence.others[name]


def run_methods(
    evidence: Evidence, valid: np.ndarray, methods: Mapping[str, Method]
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Images by method, black where the truth was not filmed, and reasons of methods that cannot run."""
    images, reasons = {}, {}
    for name, method in methods.items():
        try:
            images[name] = np.where(valid[..., None], method(evidence), np.uint8(0))
        except Unavailable as reason:
            reasons[name] = str(reason)
    return images, reasons


def run_camera(sources: Sources, output: Path, output_sheet: Path, options: EvaluateOptions) -> None:
    """Write the rows of one held-out camera and its contact sheet.

    A camera that was left out has no rows, and its sheet says why. Raises InputError.
    """
    view = read_view(sources.view)
    if view.role == LEFT_OUT:
        write_csv(output, COLUMNS, [])
        write_png(output_sheet, label_image(f"{view.name} is left out: {view.status}", (1200, 24)))
        return
    reader = EvidenceReader(sources, options)
    try:
        rows, sheet = _score_frames(reader, options)
    finally:
        reader.close()
    write_csv(output, COLUMNS, rows)
    write_png(output_sheet, draw_sheet(sheet, options.sheet_tile_px, options.sheet_error_gain))


def _score_frames(
    reader: EvidenceReader, options: EvaluateOptions
) -> tuple[list[dict[str, Any]], list[SheetRow]]:
    entries = reader.view.frames
    count = min(options.sheet_frames, len(entries))
    shown = {entries[(2 * i + 1) * len(entries) // (2 * count)].frame for i in range(count)}
    methods = list_methods(list(reader.others))
    order = list(methods)
    scorer = Scorer(options)
    remarks = {**dict.fromkeys(NEIGHBOURS, reader.films.name), "sfm_humans": BODIES}
    rows: list[dict[str, Any]] = []
    sheet: list[SheetRow] = []
    for entry in with_progress(entries, f"evaluate {reader.view.name}"):
        evidence, valid = reader.read(entry)
        found, true = reader.find_moves(entry, evidence), reader.read_moves(entry)
        moves = (found if true is None else true) & valid
        images, reasons = run_methods(evidence, valid, methods)
        regions = {"full": valid, "dynamic": moves}
        regions |= {name: region & valid for name, region in surface_regions(evidence).items()}
        scores = scorer.score(Frame(images, evidence.truth, valid, moves), regions, reasons, remarks)
        scores.sort(key=lambda score: order.index(score["method"]))
        scores += [] if true is None else score_masks(found & valid, moves)
        depth = reader.read_depth(entry)
        scores += [] if depth is None else score_true_depth(evidence, depth, regions)
        rows += [
            {
                "view": reader.view.name,
                "frame": entry.frame,
                "dt_s": f"{reader.dt_s(entry):.6f}",
                "region_source": "pipeline" if score["region"] in OWN_REGIONS else reader.region_source,
                **score,
            }
            for score in scores
        ]
        if entry.frame in shown:
            sheet.append(_sheet_row(reader.view.name, entry.frame, images, evidence.truth, scores, options))
    of_all = {
        "view": reader.view.name,
        "frame": ALL_FRAMES,
        "dt_s": "",
        "region_source": reader.region_source,
    }
    rows += [{**of_all, **score} for score in scorer.score_sets()]
    return rows, sheet


def _sheet_row(
    name: str,
    frame: int,
    images: Mapping[str, np.ndarray],
    truth: np.ndarray,
    scores: Sequence[Mapping[str, Any]],
    options: EvaluateOptions,
) -> SheetRow:
    psnr = {(s["method"], s["region"]): s["value"] for s in scores if s["metric"] == "psnr_db"}
    captions = {"truth": f"{name}, frame {frame}"}
    for method in images:
        full, moving = (psnr[method, region] for region in ("full", "dynamic"))
        captions[method] = f"{float(full):.1f} dB" + (f", moving {float(moving):.1f} dB" if moving else "")
    error = amplified_error(images["ours"], truth, options.sheet_error_gain)
    return SheetRow({"truth": truth, "error": error, **images}, captions)
