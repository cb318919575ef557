"""What each second bought: training curves, and the best picture of a held-out camera by run time."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fourd.io import read_csv
from fourd.report.costs import Clock, Job
from fourd.report.current import Current
from fourd.report.numbers import finite, parse
from fourd.report.scores import headline_metric, is_higher_better

# The last rules that a method's picture of a held-out camera waits for. Rendered folders of other
# programs have no run time here.
READY_AFTER = {
    "nn_same_time": ("prepare_camera", "place_view"),
    "nn_all_times": ("prepare_camera", "place_view"),
    "sfm": ("prepare_camera", "place_view"),
    "sfm_dense": ("prepare_camera", "place_view"),
    "sfm_humans": ("prepare_camera", "place_view"),
    "inst": ("fuse_foreground",),
    "background": ("estimate_background",),
    "paste": ("fuse_foreground", "estimate_background"),
    "ibr": ("fuse_foreground", "estimate_background"),
    "ours": ("render_frames",),
}
# Rules that a method needs for all cameras, not for the held-out one alone.
OF_ALL_CAMERAS = ("prepare_camera",)


def collect_training(results: Path, current: Current) -> list[dict[str, Any]]:
    """Per level of the composition the columns of train.csv, numbers or None."""
    levels = []
    paths = [path for path in sorted(results.glob("composition/[0-9]/train.csv"))]
    for path in (path for path in paths if current.has_level(path.parent.name)):
        rows = read_csv(path)
        columns = {key: [finite(parse(row[key])) for row in rows] for key in (rows[0] if rows else {})}
        levels.append({"level": path.parent.name, "columns": columns})
    return levels


def ready_at(jobs: Sequence[Job], method: str, heldout: Sequence[str]) -> float | None:
    """When the last job was done that a method's pictures of held-out cameras wait for; None if unknown."""
    ends = []
    for rule in READY_AFTER.get(method, ()):
        own = [job for job in jobs if job.rule == rule]
        # Pictures of other views are made by the same rules and may come later.
        named = [job for job in own if set(job.words) & set(heldout) and rule not in OF_ALL_CAMERAS]
        if not own:
            return None
        ends.append(max(job.end_s for job in named or own))
    return max(ends, default=None)


def collect_error_time(
    jobs: Sequence[Job], rows: Sequence[Mapping[str, Any]], heldout: Sequence[str]
) -> dict[str, Any]:
    """The part `error_time`: per method and region its mean and the run time after which it is there.

    rows: means by region, method and metric. `first_s` and `best_s` are the run times until the first
    picture of a held-out camera and until the best one.
    """
    metric = headline_metric(list(dict.fromkeys(row["metric"] for row in rows)))
    clock = Clock(jobs)
    points = []
    for row in rows:
        end_s = ready_at(jobs, row["method"], heldout)
        if row["metric"] == metric and row["mean"] is not None and end_s is not None:
            points.append(
                {
                    "method": row["method"],
                    "region": row["region"],
                    "metric": metric,
                    "value": row["mean"],
                    "run_time_s": clock.at(end_s),
                }
            )
    full = [point for point in points if point["region"] == "full"]
    sign = 1 if metric is not None and is_higher_better(metric) else -1
    best = max(full, key=lambda point: sign * point["value"], default=None)
    return {
        "metric": metric,
        "points": sorted(points, key=lambda point: point["run_time_s"]),
        "first_s": min((point["run_time_s"] for point in full), default=None),
        "best_s": None if best is None else best["run_time_s"],
        "unknown_methods": sorted({row["method"] for row in rows} - {p["method"] for p in points}),
    }
