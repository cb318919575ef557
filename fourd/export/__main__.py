"""Command line of stage export: `pictures`, `depth`, `write`, `frames` and `read`."""

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from fourd import cli
from fourd.errors import InputError
from fourd.export import EVENT_FORMATS, FILM_FORMATS, READ_FORMATS, ExportOptions
from fourd.io import atomic_folder, write_json
from fourd.sfm.cameras import read_cameras
from fourd.views import read_view

log = logging.getLogger("fourd.export")


def run_write(
    cameras: Path, pictures: Path, depth: Path, name: str, output: Path, options: ExportOptions
) -> None:
    """Write results/SCENE/export/FORMAT. Raises InputError if the event cannot be stated in the format."""
    from fourd.export.event import Event
    from fourd.export.formats import write_format

    event = Event(read_cameras(cameras), options, pictures, depth)
    with atomic_folder(output) as folder:
        write_format(event, name, folder)
    log.info("%s: %d cameras, %d frames in %s", name, len(event.names), len(event.frames), output)


def run_read(path: Path, name: str, output: Path) -> None:
    """Write another program's cameras as a calibration of ours. Raises InputError."""
    from fourd.export.formats import native_document, read_format

    cameras = read_format(path, name)
    write_json(output, native_document(cameras))
    log.info("%s: %d cameras", output, len(cameras))


def check_options(options: ExportOptions) -> ExportOptions:
    """The options. Raises InputError for a size that is none, or a scale that loses the world."""
    if len(options.size) not in (0, 2) or any(n < 16 for n in options.size):
        raise InputError(
            f"export: size is {list(options.size)}, expected nothing or width and height from 16 px: fix it"
        )
    if not 0 < options.scale < float("inf"):
        raise InputError(f"export: scale is {options.scale}, expected a number above 0: fix it")
    return options


def main(argv: Sequence[str] | None = None) -> None:
    """Parse the command line and run one of the commands."""
    parser = argparse.ArgumentParser(prog="python -m fourd.export", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    pictures = commands.add_parser("pictures", help="a camera's pictures, masks and held film")
    pictures.add_argument("--film", type=Path, required=True, help="frames/cameras/CAM.npz")
    depth = commands.add_parser("depth", help="an input camera's own depths")
    depth.add_argument("--camera", required=True, help="name")
    depth.add_argument("--disparity", type=Path, nargs="*", default=[], help="disparity/PAIR/CHUNK.npz")
    write = commands.add_parser("write", help="one format")
    write.add_argument("--format", choices=EVENT_FORMATS, required=True)
    write.add_argument("--pictures", type=Path, required=True, help="folder of the command pictures")
    write.add_argument("--depth", type=Path, required=True, help="folder of the command depth")
    frames = commands.add_parser("frames", help="a rendered film as frames with depth")
    frames.add_argument("--view-file", type=Path, required=True)
    frames.add_argument("--format", choices=FILM_FORMATS, required=True)
    for flag in ("--frames-dir", "--estimates"):
        frames.add_argument(flag, type=Path, nargs="+", required=True)
    read = commands.add_parser("read", help="another program's cameras as a calibration")
    read.add_argument("--format", choices=READ_FORMATS, required=True)
    read.add_argument("--input", type=Path, required=True, help="file or folder")
    for command in (pictures, depth, write, frames):
        command.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
        cli.add_options(command, ExportOptions)
    for command in (pictures, depth, write, frames, read):
        command.add_argument("--output", type=Path, required=True)
    args = parser.parse_args(argv)
    cli.set_num_threads(1)
    if args.command == "read":
        run_read(args.input, args.format, args.output)
        return
    options = check_options(cli.options_from_args(ExportOptions, args))
    size = (options.size[0], options.size[1]) if options.size else None
    # Each command loads what it needs: an export is many short jobs.
    if args.command == "pictures":
        from fourd.export.pictures import run_pictures

        run_pictures(args.film, read_cameras(args.cameras), size, args.output)
    elif args.command == "depth":
        from fourd.export.depth import run_depth

        run_depth(read_cameras(args.cameras), args.camera, args.disparity, size, args.output)
    elif args.command == "write":
        run_write(args.cameras, args.pictures, args.depth, args.format, args.output, options)
    else:
        from fourd.export.frames import run_frames

        run_frames(
            read_view(args.view_file),
            read_cameras(args.cameras),
            args.frames_dir,
            args.estimates,
            args.format,
            options.scale,
            args.output,
        )


if __name__ == "__main__":
    sys.exit(cli.run_stage(main))
