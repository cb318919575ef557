"""Stage `align` as commands: `listen`, `track`, `solve`, `sample` (fourd/align/__init__.py)."""

import argparse
import dataclasses
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fourd.align.clock import CameraClock, Offsets, read_offsets, write_offsets
from fourd.align.evidence import draw_evidence
from fourd.align.listen import run_listen
from fourd.align.motion_maps import map_motion, no_maps, read_motion_maps, write_motion_maps
from fourd.align.moving_tracks import no_tracks, read_tracks, track_motion, write_tracks
from fourd.align.options import AlignOptions
from fourd.align.request import ClockRequest, check_request
from fourd.align.sample import GivenClock, SampleOptions, clock_from_offsets, run_sample
from fourd.align.sampling import choose_start
from fourd.align.solve import Motion, needs_vision, solve_all
from fourd.align.spatiotemporal_options import SpatiotemporalOptions
from fourd.align.vision_options import VisionOptions
from fourd.cli import add_options, options_from_args, run_stage, set_num_threads
from fourd.errors import InputError
from fourd.film_cameras import read_film_cameras
from fourd.ingest import open_source, read_ingest
from fourd.io import write_png

log = logging.getLogger(__name__)


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m fourd.align", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    listen = commands.add_parser("listen", help="clocks from sound")
    track = commands.add_parser("track", help="what moves in one film, where sound leaves doubt")
    solve = commands.add_parser("solve", help="clocks from sound and sight")
    sample = commands.add_parser("sample", help="put a film on the common clock")
    for command in (listen, solve):
        command.add_argument("--ingest", type=Path, nargs="+", required=True, help="ingest/{cam}.json of all")
        command.add_argument("--output-evidence", type=Path, required=True, help="PNG of what it rests on")
    add_options(listen, AlignOptions)
    track.add_argument("--ingest", type=Path, required=True, help="ingest/{cam}.json")
    track.add_argument("--output-maps", type=Path, required=True, help="align/maps/{cam}.npz")
    solve.add_argument("--tracks", type=Path, nargs="+", required=True, help="align/tracks/{cam}.npz of all")
    solve.add_argument("--maps", type=Path, nargs="+", required=True, help="align/maps/{cam}.npz of all")
    for command in (track, solve):
        command.add_argument("--audio", type=Path, required=True, help="align/audio.json")
        command.add_argument("--cameras", type=Path, required=True, help="sfm/film_cameras.json")
        add_options(command, VisionOptions)
    for command in (listen, track, solve):
        add_options(command, ClockRequest)
    add_options(solve, SpatiotemporalOptions)
    sample.add_argument("--ingest", type=Path, required=True, help="ingest/{cam}.json")
    sample.add_argument("--offsets", type=Path, help="align/offsets.json, unless the clock is given")
    sample.add_argument("--fps", type=float, required=True, help="of the common clock's frames")
    sample.add_argument("--num-frames", type=int, required=True)
    add_options(sample, GivenClock)
    add_options(sample, SampleOptions)
    for command in (listen, track, solve, sample):
        command.add_argument("--output", type=Path, required=True)
    return parser


def _read_request(args: argparse.Namespace) -> ClockRequest:
    request = options_from_args(ClockRequest, args)
    check_request(request)
    return request


def _listen(args: argparse.Namespace) -> None:
    request = _read_request(args)
    options = options_from_args(AlignOptions, args)
    offsets, matches = run_listen(
        args.ingest,
        request.inputs,
        request.heldout,
        request.fps,
        request.num_frames,
        options,
        request.start_s,
    )
    for note in offsets.notes:
        log.info(note)
    write_png(args.output_evidence, draw_evidence(offsets, matches))
    write_offsets(args.output, offsets)


def _track(args: argparse.Namespace) -> None:
    request, options = _read_request(args), options_from_args(VisionOptions, args)
    audio = read_offsets(args.audio)
    with open_source(args.ingest) as reader:
        film = read_film_cameras(args.cameras).cameras[reader.camera]
        reason = needs_vision(audio, request, options)
        if reason:
            log.info("%s: sight is needed: %s", reader.camera, reason)
            tracks, maps = track_motion(reader, film, options), map_motion(reader, film)
        else:
            reason = "not looked at: sound suffices"
            tracks, maps = no_tracks(reader.camera, reason), no_maps(reader.camera, reason)
    log.info("%s: %d moving points, %s", tracks.name, tracks.num_tracks, tracks.status)
    write_tracks(args.output, tracks)
    write_motion_maps(args.output_maps, maps)


def _solve(args: argparse.Namespace) -> None:
    request = _read_request(args)
    documents = {d["camera"]: d for d in map(read_ingest, args.ingest)}
    tracks = {film.name: film for film in map(read_tracks, args.tracks)}
    maps = {film.name: film for film in map(read_motion_maps, args.maps)}
    motions = {name: Motion(tracks[name], maps[name]) for name in tracks}
    solution = solve_all(
        request,
        read_offsets(args.audio),
        read_film_cameras(args.cameras),
        motions,
        options_from_args(VisionOptions, args),
        options_from_args(SpatiotemporalOptions, args),
    )
    for note in solution.offsets.notes:
        log.info(note)
    placed = {n: c for n, c in solution.offsets.clocks.items() if n in request.inputs and c.status == "ok"}
    picture = draw_evidence(solution.offsets, solution.matches)
    if len(placed) < 2:
        # The engine removes the outputs of a failed job; the reason must survive it.
        refused = args.output_evidence.with_name("refused.png")
        write_png(refused, picture)
        raise InputError(_explain_refusal(solution.offsets, request, refused))
    pts = {name: np.array(documents[name]["pts_s"], dtype=np.float64) for name in placed}
    start_s = request.start_s
    if start_s is None:
        start_s = choose_start(placed, pts, request.fps, request.num_frames)
    write_png(args.output_evidence, picture)
    write_offsets(args.output, dataclasses.replace(solution.offsets, start_s=start_s))


def _explain_refusal(offsets: Offsets, request: ClockRequest, picture: Path) -> str:
    reasons = "; ".join(f"{n}: {offsets.clocks[n].status}" for n in request.inputs)
    return (
        "expected two or more films that can be put on one clock, got none that fit together "
        f"({reasons}): see {picture}; check that they show one event, or give the offsets "
        "(`clock: given`) in the scene file"
    )


def _sample(args: argparse.Namespace) -> None:
    if not args.fps > 0 or args.num_frames < 1:
        raise InputError(f"expected fps above 0 and 1 frame or more, got {args.fps} and {args.num_frames}")
    clock, start_s = CameraClock(args.offset_s), args.start_s
    if args.offsets is not None:
        clock, start_s = clock_from_offsets(read_ingest(args.ingest)["camera"], args.offsets)
    options = options_from_args(SampleOptions, args)
    run_sample(args.ingest, clock, start_s, args.fps, args.num_frames, args.output, options)


def main(argv: Sequence[str] | None = None) -> None:
    """Run one command. Raises InputError for input that cannot be used."""
    args = _make_parser().parse_args(argv)
    set_num_threads(1)
    {"listen": _listen, "track": _track, "solve": _solve, "sample": _sample}[args.command](args)


if __name__ == "__main__":
    sys.exit(run_stage(main))
