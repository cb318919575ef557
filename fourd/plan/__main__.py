"""Command line of the stage `plan`; see the package."""

import argparse
import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fourd.cli import add_options, options_from_args, run_stage
from fourd.errors import InputError
from fourd.io import read_json, write_json
from fourd.plan.cost import forecast, read_finished
from fourd.plan.files import (
    read_machine_file,
    read_motion,
    read_pair_facts,
    read_survey,
    survey_to_dict,
)
from fourd.plan.options import PlanOptions
from fourd.plan.outline import list_jobs, list_viewer
from fourd.plan.show import check_document, describe, make_document
from fourd.plan.work import OK, Survey, choose_work

log = logging.getLogger(__name__)


def run_survey(
    cameras_path: Path,
    rectifications: Sequence[Path],
    need_path: Path,
    maps: Sequence[Path],
    silhouettes_use: str,
    output: Path,
) -> None:
    """Write plan/survey.json. Raises InputError for files that are not what they should be."""
    pairs = read_pair_facts(rectifications)
    cameras = read_json(cameras_path)
    tracks = [cameras["cameras"][name]["frames"] for name in cameras["inputs"]]
    silhouettes = str(read_json(need_path)["status"])
    if silhouettes == OK and silhouettes_use == "auto" and all(len(frames) > 1 for frames in tracks):
        silhouettes = "no background to tell them from: every camera moves"
    survey = Survey(pairs, silhouettes, read_motion(maps, cameras["inputs"]))
    usable = sum(facts.status == OK for facts in pairs.values())
    log.info("%d of %d pairs can be matched; silhouettes: %s", usable, len(pairs), survey.silhouettes)
    write_json(output, survey_to_dict(survey))


def run_probe(output: Path) -> None:
    """Write machine/speed.json."""
    # Torch and OpenCV take seconds to import.
    from fourd.plan.machine import probe_machine

    document = probe_machine()
    log.info("slowness against the reference machine: %s", document["slowness"])
    write_json(output, document)


def run_show(
    outline: dict[str, Any],
    lattice: dict[str, Any] | None,
    budget: dict[str, Any] | None,
    options: PlanOptions,
    survey_path: Path,
    cameras_path: Path,
    machine_path: Path,
    benchmarks: Path,
    output: Path,
) -> None:
    """Write plan/plan.json and print it in words. Raises InputError for inputs that do not fit together."""
    survey = read_survey(survey_path)
    work = choose_work(survey, outline["pairs"], options)
    jobs = list_jobs(outline, survey, work)
    machine, finished = read_machine_file(machine_path), read_finished(benchmarks)
    costs = forecast(jobs, outline["size"], machine, finished)
    viewer = None
    if lattice is not None:
        own = forecast(list_viewer(outline, lattice, work), lattice["size"], machine, finished)
        viewer = {"size_mb": lattice["size_mb"], "forecast": own}
    results = cameras_path.parent.parent
    disk_now = sum(path.stat().st_size for path in results.rglob("*") if path.is_file())
    earlier = read_json(output) if output.is_file() else None
    left_out = read_json(cameras_path)["left_out"]
    document = make_document(outline, survey, work, left_out, budget, costs, viewer, disk_now, earlier)
    check_document(document)
    write_json(output, document)
    print(describe(document))


def parse_json(text: str) -> Any:
    """A flag that is JSON. Raises InputError for text that is none."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"expected JSON in a flag, got text that is none ({error}): quote it") from None


def main(argv: Sequence[str] | None = None) -> None:
    """Parse the command line and run one of the commands."""
    parser = argparse.ArgumentParser(prog="python -m fourd.plan", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    survey = commands.add_parser("survey", help="what is known once the cameras are")
    survey.add_argument("--rectification", type=Path, nargs="+", required=True, help="files of all pairs")
    survey.add_argument("--need", type=Path, required=True, help="silhouettes/need.json")
    survey.add_argument("--silhouettes-use", default="auto", help="setting `use` of silhouettes")
    survey.add_argument("--maps", type=Path, nargs="*", default=[], help="align/maps/{cam}.npz")
    probe = commands.add_parser("probe", help="how fast this machine is")
    show = commands.add_parser("show", help="decisions and forecast")
    show.add_argument("--outline", required=True, help="the scene's jobs as JSON")
    show.add_argument("--lattice", default="null", help="views and moments of the viewer, as JSON")
    show.add_argument("--budget", default="null", help="what a budget left, as JSON")
    show.add_argument("--survey", type=Path, required=True, help="plan/survey.json")
    show.add_argument("--machine", type=Path, required=True, help="machine/speed.json")
    show.add_argument("--benchmarks", type=Path, required=True, help="benchmark files of the scene")
    add_options(show, PlanOptions)
    for command in (survey, show):
        command.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
    for command in (survey, probe, show):
        command.add_argument("--output", type=Path, required=True)
    args = parser.parse_args(argv)
    if args.command == "survey":
        run_survey(args.cameras, args.rectification, args.need, args.maps, args.silhouettes_use, args.output)
    elif args.command == "probe":
        run_probe(args.output)
    else:
        run_show(
            parse_json(args.outline),
            parse_json(args.lattice),
            parse_json(args.budget),
            options_from_args(PlanOptions, args),
            args.survey,
            args.cameras,
            args.machine,
            args.benchmarks,
            args.output,
        )


if __name__ == "__main__":
    sys.exit(run_stage(main))
