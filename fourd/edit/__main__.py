"""Edit a finished event: `python -m fourd.edit COMMAND --named arguments`.

Commands: `mark` (write an edit file with one mark), `depths` (depth of every camera's pictures), `masks`
(carry the marks of an edit to all cameras and frames), `view` (edit the frames of one view).
"""

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

import yaml

from fourd.cli import add_options, options_from_args, run_stage, set_num_threads
from fourd.edit.options import EditOptions
from fourd.edit.spec import parse_edit, read_edit
from fourd.errors import InputError
from fourd.fuse.options import FuseOptions
from fourd.io import write_png, write_text
from fourd.render import RenderOptions

log = logging.getLogger(__name__)


def write_mark(args: argparse.Namespace) -> None:
    """Write an edit file, and the picture that the mark is drawn on if asked for.

    A file that says the same is left alone, comments included. Raises InputError, for a file that says
    something else as well.
    """
    if args.picture is not None:
        from fourd.ingest import open_camera

        if args.film is None:
            raise InputError(
                "mark: --picture is taken from a film, got none: give --film frames/cameras/CAMERA.npz"
            )
        reader = open_camera(args.film)
        write_png(args.picture, reader.read(args.frame))
        reader.close()
    shapes = {"box": args.box, "polygon": args.polygon, "scribble": args.scribble, "mask": args.mask}
    given = {name: value for name, value in shapes.items() if value is not None}
    if args.output is None and not given:
        return
    if args.output is None or len(given) != 1 or not args.views:
        raise InputError(
            "mark: expected --output, --views and one of --box, --polygon, --scribble, --mask, got "
            f"{', '.join(given) or 'no shape'}: say what is marked, in which films, and where to write it"
        )
    (shape, value), *_ = given.items()
    if shape in ("polygon", "scribble"):
        if len(value) % 2:
            raise InputError(f"mark: expected pairs x y in --{shape}, got {len(value)} numbers: add one")
        value = [[x, y] for x, y in zip(value[::2], value[1::2], strict=True)]
    document = {
        "scene": args.scene,
        "operation": args.operation,
        "views": args.views,
        "marks": [{"view": args.view, "frame": args.frame, shape: value}],
    }
    if args.order != 1:
        document["order"] = args.order
    if args.shift_frames:
        document["insert"] = {"shift_frames": args.shift_frames}
    edit = parse_edit(document, args.output)
    if args.output.exists():
        if read_edit(args.output) != edit:
            raise InputError(
                f"mark: expected a new file at {args.output}, got one that says something else: give another "
                "name, or remove the file"
            )
        log.info("%s says so already", args.output)
        return
    write_text(args.output, yaml.safe_dump(document, sort_keys=False, default_flow_style=None))


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m fourd.edit", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    mark = commands.add_parser("mark", help="write an edit file with one mark")
    mark.add_argument("view", help="camera or trajectory whose picture is marked")
    mark.add_argument("frame", type=int, help="frame of the scene (of the film, for a trajectory)")
    mark.add_argument("--box", type=float, nargs=4, metavar=("LEFT", "TOP", "RIGHT", "BOTTOM"))
    mark.add_argument("--polygon", type=float, nargs="+", metavar="X Y")
    mark.add_argument("--scribble", type=float, nargs="+", metavar="X Y")
    mark.add_argument("--mask", help="PNG of the picture's size, not 0 where the thing is")
    mark.add_argument("--scene", default="demo")
    mark.add_argument("--operation", default="remove")
    mark.add_argument("--order", type=int, default=1)
    mark.add_argument("--shift-frames", type=int, default=0)
    mark.add_argument("--views", nargs="+", help="cameras and trajectories to edit")
    mark.add_argument("--output", type=Path, help="config/edits/NAME.yaml")
    mark.add_argument("--picture", type=Path, help="also write the picture to draw on, a PNG")
    mark.add_argument("--film", type=Path, help="frames/cameras/CAMERA.npz, for --picture")
    depths, masks, view = (
        commands.add_parser(name, help=text)
        for name, text in (
            ("depths", "depth of every camera's pictures"),
            ("masks", "carry the marks of an edit to all cameras and frames"),
            ("view", "edit the frames of one view"),
        )
    )
    for command in (depths, masks, view):
        command.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
        command.add_argument("--films", nargs="+", required=True, help="frames/cameras/{cam}.npz")
        command.add_argument("--output", type=Path, required=True)
    for command in (depths, view):
        command.add_argument("--frames", type=int, nargs="+", required=True)
        command.add_argument("--disparity", type=Path, nargs="*", default=[], help="files of all pairs")
        add_options(command, FuseOptions)
    for command in (masks, view):
        command.add_argument("--edit", type=Path, required=True, help="config/edits/{edit}.yaml")
        command.add_argument("--depths", type=Path, nargs="+", required=True, help="of the whole clip")
        command.add_argument("--mark-views", type=Path, nargs="*", default=[], help="views of the marks")
        add_options(command, EditOptions)
    view.add_argument("--masks", type=Path, required=True)
    view.add_argument("--view-file", type=Path, required=True)
    view.add_argument("--background", type=Path, required=True)
    view.add_argument("--models", type=Path, nargs="+", required=True)
    view.add_argument("--rendered", type=Path, nargs="*", default=[], help="frames of a trajectory")
    view.add_argument("--film", type=Path, help="film of a physical camera")
    add_options(view, RenderOptions)
    return parser


def main(argv: Sequence[str] | None = None) -> None:
    """Run one command. Raises InputError for unusable input."""
    args = _make_parser().parse_args(argv)
    if args.command == "mark":
        write_mark(args)
        return
    set_num_threads(1)
    if args.command == "depths":
        from fourd.edit import depths

        options = options_from_args(FuseOptions, args)
        depths.run(args.cameras, args.frames, args.disparity, args.films, options, args.output)
        return
    try:
        run_edit(args)
    except InputError as error:
        # Of many edits in one run, a person has to know whose mark or view it is.
        where = "" if str(args.edit) in str(error) else f"{args.edit}: "
        raise InputError(f"{where}{error}") from None


def run_edit(args: argparse.Namespace) -> None:
    """Run `masks` or `view`. Raises InputError."""
    edit, options = read_edit(args.edit), options_from_args(EditOptions, args)
    if args.command == "masks":
        from fourd.edit import masks

        masks.run(edit, args.cameras, args.films, args.depths, args.mark_views, options, args.output)
        return
    from fourd.edit import films

    files = films.Files(
        args.masks, args.view_file, args.cameras, args.films, args.depths, args.disparity, args.background,
        args.models, args.rendered, args.film, args.mark_views,
    )  # fmt: skip
    fuse, render = options_from_args(FuseOptions, args), options_from_args(RenderOptions, args)
    films.run(edit, files, args.frames, options, fuse, render, args.output)


if __name__ == "__main__":
    sys.exit(run_stage(main))
