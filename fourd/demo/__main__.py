"""Make the demo event: `python -m fourd.demo COMMAND --named arguments`.

Commands: `camera` (synchronised frames of one camera), `cameras` (their calibration), `phones` (the
file one phone recorded), `labels` (what moves, as one camera sees it), `depths` (how far it is), `truth`
(clocks, depth, labels, orbit, parameters).
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from fourd.cli import add_options, options_from_args, run_stage, set_num_threads
from fourd.demo import DemoOptions, label_numbers
from fourd.demo.options import camera_index, check_options
from fourd.demo.phones import write_phone_file
from fourd.demo.truth import (
    PARTS,
    write_camera_depths,
    write_camera_frames,
    write_camera_labels,
    write_cameras,
    write_truth,
)


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m fourd.demo", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for command, text in (
        ("camera", "render the synchronised frames of one camera to a folder"),
        ("cameras", "write the calibration of all cameras"),
        ("phones", "write the video file of one phone"),
        ("labels", "write which pixels of one camera move to a folder"),
        ("depths", "write the true depth of one camera to a folder"),
        ("truth", "write clocks, depth, labels, orbit and parameters to a folder"),
    ):
        sub = commands.add_parser(command, help=text)
        sub.add_argument("--output", type=Path, required=True)
        if command in ("camera", "phones", "labels", "depths"):
            sub.add_argument("--name", required=True, help="cam00, cam01, ...")
        if command != "cameras":
            sub.add_argument("--without", nargs="*", default=[], help="figure1, figure2, ball")
        if command in ("labels", "depths"):
            sub.add_argument("--of-phone", action="store_true", help="of the phone's film, on its own clock")
        if command == "truth":
            sub.add_argument("--only", nargs="*", default=list(PARTS), help=f"(default: {' '.join(PARTS)})")
            sub.add_argument("--frames", type=int, nargs="*", help="frames with depth, labels (default: all)")
        add_options(sub, DemoOptions)
    return parser


def main(argv: Sequence[str] | None = None) -> None:
    """Run one command. Raises InputError for unusable options."""
    args = _make_parser().parse_args(argv)
    set_num_threads(1)
    options = options_from_args(DemoOptions, args)
    check_options(options)
    if args.command == "cameras":
        write_cameras(args.output, options)
        return
    without = label_numbers(args.without)
    if args.command == "truth":
        write_truth(args.output, options, args.only, args.frames, without)
        return
    camera_index(args.name, options)
    if args.command == "camera":
        write_camera_frames(args.output, args.name, options, without)
    elif args.command == "labels":
        write_camera_labels(args.output, args.name, options, without, args.of_phone)
    elif args.command == "depths":
        write_camera_depths(args.output, args.name, options, without, args.of_phone)
    else:
        write_phone_file(args.output, args.name, options, without)


if __name__ == "__main__":
    sys.exit(run_stage(main))
