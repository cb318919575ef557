"""Stage `sfm`: `recover` cameras from films, put known ones on `films`, `import` them to the scene.

`recover` and `films` read ingest/{cam}.json and write sfm/film_cameras.json, over the films' own
frames. `import` reads calibration files in any known format (film_cameras.json is one) and
align/cameras/{cam}.json, and writes sfm/cameras.json and sfm/points.npz (docs/formats.md).
"""

import argparse
import contextlib
import logging
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fourd.camera import Camera, CameraTrack
from fourd.cli import add_options, options_from_args, run_stage, set_num_threads
from fourd.errors import InputError
from fourd.film_cameras import write_film_cameras
from fourd.ingest import open_camera
from fourd.io import ArchiveWriter
from fourd.sfm import SceneCameras, SfmOptions, write_cameras
from fourd.sfm.assemble import (
    IngestedCamera,
    check_inputs_left,
    film_cameras_of,
    find_left_out,
    read_ingested,
    select_cameras,
    split_cameras,
)
from fourd.sfm.depth_range import DepthRange, choose_depth_ranges
from fourd.sfm.importers import FORMATS, ImportedCameras, read_calibration
from fourd.sfm.normalize import estimate_similarity, estimate_up, sample_cameras, snap_center
from fourd.sfm.recover.options import RecoverOptions
from fourd.sfm.sparse import find_sparse_points, sparse_frames

log = logging.getLogger("fourd.sfm")


def triangulate_inputs(
    tracks: Mapping[str, Sequence[Camera]],
    inputs: Sequence[str],
    ingested: Mapping[str, IngestedCamera],
    num_frames: int,
    options: SfmOptions,
) -> np.ndarray:
    """(N, 3) sparse points, world units, from a few frames of the input cameras alone."""
    with contextlib.ExitStack() as stack:
        readers = {name: stack.enter_context(open_camera(ingested[name].path)) for name in inputs}
        return find_sparse_points(
            lambda frame: {name: tracks[name][frame if len(tracks[name]) > 1 else 0] for name in inputs},
            lambda name, frame: readers[name].read(frame),
            sparse_frames(num_frames, options.num_sparse_frames),
            options,
        )


def run_import(
    imported: Sequence[ImportedCameras],
    names_in_file: Mapping[str, str],
    heldout: Sequence[str],
    film_paths: Mapping[str, Path],
    num_frames: int,
    fps: float,
    depth_range: tuple[float, float] | None,
    options: SfmOptions,
) -> tuple[SceneCameras, np.ndarray]:
    """Cameras of the scene and (N, 3) sparse points, from files.

    imported: what the calibration files hold
    names_in_file: camera -> its name in the calibration, in the scene's order
    depth_range: (near, far) in the calibration's units, or None to estimate
    Raises InputError for every input that does not fit.
    """
    split_cameras(list(names_in_file), heldout)
    missing = [name for name in names_in_file if name not in film_paths]
    if missing:
        raise InputError(f"expected a file of align for every camera, got none for {', '.join(missing)}")
    ingested = {name: read_ingested(film_paths[name]) for name in names_in_file}
    left_out = find_left_out(imported, names_in_file, ingested)
    names_in_file = {name: given for name, given in names_in_file.items() if name not in left_out}
    heldout = [name for name in heldout if name not in left_out]
    inputs = check_inputs_left(names_in_file, heldout, left_out)
    selected = select_cameras(imported, names_in_file, inputs, ingested, num_frames)
    samples = sample_cameras({name: selected.tracks[name] for name in inputs})
    similarity = estimate_similarity(samples)
    tracks = {
        name: [snap_center(similarity.apply(c)) for c in cameras] for name, cameras in selected.tracks.items()
    }
    points = similarity.world_from_source(selected.points)
    has_bounds = depth_range is not None or all(name in selected.bounds for name in tracks)
    if len(points) == 0 and not has_bounds:
        points = triangulate_inputs(tracks, inputs, ingested, num_frames, options)
    ranges = choose_depth_ranges(tracks, depth_range, selected.bounds, points, similarity, options)
    _log_ranges(ranges, len(points), similarity.scale)
    scene = SceneCameras(
        fps=fps,
        num_frames=num_frames,
        inputs=inputs,
        heldout=tuple(heldout),
        tracks={n: CameraTrack(n, tuple(tracks[n]), ranges[n].near, ranges[n].far) for n in tracks},
        origin=similarity.origin,
        scale=similarity.scale,
        up=estimate_up(samples) if selected.up is None else selected.up,
        depth_range_from={name: ranges[name].source for name in tracks},
        left_out=left_out,
    )
    return scene, points


def _read_calibrations(args: argparse.Namespace) -> list[ImportedCameras]:
    imported = [read_calibration(path, args.calibration_format) for path in args.calibration]
    for calibration in imported:
        log.info("%s: %d cameras", calibration.path, len(calibration.cameras))
        for note in calibration.notes:
            log.info("%s: %s", calibration.path, note)
    return imported


def _log_ranges(ranges: Mapping[str, DepthRange], num_points: int, scale: float) -> None:
    log.info("%d sparse points; one world unit is %.6g units of the calibration", num_points, scale)
    for name, r in ranges.items():
        log.info("camera %s: near %.4g, far %.4g, from %s", name, r.near, r.far, r.source)
    bare = [name for name, r in ranges.items() if r.source == "camera geometry"]
    if bare:
        log.warning(
            "too few sparse points in %s: near is a guess from the cameras' positions; depth_range in the "
            "scene file would make it certain",
            ", ".join(bare),
        )


def parse_camera_names(entries: Sequence[str]) -> dict[str, str]:
    """`["cam00=left.png", "cam01"]` to camera name -> name in the calibration (default: the same).

    Raises InputError for an empty name or a camera that is named twice.
    """
    names: dict[str, str] = {}
    for entry in entries:
        name, _, name_in_file = entry.partition("=")
        if not name or name in names:
            raise InputError(f"--camera: expected each camera once as NAME or NAME=NAMEINFILE, got {entry!r}")
        names[name] = name_in_file or name
    return names


def parse_depth_range(words: Sequence[str] | None) -> tuple[float, float] | None:
    """`["2", "inf"]` to (near, far); `none` and `null` mean infinite. Raises InputError."""
    if words is None:
        return None
    try:
        near, far = (float("inf") if w.lower() in ("none", "null") else float(w) for w in words)
    except ValueError:
        near, far = float("nan"), float("nan")
    if not (0 < near < far and np.isfinite(near)):
        raise InputError(
            f"depth_range: expected 0 < NEAR < FAR in the calibration's units, got {' '.join(words)}: "
            "correct it in the scene file"
        )
    return near, far


def parse_scale_hint(words: Sequence[str]) -> tuple[str, str, float] | None:
    """`["cam00", "cam01", "2.5"]` to two cameras and metres; `["none"]` and `[]` to None.

    Raises InputError.
    """
    if list(words) in ([], ["none"]):
        return None
    try:
        first, second, distance_m = words[0], words[1], float(words[2])
    except (IndexError, ValueError):
        first, second, distance_m = "", "", float("nan")
    if len(words) != 3 or first == second or not 0 < distance_m < float("inf"):
        raise InputError(
            f"scale_hint: expected two cameras and their distance in metres, got {' '.join(words)}: correct "
            "it in the scene file"
        )
    return first, second, distance_m


def build_parser() -> argparse.ArgumentParser:
    """The command line of the stage."""
    parser = argparse.ArgumentParser(
        prog="python -m fourd.sfm", description="Cameras of the scene, with near and far"
    )
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("import", help="cameras from calibration files")
    _add_calibration_flags(command)
    command.add_argument(
        "--films", type=Path, nargs="*", default=[], help="align/cameras/NAME.json of every camera"
    )
    command.add_argument("--num-frames", type=int, required=True)
    command.add_argument("--fps", type=float, required=True)
    command.add_argument("--depth-range", nargs=2, metavar=("NEAR", "FAR"), help="calibration's units")
    command.add_argument("--output-cameras", type=Path, required=True)
    command.add_argument("--output-points", type=Path, required=True)
    add_options(command, SfmOptions)
    command = commands.add_parser("films", help="known cameras over the films' own frames")
    _add_calibration_flags(command)
    _add_film_flags(command)
    command = commands.add_parser("recover", help="cameras from the films alone")
    command.add_argument("--camera", nargs="+", required=True, metavar="NAME", help="in scene order")
    command.add_argument("--heldout", nargs="*", default=[], metavar="NAME")
    _add_film_flags(command)
    command.add_argument("--audio", type=Path, help="align/audio.json: clocks that narrow the films' range")
    command.add_argument("--start-s", type=_parse_start, default=None, help="common time of frame 0")
    command.add_argument("--num-frames", type=int, required=True)
    command.add_argument("--fps", type=float, required=True)
    command.add_argument("--scale-hint", nargs="*", default=[], metavar="WORD", help="CAMERA CAMERA METRES")
    add_options(command, RecoverOptions)
    for command in commands.choices.values():
        command.add_argument("--num-threads", type=int, default=1)
    return parser


def _add_calibration_flags(command: argparse.ArgumentParser) -> None:
    command.add_argument("--calibration", type=Path, nargs="+", required=True, help="files or COLMAP folders")
    command.add_argument("--calibration-format", choices=FORMATS, default="auto")
    command.add_argument("--camera", nargs="*", default=[], metavar="NAME=NAMEINFILE", help="in scene order")
    command.add_argument("--heldout", nargs="*", default=[], metavar="NAME")


def _add_film_flags(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--ingest", type=Path, nargs="+", required=True, help="ingest/NAME.json of every camera"
    )
    command.add_argument("--output", type=Path, required=True, help="sfm/film_cameras.json")


def _parse_start(text: str) -> float | None:
    return None if text.lower() == "none" else float(text)


def main(argv: Sequence[str] | None = None) -> None:
    """Run one command. Raises InputError for input that cannot be used."""
    args = build_parser().parse_args(argv)
    set_num_threads(args.num_threads)
    if args.command != "films" and (args.num_frames < 1 or not args.fps > 0):
        raise InputError(f"expected num_frames >= 1 and fps > 0, got {args.num_frames} and {args.fps}")
    {"import": _main_import, "films": _main_films, "recover": _main_recover}[args.command](args)


def _main_recover(args: argparse.Namespace) -> None:
    # COLMAP's library takes a while to load, and import has no use for it.
    from fourd.sfm.recover.run import run_recover

    run_recover(
        dict(zip(args.camera, _paths_of(args.camera, args.ingest), strict=True)),
        args.heldout,
        args.audio,
        args.start_s,
        args.fps,
        args.num_frames,
        parse_scale_hint(args.scale_hint),
        args.output,
        options_from_args(RecoverOptions, args),
    )


def _main_films(args: argparse.Namespace) -> None:
    names = parse_camera_names(args.camera)
    split_cameras(list(names), args.heldout)
    paths = dict(zip(names, _paths_of(list(names), args.ingest), strict=True))
    write_film_cameras(args.output, film_cameras_of(_read_calibrations(args), names, args.heldout, paths))


def _paths_of(names: Sequence[str], paths: Sequence[Path]) -> list[Path]:
    by_name = {path.stem: path for path in paths}
    missing = [name for name in names if name not in by_name]
    if missing:
        raise InputError(f"expected an ingest file for every camera, got none for {', '.join(missing)}")
    return [by_name[name] for name in names]


def _main_import(args: argparse.Namespace) -> None:
    scene, points = run_import(
        _read_calibrations(args),
        parse_camera_names(args.camera),
        args.heldout,
        {path.stem: path for path in args.films},
        args.num_frames,
        args.fps,
        parse_depth_range(args.depth_range),
        options_from_args(SfmOptions, args),
    )
    with ArchiveWriter(args.output_points) as archive:
        archive.add("points", points)
    write_cameras(args.output_cameras, scene)


if __name__ == "__main__":
    sys.exit(run_stage(main))
