"""Command line of the stability suite: every extreme case, what was expected, what happened."""

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fourd.cli import run_stage, set_num_threads
from fourd.errors import InputError
from fourd.io import write_csv, write_json
from fourd.stability import all_cases
from fourd.stability.case import BAD, REFUSED, RIGHT, Case, Result, run_case

COLUMNS = (
    "group", "case", "expected", "got", "float32_error", "condition_number", "verdict", "seconds"
)  # fmt: skip
_WIDTHS = {"case": 46, "expected": 52, "got": 72}


def choose_cases(cases: Sequence[Case], words: Sequence[str]) -> list[Case]:
    """Those with all of the words in group or name. Raises InputError if there are none."""
    chosen = [case for case in cases if all(word in f"{case.group} {case.name}" for word in words)]
    if not chosen:
        raise InputError(
            f"--only: expected words of a case, got {' '.join(words)}, which none of {len(cases)} has: leave "
            "it out to see all"
        )
    return chosen


def row_of(result: Result) -> dict[str, Any]:
    """One row of stability.csv; what does not apply is empty."""
    outcome = result.outcome
    return {
        "group": result.case.group,
        "case": result.case.name,
        "expected": result.case.expected,
        "got": outcome.got,
        "float32_error": "" if outcome.float32_error is None else f"{outcome.float32_error:.2g}",
        "condition_number": "" if outcome.condition_number is None else f"{outcome.condition_number:.2g}",
        "verdict": outcome.verdict,
        "seconds": f"{result.seconds:.2f}",
    }


def format_row(row: dict[str, Any]) -> str:
    """One aligned line of the printed table; long texts are cut, the files have them whole."""
    cells = {key: _cut(str(row[key]), width) for key, width in _WIDTHS.items()}
    return (
        f"{row['group']:<10} {cells['case']:<46} {cells['expected']:<52} {cells['got']:<72} "
        f"{row['float32_error']:>8} {row['condition_number']:>9} {row['verdict']}"
    )


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else text[: width - 3] + "..."


def run(only: Sequence[str], output: Path | None) -> None:
    """Run the cases, print the table and write it. Raises InputError if no case has the words."""
    cases = choose_cases(all_cases(), only)
    heading = dict.fromkeys(COLUMNS, "")
    print(format_row(heading | {key: key for key in ("group", "case", "expected", "got", "verdict")}
                     | {"float32_error": "float32", "condition_number": "condition"}))  # fmt: skip
    rows = []
    for case in cases:
        rows.append(row_of(run_case(case)))
        print(format_row(rows[-1]), flush=True)
    counts = {verdict: sum(row["verdict"] == verdict for row in rows) for verdict in (RIGHT, REFUSED, BAD)}
    seconds = sum(float(row["seconds"]) for row in rows)
    print(", ".join(f"{count} {verdict}" for verdict, count in counts.items()) + f", {seconds:.0f} s")
    if output is not None:
        write_csv(output / "stability.csv", COLUMNS, rows)
        write_json(output / "stability.json", {"counts": counts, "cases": rows})
    bad = [f"{row['group']}: {row['case']}" for row in rows if row["verdict"] == BAD]
    if bad:
        raise SystemExit(f"error: {len(bad)} of {len(rows)} cases are bad: {'; '.join(bad)}")


def main(argv: Sequence[str] | None = None) -> None:
    """Run the suite. Exits with status 1 and a sentence if a case is bad."""
    parser = argparse.ArgumentParser(prog="python -m fourd.stability", description=__doc__)
    parser.add_argument("--output", type=Path, help="folder for stability.csv and stability.json")
    parser.add_argument("--only", nargs="+", default=[], metavar="WORD", help="cases that have all the words")
    args = parser.parse_args(argv)
    set_num_threads(1)
    # Stages report their progress; here only the table counts.
    logger = logging.getLogger("fourd")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        run(args.only, args.output)
    finally:
        logger.setLevel(level)


if __name__ == "__main__":
    sys.exit(run_stage(main))
