"""Command line of the stage `silhouettes`."""

import argparse
import contextlib
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from fourd.cli import add_options, options_from_args, run_stage, set_num_threads
from fourd.errors import InputError, explain_faults
from fourd.ingest import FrameReader, open_camera
from fourd.io import Archive, ArchiveWriter, read_json, write_json
from fourd.sfm.cameras import SceneCameras, read_cameras
from fourd.silhouettes.files import Plates, write_empty, write_plate
from fourd.silhouettes.need import read_pair_statuses, reason_against
from fourd.silhouettes.options import MOVING, UNKNOWN, SilhouetteOptions
from fourd.silhouettes.segment import segment

log = logging.getLogger(__name__)


def run_plate(
    film_path: Path,
    cameras_path: Path,
    need_path: Path,
    background_film: Path | None,
    options: SilhouetteOptions,
    output: Path,
) -> None:
    """Write silhouettes/{cam}/plate.npz; empty, with the reason as status, where none is needed or made."""
    scene = read_cameras(cameras_path)
    with open_camera(film_path) as film:
        need = read_json(need_path)
        with explain_faults(f"need.json of the stage silhouettes in {need_path}"):
            status = str(need["status"])
        reason = None if status == "ok" else status
        if film.camera in scene.left_out:
            reason = f"left out: {scene.left_out[film.camera]}"
        elif reason is None and options.use == "auto" and not scene.tracks[film.camera].is_static:
            # Turned pictures leave movers in the plate, and a mover called background carves the hull away.
            reason = "no background: the camera moves"
        if reason is not None:
            log.info("%s: %s", film.camera, reason)
            write_empty(output, film.camera, reason)
            return
        _check_calibrated(film, scene)
        write_plate(output, film, scene.tracks[film.camera], background_film, options)


def run_need(
    cameras_path: Path, rectifications: Sequence[Path], options: SilhouetteOptions, output: Path
) -> None:
    """Write silhouettes/need.json: whether silhouettes are made, or why not."""
    scene = read_cameras(cameras_path)
    reason = reason_against(read_pair_statuses(rectifications), scene.inputs, options)
    log.info("silhouettes: %s", reason or "needed")
    write_json(output, {"status": reason or "ok"})


def run_segment(
    film_paths: Sequence[Path],
    cameras_path: Path,
    plate_paths: Sequence[Path],
    frames: Sequence[int],
    options: SilhouetteOptions,
    output: Path,
) -> None:
    """Write silhouettes/{chunk}.npz of all cameras; the status of every plate is copied."""
    scene = read_cameras(cameras_path)
    meta: dict[str, dict[str, str]] = {"cameras": {}}
    with contextlib.ExitStack() as stack:
        films: list[tuple[FrameReader, Plates]] = []
        for film_path, plate_path in zip(film_paths, plate_paths, strict=True):
            archive = stack.enter_context(Archive(plate_path))
            with explain_faults(f"a plate of the stage silhouettes in {plate_path}"):
                name, status = str(archive.meta["camera"]), str(archive.meta["status"])
            meta["cameras"][name] = status
            if status == "ok":
                film = stack.enter_context(open_camera(film_path))
                _check_calibrated(film, scene)
                films.append((film, Plates(archive, scene.tracks[film.camera], options.jitter_px)))
        writer = stack.enter_context(ArchiveWriter(output, meta))
        for frame in frames if films else ():
            for film, plates in films:
                mask = segment(film.read(frame), plates.at(frame), options)
                writer.add_frame(frame, **{film.camera: mask})
                log.info(
                    "%s frame %d: %.1f %% moves, %.1f %% unknown", film.camera, frame,
                    100 * (mask == MOVING).mean(), 100 * (mask == UNKNOWN).mean(),
                )  # fmt: skip


def _check_calibrated(film: FrameReader, scene: SceneCameras) -> None:
    if film.camera not in scene.tracks:
        raise InputError(
            f"expected a calibrated camera among {', '.join(scene.tracks)}, got pictures of {film.camera}: "
            "calibrate it or leave it out"
        )


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of the stage."""
    parser = argparse.ArgumentParser(prog="python -m fourd.silhouettes")
    commands = parser.add_subparsers(dest="command", required=True)
    many = {"nargs": "+", "type": Path, "required": True}
    need = commands.add_parser("need", help="whether stereo leaves cameras alone")
    need.add_argument("--rectification", type=Path, nargs="*", default=[], help="files of all pairs")
    plate = commands.add_parser("plate", help="what a camera films where nothing moves")
    plate.add_argument("--need", type=Path, required=True, help="silhouettes/need.json")
    plate.add_argument("--background-film", type=Path, help="ingest file of a film of the empty scene")
    plate.add_argument("--film", type=Path, required=True, help="frames/cameras/{cam}.npz")
    chunk = commands.add_parser("segment", help="what moves, frame by frame")
    chunk.add_argument("--film", **many, help="frames/cameras/{cam}.npz, of any number of cameras")
    chunk.add_argument("--plate", **many, help="silhouettes/{cam}/plate.npz of the same cameras")
    chunk.add_argument("--frames", type=int, nargs="+", required=True, help="scene frames")
    for command in (need, plate, chunk):
        command.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
        command.add_argument("--output", type=Path, required=True)
        add_options(command, SilhouetteOptions)
    args = parser.parse_args(argv)
    set_num_threads(1)
    options = options_from_args(SilhouetteOptions, args)
    if args.command == "need":
        run_need(args.cameras, args.rectification, options, args.output)
    elif args.command == "plate":
        run_plate(args.film, args.cameras, args.need, args.background_film, options, args.output)
    elif len(args.film) != len(args.plate):
        raise InputError(
            f"expected one --film and one --plate per camera, got {len(args.film)} and {len(args.plate)}: "
            "name as many of each"
        )
    else:
        run_segment(args.film, args.cameras, args.plate, args.frames, options, args.output)


if __name__ == "__main__":
    sys.exit(run_stage(main))
