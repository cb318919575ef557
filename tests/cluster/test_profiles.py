"""The profiles are read by the engine, name rules that exist, and send jobs with what they ask for."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.conftest import REPOSITORY, Workspace, tiny_scene

PROFILES = REPOSITORY / "profiles"
# Runs a job at once and remembers how it ended; as PBS does, it prints a number.
QSUB = """#!/bin/sh
echo "$@" >>"$QUEUE/asked"
number=$(wc -l <"$QUEUE/asked")
for script in "$@"; do :; done
job='sh "$0" >"$1.log" 2>&1; printf "job_state = F\\n Exit_status = %s\\n" $? >"$1"'
sh -c "$job" "$script" "$QUEUE/$number" >/dev/null 2>&1 &
echo "$number"
"""
QSTAT = """#!/bin/sh
for number in "$@"; do :; done
cat "$QUEUE/$number" 2>/dev/null || echo 'job_state = R'
"""


def engine(workspace: Workspace, profile: Path, *arguments: str, **environment: str) -> str:
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(REPOSITORY / "Snakefile")]
    done = subprocess.run(
        [*command, "--profile", str(PROFILES / "slurm"), "--workflow-profile", str(profile), *arguments],
        cwd=workspace.folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=600,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), **environment},
    )
    assert done.returncode == 0, done.stdout[-3000:]
    return done.stdout


@pytest.mark.parametrize("name", ["slurm", "cluster_generic"])
def test_dry_run_shows_groups_and_resources(workspace: Workspace, name: str) -> None:
    pytest.importorskip(f"snakemake_executor_plugin_{'slurm' if name == 'slurm' else name}")
    workspace.write_scene("demo", tiny_scene())
    other = "none" if name == "slurm" else PROFILES / name
    printed = engine(workspace, other, "render_all", "-n")  # type: ignore[arg-type]
    assert re.search(r"Group job disparity .*\n(.*\n)*?.*rule disparity", printed)
    assert "mem_mb=1500" in printed and "runtime=30" in printed
    training = printed[printed.index("rule train_level:") :].split("\n\n")[0]
    assert "mem_mb=6000" in training and "gpu=0" in training


def test_what_is_asked_for_beside_films_travels_in_groups(workspace: Workspace) -> None:
    """Jobs that a user may have dozens of; a submission must not wait for itself."""
    pytest.importorskip("snakemake_executor_plugin_slurm")
    workspace.write_scene("demo", tiny_scene())
    mark = {"frame": 0, "view": "cam01", "box": [10, 10, 40, 40]}
    edits = workspace.folder / "config" / "edits"
    edits.mkdir()
    edit = {"scene": "demo", "operation": "remove", "marks": [mark], "views": ["hold_view", "cam01"]}
    (edits / "gone.yaml").write_text(yaml.safe_dump(edit))
    targets = ("viewer", "export", "edit_all")
    printed = engine(workspace, "none", *targets, "-n", "--config", "format=colmap,png16")  # type: ignore[arg-type]
    grouped = set(re.findall(r"^ +(?:local)?rule (\w+):", printed, re.MULTILINE))
    alone = set(re.findall(r"^(?:local)?rule (\w+):", printed, re.MULTILINE)) - grouped
    single = {"viewer", "export", "edit_all", "viewer_page", "edit_masks", "train_level", "demo_cameras"}
    assert alone <= single | {"import_cameras", "judge_need", "match_colours", "film_cameras"}
    for rule in ("fuse_lattice", "map_lattice", "render_lattice", "edit_view", "edit_film", "export_event"):
        assert rule in grouped, rule


def test_every_rule_of_the_profile_exists() -> None:
    profile = yaml.safe_load((PROFILES / "slurm" / "profile.yaml").read_text())
    text = "".join(path.read_text() for path in sorted((REPOSITORY / "rules").glob("*.smk")))
    rules = set(re.findall(r"^\s*(?:rule|use rule \w+ as) (\w+)(?: with)?:", text, re.MULTILINE))
    groups = dict(entry.split("=") for entry in profile["groups"])
    assert groups.keys() | profile["set-resources"].keys() <= rules
    assert {entry.split("=")[0] for entry in profile["group-components"]} == set(groups.values())


def test_other_queue_gets_a_job_and_tells_how_it_ended(workspace: Workspace, tmp_path: Path) -> None:
    pytest.importorskip("snakemake_executor_plugin_cluster_generic")
    workspace.write_scene("demo", tiny_scene(num_cameras=3, num_frames=2) | {"heldout": [], "labels": None})
    (tmp_path / "profiles").symlink_to(PROFILES)
    programs, queue = tmp_path / "bin", tmp_path / "queue"
    for folder in (programs, queue):
        folder.mkdir()
    for name, text in {"qsub": QSUB, "qstat": QSTAT}.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    engine(
        workspace,
        PROFILES / "cluster_generic",
        "data/demo/cameras.json",
        *("--seconds-between-status-checks", "1"),
        PATH=f"{programs}:{os.environ['PATH']}",
        QUEUE=str(queue),
    )
    assert (tmp_path / "data/demo/cameras.json").is_file()
    assert "select=1:ncpus=1:mem=1500mb -l walltime=30:00" in (queue / "asked").read_text()
