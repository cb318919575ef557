"""Command-line plumbing shared by all stages: flags from dataclasses, logging, exit codes."""

import argparse
import dataclasses
import errno
import logging
import os
import shlex
import sys
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from fourd.errors import InputError

OptionsT = TypeVar("OptionsT")


def _parse_bool(text: str) -> bool:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    raise argparse.ArgumentTypeError(f"expected true or false, got {text!r}")


def _parse_optional(parse: Callable[[str], Any]) -> Callable[[str], Any]:
    """A parser that also accepts the word `none`."""
    return lambda text: None if text.lower() == "none" else parse(text)


def _flag_arguments(annotation: Any) -> dict[str, Any]:
    """argparse arguments for one annotated dataclass field."""
    origin = typing.get_origin(annotation)
    if origin is tuple:
        item = typing.get_args(annotation)[0]
        return {"type": item, "nargs": "*"}
    if origin in (typing.Union, types.UnionType):
        item = next(a for a in typing.get_args(annotation) if a is not type(None))
        return {"type": _parse_optional(_flag_arguments(item)["type"])}
    return {"type": _parse_bool if annotation is bool else annotation}


def add_options(parser: argparse.ArgumentParser, options_class: type) -> None:
    """Add one `--snake-as-kebab` flag per field of a dataclass, with the dataclass' default."""
    hints = typing.get_type_hints(options_class)
    for field in dataclasses.fields(options_class):
        parser.add_argument(
            "--" + field.name.replace("_", "-"),
            default=field.default,
            help=f"(default: {field.default})",
            **_flag_arguments(hints[field.name]),
        )


def options_from_args(options_class: type[OptionsT], args: argparse.Namespace) -> OptionsT:
    """The dataclass back from parsed arguments; lists become tuples."""
    values = {}
    for field in dataclasses.fields(options_class):  # type: ignore[arg-type]
        value = getattr(args, field.name)
        values[field.name] = tuple(value) if isinstance(value, list) else value
    return options_class(**values)


def flags_from_mapping(section: Mapping[str, Any]) -> str:
    """A config section as a shell-quoted string of flags, the inverse of `add_options`.

    Nested mappings are left out: they belong to another rule.
    """
    words: list[str] = []
    for key, value in section.items():
        if isinstance(value, Mapping):
            continue
        flag = "--" + key.replace("_", "-")
        if isinstance(value, list | tuple):
            words += [flag, *map(str, value)]
        else:
            # One word, so that argparse does not take a value such as -1e-5 for a flag.
            word = "none" if value is None else str(value)
            words.append(f"{flag}={word.lower() if isinstance(value, bool) else word}")
    return shlex.join(words)


def named_path(word: str) -> tuple[str, Path]:
    """`NAME=PATH`, or a path whose stem is the name: how a flag maps cameras to files."""
    name, separator, path = word.partition("=")
    return (name, Path(path)) if separator and "/" not in name else (Path(word).stem, Path(word))


def set_num_threads(num_threads: int) -> None:
    """Bound the threads of OpenCV and torch, if loaded, and of what is loaded later.

    Two jobs that each start a thread per core fight for the cores; the rule says how many.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, str(num_threads))
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(num_threads)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(num_threads)


def choose_torch_device(name: str) -> str:
    """`auto` is the first CUDA device that works, else the CPU. Raises InputError for one that does not."""
    # Torch takes seconds to import, and most stages do without it.
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError(
            f"--device: expected a device of this machine, got {name}, but CUDA finds none: use cpu"
        )
    return name


def run_stage(main: Callable[[Sequence[str] | None], None], argv: Sequence[str] | None = None) -> int:
    """Run a stage's `main`; turn expected failures into one sentence and an exit status.

    Returns 0, 2 for unusable input, 3 when a file could not be written or read, 4 without memory.
    """
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    try:
        main(argv)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {_explain_os_error(error)}", file=sys.stderr)
        return 3
    except Exception as error:
        # What lacks memory has a different type in every library; anything else is a programming error.
        if not _lacks_memory(error):
            raise
        print(
            "error: not enough memory for this job: run fewer jobs at a time (--cores) or on a computer with "
            "more memory; finished files are whole and kept",
            file=sys.stderr,
        )
        return 4
    return 0


def _lacks_memory(error: Exception) -> bool:
    words = ("not enough memory", "out of memory", "insufficient memory", "can't allocate memory")
    return isinstance(error, MemoryError) or any(word in str(error).lower() for word in words)


def _explain_os_error(error: OSError) -> str:
    where = error.filename or "a file of this job"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return (
            f"the disk is full: {where} could not be written. Finished files are whole and kept; "
            "free some space and run the same command again"
        )
    if error.errno == errno.ENOMEM:
        return f"not enough memory to use {where}: run fewer jobs at a time (--cores)"
    if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
        return f"no permission to use {where}: give write access or choose another results folder"
    if error.errno == errno.ENOENT:
        return f"{where} does not exist: check the path in the scene file, or run again to remake it"
    return f"{where}: {error.strerror or error}"
