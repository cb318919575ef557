"""Command line of stage stereo: `rectify` a pair, then `disparity` of its frames."""

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd import cli, io
from fourd.camera import CameraTrack, tracks_from_dict
from fourd.errors import InputError, explain_faults
from fourd.ingest import FrameReader, open_camera
from fourd.stereo.disparity import StereoOptions, find_row_shift, make_matcher, match_pair
from fourd.stereo.files import (
    add_disparity_frame,
    disparity_meta,
    read_rectification,
    write_rectification,
)
from fourd.stereo.guard import describe_measures
from fourd.stereo.rectification import STATUS_OK, SWEEP, PairRectification
from fourd.stereo.rectify import RectifyOptions, rectify_tracks
from fourd.stereo.rows import RowShift
from fourd.stereo.sweep import SWEEP_SIGMA_PX, sweep_pair

_log = logging.getLogger(__name__)


def read_tracks(cameras_path: Path, left: str, right: str) -> tuple[CameraTrack, CameraTrack]:
    """Two cameras of a cameras file. Raises InputError if one is not in there."""
    cameras = _read_section(cameras_path, "cameras")
    for name in (left, right):
        if name not in cameras:
            raise InputError(
                f"expected camera {name} in {cameras_path}, got {', '.join(cameras) or 'no cameras'}: "
                "calibrate it or leave it out of the scene"
            )
    tracks = tracks_from_dict({name: cameras[name] for name in (left, right)}, str(cameras_path))
    return tracks[left], tracks[right]


def _read_section(cameras_path: Path, key: str) -> dict[str, Any]:
    """A mapping by camera name, unchecked: of many cameras with many poses a pair needs two."""
    document = io.read_json(cameras_path)
    with explain_faults(f"cameras.json of this workflow in {cameras_path}"):
        return dict(document.get(key, {}))


def run_rectify(cameras_path: Path, left: str, right: str, options: RectifyOptions, output: Path) -> None:
    """Rectify a pair, or refuse it, and write the result."""
    left_out = _read_section(cameras_path, "left_out")
    absent = [f"camera {name} is left out: {left_out[name]}" for name in (left, right) if name in left_out]
    if absent:
        pair = PairRectification(left, right, "; ".join(absent), 0)
    else:
        pair = rectify_tracks(*read_tracks(cameras_path, left, right), options)
    write_rectification(output, pair)
    verdict = f"refused: {pair.status}" if pair.kind is None else pair.kind
    if pair.obstacle:
        verdict += f" ({pair.obstacle})"
    _log.info("%s-%s %s; %s", left, right, verdict, describe_measures(pair.measures) or "nothing measured")


def run_disparity(
    rectification_path: Path,
    film_paths: tuple[Path, Path],
    cameras_path: Path,
    frames: Sequence[int],
    options: StereoOptions,
    output: Path,
) -> None:
    """Match the frames of a pair and write them one by one; a refused pair keeps its reason."""
    matcher = make_matcher(options)
    pair = read_rectification(rectification_path)
    sigma_px = SWEEP_SIGMA_PX if pair.kind == SWEEP else options.sigma_px
    with io.ArchiveWriter(output, disparity_meta(pair, sigma_px)) as writer:
        if pair.status != STATUS_OK:
            _log.info("%s-%s not matched: %s", pair.left, pair.right, pair.status)
            return
        tracks = read_tracks(cameras_path, pair.left, pair.right)
        density = []
        with open_camera(film_paths[0]) as left, open_camera(film_paths[1]) as right:
            rows = _measure_rows(pair, tracks, (left, right), options)
            for frame in frames:
                rectification = pair.at(frame)
                views = tracks[0].at(frame), tracks[1].at(frame)
                images = left.read(frame), right.read(frame)
                if rectification.kind == SWEEP:
                    disparity = sweep_pair(rectification, views, images, options)
                else:
                    disparity = match_pair(rectification, views, images, matcher, options, rows)
                add_disparity_frame(writer, frame, disparity)
                density.append(
                    (
                        np.isfinite(disparity.left_disparity).mean()
                        + np.isfinite(disparity.right_disparity).mean()
                    )
                    / 2
                )
        _log.info(
            "%s-%s frames %d to %d: %.0f %% of the rectified pixels matched",
            pair.left, pair.right, frames[0], frames[-1], 100 * np.mean(density),
        )  # fmt: skip


def _measure_rows(
    pair: PairRectification,
    tracks: tuple[CameraTrack, CameraTrack],
    films: tuple[FrameReader, FrameReader],
    options: StereoOptions,
) -> RowShift | None:
    """Misalignment of a planar pair's rows in the scene's first frame.

    One for all frames, or depth would tremble; the same one in every chunk, or chunks would differ.
    """
    if not options.align_rows or pair.kind == SWEEP:
        return None
    images = films[0].read(0), films[1].read(0)
    rows = find_row_shift(pair.at(0), (tracks[0].at(0), tracks[1].at(0)), images, options)
    _log.info("%s-%s rows: %s", pair.left, pair.right, _describe_rows(rows))
    return rows


def _describe_rows(rows: RowShift | None) -> str:
    if rows is None:
        return "no significant misalignment"
    return (
        f"{rows.before_px:.2f} px off over {rows.num_matches} matches, corrected to {rows.after_px:.2f} px "
        f"({rows.offset:+.2f} px, {1000 * rows.along_y:+.2f} along y and {1000 * rows.along_x:+.2f} along x "
        "per 1000 px)"
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Parse the command line and run one of the two commands."""
    parser = argparse.ArgumentParser(prog="fourd.stereo", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    rectify = commands.add_parser("rectify", help="rectify a pair of cameras, or say why not")
    rectify.add_argument("--cameras", type=Path, required=True)
    rectify.add_argument("--left", required=True, help="name of a camera")
    rectify.add_argument("--right", required=True, help="name of a camera")
    cli.add_options(rectify, RectifyOptions)
    match = commands.add_parser("disparity", help="match frames of a rectified pair in both directions")
    match.add_argument("--rectification", type=Path, required=True)
    match.add_argument("--left-film", type=Path, required=True)
    match.add_argument("--right-film", type=Path, required=True)
    match.add_argument("--cameras", type=Path, required=True)
    match.add_argument("--frames", type=int, nargs="+", help="frames of the scene's clock")
    match.add_argument("--first", type=int, help="first frame, instead of --frames")
    match.add_argument("--last", type=int, help="last frame, inclusive")
    match.add_argument("--threads", type=int, default=1)
    cli.add_options(match, StereoOptions)
    for command in (rectify, match):
        command.add_argument("--output", type=Path, required=True)
    args = parser.parse_args(argv)
    if args.command == "rectify":
        cli.set_num_threads(1)
        options = cli.options_from_args(RectifyOptions, args)
        run_rectify(args.cameras, args.left, args.right, options, args.output)
        return
    cli.set_num_threads(args.threads)
    run_disparity(
        args.rectification,
        (args.left_film, args.right_film),
        args.cameras,
        _frames_from_args(args),
        cli.options_from_args(StereoOptions, args),
        args.output,
    )


def _frames_from_args(args: argparse.Namespace) -> list[int]:
    if args.frames and args.first is None and args.last is None:
        return args.frames
    if not args.frames and args.first is not None and args.last is not None and args.first <= args.last:
        return list(range(args.first, args.last + 1))
    raise InputError(
        "expected either --frames N ... or --first N --last M with N <= M, got "
        f"frames {args.frames}, first {args.first}, last {args.last}"
    )


if __name__ == "__main__":
    sys.exit(cli.run_stage(main))
