"""What jobs cost: straight lines, measured once, scaled to this machine, corrected by the run's own jobs."""

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fourd.plan.outline import SAMPLES, Job

COMPILED, VISION, NETWORK = "compiled", "vision", "network"
KINDS = (COMPILED, VISION, NETWORK)
MIN_SECONDS = 1.0
"""Finished jobs of a rule correct its line once they have worked for this long together."""
# A chunk is removed when the chunk after it is under way.
LIVE_CHUNKS = 2


@dataclasses.dataclass(frozen=True)
class Rate:
    """Cost of a rule's jobs. start_s, unit_s: processor seconds of a job, and of a unit of its work

    kind: which speed of a machine counts;  base_mb, mb_per_mpx: memory, MiB, and per million pixels
    """

    start_s: float
    unit_s: float
    kind: str = VISION
    base_mb: float = 120.0
    mb_per_mpx: float = 0.0


# Two runs of the embedded event from its phones, 480x270, 7 + 2 cameras, 30 frames, each fitted by a line
# (`python -m benches.plan` checks them); training from 66 steps beside the probe of the machine.
# Units: `Job.amount` of fourd/plan/outline.py, mostly frames times millions of pixels.
RATES = {
    "probe_camera": Rate(0.45, 0.0),
    "listen": Rate(1.2, 0.1, base_mb=200),
    "film_cameras": Rate(3.0, 1.3, base_mb=450, mb_per_mpx=1000),
    "track_motion": Rate(0.6, 0.39, base_mb=180, mb_per_mpx=700),
    "align_cameras": Rate(1.0, 0.006, base_mb=300, mb_per_mpx=500),
    "sample_camera": Rate(0.4, 0.14, base_mb=150, mb_per_mpx=500),
    "import_cameras": Rate(0.5, 0.0),
    "match_colours": Rate(0.6, 0.5, base_mb=180, mb_per_mpx=400),
    "prepare_camera": Rate(0.4, 0.95, base_mb=110, mb_per_mpx=450),
    "place_view": Rate(0.25, 0.0),
    "rectify_pair": Rate(0.5, 0.0, base_mb=170),
    "disparity": Rate(0.85, 1.1, COMPILED, base_mb=330, mb_per_mpx=200),
    "judge_need": Rate(0.25, 0.0),
    "survey": Rate(0.25, 0.0),
    "background_plate": Rate(0.4, 4.0, base_mb=120, mb_per_mpx=1000),
    "silhouettes": Rate(0.4, 0.2, base_mb=120, mb_per_mpx=300),
    "fuse_training": Rate(0.9, 0.1, COMPILED, base_mb=330, mb_per_mpx=400),
    "fuse_foreground": Rate(0.9, 0.06, COMPILED, base_mb=330, mb_per_mpx=400),
    "estimate_background": Rate(1.2, 0.049, COMPILED, base_mb=550, mb_per_mpx=800),
    "train_level": Rate(6.0, 3.0, NETWORK, base_mb=400, mb_per_mpx=3000),
    "render_frames": Rate(1.3, 1.0, base_mb=320, mb_per_mpx=600),
    "encode_film": Rate(0.35, 0.04, base_mb=80, mb_per_mpx=150),
    "evaluate_camera": Rate(1.0, 6.0, base_mb=200, mb_per_mpx=600),
    "find_people": Rate(3.0, 0.4, base_mb=500),
    "collect_metrics": Rate(1.0, 0.0, base_mb=170),
}
# The viewer's page takes the same steps as a film, at other places; its own two from one run of 13 views.
RATES |= {
    "place_lattice": RATES["place_view"],
    "fuse_lattice": RATES["fuse_foreground"],
    "estimate_lattice_background": RATES["estimate_background"],
    "render_lattice": RATES["render_frames"],
    "map_lattice": Rate(0.2, 0.03),
    "viewer_page": Rate(0.5, 0.08),
}
GPU_RULES = ("train_level", "render_frames", "render_lattice")


@dataclasses.dataclass(frozen=True)
class Machine:
    """How fast a machine is. slowness: kind of work -> its processor seconds over the reference machine's

    gpu_slowness: the network's seconds on its GPU over those of the reference processor, None without one
    """

    num_cores: int = 1
    slowness: Mapping[str, float] = dataclasses.field(default_factory=lambda: dict.fromkeys(KINDS, 1.0))
    gpu_slowness: float | None = None
    gpu_name: str | None = None


def read_machine(document: Mapping[str, Any]) -> Machine:
    """A machine from its file (docs/formats.md, `machine/speed.json`)."""
    return Machine(
        int(document["num_cores"]),
        {kind: float(document["slowness"][kind]) for kind in KINDS},
        document["gpu_slowness"],
        document["gpu_name"],
    )


def cpu_seconds(job: Job, machine: Machine) -> float:
    """Processor seconds of a job by its line, on a machine without a GPU."""
    rate = RATES[job.rule]
    return (rate.start_s + rate.unit_s * job.amount) * machine.slowness[rate.kind]


def gpu_seconds(job: Job, machine: Machine) -> float:
    """Seconds on the GPU, 0 without one."""
    if machine.gpu_slowness is None or job.rule not in GPU_RULES:
        return 0.0
    return RATES[job.rule].unit_s * job.amount * machine.gpu_slowness


def read_finished(folder: Path) -> dict[tuple[str, ...], tuple[float, float | None]]:
    """(rule, word, ...) -> processor seconds and peak memory, MiB, of the benchmark files of a scene."""
    finished = {}
    for path in sorted(folder.rglob("*.tsv")):
        lines = path.read_text(encoding="utf-8").splitlines()
        if len(lines) < 2:
            continue
        # With repeats the last line is the job that made the file that is there.
        row = dict(zip(lines[0].split("\t"), lines[-1].split("\t"), strict=False))
        seconds, cpu, memory = (_number(row.get(key)) for key in ("s", "cpu_time", "max_rss"))
        if seconds is not None:
            # A job that ends before it was looked at has no processor time.
            finished[path.relative_to(folder).with_suffix("").parts] = (cpu or seconds, memory)
    return finished


def _number(text: str | None) -> float | None:
    try:
        return float(text or "")
    except ValueError:
        return None


def corrections(
    jobs: Iterable[Job], finished: Mapping[tuple[str, ...], tuple[float, float | None]], machine: Machine
) -> dict[str, float]:
    """Rule -> how many times what its line says its finished jobs have taken, where that is known."""
    said: dict[str, float] = {}
    taken: dict[str, float] = {}
    for job in jobs:
        entry = finished.get((job.rule, *job.words))
        if entry is not None:
            said[job.rule] = said.get(job.rule, 0.0) + cpu_seconds(job, machine)
            taken[job.rule] = taken.get(job.rule, 0.0) + entry[0]
    return {rule: taken[rule] / said[rule] for rule in said if taken[rule] >= MIN_SECONDS}


def forecast(
    jobs: Sequence[Job],
    size: tuple[int, int],
    machine: Machine,
    finished: Mapping[tuple[str, ...], tuple[float, float | None]],
    num_cores: int | None = None,
) -> dict[str, Any]:
    """What the jobs cost, by rule and in all (docs/formats.md, `plan/plan.json`).

    size: (width, height) of the films;  finished: of `read_finished`, jobs that are done
    num_cores: cores that work at a time, None for all of the machine's
    """
    factors = corrections(jobs, finished, machine)
    mpx = size[0] * size[1] / 1e6
    rows: dict[str, dict[str, Any]] = {}
    for job in jobs:
        row = rows.setdefault(job.rule, _empty_row())
        rate = RATES[job.rule]
        done = finished.get((job.rule, *job.words))
        gpu_s = gpu_seconds(job, machine)
        cpu_s = cpu_seconds(job, machine) * factors.get(job.rule, 1.0)
        row["jobs"] += 1
        row["jobs_done"] += done is not None
        row["cpu_s_done"] += done[0] if done else 0.0
        row["gpu_s"] += 0.0 if done else gpu_s
        # With a GPU the processor waits; a start and a tenth remain.
        row["cpu_s"] += 0.0 if done else (rate.start_s + cpu_s / 10 if gpu_s else cpu_s)
        row["peak_mb"] = max(row["peak_mb"], rate.base_mb + rate.mb_per_mpx * mpx)
        row["num_bytes"] += job.num_bytes
    for rule, row in rows.items():
        measured = [finished[key][1] for key in finished if key[0] == rule]
        seen = max((m for m in measured if m is not None), default=0.0)
        row["peak_mb"] = seen or row["peak_mb"]
    cores = num_cores or machine.num_cores
    left_s = sum(row["cpu_s"] for row in rows.values())
    return {
        "rules": rows,
        "jobs": len(jobs),
        "jobs_left": sum(row["jobs"] - row["jobs_done"] for row in rows.values()),
        "cpu_minutes": left_s / 60,
        "gpu_minutes": sum(row["gpu_s"] for row in rows.values()) / 60,
        "minutes": (left_s / cores + sum(row["gpu_s"] for row in rows.values())) / 60,
        "num_cores": cores,
        "peak_mb": max(row["peak_mb"] for row in rows.values()),
        **disk(jobs),
    }


def _empty_row() -> dict[str, Any]:
    counts, sums = ("jobs", "jobs_done"), ("cpu_s", "gpu_s", "peak_mb", "num_bytes", "cpu_s_done")
    return {**dict.fromkeys(counts, 0), **dict.fromkeys(sums, 0.0)}


def disk(jobs: Collection[Job]) -> dict[str, float]:
    """Bytes on the disk at the end of a run, and at its fullest moment.

    Disparities that are not kept are removed chunk by chunk: two chunks lie there at a time, and the frames
    that backgrounds are made from until the last background. Fused images wait for the training.
    """
    end = sum(job.num_bytes for job in jobs if job.is_kept)
    waiting = sum(job.num_bytes for job in jobs if not job.is_kept and job.rule != "disparity")
    passing: dict[str, float] = {}
    for job in jobs:
        if not job.is_kept and job.rule == "disparity":
            passing[job.words[-1]] = passing.get(job.words[-1], 0.0) + job.num_bytes
    fixed = passing.pop(SAMPLES, 0.0)
    live = sum(sorted(passing.values())[-LIVE_CHUNKS:])
    return {"end_bytes": end, "peak_bytes": end + waiting + fixed + live}
