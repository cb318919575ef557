"""`python -m fourd.report --results DIR --benchmarks DIR --output DIR`."""

import argparse
import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fourd import cli
from fourd.errors import InputError
from fourd.io import write_csv, write_json, write_text
from fourd.report import ReportOptions
from fourd.report.document import Sources, check_document, collect_document
from fourd.report.page import draw_page, edit_shows, film_players, read_evidence, read_validation
from fourd.report.pictures import collect_pictures

logger = logging.getLogger(__name__)


def run(sources: Sources, output: Path, options: ReportOptions) -> None:
    """Write index.html, report.json and the data of its tables as CSV. Raises InputError."""
    document, scores = collect_document(sources)
    check_document(document)
    results, current, width = sources.results, sources.current, options.picture_px
    shows = collect_pictures(results, current, scores, options)
    films = film_players(results, current, output, width)
    edits = edit_shows(results, current, output, width)
    evidence, validation = read_evidence(results), read_validation(results, current)
    page = draw_page(document, scores, shows, evidence, films, edits, validation, width)
    write_json(output / "report.json", document)
    for name, rows in (
        ("scores", document["scores"]["rows"]),
        ("costs", document["costs"]["stages"]),
        ("error_time", document["error_time"]["points"]),
    ):
        write_csv(output / f"{name}.csv", list(rows[0]) if rows else ["none"], rows)
    write_text(output / "index.html", page)
    logger.info("report of %s: %.1f MB at %s", sources.results.name, len(page) / 1e6, output / "index.html")


def parse_settings(text: str | None) -> dict[str, Any] | None:
    """The configuration from JSON. Raises InputError for text that is no JSON object."""
    if text is None:
        return None
    try:
        settings = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(
            f"--settings: expected a JSON object, got text that is none ({error}): quote it"
        ) from None
    if not isinstance(settings, dict):
        raise InputError(
            f"--settings: expected a JSON object, got a {type(settings).__name__}: put keys around it"
        )
    return settings


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of the stage."""
    parser = argparse.ArgumentParser(prog="python -m fourd.report", description="one page about one scene")
    parser.add_argument("--results", type=Path, required=True, help="folder of one scene's results")
    parser.add_argument(
        "--benchmarks", type=Path, required=True, help="folder of the same scene's benchmarks"
    )
    parser.add_argument("--stability", type=Path, help="stability.csv, if the suite has been run")
    parser.add_argument("--benches", type=Path, help="folder of sweeps, if any have been run")
    parser.add_argument("--settings", help="the configuration as JSON, to be shown")
    parser.add_argument("--num-levels", type=int, help="levels of the composition that the scene has")
    parser.add_argument("--edits", nargs="*", help="edits that the scene has")
    parser.add_argument("--output", type=Path, required=True, help="folder of the page")
    cli.add_options(parser, ReportOptions)
    args = parser.parse_args(argv)
    cli.set_num_threads(1)
    settings = parse_settings(args.settings)
    options = cli.options_from_args(ReportOptions, args)
    truth = Path(options.truth) if options.truth else None
    files = (args.results, args.benchmarks, args.stability, args.benches)
    sources = Sources(*files, settings, truth, args.num_levels, args.edits)
    run(sources, args.output, options)


if __name__ == "__main__":
    sys.exit(cli.run_stage(main))
