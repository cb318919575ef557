"""What leaving out pairs costs in error, and how far forecasts are from what jobs took.

    python -m benches.plan pairs --scene results/SCENE --output DIR
    python -m benches.plan forecast --scene results/SCENE --benchmarks benchmarks/SCENE --output DIR

Run where the scene was made, since its films are named from there. `pairs` needs kept disparities and
backgrounds: held-out views are fused from the most useful pairs only, pasted over the background and compared
with what the cameras filmed. `forecast` needs a `snakemake plan` before the run, whose forecast is kept.
"""

import argparse
import math
import resource
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd import cli, io
from fourd.baselines import paste
from fourd.evaluate.evidence import EvidenceReader, Sources
from fourd.fuse.__main__ import main as fuse
from fourd.metrics import psnr
from fourd.plan.budget import SHARES_OF_PAIRS
from fourd.plan.cost import read_finished
from fourd.plan.files import read_pair_facts
from fourd.plan.work import OK, rank_pairs

PAIR_COLUMNS = (
    "view",
    "share",
    "num_pairs",
    "psnr_db",
    "moving_db",
    "error",
    "seconds",
    "cpu_seconds",
    "peak_rss_mb",
)
FORECAST_COLUMNS = ("rule", "jobs", "forecast_cpu_s", "cpu_seconds", "ratio", "forecast_mb", "peak_rss_mb")


def measure_pairs(scene: Path, labels: Path | None, shares: Sequence[float]) -> Iterator[dict[str, Any]]:
    """Rows of held-out views fused from fewer pairs; error is the loss against all of them, dB.

    labels: folder of the true masks of what moves, by camera;  of full frame and movers the larger loss
    """
    facts = read_pair_facts(sorted((scene / "rectification").glob("*.npz")))
    ranked = rank_pairs({name: fact for name, fact in facts.items() if fact.status == OK})
    whole: dict[str, np.ndarray] = {}
    for share in shares:
        names = ranked[: math.ceil(share * len(ranked))]
        for view in io.read_json(scene / "sfm" / "cameras.json")["heldout"]:
            wall, cpu = time.perf_counter(), time.process_time()
            values = _score_view(scene, view, labels, names)
            yield {
                "view": view,
                "share": share,
                "num_pairs": len(names),
                "psnr_db": float(values[0]),
                "moving_db": float(values[1]),
                "error": float((whole.setdefault(view, values) - values).max()),
                "seconds": time.perf_counter() - wall,
                "cpu_seconds": time.process_time() - cpu,
                "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            }


def _score_view(scene: Path, view: str, labels: Path | None, pairs: Sequence[str]) -> np.ndarray:
    """Mean PSNR, dB, full and moving pixels of a held-out view: foreground of some pairs over background."""
    films = {path.stem: path for path in sorted((scene / "frames" / "cameras").glob("*.npz"))}
    inputs = io.read_json(scene / "sfm" / "cameras.json")["inputs"]
    view_path, cameras = scene / "views" / f"{view}.json", scene / "sfm" / "cameras.json"
    frames = [entry["frame"] for entry in io.read_json(view_path)["frames"]]
    with tempfile.TemporaryDirectory() as folder:
        foreground = Path(folder) / "foreground.npz"
        disparity = [p for pair in pairs for p in sorted((scene / "disparity" / pair).glob("0*.npz"))]
        options = io.Archive(next((scene / "foreground" / view).glob("*.npz"))).meta["options"]
        fuse(
            ["foreground", "--view-file", str(view_path), "--cameras", str(cameras)]
            + ["--frames", *map(str, frames), "--disparity", *map(str, disparity)]
            + ["--films", *(str(films[name]) for name in inputs), "--output", str(foreground)]
            + ["--estimates", "consensus", f"--min-pairs={options['min_pairs']}"]
        )
        reader = EvidenceReader(
            Sources(
                view_path,
                cameras,
                films,
                tuple(sorted(p for p in (scene / "render" / view).iterdir() if p.is_dir())),
                (foreground,),
                tuple(sorted((scene / "background" / view).glob("*.npz"))),
                labels and labels / view,
            )
        )
        values = []
        for entry in reader.view.frames:
            evidence, valid = reader.read(entry)
            moves = reader.find_moves(entry, evidence) & valid
            image = paste.render(evidence)
            values.append([psnr(image, evidence.truth, region) for region in (valid, moves)])
        reader.close()
    return np.nanmean(values, axis=0)


def compare_forecast(scene: Path, benchmarks: Path) -> Iterator[dict[str, Any]]:
    """Rows of rules: what the first forecast said and what the jobs took."""
    finished = read_finished(benchmarks)
    for rule, row in io.read_json(scene / "plan" / "plan.json")["first_forecast"]["rules"].items():
        own = [entry for words, entry in finished.items() if words[0] == rule]
        if len(own) == row["jobs"]:
            actual = sum(seconds for seconds, _ in own)
            said = row["cpu_s"] + row["cpu_s_done"]
            yield {
                "rule": rule,
                "jobs": len(own),
                "forecast_cpu_s": said,
                "cpu_seconds": actual,
                "ratio": said / actual,
                "forecast_mb": row["peak_mb"],
                "peak_rss_mb": max(memory or 0.0 for _, memory in own),
            }


def main(argv: Sequence[str] | None = None) -> None:
    """Print a table and write it as CSV."""
    parser = argparse.ArgumentParser(prog="python -m benches.plan", description=__doc__)
    parser.add_argument("part", choices=("pairs", "forecast"))
    parser.add_argument("--scene", type=Path, required=True, help="results of one scene")
    parser.add_argument("--labels", type=Path, help="true masks by camera, for `pairs`")
    parser.add_argument("--benchmarks", type=Path, help="benchmark files of the scene, for `forecast`")
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args(argv)
    cli.set_num_threads(1)
    if args.part == "pairs":
        columns, rows = PAIR_COLUMNS, list(measure_pairs(args.scene, args.labels, SHARES_OF_PAIRS))
    else:
        columns, rows = FORECAST_COLUMNS, list(compare_forecast(args.scene, args.benchmarks))
    io.write_csv(args.output / f"plan_{args.part}.csv", columns, rows)
    print(*columns, sep="\t")
    for row in rows:
        print(*(f"{v:.3g}" if isinstance(v, float) else v for v in row.values()), sep="\t")


if __name__ == "__main__":
    sys.exit(cli.run_stage(main))
