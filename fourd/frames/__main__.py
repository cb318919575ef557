"""Command line of stage frames: `colour` compares all cameras, `prepare` readies one for its readers."""

import argparse
import contextlib
import dataclasses
import logging
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd import cli, io
from fourd.errors import InputError, explain_faults
from fourd.flow import compensate_motion
from fourd.frames.colour import describe_colour, match_colours
from fourd.frames.options import FramesOptions
from fourd.image import difference_of
from fourd.ingest import SourceReader, check_film, open_camera
from fourd.sfm import read_cameras
from fourd.tone import table_at

_log = logging.getLogger("fourd.frames")


def read_film(path: Path) -> dict[str, Any]:
    """A film on the common clock. Raises InputError for another file."""
    document = io.read_json(path)
    with explain_faults(f"a film on the common clock (stage align) in {path}"):
        check_film(document)
    return document


def run_colour(cameras: Path, films: Sequence[Path], output: Path, options: FramesOptions) -> None:
    """Write frames/colour.json."""
    documents = {
        str(document["camera"]): (path, document) for path in films for document in [read_film(path)]
    }
    scene = read_cameras(cameras)
    reasons = {name: str(document["status"]) for name, (_, document) in documents.items()}
    for name, status in reasons.items():
        if status == "ok" and name not in scene.tracks:
            reasons[name] = scene.left_out.get(name, f"no camera in {cameras}")
    names = [name for name in scene.tracks if reasons.get(name) == "ok"]
    absent = [name for name in scene.tracks if name not in documents]
    if absent:
        raise InputError(f"expected a film for every camera in {cameras}, got none for {', '.join(absent)}")
    body: dict[str, Any] = {"is_matched": options.match_colours, "frames": [], "reference": None}
    entries: Mapping[str, Any] = {}
    if options.match_colours:
        with contextlib.ExitStack() as stack:
            readers = {name: stack.enter_context(open_camera(documents[name][0])) for name in names}
            frames, reference, colours = match_colours(
                scene, names, lambda name, frame: readers[name].read(frame, is_raw=True), options
            )
        body |= {"frames": list(frames), "reference": reference}
        entries = {name: describe_colour(colour, frames) for name, colour in colours.items()}
        _log_colours(entries, reference)
    not_matched = "switched off" if not options.match_colours else None
    body["cameras"] = {
        name: entries.get(name) or {"status": not_matched or reasons[name], "tone": None}
        for name in documents
    }
    io.write_json(output, body)


def _log_colours(entries: Mapping[str, Any], reference: str | None) -> None:
    if reference is None:
        _log.warning("no two cameras see enough static points in common: colours stay as they are")
        return
    needed = [name for name, entry in entries.items() if entry["is_needed"]]
    _log.info(
        "colours as in %s; %s",
        reference,
        f"corrected: {', '.join(needed)}" if needed else "no camera needs any",
    )
    for name, entry in entries.items():
        if entry["status"] == "ok":
            _log.info(
                "%s: differs by %.1f levels (+-%.1f), %d points%s",
                name, entry["change_levels"], entry["sigma_levels"], entry["num_matches"],
                "" if entry["is_needed"] else ", left as it is",
            )  # fmt: skip
        else:
            _log.warning("%s: colours stay as they are: %s", name, entry["status"])


def run_prepare(film: Path, colour: Path, output: Path, options: FramesOptions) -> None:
    """Write frames/cameras/{cam}.npz: the film, its colours, and what motion changes in its pictures."""
    document = read_film(film)
    name, found = str(document["camera"]), io.read_json(colour)
    with explain_faults(f"camera {name} in {colour}"):
        tone = found["cameras"][name]["tone"]
    # A table that cannot be applied is found here, not by each of its readers.
    table_at(tone, 0)
    is_off = not options.compensate or document["status"] != "ok"
    meta = {
        **document,
        "tone": tone,
        "compensation": None if is_off else dataclasses.asdict(options.compensation),
    }
    with io.ArchiveWriter(output, meta) as writer:
        num_moved = 0 if is_off else _add_moved_pixels(writer, document, film, options)
    _log.info("%s: %d of %d pictures brought to the common time", name, num_moved, len(document["dt_s"]))


def _add_moved_pixels(
    writer: io.ArchiveWriter, document: Mapping[str, Any], film: Path, options: FramesOptions
) -> int:
    """Store, for every picture that is off in time, the pixels that differ at the frame's time."""
    num_moved = 0
    with explain_faults(f"a film on the common clock in {film}"):
        rate, sigma_s = 1 + float(document["rate_ppm"]) * 1e-6, float(document["sigma_s"])
        reader = SourceReader(document["ingest"], film)
    with reader:
        common_s = reader.pts_s * rate
        for frame, (at, dt_s) in enumerate(zip(document["source_frame"], document["dt_s"], strict=True)):
            other = find_other_side(common_s, at, dt_s)
            # A shift smaller than the clock's own doubt would move pixels by what is not known.
            if abs(dt_s) < max(options.min_dt_s, sigma_s) or other is None:
                continue
            image = reader.read(at)
            gap_s = abs(float(common_s[at] - common_s[other]))
            moved = compensate_motion(image, reader.read(other), dt_s, gap_s, options.compensation)
            where, rgb = difference_of(image, moved)
            if len(rgb):
                writer.add_frame(frame, where=where, rgb=rgb)
                num_moved += 1
    return num_moved


def find_other_side(common_s: np.ndarray, at: int, dt_s: float) -> int | None:
    """The nearest film frame on the other side of the wanted time; None at the film's ends.

    common_s: (N,) times of the film's frames, s;  at: the frame that is dt_s later than wanted
    """
    wanted = common_s[at] - dt_s
    other = int(np.searchsorted(common_s, wanted, side="right")) - 1 if dt_s > 0 else None
    if dt_s < 0:
        other = int(np.searchsorted(common_s, wanted, side="left"))
    return other if other is not None and other != at and 0 <= other < len(common_s) else None


def main(argv: Sequence[str] | None = None) -> None:
    """Parse the command line and run one of the two commands."""
    parser = argparse.ArgumentParser(prog="python -m fourd.frames", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    colour = commands.add_parser("colour", help="find the colour corrections of all cameras")
    colour.add_argument("--cameras", type=Path, required=True, help="cameras.json of the stage sfm")
    colour.add_argument("--films", type=Path, nargs="+", required=True, help="films on the common clock")
    prepare = commands.add_parser("prepare", help="one film with everything that its readers need")
    prepare.add_argument("--film", type=Path, required=True, help="film on the common clock")
    prepare.add_argument("--colour", type=Path, required=True, help="output of the command colour")
    for command in (colour, prepare):
        command.add_argument("--output", type=Path, required=True)
        cli.add_options(command, FramesOptions)
    args = parser.parse_args(argv)
    cli.set_num_threads(1)
    options = cli.options_from_args(FramesOptions, args)
    if args.command == "colour":
        run_colour(args.cameras, args.films, args.output, options)
    else:
        run_prepare(args.film, args.colour, args.output, options)


if __name__ == "__main__":
    sys.exit(cli.run_stage(main))
