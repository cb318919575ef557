"""How the job graph follows what is known of a scene: dry runs with a survey written by hand."""

import itertools
import json
import re

from tests.conftest import Workspace, tiny_scene
from tests.workflow.test_job_graph import DRY_RUN, job_counts, large_scene

INPUTS = ("cam00", "cam01", "cam03", "cam04")
PAIRS = tuple("-".join(pair) for pair in itertools.combinations(INPUTS, 2))
STILL = "nothing in it moves by itself, as far as can be seen"


def write_survey(workspace: Workspace, silhouettes: str = "stereo suffices", still: bool = False) -> None:
    """Neighbours can be matched, other pairs cannot."""
    neighbours = {"-".join(pair) for pair in itertools.pairwise(INPUTS)}
    pairs = {
        name: {
            "status": "ok" if name in neighbours else "too wide", "kind": "planar", "angle_deg": 20.0 + i,
            "size": [96, 54], "num_disparities": 60.0,
        }
        for i, name in enumerate(PAIRS)
    }  # fmt: skip
    motion = dict.fromkeys(INPUTS, STILL) if still else {}
    folder = workspace.folder / "results" / "demo"
    (folder / "plan").mkdir(parents=True)
    survey = {"schema_version": 1, "pairs": pairs, "silhouettes": silhouettes, "motion": motion}
    (folder / "plan" / "survey.json").write_text(json.dumps(survey))
    (folder.parent / "machine").mkdir()
    speed = {"num_cores": 2, "gpu_name": None, "gpu_slowness": None}
    speed["slowness"] = dict.fromkeys(("compiled", "vision", "network"), 1.0)
    (folder.parent / "machine" / "speed.json").write_text(json.dumps(speed))


def dry_run(workspace: Workspace, *config: str) -> dict[str, int]:
    result = workspace.snakemake(*DRY_RUN, *(("--config", *config) if config else ()))
    assert result.returncode == 0, result.stdout
    assert "upper bound" not in result.stdout
    return job_counts(result.stdout)


def test_before_the_cameras_a_dry_run_is_an_upper_bound_and_says_so(workspace: Workspace) -> None:
    workspace.write_scene("demo", tiny_scene())
    result = workspace.snakemake(*DRY_RUN)
    assert result.stdout.count("upper bound") == 1
    counts = job_counts(result.stdout)
    assert counts["disparity"] == 6 * 3
    assert counts["silhouettes"] == 2


def test_what_a_scene_does_not_need_has_no_jobs(workspace: Workspace) -> None:
    workspace.write_scene("demo", tiny_scene())
    write_survey(workspace)
    counts = dry_run(workspace)
    assert counts["disparity"] == 3 * 3
    assert "silhouettes" not in counts and "background_plate" not in counts
    assert dry_run(workspace, "plan={leave_out_pairs: [cam00-cam01], max_pairs: 1}")["disparity"] == 3
    result = workspace.snakemake(*DRY_RUN, "--config", "plan={leave_out_pairs: [cam00-cam09]}")
    assert result.returncode != 0
    assert "no pair of input cameras" in " ".join(result.stdout.split())


def test_nothing_moves_no_foreground(workspace: Workspace) -> None:
    workspace.write_scene("demo", tiny_scene())
    write_survey(workspace, silhouettes="ok", still=True)
    counts = dry_run(workspace)
    # Only the frames that the background is made from.
    assert counts["disparity"] == 3
    assert "silhouettes" not in counts
    counts = dry_run(workspace, "plan={foreground: always}")
    assert counts["disparity"] == 3 * 3 and counts["silhouettes"] == 2


def test_a_budget_takes_the_same_work_every_time(workspace: Workspace) -> None:
    workspace.write_scene("demo", tiny_scene())
    write_survey(workspace)
    whole = dry_run(workspace, "minutes=1000", "disk_gb=1000")
    assert whole == dry_run(workspace)
    first = dry_run(workspace, "minutes=0.001")
    assert first["disparity"] <= whole["disparity"]
    assert first == dry_run(workspace, "minutes=0.001")


def test_far_too_many_jobs_are_refused_with_advice(workspace: Workspace) -> None:
    workspace.write_config({"scene": "large"})
    workspace.write_scene("large", large_scene(workspace, 30, 9000))
    result = workspace.snakemake(*DRY_RUN)
    assert result.returncode != 0
    assert re.search(r"use chunk_frames \d+ or more, or raise max_jobs", " ".join(result.stdout.split()))
