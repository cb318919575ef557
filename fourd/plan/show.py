"""The plan as a document and in words: what is made, what is left out and why, what the rest will cost."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jsonschema

from fourd.errors import InputError
from fourd.plan.files import survey_to_dict
from fourd.plan.work import OK, Survey, Work

SCHEMA_PATH = Path(__file__).with_name("plan.schema.json")
MAX_REFUSED = 8
"""Pairs whose reasons are printed; all stand in the document."""
LINES_OF_LEVELS = (270, 540, 1080)
"""Lines of the paper's three resolutions."""


def decide_stages(
    outline: Mapping[str, Any], survey: Survey, work: Work, left_out: Mapping[str, str]
) -> list[dict[str, Any]]:
    """One row per decision: `stage`, `is_made`, `what`, `reason` (null if nothing speaks against it), `key`.

    left_out: cameras that could not be placed -> why;  key: what to set in the configuration or scene file
    """
    rows = []

    def add(stage: str, is_made: bool, what: str, reason: str | None, key: str) -> None:
        rows.append({"stage": stage, "is_made": is_made, "what": what, "reason": reason, "key": key})

    clock, cameras = outline["clock_is_given"], outline["cameras_are_given"]
    add("align", not clock, "one clock for all films", "the scene file gives it" if clock else None, "clock")
    add(
        "sfm", not cameras, "cameras from the films", "the scene file gives them" if cameras else None,
        "calibration",
    )  # fmt: skip
    for camera, reason in left_out.items():
        add("sfm", False, f"camera {camera}", reason, "cameras")
    num_matched, num_pairs = len(work.matched), len(outline["pairs"])
    add("stereo", bool(num_matched), f"{num_matched} of {num_pairs} pairs of cameras", None, "rectify")
    for name, status in work.pairs.items():
        if status != OK and not left_out.keys() & set(name.split("-")):
            key = "plan" if survey.pairs[name].status == OK else "rectify"
            add("stereo", False, f"pair {name}", status, key)
    for stage, what, status, key in (
        ("silhouettes", "what moves in front of a known background", work.silhouettes, "silhouettes.use"),
        ("fuse", "instantaneous foreground", work.foreground, "plan.foreground"),
    ):
        add(stage, status == OK, what, None if status == OK else status, key)
    samples = outline["num_samples"]
    add("background", True, f"static background from {samples} moments", None, "background.num_samples")
    lines = min(outline["size"])
    for level in range(outline["num_levels"], len(LINES_OF_LEVELS)):
        reason = f"the films have {lines} lines" if lines < 0.75 * LINES_OF_LEVELS[level] else "max_levels"
        add("composition", False, f"level of {LINES_OF_LEVELS[level]} lines", reason, "max_levels")
    epochs, levels = outline["training"]["epochs"], outline["num_levels"]
    add("composition", True, f"{_count_levels(levels)}, {epochs} epochs", None, "composition.epochs")
    heldout = len(outline["heldout"])
    reason = None if heldout else "no camera is held out"
    add("evaluate", bool(heldout), f"scores of {heldout} held-out cameras", reason, "heldout")
    return rows


def make_document(
    outline: Mapping[str, Any],
    survey: Survey,
    work: Work,
    left_out: Mapping[str, str],
    budget: Mapping[str, Any] | None,
    costs: Mapping[str, Any],
    viewer: Mapping[str, Any] | None,
    disk_now_bytes: int,
    earlier: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """plan/plan.json. earlier: the one that is there, whose first forecast of the same work is kept.

    viewer: `size_mb` of the page and the `forecast` of its own jobs, None where it is not known
    """
    decisions = decide_stages(outline, survey, work, left_out)
    pairs = survey_to_dict(survey)["pairs"]
    document = {
        "scene": outline["scene"],
        "decisions": decisions,
        "pairs": {name: {**pairs[name], "status": status} for name, status in work.pairs.items()},
        "budget": budget,
        "disk_now_bytes": disk_now_bytes,
        "forecast": costs,
        "first_forecast": costs,
        "viewer": viewer,
    }
    if earlier and earlier.get("decisions") == decisions and earlier["forecast"]["jobs"] == costs["jobs"]:
        document["first_forecast"] = earlier["first_forecast"]
    return document


def check_document(document: Mapping[str, Any]) -> None:
    """Raise InputError, naming the place, if a plan does not follow its schema."""
    schema = json.loads(SCHEMA_PATH.read_text(encoding="utf-8"))
    error = next(iter(jsonschema.Draft202012Validator(schema).iter_errors(document)), None)
    if error is not None:
        place = ".".join(map(str, error.absolute_path)) or "the document"
        raise InputError(f"the plan does not follow its schema at {place}: {error.message}; plan anew")


def describe(document: Mapping[str, Any]) -> str:
    """The plan in words, for a terminal."""
    costs = document["forecast"]
    lines = [f"Plan of {document['scene']}", ""]
    refused = [row for row in document["decisions"] if row["what"].startswith("pair ")]
    for row in document["decisions"]:
        if row in refused[MAX_REFUSED:]:
            if row is refused[-1]:
                lines.append(f"  {row['stage']:<12}  and {len(refused) - MAX_REFUSED} more (plan.json)")
            continue
        verb = "  " if row["is_made"] else "  no "
        reason = f": {row['reason']} [{row['key']}]" if row["reason"] else ""
        lines.append(f"  {row['stage']:<12}{verb}{row['what']}{reason}")
    lines += ["", f"  {'rule':<22}{'jobs':>6}{'done':>6}{'CPU left':>11}{'GPU':>8}{'memory':>9}"]
    for rule, row in costs["rules"].items():
        gpu = show_time(row["gpu_s"]) if row["gpu_s"] else "-"
        lines.append(
            f"  {rule:<22}{row['jobs']:>6}{row['jobs_done']:>6}{show_time(row['cpu_s']):>11}{gpu:>8}"
            f"{show_size(row['peak_mb'] * 2**20):>9}"
        )
    lines += [
        "",
        f"  {costs['jobs_left']} of {costs['jobs']} jobs left: {costs['cpu_minutes']:.1f} processor minutes, "
        f"{costs['gpu_minutes']:.1f} on a GPU; about {costs['minutes']:.1f} minutes with "
        f"{costs['num_cores']} cores; at most {show_size(costs['peak_mb'] * 2**20)} of memory a job",
        f"  disk: {show_size(document['disk_now_bytes'])} now, {show_size(costs['peak_bytes'])} at the "
        f"fullest, {show_size(costs['end_bytes'])} at the end",
    ]
    return "\n".join(
        [*lines, *_describe_budget(document["budget"]), *_describe_viewer(document["viewer"]), ""]
    )


def _describe_viewer(viewer: Mapping[str, Any] | None) -> list[str]:
    if viewer is None:
        return []
    costs = viewer["forecast"]
    return [
        f"  not counted above: `snakemake viewer`, a page of {show_size(viewer['size_mb'] * 1e6)} by "
        f"{costs['jobs_left']} of {costs['jobs']} more jobs, {costs['cpu_minutes']:.1f} processor minutes, "
        f"{show_size(costs['end_bytes'])} on the disk; edits, exports and the report, which are not forecast"
    ]


def _count_levels(number: int) -> str:
    return f"{number} level" if number == 1 else f"{number} levels"


def _describe_budget(budget: Mapping[str, Any] | None) -> list[str]:
    if budget is None:
        return []
    pairs = "all" if budget["max_pairs"] is None else f"at most {budget['max_pairs']}"
    asked = [
        f"{budget[key]:g} {unit}" for key, unit in (("minutes", "minutes"), ("disk_gb", "GB")) if budget[key]
    ]
    verdict = "fits" if budget["fits"] else "does not fit even with the least work"
    return [
        f"  budget of {' and '.join(asked)} {verdict}: {pairs} pairs, {budget['num_samples']} moments for "
        f"the background, {_count_levels(budget['num_levels'])}, {budget['epochs']} epochs; from nothing "
        f"{budget['forecast_minutes']:.1f} minutes and {show_size(budget['peak_bytes'])}; expected to lose "
        f"{budget['loss_db']:.1f} dB"
    ]


def show_time(seconds: float) -> str:
    """`12 s`, `3.4 min` or `5.6 h`."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def show_size(num_bytes: float) -> str:
    """`12 MB`, `3.4 GB` or `5.6 TB`."""
    for unit, size in (("TB", 1e12), ("GB", 1e9)):
        if num_bytes >= size:
            return f"{num_bytes / size:.1f} {unit}"
    return f"{num_bytes / 1e6:.0f} MB"
