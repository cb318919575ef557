"""What a case of the suite is, and how it is judged.

A case is a function without arguments. Its name is the name of the case, its docstring what is
expected, and it returns an `Outcome`: either the right answer or a refusal that names the cause.
"""

import dataclasses
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from fourd.errors import InputError

RIGHT, REFUSED, BAD = "right", "refused", "bad"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What happened in a case.

    got: a few words or numbers;  verdict: `right`, `refused` (with the cause in `got`) or `bad`
    float32_error: largest relative difference between float32 and float64, None where only one is used
    condition_number: of the system solved, 2-norm, None without one
    """

    got: str
    verdict: str
    float32_error: float | None = None
    condition_number: float | None = None


@dataclasses.dataclass(frozen=True)
class Case:
    """One line of the table. group: file of the case;  expected: first sentence of its docstring."""

    group: str
    name: str
    expected: str
    run: Callable[[], Outcome]


@dataclasses.dataclass(frozen=True)
class Result:
    """A case after it was run."""

    case: Case
    outcome: Outcome
    seconds: float


def make_cases(group: str, *functions: Callable[[], Outcome]) -> tuple[Case, ...]:
    """The cases of one file, in the order of the table."""
    cases = []
    for function in functions:
        expected = " ".join((function.__doc__ or "").split()).rstrip(".")
        cases.append(Case(group, function.__name__.replace("_", " "), expected, function))
    return tuple(cases)


def run_case(case: Case) -> Result:
    """Run one case. One that stops with an error is `bad`, and the others still run."""
    begin = time.perf_counter()
    with warnings.catch_warnings():
        # What a warning warns of shows in the outcome; the table is the place to read it.
        warnings.simplefilter("ignore")
        try:
            outcome = case.run()
        # Whatever stops a case is what the suite is to find: it becomes the case's row, never silence.
        except Exception as error:
            outcome = Outcome(f"{type(error).__name__}: {error}", BAD)
    return Result(case, outcome, time.perf_counter() - begin)


def judge(
    is_right: bool,
    got: str,
    float32_error: float | None = None,
    condition_number: float | None = None,
) -> Outcome:
    """The outcome of a case that has an answer."""
    return Outcome(got, RIGHT if is_right else BAD, float32_error, condition_number)


def judge_refusal(reason: str | None, *causes: str) -> Outcome:
    """The outcome of a case that has to be refused.

    reason: what was said, None if it was not refused;  causes: words one of which names the cause
    """
    if reason is None:
        return Outcome("no refusal", BAD)
    is_named = not causes or any(cause in reason for cause in causes)
    return Outcome(reason, REFUSED if is_named else BAD)


def reason_of(function: Callable[..., Any], *arguments: Any, **named: Any) -> str | None:
    """The sentence with which a call refuses its arguments, None if it does not."""
    try:
        function(*arguments, **named)
    except (InputError, ValueError) as error:
        return str(error)
    return None


def relative_difference(a: np.ndarray, b: np.ndarray) -> float:
    """Largest |a - b| in units of the largest |b|; infinite if one is not finite, or b is 0 and a is not."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return float("inf")
    difference, size = float(np.abs(a - b).max(initial=0)), float(np.abs(b).max(initial=0))
    return difference / size if size > 0 else float(np.where(difference > 0, np.inf, 0))


def elementwise_difference(a: np.ndarray, b: np.ndarray) -> float:
    """Largest |a - b| / |b| of the elements where both are finite; infinite where only one is."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    both = np.isfinite(a) & np.isfinite(b)
    if not np.array_equal(np.isfinite(a), np.isfinite(b)):
        return float("inf")
    return float((np.abs(a - b)[both] / np.maximum(np.abs(b)[both], 1e-300)).max(initial=0))
