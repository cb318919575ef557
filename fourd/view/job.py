"""Dropped videos, and the workflow that runs on them."""

import contextlib
import filecmp
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from fourd.config import load_yaml
from fourd.errors import InputError
from fourd.io import atomic_path

SCENE_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
SUFFIXES = ("mp4", "mov", "m4v", "mkv", "webm", "avi", "mts")
MAX_FILMS = 40
MAX_FILM_BYTES = 4 * 2**30
# So much of the disk stays free: results are larger than films.
MIN_FREE_BYTES = 2 * 2**30
BLOCK_BYTES = 2**20
STEPS = re.compile(r"(\d+) of (\d+) steps")
RULE = re.compile(r"^(?:local)?(?:rule|checkpoint) (\w+):", re.MULTILINE)
LAST_LINES = 40


def check_scene_name(name: str) -> str:
    """The name. Raises InputError unless it can be that of a scene; nothing else becomes part of a path."""
    if not SCENE_NAME.fullmatch(name):
        raise InputError(
            "expected a scene name of small letters, digits and _ that begins with a letter, got "
            f"{name[:40]!r}"
        )
    return name


def store_film(folder: Path, index: int, suffix: str, body: io.BufferedIOBase, num_bytes: int) -> Path:
    """Write a film of `num_bytes` under a name of its own: what it was called elsewhere is not looked at.

    Raises InputError for a kind of file, number or size that is not taken, or a body that ends early.
    """
    if suffix not in SUFFIXES:
        raise InputError(f"expected a video ({', '.join(SUFFIXES)}), got .{suffix[:12]}: convert it")
    if not 0 <= index < MAX_FILMS:
        raise InputError(f"expected at most {MAX_FILMS} films, got one more: leave some out")
    if not 0 < num_bytes <= MAX_FILM_BYTES:
        raise InputError(f"expected a film of 1 byte to {MAX_FILM_BYTES >> 30} GB, got {num_bytes} bytes")
    folder.mkdir(parents=True, exist_ok=True)
    if shutil.disk_usage(folder).free - num_bytes < MIN_FREE_BYTES:
        raise InputError(f"expected {MIN_FREE_BYTES >> 30} GB to stay free beside the film: free some space")
    path = folder / f"cam{index:02d}.{suffix}"
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        left = num_bytes
        while left:
            block = body.read(min(BLOCK_BYTES, left))
            if not block:
                raise InputError(
                    f"expected {num_bytes} bytes of {path.name}, {left} are missing: send it again"
                )
            file.write(block)
            left -= len(block)
        file.flush()
        if path.exists() and filecmp.cmp(path, temporary, shallow=False):
            # A film that is sent again makes nothing anew: a cancelled run goes on.
            known = path.stat()
            os.utime(temporary, ns=(known.st_atime_ns, known.st_mtime_ns))
    return path


def _sources(scene_file: Path) -> list[str]:
    return sorted(camera["source"] for camera in load_yaml(scene_file)["cameras"].values())


class WorkflowJob:
    """One run of the workflow at a time: `python -m fourd.init` for films, then `snakemake viewer`.

    cwd: the folder that snakemake runs in;  arguments: more words for snakemake
    """

    def __init__(self, cwd: Path, cores: int, arguments: tuple[str, ...] = ()) -> None:
        self._cwd, self._cores, self._arguments = cwd, cores, arguments
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._is_cancelled = False
        self.state: dict[str, Any] = {"status": "idle"}

    def films_folder(self, name: str) -> Path:
        return self._cwd / "data" / "uploads" / check_scene_name(name)

    def start(self, name: str, num_films: int, is_synchronized: bool = False) -> None:
        """Run on the films of a scene, or go on with a run on them that was cancelled.

        num_films: how many were sent for it
        Raises InputError while another runs, for too few films, or for a scene that is made of others.
        """
        films = sorted(self.films_folder(name).glob("cam*.*"))
        if num_films < 2:
            raise InputError(f"scene {name}: expected at least 2 films, got {num_films}: drop more videos")
        paths = [str(film.relative_to(self._cwd)) for film in films]
        scene_file = self._cwd / "config" / "scenes" / f"{name}.yaml"
        is_known = scene_file.exists()
        if len(films) != num_films or (is_known and _sources(scene_file) != paths):
            raise InputError(f"scene {name}: there is one of other films already: choose another name")
        with self._lock:
            if self.state["status"] == "running":
                raise InputError(
                    f"expected one run at a time, {self.state['scene']} is not done: wait for it"
                )
            self._is_cancelled = False
            self.state = {
                "status": "running",
                "scene": name,
                "done": 0,
                "total": 0,
                "step": "looking at the films",
            }
        init = [sys.executable, "-m", "fourd.init", name, *paths]
        init += ["--synchronized"] if is_synchronized else []
        make = [sys.executable, "-m", "snakemake", "--cores", str(self._cores), "viewer"]
        make += ["--config", f"scene={name}", "--workflow-profile", "none", "--scheduler", "greedy"]
        make += ["--rerun-incomplete", *self._arguments]
        threading.Thread(
            target=self._run, args=(name, [make] if is_known else [init, make]), daemon=True
        ).start()

    def _run(self, name: str, commands: list[list[str]]) -> None:
        lines: list[str] = []
        for command in commands:
            # A session of its own: cancelling stops its jobs too.
            self._process = subprocess.Popen(
                command,
                cwd=self._cwd,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
            )
            assert self._process.stdout is not None
            for line in self._process.stdout:
                lines = [*lines[-LAST_LINES:], line.rstrip()]
                self._note(line)
            if self._process.wait() or self._is_cancelled:
                status = "cancelled" if self._is_cancelled else "failed"
                self.state = {**self.state, "status": status, "words": lines}
                return
        self.state = {**self.state, "status": "done", "address": f"/scenes/{name}/"}

    def _note(self, line: str) -> None:
        if steps := STEPS.search(line):
            self.state = {**self.state, "done": int(steps[1]), "total": int(steps[2])}
        elif rule := RULE.search(line):
            self.state = {**self.state, "step": rule[1].replace("_", " ")}

    def cancel(self) -> None:
        """Stop the run; what is finished stays, and the same films can go on later."""
        self._is_cancelled = True
        if self._process is not None and self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGTERM)
