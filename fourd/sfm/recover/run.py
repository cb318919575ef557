"""Files of `recover`: films in, film_cameras.json out."""

import contextlib
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import pycolmap

from fourd.align.clock import read_offsets
from fourd.errors import InputError
from fourd.film_cameras import write_film_cameras
from fourd.ingest import open_source
from fourd.io import read_json
from fourd.sfm.recover.films import Film, focal_guess_px, select_frames
from fourd.sfm.recover.options import RecoverOptions
from fourd.sfm.recover.recover import recover_cameras

log = logging.getLogger(__name__)

# COLMAP writes a line per picture, and Ceres one per step that it rejects.
_ONLY_FATAL = 3


def run_recover(
    ingest_paths: Mapping[str, Path],
    heldout: Sequence[str],
    audio_path: Path | None,
    start_s: float | None,
    duration_s: float,
    scale_hint: tuple[str, str, float] | None,
    output: Path,
    options: RecoverOptions,
) -> None:
    """Recover the cameras of the films and write film_cameras.json.

    ingest_paths: ingest/{cam}.json by camera, in the scene's order;  audio_path: align/audio.json
    start_s: common time at which the scene starts, None to take it from align/audio.json
    duration_s: of the scene
    Raises InputError if the cameras cannot be recovered.
    """
    unknown = [name for name in heldout if name not in ingest_paths]
    if unknown:
        raise InputError(
            f"heldout: expected names of the scene's cameras ({', '.join(ingest_paths)}), got "
            f"{', '.join(unknown)}: correct heldout in the scene file"
        )
    pycolmap.logging.minloglevel = _ONLY_FATAL
    clocks = None if audio_path is None else read_offsets(audio_path)
    with contextlib.ExitStack() as stack:
        films = {}
        for name, path in ingest_paths.items():
            source = stack.enter_context(open_source(path))
            frames, wanted = select_frames(name, source.pts_s, clocks, start_s, duration_s, options.margin_s)
            focal_px = focal_guess_px(source.size, read_json(path).get("focal_35mm_mm"))
            films[name] = Film(name, source, frames, focal_px, wanted)
        found = recover_cameras(films, heldout, scale_hint, options)
    for note in found.notes:
        log.warning("%s", note)
    write_film_cameras(output, found)
