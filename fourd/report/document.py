"""All figures of the page as one JSON object, checked against its schema before it is written."""

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jsonschema

from fourd.evaluate.depth import CONSENSUS, SURFACE
from fourd.evaluate.score import ESTIMATES, MASKS
from fourd.io import SCHEMA_VERSION
from fourd.report import costs, environment, extras, films, progress, scene
from fourd.report.current import Current, read_current
from fourd.report.scores import Scores, add_summary, read_notes, read_scores, summarize
from fourd.report.truth import collect_truth
from fourd.sfm import read_cameras

SCHEMA = Path(__file__).with_name("report.schema.json")


@dataclasses.dataclass(frozen=True)
class Sources:
    """Where the figures come from. results, benchmarks: folders of one scene; the others may be missing.

    settings: the configuration of the run with all defaults filled in;  truth: true films (`truth`)
    num_levels, edits: how many levels of the composition and which edits the scene has, None if not known
    """

    results: Path
    benchmarks: Path
    stability: Path | None = None
    benches: Path | None = None
    settings: Mapping[str, Any] | None = None
    truth: Path | None = None
    num_levels: int | None = None
    edits: Sequence[str] | None = None

    @functools.cached_property
    def current(self) -> Current:
        """What belongs to the scene as it is now."""
        return read_current(self.results, self.settings, self.num_levels, self.edits)


def collect_document(sources: Sources) -> tuple[dict[str, Any], Scores | None]:
    """Everything that can be said in figures and words, and the scores that its means are of.

    Raises InputError for a missing sfm/cameras.json or a file that is not of this workflow.
    """
    results = sources.results
    # Checks every camera, so that a damaged file is named before anything is drawn from it.
    read_cameras(results / "sfm" / "cameras.json")
    current, metrics = sources.current, results / "evaluate" / "metrics.csv"
    scores = read_scores(metrics, current.heldout) if metrics.is_file() else None
    rows = summarize(scores, ("region", "region_source", "method", "metric")) if scores else []
    add_summary(rows, results / "evaluate" / "summary.csv")
    masks = {row["metric"]: row["mean"] for row in rows if row["method"] == MASKS}
    depths = [row for row in rows if row["method"] in (CONSENSUS, SURFACE)]
    rows = [row for row in rows if row["method"] not in ESTIMATES]
    by_view = summarize(scores, ("view", "region", "method", "metric")) if scores else []
    jobs = [job for job in costs.read_jobs(sources.benchmarks) if current.has_job(job)]
    pairs = scene.collect_pairs(results, current)
    document = {
        "schema_version": SCHEMA_VERSION,
        **scene.collect_scene(results),
        "map": scene.collect_map(results, current.views),
        "truth": collect_truth(results, sources.truth),
        "pairs": pairs,
        "scores": {
            "rows": rows,
            "by_view": [row for row in by_view if row["method"] not in ESTIMATES],
            "masks": masks,
            "depths": depths,
            "notes": read_notes(results / "evaluate" / "table.md") if rows else [],
        },
        "renders": scene.collect_renders(results, current),
        "films": films.collect_films(results, current),
        "edits": films.collect_edits(results, current),
        "training": progress.collect_training(results, current),
        "costs": costs.collect_costs(results, jobs),
        "forecast": costs.collect_forecast(results / "plan" / "plan.json", jobs),
        "stability": extras.collect_stability(sources.stability),
        "benches": extras.collect_benches(sources.benches),
        "ablations": extras.collect_ablations(results / "ablations"),
        "left_out": scene.collect_left_out(results, current, pairs, rows),
        "environment": environment.collect_environment(sources.settings),
    }
    heldout = [camera["name"] for camera in document["cameras"] if camera["role"] == "held out"]
    document["error_time"] = progress.collect_error_time(jobs, rows, heldout)
    document["warnings"] = scene.collect_warnings(document)
    return document, scores


def check_document(document: Mapping[str, Any]) -> None:
    """Raise ValueError, naming the key, if a document is not as its schema says."""
    validator = jsonschema.Draft202012Validator(json.loads(SCHEMA.read_text(encoding="utf-8")))
    for error in validator.iter_errors(document):
        where = "/".join(map(str, error.absolute_path))
        raise ValueError(f"report.json is not as its schema says at {where or 'the top'}: {error.message}")
