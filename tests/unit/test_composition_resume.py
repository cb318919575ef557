"""Training that is stopped, killed or continued gives what one without a break gives."""

import dataclasses
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from fourd.composition import data
from fourd.composition.checkpoint import Checkpoint, StopRequest, read_torch
from fourd.composition.model import PRECISIONS
from fourd.composition.train import Trainer, train
from fourd.errors import InputError
from tests.composition_scene import (
    CAMS,
    TINY,
    are_equal,
    command_line,
    smooth_image,
    train_model,
    write_scene,
)

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    torch.set_num_threads(1)
    return write_scene(tmp_path_factory.mktemp("scene"))


def interrupted_training(sources, folder, options, num_interruptions):
    """Training that is stopped after each of its first steps, every time by a new process' objects."""
    for _ in range(num_interruptions):
        samples = data.SampleSet(
            sources.foreground,
            sources.background,
            lambda cam, f: (smooth_image(f), np.ones((24, 32), bool)),
            1,
            8,
        )
        trainer, save = Trainer(0, options, "cpu"), Checkpoint(folder / "checkpoint.pt", "same")
        save.restore(trainer, 10**6)
        stop = StopRequest()
        stop.signal_number = signal.SIGTERM if num_interruptions > 1 else None
        num_interruptions -= 1
        try:
            train(trainer, samples, (samples.ids, []), options, save, stop)
        except SystemExit as exit_request:
            assert exit_request.code == 128 + signal.SIGTERM
    return trainer.generator.state_dict(), trainer.counters


@pytest.mark.parametrize("precision", PRECISIONS)
def test_training_interrupted_at_every_step_equals_uninterrupted(sources, tmp_path, precision):
    options = dataclasses.replace(TINY, precision=precision)
    whole, counters = interrupted_training(sources, tmp_path / "a", options, 1)
    parts, counters_of_parts = interrupted_training(sources, tmp_path / "b", options, 9)
    assert counters["step"] == counters_of_parts["step"] == 12
    assert are_equal(whole, parts)
    timeless = [[{**row, "seconds": 0} for row in c["rows"]] for c in (counters, counters_of_parts)]
    assert timeless[0] == timeless[1]


def train_until_killed(sources, folder, options, num_steps):
    """Training whose process kills itself while it reads the sample of a later step; None: never."""
    num_read = 0

    def read_target(cam, frame):
        nonlocal num_read
        num_read += 1
        if num_read == num_steps:
            os.kill(os.getpid(), signal.SIGKILL)
        return smooth_image(10 * CAMS.index(cam) + frame), np.ones((24, 32), bool)

    samples = data.SampleSet(sources.foreground, sources.background, read_target, 1, 0)
    trainer, save = Trainer(0, options, "cpu"), Checkpoint(folder / "checkpoint.pt", "same")
    save.restore(trainer, 10**6)
    train(trainer, samples, (samples.ids, []), options, save, StopRequest())
    return trainer


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes that share what was imported")
def test_training_killed_at_random_points_equals_uninterrupted(sources, tmp_path):
    """Killed for good: what was done since the last checkpoint is done again, and comes out the same."""
    (tmp_path / "whole").mkdir()
    (tmp_path / "killed").mkdir()
    options = dataclasses.replace(TINY, epochs=6, adversarial_weight=1.0)
    whole = train_until_killed(sources, tmp_path / "whole", options, None)
    fork = multiprocessing.get_context("fork")
    for num_steps in np.random.default_rng(0).integers(2, 8, 5).tolist():
        process = fork.Process(
            target=train_until_killed, args=(sources, tmp_path / "killed", options, num_steps)
        )
        process.start()
        process.join(60)
        assert process.exitcode == -signal.SIGKILL
    rest = train_until_killed(sources, tmp_path / "killed", options, None)
    assert whole.counters["step"] == rest.counters["step"] == 36
    states = [trainer.state() for trainer in (whole, rest)]
    for name in ("generator", "average", "discriminator"):
        assert are_equal(*(state[name] for state in states))
    first = read_torch(tmp_path / "killed/checkpoint.pt", ("generator_optimizer",))["generator_optimizer"]
    assert all(
        torch.equal(first["state"][key]["exp_avg"], value["exp_avg"])
        for key, value in states[0]["generator_optimizer"]["state"].items()
    )


def test_more_epochs_continue_a_finished_training(sources, tmp_path, caplog):
    caplog.set_level("INFO")
    whole = train_model(sources, tmp_path / "a", dataclasses.replace(TINY, epochs=3))
    train_model(sources, tmp_path / "b", dataclasses.replace(TINY, epochs=1))
    assert are_equal(whole, train_model(sources, tmp_path / "b", dataclasses.replace(TINY, epochs=3)))
    assert "continuing from" in caplog.text


def test_checkpoint_of_other_options_is_ignored_with_a_sentence(sources, tmp_path, caplog):
    caplog.set_level("INFO")
    train_model(sources, tmp_path / "a")
    other = dataclasses.replace(TINY, seed=5)
    again = train_model(sources, tmp_path / "a", other)
    assert "is ignored: it was made with other options" in caplog.text
    assert are_equal(again, train_model(sources, tmp_path / "b", other))
    train_model(sources, tmp_path / "a", dataclasses.replace(other, epochs=1))
    assert "is ignored: it is past the 6 steps" in caplog.text


def test_broken_checkpoint_is_named(sources, tmp_path):
    (tmp_path / "checkpoint.pt").write_bytes(b"half a file")
    with pytest.raises(InputError, match=r"checkpoint\.pt.*delete it"):
        train_model(sources, tmp_path)


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_sigterm_saves_and_the_next_run_continues_bit_for_bit(sources, tmp_path):
    options = dataclasses.replace(TINY, epochs=10**5, checkpoint_s=0.0)
    command = [sys.executable, "-m", "fourd.composition", *command_line(sources, tmp_path, options)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while (
        not (tmp_path / "checkpoint.pt").exists() and process.poll() is None and time.monotonic() < deadline
    ):
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, messages = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM, messages
    assert "run again to continue" in messages
    assert not (tmp_path / "model.pt").exists()
    done = read_torch(tmp_path / "checkpoint.pt", ("counters",))["counters"]["step"]
    rest = dataclasses.replace(options, epochs=done // 6 + 2)
    assert are_equal(train_model(sources, tmp_path, rest), train_model(sources, tmp_path / "whole", rest))
