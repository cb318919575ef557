"""Long work kept safe and visible: checkpoints, a request to stop, progress."""

import errno
import logging
import pickle
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch

from fourd import io
from fourd.errors import InputError

log = logging.getLogger("fourd.composition")

PROGRESS_S = 5.0
# The first of these steps, slower than the rest, is not counted.
PROBE_STEPS = 20


class Resumable(Protocol):
    """What a checkpoint holds; `counters["step"]` says how far it has come."""

    counters: dict[str, Any]

    def state(self) -> dict[str, Any]: ...

    def restore(self, state: Mapping[str, Any]) -> None: ...


def save_torch(path: Path, document: Mapping[str, Any]) -> None:
    """Write tensors and plain values atomically; the same content gives the same bytes."""
    with io.atomic_path(path) as temporary, temporary.open("wb") as handle:
        torch.save(dict(document), handle)


def read_torch(path: Path, keys: tuple[str, ...]) -> dict[str, Any]:
    """Tensors and plain values of a file, on the CPU; nothing in it is executed.

    Raises InputError if the file is missing, broken, or lacks one of `keys`.
    """
    if not Path(path).is_file():
        raise InputError(f"expected a file at {path}, found nothing: run the training first")
    try:
        document = torch.load(path, map_location="cpu", weights_only=True)
        for key in keys:
            document[key]
    except (OSError, RuntimeError, LookupError, TypeError, EOFError, pickle.UnpicklingError) as error:
        # In a file that was cut off, torch looks for places before its beginning.
        if isinstance(error, OSError) and error.errno != errno.EINVAL:
            raise
        reason = " ".join(str(error).split())[:120]
        raise InputError(
            f"expected a whole file of this training in {path}, got: {reason}; delete it and train again"
        ) from None
    return document


class Checkpoint:
    """Saves a trainer beside the model, whole or not at all, and restores it if it is the same work."""

    def __init__(self, path: Path, fingerprint: str) -> None:
        self.path, self.fingerprint = path, fingerprint
        self._saved_at = time.monotonic()

    def __call__(self, trainer: Resumable) -> None:
        document = {"schema_version": io.SCHEMA_VERSION, "fingerprint": self.fingerprint}
        save_torch(self.path, document | trainer.state())
        self._saved_at = time.monotonic()

    def is_due(self, every_s: float) -> bool:
        return time.monotonic() - self._saved_at >= every_s

    def restore(self, trainer: Resumable, total_steps: int) -> None:
        """Continue from the file if it fits; otherwise say why it is ignored."""
        if not self.path.is_file():
            return
        state = read_torch(self.path, ("fingerprint", "counters"))
        if state.get("fingerprint") != self.fingerprint:
            log.info("%s is ignored: it was made with other options, data or versions", self.path)
        elif state["counters"]["step"] > total_steps:
            log.info("%s is ignored: it is past the %d steps asked for", self.path, total_steps)
        else:
            trainer.restore(state)
            log.info("continuing from %s at step %d", self.path, trainer.counters["step"])


class StopRequest:
    """Remembers SIGTERM or SIGINT while it is entered, so that a step is never cut in two."""

    signal_number: int | None = None

    def __enter__(self) -> "StopRequest":
        self._previous = {n: signal.signal(n, self._request) for n in (signal.SIGTERM, signal.SIGINT)}
        return self

    def _request(self, number: int, _frame: object) -> None:
        self.signal_number = number

    def __exit__(self, *_exception: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)


class Progress:
    """A line every few seconds: where training is, how well it does, when it ends."""

    def __init__(self, total: int, first: int) -> None:
        self._total, self._first = total, first
        self._started = self._reported = self._warm = time.monotonic()

    def report(self, done: int, epoch: int, epochs: int, terms: Mapping[str, float]) -> None:
        now = time.monotonic()
        if done - self._first == 1:
            self._warm = now
        if done - self._first == 1 + PROBE_STEPS:
            step_s = (now - self._warm) / PROBE_STEPS
            left_min = step_s * (self._total - done) / 60
            log.info("forecast: %d steps of %.3f s, %.1f minutes", self._total - done, step_s, left_min)
        if now - self._reported < PROGRESS_S and done < self._total:
            return
        self._reported = now
        per_s = (done - self._first) / max(now - self._started, 1e-9)
        left_s = (self._total - done) / per_s
        shown = ", ".join(f"{name} {value:.4g}" for name, value in terms.items())
        eta = f"{int(left_s // 60)}:{int(left_s % 60):02d}"
        log.info("step %d/%d, epoch %d/%d, %s, %.2f steps/s, ETA %s",
                 done, self._total, epoch + 1, epochs, shown, per_s, eta)  # fmt: skip
