"""Paths and helpers shared by the tests."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED_DATA = REPOSITORY.parent / "shared" / "data"
ENGINE = [sys.executable, "-m", "snakemake", "--snakefile", str(REPOSITORY / "Snakefile")]
ENGINE += ["--workflow-profile", "none"]


@pytest.fixture
def studio() -> Path:
    """The rendered studio event, where it is at hand."""
    folder = SHARED_DATA / "studio"
    if not folder.is_dir():
        pytest.skip(f"needs the studio footage at {folder}")
    return folder


class Workspace:
    """A working folder of its own in which the workflow is called as a user calls it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "config" / "scenes").mkdir(parents=True)
        self.write_config({"scene": "demo"})

    def write_config(self, config: dict) -> None:
        (self.folder / "config" / "config.yaml").write_text(yaml.safe_dump(config))

    def write_scene(self, name: str, scene: dict) -> None:
        (self.folder / "config" / "scenes" / f"{name}.yaml").write_text(yaml.safe_dump(scene))

    def snakemake(self, *arguments: str, timeout_s: float = 600) -> subprocess.CompletedProcess[str]:
        """Run snakemake here; standard output and error come back joined."""
        return subprocess.run(
            [*ENGINE, "--scheduler", "greedy", *arguments],
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=timeout_s,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        )

    def planned(self, target: str, *arguments: str) -> dict[str, int]:
        """Rules that a dry run of a target would run, and how often; the target itself is not counted."""
        output = self.snakemake(target, "-n", "--quiet", "rules", "host", *arguments).stdout
        return {} if "Nothing to be done" in output else job_counts(output, target)


def job_counts(output: str, *but: str) -> dict[str, int]:
    """Rule -> number of jobs, from the table that a dry run prints, without the rules named."""
    table = output.split("Job stats:")[1].split("total")[0]
    rows = re.findall(r"^(\w+)\s+(\d+)$", table, re.MULTILINE)
    return {rule: int(count) for rule, count in rows if rule not in but}


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path)


def tiny_scene(num_cameras: int = 5, num_frames: int = 6) -> dict:
    """The demo event, small enough for a test: the same code from end to end."""
    names = [f"cam{i:02d}" for i in range(num_cameras)]
    return {
        "fps": 30,
        "num_frames": num_frames,
        "size": [96, 54],
        "cameras": {name: {"source": f"data/demo/frames/{name}"} for name in names},
        "heldout": names[2:3],
        "clock": "given",
        "calibration": ["data/demo/cameras.json"],
        "labels": "data/demo/truth/labels",
        "settings": {
            "chunk_frames": 3,
            "views": {"train_frames": 3, "heldout_frames": 2},
            "background": {"num_samples": 3},
            "composition": {"num_filters": [4, 4, 4], "epochs": 2},
        },
    }
