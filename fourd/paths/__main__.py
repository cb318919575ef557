"""Camera paths as files: `convert` between formats, `describe` where a film lies among the cameras."""

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from fourd.cli import run_stage
from fourd.errors import InputError
from fourd.io import write_json
from fourd.paths.files import FORMATS, film_of_view, moved_film, read_dataparser, read_film, write_film
from fourd.paths.hull import describe_path
from fourd.sfm.cameras import read_cameras
from fourd.views import read_view

log = logging.getLogger("fourd.paths")


def run_convert(
    source: Path,
    source_format: str,
    output: Path,
    output_format: str,
    cameras: Path,
    size: Sequence[int] | None,
    dataparser: Path | None,
) -> None:
    """Write a path or a placed view in another format. Raises InputError.

    dataparser: of a model whose coordinates a nerfstudio path is in
    """
    scene = read_cameras(cameras)
    if source_format == "view":
        film = film_of_view(read_view(source), scene)
    else:
        own = scene.tracks[scene.inputs[0]].size
        film = read_film(source, source_format, scene, own if size is None else (size[0], size[1]))
    if dataparser is not None:
        if (source_format == "nerfstudio") == (output_format == "nerfstudio"):
            raise InputError("--dataparser: expected one of --from and --to to be nerfstudio: leave it out")
        film = moved_film(film, read_dataparser(dataparser), to_model=output_format == "nerfstudio")
    write_film(output, output_format, film)
    log.info("%d frames written to %s", len(film.cameras), output)


def run_describe(view: Path, cameras: Path, output: Path) -> None:
    """Write render/{trajectory}.json (docs/paths.md). Raises InputError."""
    document = describe_path(read_view(view), read_cameras(cameras))
    write_json(output, document)
    if document["num_outside"]:
        log.warning(
            "%s: %d of %d frames are filmed from where no camera is near",
            document["view"], document["num_outside"], len(document["frames"]),
        )  # fmt: skip


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of camera paths."""
    parser = argparse.ArgumentParser(prog="python -m fourd.paths", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    convert = commands.add_parser("convert", help="a path in another format, in the calibration's world")
    convert.add_argument("--input", type=Path, required=True, help="path file, folder or views/NAME.json")
    convert.add_argument("--from", dest="source_format", choices=("view", *FORMATS), required=True)
    convert.add_argument("--to", dest="output_format", choices=FORMATS, required=True)
    convert.add_argument("--size", type=int, nargs=2, help="width and height, px, where the input has none")
    convert.add_argument("--dataparser", type=Path, help="dataparser_transforms.json of a trained model")
    describe = commands.add_parser("describe", help="where a placed film lies among the cameras")
    describe.add_argument("--view-file", type=Path, required=True, help="views/NAME.json")
    for command in (convert, describe):
        command.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
        command.add_argument("--output", type=Path, required=True)
    args = parser.parse_args(argv)
    if args.command == "convert":
        formats = (args.source_format, args.output, args.output_format)
        run_convert(args.input, *formats, args.cameras, args.size, args.dataparser)
    else:
        run_describe(args.view_file, args.cameras, args.output)


if __name__ == "__main__":
    sys.exit(run_stage(main))
