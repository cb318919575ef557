"""What the workflow engine itself costs: over real jobs, thousands of empty ones, and with nothing to do.

    python -m benches.load --output DIR                       2,000 empty jobs, then a run without work
    python -m benches.load --output DIR --parts overhead      15 cameras x 120 frames of the demo at 96x54

An empty job is the real rule, command line and files, with a `python` that only makes the outputs. Memory
of the engine is read every half second; growth is what it gains after the first fifth of the run.
`overhead` is what of the cores' time was not spent in jobs; other work on the computer counts as
overhead, so the share by processor seconds stands beside it.
"""

import argparse
import os
import re
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

from benches.workspace import REPOSITORY, write_scene
from fourd.io import ArchiveWriter, write_csv, write_json

COLUMNS = (
    "part", "jobs", "cores", "overhead", "overhead_of_cpu", "ms_per_job", "growth_mb", "seconds",
    "cpu_seconds", "peak_rss_mb",
)  # fmt: skip
STUB = """#!/bin/sh
# Stands for `python -m fourd.STAGE`: makes what follows the flags --output*.
is_output=0
for word in "$@"; do
  case $word in
    --output*) is_output=1 ;;
    --*) is_output=0 ;;
    *)
      if [ $is_output = 1 ]; then
        case ${word##*/} in
          *.npz) mkdir -p "${word%/*}" && cp "${0%/*}/empty.npz" "$word" ;;
          *.*) mkdir -p "${word%/*}" && cp "${0%/*}/empty.json" "$word" ;;
          *) mkdir -p "$word" ;;
        esac
      fi
      ;;
  esac
done
"""


def large_scene(num_cameras: int, num_frames: int, chunk_frames: int) -> dict:
    """The demo event with more cameras and frames, small pictures and the default films."""
    names = [f"cam{i:02d}" for i in range(num_cameras)]
    return {
        "num_frames": num_frames,
        "size": [96, 54],
        "cameras": {name: {"source": f"data/demo/frames/{name}"} for name in names},
        "heldout": names[num_cameras // 2 :][:1],
        "clock": "given",
        "calibration": ["data/demo/cameras.json"],
        "settings": {
            "chunk_frames": chunk_frames,
            "views": {"train_frames": 4, "heldout_frames": 4},
            "background": {"num_samples": 5},
            "composition": {"num_filters": [4, 4, 4], "epochs": 1},
        },
    }


def processor_seconds(pid: int) -> float:
    """User and system time of one process, without its children, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_mb(pid: int) -> float:
    """Memory of one process, MiB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def measure(part: str, folder: Path, cores: int, path: str | None = None) -> dict[str, object]:
    """Run `render_all` once and watch the engine. path: searched for programs first"""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    if path is not None:
        environment["PATH"] = f"{path}:{environment['PATH']}"
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(REPOSITORY / "Snakefile")]
    command += ["--workflow-profile", "none", "--scheduler", "greedy", "--cores", str(cores), "render_all"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begin = time.monotonic()
    log_path = folder / f"{part}.log"
    with log_path.open("w") as log:
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=log, stderr=subprocess.STDOUT, text=True
        )
        own_s, memory = 0.0, []
        while process.poll() is None:
            try:
                own_s, resident = processor_seconds(process.pid), resident_mb(process.pid)
                memory.append(resident)
            except (FileNotFoundError, ProcessLookupError, IndexError):
                break
            time.sleep(0.5)
        status = process.wait()
    seconds = time.monotonic() - begin
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if status != 0:
        sys.exit(f"error: the run failed, see {log_path}")
    total_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    counts = re.findall(r"^(\d+) of \d+ steps", log_path.read_text(), re.MULTILINE)
    jobs = int(counts[-1]) if counts else 0
    peak = [value for value in memory if value > 0] or [0.0]
    # The graph is built in the first part; at the very end libraries are loaded for the last words.
    first, last = len(peak) // 5, len(peak) - len(peak) // 20
    return {
        "part": part,
        "jobs": jobs,
        "cores": cores,
        "overhead": f"{1 - (total_s - own_s) / (seconds * cores):.3f}",
        "overhead_of_cpu": f"{own_s / total_s:.3f}",
        "ms_per_job": f"{1000 * own_s / jobs:.1f}" if jobs else "",
        "growth_mb": f"{max(peak[first:last]) - max(peak[: first + 1]):.1f}" if jobs else "",
        "seconds": f"{seconds:.1f}",
        "cpu_seconds": f"{total_s:.1f}",
        "peak_rss_mb": f"{max(peak):.0f}",
    }


def write_stub(folder: Path) -> None:
    """A `python` that makes the outputs of any job and does nothing else, and what it copies."""
    folder.mkdir(parents=True)
    stub = folder / "python"
    stub.write_text(STUB)
    stub.chmod(0o755)
    with ArchiveWriter(folder / "empty.npz", {"status": "ok"}):
        pass
    # What the engine itself reads: cameras, and what is known of the pairs.
    write_json(folder / "empty.json", {"left_out": {}, "pairs": {}, "silhouettes": "ok", "motion": {}})


def measure_empty_jobs(folder: Path, cores: int) -> list[dict[str, object]]:
    """About 2,000 jobs that do nothing, then the same command once more."""
    scene = large_scene(num_cameras=15, num_frames=900, chunk_frames=50)
    write_scene(folder, "large", scene)
    write_stub(folder / "bin")
    path = str(folder / "bin")
    return [measure(part, folder, cores, path) for part in ("soak", "nothing_to_do")]


def measure_overhead(folder: Path, cores: int) -> list[dict[str, object]]:
    """Real jobs, small pictures: 15 cameras, 120 frames."""
    write_scene(folder, "large", large_scene(num_cameras=15, num_frames=120, chunk_frames=60))
    return [measure("overhead", folder, cores)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--parts", nargs="+", choices=("empty", "overhead"), default=["empty"])
    parser.add_argument("--cores", type=int, default=2)
    args = parser.parse_args()
    print(f"load of the computer: {', '.join(f'{load:.1f}' for load in os.getloadavg())}")
    parts = {"empty": measure_empty_jobs, "overhead": measure_overhead}
    rows = []
    for part in args.parts:
        folder = args.output / part
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        rows += parts[part](folder, args.cores)
    write_csv(args.output / "load.csv", COLUMNS, rows)
    print(*COLUMNS, sep="\t")
    for row in rows:
        print(*row.values(), sep="\t")
    print(f"load of the computer: {', '.join(f'{load:.1f}' for load in os.getloadavg())}")


if __name__ == "__main__":
    main()
