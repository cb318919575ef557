"""A folder of its own in which a bench calls the workflow as a user calls it."""

import os
import subprocess
import sys
from pathlib import Path

import yaml

REPOSITORY = Path(__file__).resolve().parents[1]


def write_scene(folder: Path, name: str, scene: dict) -> None:
    """The configuration of a working folder that knows one scene."""
    (folder / "config" / "scenes").mkdir(parents=True, exist_ok=True)
    (folder / "config" / "config.yaml").write_text(yaml.safe_dump({"scene": name}))
    (folder / "config" / "scenes" / f"{name}.yaml").write_text(yaml.safe_dump(scene, sort_keys=False))


def run_workflow(folder: Path, cores: int, *targets: str) -> None:
    """Make the targets; what is newer than its inputs is taken as it is."""
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(REPOSITORY / "Snakefile")]
    command += [
        "--workflow-profile",
        "none",
        "--scheduler",
        "greedy",
        "--cores",
        str(cores),
        "--quiet",
        "all",
    ]
    command += ["--rerun-triggers", "mtime", "--show-failed-logs", *targets]
    subprocess.run(command, cwd=folder, check=True, env={**os.environ, "PYTHONPATH": str(REPOSITORY)})
