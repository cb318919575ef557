"""Write a scene file for footage that is there: `python -m fourd.init NAME VIDEO_OR_FOLDER...`.

Probes the inputs, listens which part of the event all of them film, and says what to run next. Cameras
are called cam00, cam01 ... in the order given, unless the sources' own names are of that kind: cam01.mp4
stays cam01.
"""

import argparse
import collections
import dataclasses
import json
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml

from fourd.align.listen import compare_sounds, solve_by_sound
from fourd.align.options import AlignOptions
from fourd.align.sound import check_sound, prepare_sound
from fourd.audio import read_audio
from fourd.cli import run_stage
from fourd.errors import InputError
from fourd.ingest import Source, probe_source
from fourd.io import write_text
from fourd.sfm.importers import read_calibration

NAME_PATTERN = "[a-z][a-z0-9_]*"
CAMERA_PATTERN = r"cam\d{1,4}"
DEFAULT_FPS = 30.0
# The films' longer side at first: a first result within minutes, whatever the cameras recorded.
MAX_FILM_SIDE = 960


@dataclasses.dataclass(frozen=True)
class SceneDraft:
    """What goes into the scene file.

    cameras: name -> (source as given, calibration name or None)
    is_synchronized: all sources start together on one clock;  notes: what the user should know
    """

    fps: float
    num_frames: int
    size: tuple[int, int]
    cameras: dict[str, tuple[str, str | None]]
    heldout: tuple[str, ...]
    calibration: tuple[str, ...]
    is_synchronized: bool = False
    notes: tuple[str, ...] = ()


def most_common_fps(sources: Sequence[Source]) -> float | None:
    """The frame rate that most videos have, the lowest of them on a draw; None without a video."""
    rates = collections.Counter(source.info.fps for source in sources if not source.files)
    return max(rates, key=lambda fps: (rates[fps], -fps)) if rates else None


def common_num_frames(sources: Sequence[Source], fps: float) -> tuple[int, int]:
    """Frames at `fps` for which every source has a picture, all starting together; index of the shortest."""
    durations_s = [len(s.info.pts_s) / fps if s.files else s.info.pts_s[-1] + 1 / fps for s in sources]
    shortest = int(np.argmin(durations_s))
    return max(1, int(np.floor(durations_s[shortest] * fps + 1e-3))), shortest


def overlapping_num_frames(
    paths: Sequence[str], sources: Sequence[Source], fps: float
) -> tuple[int | None, str]:
    """Frames at `fps` that all sources film together, by their sound, and a sentence about it.

    None where sound does not place every source: then only the run can tell.
    """
    sounds, names = {}, [str(path) for path in paths]
    for name, source in zip(names, sources, strict=True):
        audio = None if source.files else read_audio(name)
        if audio is not None and check_sound(audio.samples, audio.sample_rate) == "ok":
            sounds[name] = prepare_sound(audio.samples, audio.sample_rate, audio.start_s)
    status = {name: "ok" if name in sounds else "it has no sound that can be compared" for name in names}
    delays = [match.delay for match in compare_sounds(sounds, names, (), AlignOptions())]
    clocks = solve_by_sound(delays, status, names, ()).clocks
    unplaced = [f"{name} ({clock.status})" for name, clock in clocks.items() if clock.status != "ok"]
    if unplaced:
        return None, f"Sound does not tell when these started: {'; '.join(unplaced)}. What they show may."
    starts = [clocks[name].offset_s for name in names]
    ends = [
        float(clocks[name].common_time(source.info.pts_s[-1:])[0])
        for name, source in zip(names, sources, strict=True)
    ]
    # One frame less: the first one is put where the pictures of all cameras are nearest in time.
    num_frames = int(np.floor((min(ends) - max(starts)) * fps))
    if num_frames < 1:
        return None, "By their sound these films show no moment in common."
    return num_frames, f"By their sound all films have {num_frames / fps:.1f} s in common."


def film_size(size: tuple[int, int], max_side: int = MAX_FILM_SIDE) -> tuple[int, int]:
    """(width, height) of the same shape, even, the longer side max_side px at most."""
    scale = min(1.0, max_side / max(size))
    return max(16, 2 * round(size[0] * scale / 2)), max(16, 2 * round(size[1] * scale / 2))


def name_cameras(paths: Sequence[str]) -> list[str]:
    """Names of the cameras: the sources' stems if all are like cam01 and differ, else cam00, cam01 ..."""
    stems = [Path(path).stem for path in paths]
    if all(re.fullmatch(CAMERA_PATTERN, stem) for stem in stems) and len(set(stems)) == len(stems):
        return stems
    return [f"cam{i:02d}" for i in range(len(paths))]


# Up to here two agreeing pairs served better than the paper's three on both events with truth.
FEW_CAMERAS = 10


def match_calibration_names(
    cameras: Sequence[str], paths: Sequence[str], calibration: Sequence[str]
) -> list[str | None]:
    """For each source the camera of the calibration, of any format, that belongs to it.

    A name that equals the file's or folder's stem wins; if any stem has none, the order counts.
    None where the camera's own name will do.
    Raises InputError if a calibration cannot be read or has fewer cameras than there are sources.
    """
    names: list[str] = []
    for file in calibration:
        if not Path(file).exists():
            raise InputError(f"expected a calibration at {file}, found nothing: check --calibration")
        names += read_calibration(file).cameras
    if not names:
        return [None] * len(paths)
    belonging = [Path(path).stem for path in paths]
    if not set(belonging) <= set(names):
        if len(names) < len(paths):
            raise InputError(
                f"expected a calibrated camera for each of {len(paths)} sources in {', '.join(calibration)}, "
                f"got {', '.join(names)}: calibrate the others or leave them out"
            )
        belonging = names[: len(paths)]
    return [None if name == camera else name for camera, name in zip(cameras, belonging, strict=True)]


def resolve_heldout(heldout: Sequence[str], cameras: Sequence[str], paths: Sequence[str]) -> tuple[str, ...]:
    """Camera names for names given as cam00 or as the stem of a source.

    Raises InputError for a name that is neither, or means two cameras.
    """
    resolved = []
    for name in heldout:
        meant = {c for c, path in zip(cameras, paths, strict=True) if name in (c, Path(path).stem)}
        if len(meant) != 1:
            raise InputError(
                f"expected --heldout to name one camera of {', '.join(cameras)} or the stem of its source, "
                f"got {name}, which means {len(meant)}: correct it"
            )
        resolved += meant
    return tuple(dict.fromkeys(resolved))


def scene_text(name: str, draft: SceneDraft) -> str:
    """The scene file, commented."""
    cameras = [
        f"  {camera}: {{source: {_scalar(source)}"
        + (f", calibration_name: {_scalar(calibrated)}}}" if calibrated else "}")
        for camera, (source, calibrated) in draft.cameras.items()
    ]
    clock, calibration = _known_lines(draft)
    few_cameras = []
    if len(draft.cameras) < FEW_CAMERAS:
        few_cameras = [
            "  # So few cameras are few pairs: two that agree on a depth are enough.",
            "  fuse: {min_pairs: 2}",
        ]
    lines = [
        f"# The facts of one event. Run: snakemake --cores 2 render_all --config scene={name}",
        "# Paths are relative to the folder that snakemake runs in.",
        "",
        "# Frames per second of the common clock and of the films; frame k is at k / fps seconds.",
        f"fps: {draft.fps:.10g}",
        "# Frames on the common clock, from its time 0; every camera must have filmed all of them.",
        f"num_frames: {draft.num_frames}",
        "# Width and height of the films, px. Larger is slower.",
        f"size: [{draft.size[0]}, {draft.size[1]}]",
        "",
        "# Cameras in the order in which they stand, if you know it. Only `source` is required:",
        "#   source: a video file or a folder of numbered images",
        "#   calibration_name: the camera's name in the calibration, where it differs",
        "cameras:",
        *cameras,
        *clock,
        "",
        "# Cameras that nothing is made from; they show how close the films come to what was there.",
        f"heldout: [{', '.join(draft.heldout)}]",
        "",
        *calibration,
        "# Nearest and farthest depth worth seeing, in the calibration's units; estimated if left out.",
        "# depth_range: [1.5, 30]",
        "",
        "# A network that two cores train in minutes; with a GPU take it out",
        "settings:",
        *few_cameras,
        "  composition: {num_filters: [8, 8, 8], crop: 192, epochs: 6}",
    ]
    return "\n".join(lines) + "\n"


def _known_lines(draft: SceneDraft) -> tuple[list[str], list[str]]:
    """What the scene file says about clocks and about cameras."""
    if draft.calibration:
        calibration = [
            "# Files or folders with K, R, t of all cameras in one world; the format is recognised.",
            f"calibration: [{', '.join(map(_scalar, draft.calibration))}]",
        ]
    else:
        calibration = [
            "# Nothing is known about where the cameras stood: the videos tell. If you have a calibration:",
            "# calibration: [colmap/sparse/0]",
        ]
    if draft.is_synchronized:
        clock = ["# All sources start together; where one does not, give it its offset_s.", "clock: given"]
    else:
        clock = [
            "# When each camera started is found from sound and motion. If you know: `clock: given`, and",
            "# offset_s for every camera.",
        ]
    return clock, calibration


def _scalar(text: str) -> str:
    """Text as a YAML scalar inside a flow collection, quoted only if it has to be."""
    is_plain = re.fullmatch(r"[\w./~+-]+", text) and yaml.safe_load(text) == text
    return text if is_plain else json.dumps(text, ensure_ascii=False)


def draft_scene(
    paths: Sequence[str],
    calibration: Sequence[str] = (),
    heldout: Sequence[str] = (),
    fps: float | None = None,
    num_frames: int | None = None,
    is_synchronized: bool = False,
) -> SceneDraft:
    """Probe the sources and propose a scene.

    fps, num_frames: None takes the most common rate and what all sources have in common
    Raises InputError for fewer than 2 sources, unreadable ones, or a range that they do not have.
    """
    if len(paths) < 2:
        raise InputError(f"expected 2 or more videos or folders of images, got {len(paths)}: name them all")
    missing = [path for path in paths if not Path(path).exists()]
    if missing:
        raise InputError(
            f"expected videos or folders of images, found nothing at {', '.join(missing)}: check the path"
        )
    if fps is not None and not (np.isfinite(fps) and fps > 0):
        raise InputError(f"expected --fps above 0, got {fps}: correct it")
    sources = [probe_source(Path(path), fps or DEFAULT_FPS) for path in paths]
    clock_fps = fps or most_common_fps(sources) or DEFAULT_FPS
    is_synchronized = is_synchronized or all(source.files for source in sources)
    (available, shortest), notes = common_num_frames(sources, clock_fps), ()
    if not is_synchronized:
        heard, note = overlapping_num_frames(paths, sources, clock_fps)
        notes = (note,)
        if heard is None:
            notes += (
                f"num_frames is a guess: {available}, as many as {paths[shortest]}, the shortest, has; the "
                "run says what fits.",
            )
        available = heard or available
    if num_frames is not None and not 1 <= num_frames <= available:
        raise InputError(
            f"expected --num-frames in 1..{available}, which is what all sources have at {clock_fps:g} fps, "
            f"got {num_frames}: lower it"
        )
    cameras = name_cameras(paths)
    calibrated = match_calibration_names(cameras, paths, calibration)
    return SceneDraft(
        fps=clock_fps,
        num_frames=num_frames or available,
        size=film_size(sources[0].info.size),
        cameras=dict(zip(cameras, zip(paths, calibrated, strict=True), strict=True)),
        heldout=resolve_heldout(heldout, cameras, paths),
        calibration=tuple(calibration),
        is_synchronized=is_synchronized,
        notes=notes,
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m fourd.init", description=__doc__)
    parser.add_argument("name", metavar="NAME", help="of the scene")
    parser.add_argument("sources", metavar="VIDEO_OR_FOLDER", nargs="*")
    parser.add_argument("--calibration", nargs="+", default=[], metavar="FILE_OR_FOLDER")
    parser.add_argument(
        "--heldout",
        nargs="+",
        default=[],
        metavar="CAMERA",
        help="its name in the scene, or its source's stem",
    )
    parser.add_argument("--fps", type=float, help="of the common clock (default: what most videos have)")
    parser.add_argument("--num-frames", type=int, help="(default: what all sources have)")
    parser.add_argument("--synchronized", action="store_true", help="all sources start together")
    parser.add_argument("--scenes", type=Path, default=Path("config/scenes"), help="folder to write to")
    parser.add_argument("--force", action="store_true", help="write over an existing scene file")
    args = parser.parse_args(argv)
    if not re.fullmatch(NAME_PATTERN, args.name):
        raise InputError(
            f"expected a scene name of small letters, digits and _ that starts with a letter, got "
            f"{args.name!r}: choose another"
        )
    path = args.scenes / f"{args.name}.yaml"
    if path.exists() and not args.force:
        raise InputError(f"expected no file at {path}, but there is one: choose another name or give --force")
    draft = draft_scene(
        args.sources, args.calibration, args.heldout, args.fps, args.num_frames, args.synchronized
    )
    write_text(path, scene_text(args.name, draft))
    _print_summary(args.name, path, draft)


def _print_summary(name: str, path: Path, draft: SceneDraft) -> None:
    print(
        f"{path}: {len(draft.cameras)} cameras, {draft.num_frames} frames at {draft.fps:.6g} fps, films of "
        f"{draft.size[0]} x {draft.size[1]}"
    )
    for note in draft.notes:
        print(note)
    print("Run:")
    print(f"  snakemake --cores 2 render_all --config {shlex.quote('scene=' + name)}")


if __name__ == "__main__":
    sys.exit(run_stage(main))
