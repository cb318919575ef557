"""Flags made from options classes, and what a user sees when something fails."""

import argparse
import dataclasses
import errno
import os
import shlex
import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd import cli
from fourd.errors import InputError
from tests.conftest import REPOSITORY


@dataclasses.dataclass(frozen=True)
class Options:
    """One field of every kind that options may have."""

    count: int = 3
    limit_px: float = 1.5
    mode: str = "fast"
    check: bool = True
    device: str | None = None
    sizes: tuple[int, ...] = (1, 2)


def parse(words: str) -> Options:
    parser = argparse.ArgumentParser()
    cli.add_options(parser, Options)
    return cli.options_from_args(Options, parser.parse_args(shlex.split(words)))


def test_no_flags_give_the_defaults() -> None:
    assert parse("") == Options()


# A busy machine's pauses are no failure.
@settings(deadline=None)
@given(
    st.builds(
        Options,
        count=st.integers(),
        limit_px=st.floats(allow_nan=False, allow_infinity=False),
        mode=st.text("abc ;$'\"\\", min_size=1).filter(lambda t: not t.startswith("-")),
        check=st.booleans(),
        device=st.none() | st.sampled_from(["cpu", "cuda:1"]),
        sizes=st.lists(st.integers(0, 9), max_size=3).map(tuple),
    )
)
def test_flags_round_trip(options: Options) -> None:
    assert parse(cli.flags_from_mapping(dataclasses.asdict(options))) == options


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (InputError("expected two cameras, got one"), 2, "expected two cameras"),
        (OSError(errno.ENOSPC, "No space left on device", "out.npz"), 3, "disk is full: out.npz"),
        (OSError(errno.EROFS, "Read-only file system", "out.npz"), 3, "no permission to use out.npz"),
        (FileNotFoundError(errno.ENOENT, "No such file", "in.npz"), 3, "in.npz does not exist"),
    ],
)
def test_expected_failures_are_one_sentence(
    error: Exception, status: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def main(argv: object) -> None:
        raise error

    assert cli.run_stage(main) == status
    printed = capsys.readouterr().err
    assert words in printed
    assert len(printed.strip().splitlines()) == 1


def test_programming_errors_are_not_swallowed() -> None:
    def main(argv: object) -> None:
        raise KeyError("bug")

    with pytest.raises(KeyError):
        cli.run_stage(main)


@pytest.mark.parametrize(("asked", "expected"), [({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "active"}, "ACTIVE")])
def test_threads_of_torch_wait_without_spinning_unless_told(asked: dict[str, str], expected: str) -> None:
    """As the loaded OpenMP itself says it."""
    environment = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    result = subprocess.run(
        [sys.executable, "-c", "import fourd.composition.model"],
        cwd=REPOSITORY,
        env={**environment, **asked, "OMP_DISPLAY_ENV": "true"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"OMP_WAIT_POLICY = '{expected}'" in result.stderr
