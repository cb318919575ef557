"""Time and memory of the page about a scene, by the length of its table of scores.

python -m benches.report --results results/demo --benchmarks benchmarks/demo --output DIR
The finished scene stays as it is: its folders are linked from DIR, only the table of scores and the list
of held-out cameras are made up. One process per size, so that memory is of that size alone.
"""

import argparse
import itertools
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fourd.baselines import METHODS
from fourd.evaluate.camera import COLUMNS as SCORE_COLUMNS
from fourd.io import read_json, write_csv, write_json

COLUMNS = ("cameras", "frames", "rows", "page_mb", "seconds", "cpu_seconds", "peak_rss_mb")
METRICS = ("mse", "psnr_db", "ssim", "ms_ssim", "lpips_alex")
REGIONS = ("full", "dynamic", "seen_1", "seen_2", "inferred", "outside_hull")
SIZES = ((2, 10), (5, 100), (15, 300))


def make_rows(heldout: list[str], num_frames: int) -> Iterator[dict[str, Any]]:
    """Scores of every method, region and metric, drawn around 20."""
    rng = np.random.default_rng(0)
    keys = itertools.product(heldout, range(num_frames), METHODS, REGIONS, METRICS)
    for view, frame, method, region, metric in keys:
        row = dict.fromkeys(SCORE_COLUMNS, "") | {"view": view, "frame": frame, "dt_s": "0.000000"}
        row |= {"method": method, "region": region, "region_source": "truth", "metric": metric}
        yield row | {"value": repr(float(rng.normal(20, 2))), "num_pixels": 1000}


def link_scene(results: Path, folder: Path, num_cameras: int, num_frames: int) -> int:
    """A scene with other scores below `folder`; returns their number."""
    folder.mkdir(parents=True)
    for path in results.iterdir():
        if path.name not in ("sfm", "evaluate", "report"):
            (folder / path.name).symlink_to(path.resolve())
    document = read_json(results / "sfm" / "cameras.json")
    # Cameras beyond those of the scene have scores but no pictures.
    document["heldout"] += [f"other{i:02d}" for i in range(num_cameras - len(document["heldout"]))]
    document["heldout"] = document["heldout"][:num_cameras]
    write_json(folder / "sfm" / "cameras.json", document)
    (folder / "sfm" / "points.npz").symlink_to((results / "sfm" / "points.npz").resolve())
    rows = list(make_rows(document["heldout"], num_frames))
    write_csv(folder / "evaluate" / "metrics.csv", SCORE_COLUMNS, rows)
    return len(rows)


def measure(
    results: Path, benchmarks: Path, output: Path, num_cameras: int, num_frames: int
) -> dict[str, Any]:
    """One row of the table."""
    folder = output / f"{num_cameras}x{num_frames}"
    num_rows = link_scene(results, folder / "results", num_cameras, num_frames)
    command = [sys.executable, "-m", "fourd.report", "--results", str(folder / "results")]
    command += ["--benchmarks", str(benchmarks), "--output", str(folder / "page")]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "cameras": num_cameras,
        "frames": num_frames,
        "rows": num_rows,
        "page_mb": round((folder / "page" / "index.html").stat().st_size / 1e6, 2),
        "seconds": round(time.perf_counter() - start, 2),
        "cpu_seconds": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 2),
        # The largest child so far; sizes rise.
        "peak_rss_mb": round(after.ru_maxrss / 1024),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--results", type=Path, required=True, help="a finished scene")
    parser.add_argument("--benchmarks", type=Path, required=True, help="its benchmarks")
    parser.add_argument("--output", type=Path, required=True, help="a new folder")
    args = parser.parse_args()
    rows = []
    for num_cameras, num_frames in SIZES:
        rows.append(measure(args.results, args.benchmarks, args.output, num_cameras, num_frames))
        print(", ".join(f"{key} {value}" for key, value in rows[-1].items()), flush=True)
    write_csv(args.output / "report.csv", COLUMNS, rows)


if __name__ == "__main__":
    main()
