"""What the dry run shows: how many jobs of each rule, and what a changed setting runs again."""

import os
import re
import resource
import subprocess

import pytest

from benches.load import write_stub
from tests.conftest import Workspace, tiny_scene

DRY_RUN = ("render_all", "-n", "--quiet", "rules", "host")


def job_counts(output: str) -> dict[str, int]:
    """Rule -> number of jobs, from the table that a dry run prints."""
    table = output.split("Job stats:")[1].split("total")[0]
    return {rule: int(count) for rule, count in re.findall(r"^(\w+)\s+(\d+)$", table, re.MULTILINE)}


def large_scene(workspace: Workspace, num_cameras: int, num_frames: int) -> dict:
    names = [f"cam{i:02d}" for i in range(num_cameras)]
    for name in [*names, "cameras"]:
        (workspace.folder / name).touch()
    return {
        "num_frames": num_frames,
        "size": [1920, 1080],
        "cameras": {name: {"source": name} for name in names},
        "clock": "given",
        "calibration": ["cameras"],
    }


def test_demo_counts(workspace: Workspace) -> None:
    workspace.write_scene("demo", tiny_scene(num_cameras=5, num_frames=6))
    result = workspace.snakemake(*DRY_RUN)
    assert result.returncode == 0, result.stdout
    counts = job_counts(result.stdout)
    # 4 inputs and 1 held-out camera, 2 chunks, 3 trajectories of which one has a frozen clock.
    assert counts["demo_frames"] == 5
    assert counts["probe_camera"] == 5
    assert counts["rectify_pair"] == 6
    assert counts["disparity"] == 6 * (2 + 1)
    assert counts["place_view"] == 5 + 3
    assert counts["train_level"] == 1
    assert counts["fuse_training"] == 2
    # Three films and the held-out camera in two chunks each; the four inputs have one group of poses.
    assert counts["fuse_foreground"] == 8
    assert counts["estimate_background"] == 8 + 4
    assert counts["encode_film"] == 3
    assert counts["evaluate_camera"] == 1


def test_fifteen_cameras_nine_hundred_frames(workspace: Workspace) -> None:
    """About two thousand jobs; what the dry run costs is printed, not asserted."""
    workspace.write_config({"scene": "large"})
    workspace.write_scene("large", large_scene(workspace, 15, 900))
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    result = workspace.snakemake(*DRY_RUN)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert result.returncode == 0, result.stdout
    counts = job_counts(result.stdout)
    assert counts["rectify_pair"] == 105
    assert counts["disparity"] == 105 * (900 // 60 + 1)
    assert counts["train_level"] == 3
    assert 1_900 <= sum(counts.values()) <= 2_100
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{sum(counts.values())} jobs, dry run {seconds:.1f} s of processor time")


def test_too_many_jobs_are_refused_with_a_chunk_size_that_fits(workspace: Workspace) -> None:
    workspace.write_config({"scene": "large", "chunk_frames": 1, "max_jobs": 2000})
    workspace.write_scene("large", large_scene(workspace, 8, 120))
    result = workspace.snakemake(*DRY_RUN)
    assert result.returncode != 0
    proposed = re.search(r"use chunk_frames (\d+) or more", " ".join(result.stdout.split()))
    assert proposed, result.stdout
    workspace.write_config({"scene": "large", "chunk_frames": int(proposed[1]), "max_jobs": 2000})
    assert workspace.snakemake(*DRY_RUN).returncode == 0


def test_the_engine_looks_for_work_when_a_job_ends_and_not_more_often(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its timers, each of which started one more, took ten times as much as its own work for the jobs."""
    workspace.write_scene("demo", tiny_scene(num_cameras=6))
    write_stub(workspace.folder / "bin")
    monkeypatch.setenv("PATH", f"{workspace.folder / 'bin'}:{os.environ['PATH']}")
    result = workspace.snakemake("--cores", "1", "--verbose", "render_all")
    assert result.returncode == 0, result.stdout
    jobs, rounds = result.stdout.count("Finished jobid"), result.stdout.count("Ready jobs: ")
    assert jobs > 80
    assert rounds <= jobs + 2


@pytest.mark.parametrize("arguments", [("--lint",), ("render_all", "--rulegraph")])
def test_lint_and_rule_graph(workspace: Workspace, arguments: tuple[str, ...]) -> None:
    workspace.write_scene("demo", tiny_scene())
    result: subprocess.CompletedProcess[str] = workspace.snakemake(*arguments)
    assert result.returncode == 0, result.stdout
