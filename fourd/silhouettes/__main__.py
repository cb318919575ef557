"""Command line of the stage `silhouettes`."""

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from fourd.cli import add_options, options_from_args, run_stage, set_num_threads
from fourd.errors import InputError
from fourd.ingest import FrameReader, open_camera
from fourd.io import Archive, ArchiveWriter
from fourd.sfm.cameras import SceneCameras, read_cameras
from fourd.silhouettes.files import Plates, write_empty, write_plate
from fourd.silhouettes.need import read_pair_statuses, reason_against
from fourd.silhouettes.options import MOVING, UNKNOWN, SilhouetteOptions
from fourd.silhouettes.segment import segment

log = logging.getLogger(__name__)


def run_plate(
    film_path: Path,
    cameras_path: Path,
    rectifications: Sequence[Path],
    background_film: Path | None,
    options: SilhouetteOptions,
    output: Path,
) -> None:
    """Write silhouettes/{cam}/plate.npz; empty, with the reason as status, where none is needed or made."""
    scene = read_cameras(cameras_path)
    with open_camera(film_path) as film:
        reason = reason_against(read_pair_statuses(rectifications), scene.inputs, options)
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


def run_segment(
    film_path: Path,
    cameras_path: Path,
    plate_path: Path,
    frames: Sequence[int],
    options: SilhouetteOptions,
    output: Path,
) -> None:
    """Write silhouettes/{cam}/{chunk}.npz; the status of the plate is copied."""
    archive = Archive(plate_path)
    with open_camera(film_path) as film:
        status = str(archive.meta["status"])
        if status != "ok":
            write_empty(output, film.camera, status)
            return
        scene = read_cameras(cameras_path)
        _check_calibrated(film, scene)
        plates = Plates(archive, scene.tracks[film.camera], options.jitter_px)
        with ArchiveWriter(output, {"camera": film.camera, "status": "ok"}) as writer:
            for frame in frames:
                mask = segment(film.read(frame), plates.at(frame), options)
                writer.add_frame(frame, mask=mask)
                log.info(
                    "%s frame %d: %.1f %% moves, %.1f %% unknown", film.camera, frame,
                    100 * (mask == MOVING).mean(), 100 * (mask == UNKNOWN).mean(),
                )  # fmt: skip
    archive.close()


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
    plate = commands.add_parser("plate", help="what a camera films where nothing moves")
    plate.add_argument("--rectification", type=Path, nargs="*", default=[], help="files of all pairs")
    plate.add_argument("--background-film", type=Path, help="ingest file of a film of the empty scene")
    chunk = commands.add_parser("segment", help="what moves, frame by frame")
    plate.add_argument("--film", type=Path, required=True, help="frames/cameras/{cam}.npz")
    plate.add_argument("--output", type=Path, required=True)
    chunk.add_argument("--film", **many, help="frames/cameras/{cam}.npz, of any number of cameras")
    chunk.add_argument("--plate", **many, help="silhouettes/{cam}/plate.npz of the same cameras")
    chunk.add_argument("--frames", type=int, nargs="+", required=True, help="scene frames")
    chunk.add_argument("--output", **many, help="one file per camera")
    for command in (plate, chunk):
        command.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
        add_options(command, SilhouetteOptions)
    args = parser.parse_args(argv)
    set_num_threads(1)
    options = options_from_args(SilhouetteOptions, args)
    if args.command == "plate":
        run_plate(args.film, args.cameras, args.rectification, args.background_film, options, args.output)
        return
    if not len(args.film) == len(args.plate) == len(args.output):
        raise InputError(
            f"expected one --film, --plate and --output per camera, got {len(args.film)}, {len(args.plate)} "
            f"and {len(args.output)}: name as many of each"
        )
    for film, plate_path, output in zip(args.film, args.plate, args.output, strict=True):
        run_segment(film, args.cameras, plate_path, args.frames, options, output)


if __name__ == "__main__":
    sys.exit(run_stage(main))
