"""Command line of stage `viewer`: `maps` for one view and chunk, `page` for the whole scene."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from fourd.cli import add_options, options_from_args, run_stage, set_num_threads
from fourd.viewer import ViewerOptions
from fourd.viewer.maps import write_maps
from fourd.viewer.page import Sources, write_page


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of the stage."""
    parser = argparse.ArgumentParser(prog="python -m fourd.viewer", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    maps = commands.add_parser("maps", help="depth and origin of the pictures of one view")
    maps.add_argument("--foreground", type=Path, required=True)
    maps.add_argument("--background", type=Path, required=True)
    maps.add_argument("--output", type=Path, required=True)
    page = commands.add_parser("page", help="the page and its files")
    page.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
    page.add_argument("--points", type=Path, required=True, help="sfm/points.npz")
    page.add_argument("--films", type=Path, nargs="+", required=True, help="frames/cameras/{cam}.npz")
    page.add_argument("--views", type=Path, nargs="+", required=True, help="lattice/views/{view}.json")
    page.add_argument("--render", type=Path, nargs="+", required=True, help="lattice/render/{view}/{chunk}")
    page.add_argument("--maps", type=Path, nargs="+", required=True, help="lattice/maps/{view}/{chunk}.npz")
    page.add_argument("--forecast-mb", type=float, required=True, help="what the plan of the lattice says")
    page.add_argument("--output", type=Path, required=True, help="folder of the page")
    add_options(page, ViewerOptions)
    args = parser.parse_args(argv)
    set_num_threads(1)
    if args.command == "maps":
        write_maps(args.foreground, args.background, args.output)
        return
    sources = Sources(args.cameras, args.points, args.films, args.views, args.render, args.maps)
    write_page(sources, options_from_args(ViewerOptions, args), args.forecast_mb, args.output)


if __name__ == "__main__":
    sys.exit(run_stage(main))
