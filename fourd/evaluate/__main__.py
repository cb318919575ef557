"""`python -m fourd.evaluate COMMAND`: `camera`, `people` and `collect`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from fourd import cli
from fourd.evaluate import EvaluateOptions
from fourd.evaluate.camera import Sources, run_camera
from fourd.evaluate.people import run_people
from fourd.evaluate.table import run_collect


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of the stage."""
    parser = argparse.ArgumentParser(prog="python -m fourd.evaluate")
    commands = parser.add_subparsers(dest="command", required=True)
    camera = commands.add_parser("camera", help="score one held-out camera")
    camera.add_argument("--view-file", type=Path, required=True)
    camera.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
    camera.add_argument("--films", type=cli.named_path, nargs="+", required=True, metavar="CAM=FILE")
    camera.add_argument("--rendered", type=Path, nargs="+", required=True, help="folders of the stage render")
    camera.add_argument("--foreground", type=Path, nargs="+", required=True)
    camera.add_argument("--background", type=Path, nargs="+", required=True)
    camera.add_argument("--labels", type=Path, help="folder of this camera's true masks")
    camera.add_argument("--points", type=Path, help="sfm/points.npz")
    camera.add_argument("--people", type=Path, help="what the command people wrote")
    camera.add_argument(
        "--recovered", action="store_true", help="cameras were found from the films: depth has no unit"
    )
    cli.add_options(camera, EvaluateOptions)
    collect = commands.add_parser("collect", help="join the scores of all held-out cameras")
    collect.add_argument("--inputs", type=Path, nargs="+", required=True)
    collect.add_argument("--sheets", type=Path, nargs="+", required=True)
    collect.add_argument("--output-summary", type=Path, required=True)
    collect.add_argument("--output-table", type=Path, required=True)
    people = commands.add_parser("people", help="fit the people in the inputs, for all held-out cameras")
    people.add_argument("--view-files", type=Path, nargs="+", required=True, help="of held-out cameras")
    people.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
    people.add_argument("--films", type=cli.named_path, nargs="+", required=True, metavar="CAM=FILE")
    people.add_argument("--humans", default="", help="folder of the models")
    people.add_argument("--output", type=Path, required=True)
    for command in (camera, collect):
        command.add_argument("--output", type=Path, required=True)
        command.add_argument("--output-sheet", type=Path, required=True)
    args = parser.parse_args(argv)
    if args.command == "collect":
        outputs = (args.output, args.output_summary, args.output_table, args.output_sheet)
        print(run_collect(args.inputs, args.sheets, *outputs))
        return
    cli.set_num_threads(1)
    if args.command == "people":
        run_people(args.view_files, args.cameras, dict(args.films), args.humans, args.output)
        return
    sources = Sources(
        args.view_file,
        args.cameras,
        dict(args.films),
        tuple(args.rendered),
        tuple(args.foreground),
        tuple(args.background),
        args.labels,
        args.points,
        args.people,
        args.recovered,
    )
    run_camera(sources, args.output, args.output_sheet, cli.options_from_args(EvaluateOptions, args))


if __name__ == "__main__":
    sys.exit(cli.run_stage(main))
