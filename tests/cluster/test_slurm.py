"""The small event through a real one-node Slurm: the same bytes as without it, and jobs that fare badly."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.conftest import REPOSITORY, Workspace
from tests.small_event import digests, small_scene, whole_run

SCRIPT = Path(__file__).with_name("one_node_slurm.sh")
PROGRAMS = ("slurmctld", "slurmd", "slurmdbd", "munged", "mariadbd", "sbatch", "sacct")
ENGINE = [sys.executable, "-m", "snakemake", "--snakefile", str(REPOSITORY / "Snakefile")]
ENGINE += ["--workflow-profile", "none"]


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    pytest.importorskip("snakemake_executor_plugin_slurm", reason="needs the extra `cluster`")
    missing = [program for program in PROGRAMS if shutil.which(program) is None]
    if missing:
        pytest.skip(f"needs Slurm with accounting: {', '.join(missing)} not installed")
    if os.geteuid() != 0:
        pytest.skip("needs root to start Slurm's daemons")
    folder = tmp_path_factory.mktemp("slurm")
    started = subprocess.run([SCRIPT, "start", folder], capture_output=True, text=True)
    try:
        # Containers differ in what daemons may do; what cannot start says nothing about this project.
        if started.returncode != 0:
            pytest.skip(f"Slurm cannot be started here: {started.stderr.strip()[-500:]}")
        yield
    finally:
        subprocess.run([SCRIPT, "stop", folder], check=started.returncode == 0)


def write_profile(folder: Path, **changes: object) -> None:
    """profiles/slurm on one node of two cores, in a hurry."""
    profile = yaml.safe_load((REPOSITORY / "profiles" / "slurm" / "profile.yaml").read_text())
    profile |= {"cores": 2, "jobs": 8, "latency-wait": 5, "slurm-init-seconds-before-status-checks": 1}
    profile["seconds-between-status-checks"] = 1
    profile["default-resources"] = ["mem_mb=1000 * attempt", "runtime=10"]
    for resources in profile["set-resources"].values():
        resources["mem_mb"] = "1500 * attempt"
    profile["set-resources"]["train_level"]["gpu"] = 1
    profile |= changes
    profile["default-resources"] += ["slurm_account=tests", "slurm_partition=main"]
    (folder / "profile").mkdir()
    (folder / "profile" / "profile.yaml").write_text(yaml.safe_dump(profile))


def submit(folder: Path, *targets: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*ENGINE, "--profile", "profile", *targets],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )


def wait(process: subprocess.Popen[str]) -> str:
    """What the engine said until it ended; it is not waited for for ever."""
    try:
        return process.communicate(timeout=600)[0]
    except subprocess.TimeoutExpired:
        process.kill()
        pytest.fail(f"no end after ten minutes: {process.communicate()[0][-4000:]}")


def said(output: str) -> str:
    return " ".join(output.split())


def test_results_are_those_of_a_local_run(slurm: None, tmp_path: Path) -> None:
    """Every file of every job, by its bytes."""
    workspace = Workspace(tmp_path)
    workspace.write_scene("demo", small_scene())
    write_profile(tmp_path)
    process = submit(tmp_path, "render_all")
    output = wait(process)
    assert process.returncode == 0, output[-4000:]
    print(f"{output.count('has been submitted')} submissions")
    assert digests(tmp_path) == digests(whole_run().folder)
    allocated = ["sacct", "--allocations", "--noheader", "--parsable2", "--format=Comment,AllocTRES"]
    jobs = subprocess.run(allocated, capture_output=True, text=True, check=True).stdout.splitlines()
    assert [job.split("|")[0] for job in jobs if "gres/gpu=1" in job] == ["rule_train_level_wildcards_0"]


def test_job_that_takes_too_much_memory_is_sent_again_with_more(slurm: None, tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    workspace.write_scene("demo", small_scene())
    write_profile(tmp_path, **{"default-resources": ["mem_mb=130 * attempt ** 3", "runtime=10"]})
    process = submit(tmp_path, "data/demo/frames/cam00")
    output = wait(process)
    assert process.returncode == 0, output[-4000:]
    assert "Exceeded job memory limit" in said(output)
    assert "Trying to restart job" in said(output)
    assert len(list((tmp_path / "data/demo/frames/cam00").glob("*.png"))) == 4


def test_cancelled_job_is_named_and_sent_again(slurm: None, tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    workspace.write_scene("demo", small_scene())
    write_profile(tmp_path)
    process = submit(tmp_path, "data/demo/frames/cam00")
    running = ["squeue", "--noheader", "--states=running", "--format=%i"]
    for _ in range(600):
        numbers = subprocess.run(running, capture_output=True, text=True, check=True).stdout.split()
        if numbers:
            break
        time.sleep(0.1)
    subprocess.run(["scancel", *numbers], check=True)
    output = wait(process)
    assert process.returncode == 0, output[-4000:]
    assert f"JOB {numbers[0]} ON" in said(output) and "CANCELLED AT" in said(output)
    assert "Trying to restart job" in said(output)
