"""Runs that are killed, told to stop, or find their files cut: each goes on, or says what is wrong."""

import base64
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from fourd.io import read_json
from fourd.plan.marks import marked_outputs
from tests.conftest import ENGINE, REPOSITORY, Workspace
from tests.small_event import digests, small_scene, whole_run

KILLS = 20


@pytest.fixture(scope="module")
def whole() -> Workspace:
    return whole_run()


@pytest.fixture
def copied(whole: Workspace, tmp_path: Path) -> Workspace:
    """The finished run with another folder's name."""
    shutil.copytree(whole.folder, tmp_path / "copy", copy_function=shutil.copy2)
    workspace = object.__new__(Workspace)
    workspace.folder = tmp_path / "copy"
    return workspace


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    """The engine in a process group of its own, its output to be read line by line."""
    return subprocess.Popen(
        [*ENGINE, "--scheduler", "greedy", "--rerun-incomplete", "--cores", "2", *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )


def wait_for_jobs(process: subprocess.Popen[str], count: int) -> bool:
    """Whether the engine started so many more jobs; False if it ended before."""
    assert process.stdout is not None
    for line in process.stdout:
        count -= line.startswith(("rule ", "localrule "))
        if count <= 0:
            return True
    return False


def kill(process: subprocess.Popen[str]) -> None:
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def made_files(folder: Path) -> Iterator[Path]:
    for name in ("data", "results"):
        yield from (path for path in (folder / name).rglob("*") if path.is_file())


def unfinished(folder: Path) -> list[Path]:
    """Outputs that the engine knows to be unfinished."""
    return [folder / name for name in marked_outputs(folder / ".snakemake")]


def finished(folder: Path) -> dict[Path, int]:
    """Time stamp of every file of a finished job."""
    open_outputs = unfinished(folder)
    return {
        path: path.stat().st_mtime_ns
        for path in made_files(folder)
        if not any(".tmp" in part for part in path.relative_to(folder).parts)
        and path.name != "checkpoint.pt"
        and not any(path == output or output in path.parents for output in open_outputs)
    }


def test_killed_at_random_moments_it_goes_on_and_ends_with_the_same_bytes(
    whole: Workspace, tmp_path: Path
) -> None:
    """No finished job is run again, and nothing of the killed ones stays."""
    workspace = Workspace(tmp_path)
    workspace.write_scene("demo", small_scene())
    moments = random.Random(0)
    kills = 0
    before: dict[Path, int] = {}
    while kills < KILLS:
        process = start(tmp_path, "render_all")
        if not wait_for_jobs(process, moments.randint(1, 6)):
            process.communicate()
            break
        time.sleep(moments.uniform(0, 1))
        kill(process)
        kills += 1
        after = finished(tmp_path)
        assert {path: after.get(path) for path in before} == before
        before = after
        # A killed engine leaves its lock, unless it was at its very end; a second run says so, see below.
        locks = tmp_path / ".snakemake" / "locks"
        if locks.is_dir():
            shutil.rmtree(locks)
    print(f"killed {kills} times")
    assert kills >= KILLS // 2
    result = workspace.snakemake("--cores", "2", "--rerun-incomplete", "render_all")
    assert result.returncode == 0, result.stdout[-4000:]
    after = finished(tmp_path)
    assert {path: after.get(path) for path in before} == before
    assert digests(tmp_path) == digests(whole.folder)
    assert [path for path in tmp_path.rglob("*") if ".tmp" in path.name and "data" in path.parts] == []
    assert [path for path in (tmp_path / "results").rglob("*") if ".tmp" in path.name] == []
    # A mark alone is none: what a job of a killed run was to make for another need not be made again.
    assert [path for path in unfinished(tmp_path) if path.exists()] == []


def test_output_that_was_not_registered_is_made_again(whole: Workspace, copied: Workspace) -> None:
    """Killed after a file was in its place and before the engine noted with which settings it was made.

    Of jobs behind the checkpoint the engine does not look at such marks by itself.
    """
    records = copied.folder / ".snakemake"
    names = ["disparity/cam00-cam01/000000-000001.npz", "render/time_and_view/000000-000001"]
    for output in (f"results/demo/{name}" for name in names):
        mark = base64.urlsafe_b64encode(output.encode()).decode()
        (records / "metadata" / mark).rename(records / "incomplete" / mark)
        for path in [copied.folder / output, *(copied.folder / output).glob("*")]:
            if path.is_file():
                path.write_bytes(b"of other settings")
    result = copied.snakemake("--cores", "2", "--rerun-incomplete", "render_all")
    assert result.returncode == 0, result.stdout[-4000:]
    assert digests(copied.folder) == digests(whole.folder)
    assert unfinished(copied.folder) == []


def test_second_run_on_the_same_results_refuses_politely(copied: Workspace) -> None:
    """Two runs may work side by side on different files; on the same one the second says how to go on."""
    shutil.rmtree(copied.folder / "results" / "demo" / "views")
    targets = [f"results/demo/views/cam0{i}.json" for i in range(2)]
    process = start(copied.folder, *targets)
    assert wait_for_jobs(process, 1)
    os.killpg(process.pid, signal.SIGSTOP)
    second = copied.snakemake("--cores", "1", targets[1])
    kill(process)
    assert second.returncode != 0
    said = " ".join(second.stdout.split())
    assert "Directory cannot be locked" in said and "--unlock" in said
    assert "Traceback" not in said
    # The lock is still there; taken away as it says, the run goes on.
    assert copied.snakemake("--unlock").returncode == 0
    result = copied.snakemake("--cores", "1", "--rerun-incomplete", *targets)
    assert result.returncode == 0, result.stdout[-3000:]


@pytest.mark.parametrize("to_all", [True, False], ids=["group", "engine"])
def test_told_to_stop_it_ends_and_can_be_run_again(copied: Workspace, to_all: bool) -> None:
    """SIGTERM, as a queue or a shutdown sends it, to all processes or to the engine alone."""
    shutil.rmtree(copied.folder / "data" / "demo" / "frames" / "cam03")
    target = ("data/demo/frames/cam03", "--rerun-triggers", "mtime")
    process = start(copied.folder, *target)
    assert wait_for_jobs(process, 1)
    time.sleep(0.5)
    if to_all:
        os.killpg(process.pid, signal.SIGTERM)
    else:
        process.terminate()
    output, _ = process.communicate(timeout=120)
    assert process.returncode != 0
    assert "Traceback" not in output
    assert not (copied.folder / ".snakemake" / "locks").exists() or not any(
        (copied.folder / ".snakemake" / "locks").iterdir()
    )
    result = copied.snakemake("--cores", "1", "--rerun-incomplete", *target)
    assert result.returncode == 0, result.stdout[-3000:]
    assert len(list((copied.folder / "data" / "demo" / "frames" / "cam03").glob("*.png"))) == 4
    assert list((copied.folder / "data" / "demo" / "frames").glob(".*")) == []


@pytest.mark.parametrize(
    ("cut", "lost"),
    [
        ("sfm/cameras.json", "views/cam00.json"),
        ("disparity/cam00-cam01/000000-000001.npz", "foreground/time_and_view/000000-000001.npz"),
        ("composition/0/model.pt", "render/cam02/000002-000003"),
        ("evaluate/cam02.csv", "evaluate/metrics.csv"),
    ],
)
def test_file_cut_by_a_power_failure_is_named(copied: Workspace, cut: str, lost: str) -> None:
    """Bytes that never reached the disk under a final name: the reader says which file to delete."""
    results = copied.folder / "results" / "demo"
    path, gone = results / cut, results / lost
    times = path.stat()
    path.write_bytes(path.read_bytes()[: times.st_size // 2])
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    shutil.rmtree(gone) if gone.is_dir() else gone.unlink()
    target = ("--cores", "1", "--show-failed-logs", f"results/demo/{lost}")
    result = copied.snakemake(*target, "--rerun-triggers", "mtime")
    assert result.returncode != 0
    said = " ".join(result.stdout.split())
    assert "error: expected" in said and str(Path(cut)) in said and "delete" in said, said[-1500:]
    assert "Traceback" not in said


def test_full_disk_stops_with_a_sentence_and_the_run_goes_on(copied: Workspace) -> None:
    """A folder of the results on a disk of its own that is full."""
    folder = copied.folder / "results" / "demo" / "disparity"
    target = "results/demo/disparity/cam00-cam01/000000-000001.npz"
    shutil.rmtree(folder)
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=48k", "tmpfs", str(folder)]
    mounted = subprocess.run(mount, capture_output=True, text=True)
    if mounted.returncode != 0:
        pytest.skip(f"needs the right to mount a file system: {mounted.stderr.strip()}")
    try:
        result = copied.snakemake("--cores", "1", "--show-failed-logs", target)
    finally:
        subprocess.run(["umount", str(folder)], check=True)
    assert result.returncode != 0
    assert "the disk is full" in " ".join(result.stdout.split()), result.stdout[-3000:]
    assert "Traceback" not in result.stdout
    result = copied.snakemake("--cores", "1", "--rerun-incomplete", target)
    assert result.returncode == 0, result.stdout[-3000:]


def test_worker_without_memory_says_so(whole: Workspace, tmp_path: Path) -> None:
    """A limit on the address space stands for a full computer; finished files stay."""
    scene = whole.folder / "results" / "demo"
    command = [sys.executable, "-m", "fourd.demo", "camera", "--name", "cam00", "--output", "frames"]
    command += [
        "--num-cameras",
        "4",
        "--num-frames",
        "2",
        "--fps",
        "30",
        "--width",
        "4096",
        "--height",
        "2304",
    ]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (1_200_000_000, 1_200_000_000)),
    )
    assert done.returncode == 4, done.stderr[-2000:]
    assert "error: not enough memory for this job" in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []
    assert read_json(scene / "sfm" / "cameras.json")["heldout"] == ["cam02"]


def test_results_of_another_version_of_a_stage_are_made_again(whole: Workspace, tmp_path: Path) -> None:
    """The engine does not look into modules; the number that a changed one raises tells it."""
    for name in ("Snakefile", "rules", "fourd", "config"):
        source = REPOSITORY / name
        if source.is_dir():
            shutil.copytree(source, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(source, tmp_path / name)
    module = tmp_path / "fourd" / "render.py"
    text = module.read_text()
    module.write_text(re.sub(r"^STAGE_VERSION = \d+$", "STAGE_VERSION = 999", text, flags=re.MULTILINE))
    assert module.read_text() != text
    for repository, expected in ((REPOSITORY, set()), (tmp_path, {"render_frames", "encode_film"})):
        command = [sys.executable, "-m", "snakemake", "--snakefile", str(repository / "Snakefile")]
        command += ["--workflow-profile", "none", "render_all", "-n", "--quiet", "host"]
        done = subprocess.run(command, cwd=whole.folder, capture_output=True, text=True)
        planned = set(re.findall(r"^rule (\w+):$", done.stdout + done.stderr, re.MULTILINE))
        assert planned >= expected and bool(planned) == bool(expected), done.stdout + done.stderr
        assert not planned & {"disparity", "fuse_foreground", "train_level"}
