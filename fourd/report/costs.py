"""Seconds, processor seconds, memory and bytes of every stage, and when each was done."""

import bisect
import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from fourd.io import read_json
from fourd.report.numbers import parse

# Rule -> folder of results that it writes, in the order of the flow; a rule not named here comes last.
FOLDER_OF_RULE = {
    "probe_camera": "ingest",
    "probe_background": "ingest",
    "listen": "align",
    "film_cameras": "sfm",
    "track_motion": "align",
    "align_cameras": "align",
    "sample_camera": "align",
    "import_cameras": "sfm",
    "match_colours": "frames",
    "prepare_camera": "frames",
    "place_view": "views",
    "rectify_pair": "rectification",
    "disparity": "disparity",
    "judge_need": "silhouettes",
    "survey": "plan",
    "background_plate": "silhouettes",
    "silhouettes": "silhouettes",
    "fuse_training": "foreground",
    "fuse_foreground": "foreground",
    "estimate_background": "background",
    "train_level": "composition",
    "render_frames": "render",
    "encode_film": "render",
    "encode_master": "render",
    "edit_depths": "edit",
    "edit_place": "edit",
    "edit_background": "edit",
    "edit_masks": "edits",
    "edit_view": "edits",
    "edit_film": "edits",
    "find_people": "evaluate",
    "evaluate_camera": "evaluate",
    "collect_metrics": "evaluate",
}
# Rules whose jobs are no part of a run: this page, and making the footage of the embedded event.
OTHER_RULES = ("report_page", "demo_")
MEBIBYTE = 2**20


@dataclasses.dataclass(frozen=True)
class Job:
    """One benchmark file. words: what the job is of (`cam02`, `000000-000029`); times in s, memory in MiB.

    end_s: when the file was written, seconds since the epoch
    """

    rule: str
    words: tuple[str, ...]
    seconds: float
    cpu_seconds: float | None
    peak_mb: float | None
    end_s: float


def read_jobs(folder: Path) -> list[Job]:
    """Every benchmark below a scene's folder, `RULE.tsv` or `RULE/WORD/.../WORD.tsv`."""
    jobs = []
    for path in sorted(folder.rglob("*.tsv")):
        lines = path.read_text(encoding="utf-8").splitlines()
        if len(lines) < 2:
            continue
        # With repeats the last line is the job that made the file that is there.
        row = dict(zip(lines[0].split("\t"), lines[-1].split("\t"), strict=False))
        seconds = parse(row.get("s"))
        words = path.relative_to(folder).with_suffix("").parts
        if seconds is not None and not words[0].startswith(OTHER_RULES):
            cpu, peak = parse(row.get("cpu_time")), parse(row.get("max_rss"))
            jobs.append(Job(words[0], words[1:], seconds, cpu, peak, path.stat().st_mtime))
    return jobs


class Clock:
    """Run time: how long at least one job was at work, so that pauses between runs do not count."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        merged: list[list[float]] = []
        for start, end in sorted((job.end_s - job.seconds, job.end_s) for job in jobs):
            if merged and start <= merged[-1][1]:
                merged[-1][1] = max(merged[-1][1], end)
            else:
                merged.append([start, end])
        self._spans = merged
        self._before = [0.0]
        for start, end in merged:
            self._before.append(self._before[-1] + end - start)

    @property
    def total_s(self) -> float:
        return self._before[-1]

    def at(self, time_s: float) -> float:
        """Run time until a moment (seconds since the epoch)."""
        i = bisect.bisect_right([span[0] for span in self._spans], time_s)
        if i == 0:
            return 0.0
        start, end = self._spans[i - 1]
        return self._before[i - 1] + min(time_s, end) - start


def measure_folder(folder: Path) -> tuple[int, int]:
    """(bytes, files) of everything below a folder."""
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    return sum(sizes), len(sizes)


def collect_costs(results: Path, jobs: Sequence[Job]) -> dict[str, Any]:
    """The part `costs` of the report: rows per rule and per stage in the order of the flow, and totals."""
    clock = Clock(jobs)
    known = [rule for rule in FOLDER_OF_RULE if any(job.rule == rule for job in jobs)]
    rules = known + sorted({job.rule for job in jobs} - set(known))
    rule_rows = []
    for rule in rules:
        own = [job for job in jobs if job.rule == rule]
        row = {"rule": rule, "stage": FOLDER_OF_RULE.get(rule, rule), **_sum(own)}
        rule_rows.append({**row, "done_at_s": clock.at(max(job.end_s for job in own))})
    stages, cumulative, cumulative_cpu = [], 0.0, 0.0
    present = sorted(p.name for p in results.iterdir() if p.is_dir() and p.name != "report")
    for stage in dict.fromkeys([*FOLDER_OF_RULE.values(), *(r["stage"] for r in rule_rows), *present]):
        own = [job for job in jobs if FOLDER_OF_RULE.get(job.rule, job.rule) == stage]
        num_bytes, num_files = measure_folder(results / stage)
        if not own and not num_files:
            continue
        sums = _sum(own)
        cumulative += sums["seconds"]
        cumulative_cpu += sums["cpu_seconds"]
        stages.append(
            {
                "stage": stage,
                **sums,
                "cumulative_seconds": cumulative,
                "cumulative_cpu_seconds": cumulative_cpu,
                "num_bytes": num_bytes,
                "num_files": num_files,
            }
        )
    total = {**_sum(jobs), "run_time_s": clock.total_s, "num_bytes": sum(s["num_bytes"] for s in stages)}
    return {"stages": stages, "rules": rule_rows, "total": total}


def collect_forecast(path: Path, jobs: Sequence[Job]) -> dict[str, Any] | None:
    """The part `forecast`: what the first plan of the scene foresaw and what the jobs took, by rule.

    path: plan/plan.json, None is returned without it. Rules without a job's file have no actual time.
    """
    foreseen = read_json(path).get("first_forecast") if path.is_file() else None
    if foreseen is None:
        return None
    rules = []
    for rule, entry in foreseen["rules"].items():
        own = [job for job in jobs if job.rule == rule]
        rules.append(
            {
                "rule": rule,
                "forecast_cpu_s": entry["cpu_s"] + entry["cpu_s_done"],
                "cpu_s": _sum(own)["cpu_seconds"] if own else None,
                "num_jobs_forecast": entry["jobs"],
                "num_jobs": len(own),
            }
        )
    return {"minutes": foreseen["minutes"], "num_cores": foreseen["num_cores"], "rules": rules}


def _sum(jobs: Iterable[Job]) -> dict[str, Any]:
    jobs = list(jobs)
    peaks = [job.peak_mb for job in jobs if job.peak_mb is not None]
    return {
        "num_jobs": len(jobs),
        "seconds": sum(job.seconds for job in jobs),
        # A job that ends before it was looked at has no processor time; it had little.
        "cpu_seconds": sum(job.cpu_seconds or 0.0 for job in jobs),
        "peak_bytes": round(max(peaks) * MEBIBYTE) if peaks else None,
    }
