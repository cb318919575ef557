"""The demo event at its smallest, for tests that run the whole workflow more than once."""

import atexit
import functools
import hashlib
import shutil
import tempfile
from pathlib import Path

from tests.conftest import Workspace, tiny_scene

# A table with run times, and a file that says how far a training came.
NOT_COMPARED = ("train.csv", "checkpoint.pt")


def small_scene() -> dict:
    """Four cameras of which one is held out, four frames in two chunks, one film."""
    scene = tiny_scene(num_cameras=4, num_frames=4)
    scene["settings"] |= {
        "chunk_frames": 2,
        "views": {"train_frames": 2, "heldout_frames": 1},
        "composition": {"num_filters": [4, 4, 4], "epochs": 1},
        "trajectories": {"time_and_view": {"kind": "arc", "num_frames": 4}},
    }
    return scene


@functools.cache
def whole_run() -> Workspace:
    """The small event, run once for all tests without a disturbance. Not to be changed."""
    folder = Path(tempfile.mkdtemp(prefix="small_event"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    workspace = Workspace(folder)
    workspace.write_scene("demo", small_scene())
    result = workspace.snakemake("--cores", "2", "render_all", timeout_s=1800)
    assert result.returncode == 0, result.stdout[-4000:]
    return workspace


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file that the workflow made below a working folder, by relative path."""
    files = (path for name in ("data", "results") for path in sorted((folder / name).rglob("*")))
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if path.is_file() and path.name not in NOT_COMPARED
    }
