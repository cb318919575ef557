"""Files of `recover`: films in, film_cameras.json out."""

import contextlib
import dataclasses
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from fourd.align.clock import read_offsets
from fourd.align.sampling import find_too_short
from fourd.errors import InputError
from fourd.film_cameras import FilmCamera, write_film_cameras
from fourd.ingest import open_source, read_ingest
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
    fps: float,
    num_frames: int,
    scale_hint: tuple[str, str, float] | None,
    output: Path,
    options: RecoverOptions,
) -> None:
    """Recover the cameras of the films and write film_cameras.json.

    ingest_paths: ingest/{cam}.json by camera, in the scene's order;  audio_path: align/audio.json
    start_s: common time at which the scene starts, None to take it from align/audio.json
    fps, num_frames: of the scene. A film that is too short for it is not looked at.
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
    documents = {name: read_ingest(path) for name, path in ingest_paths.items()}
    pts = {name: np.array(document["pts_s"], dtype=np.float64) for name, document in documents.items()}
    left_out = find_too_short(pts, [name for name in ingest_paths if name not in heldout], fps, num_frames)
    with contextlib.ExitStack() as stack:
        films: dict[str, Film] = {}
        unused: dict[str, FilmCamera] = {}
        first_with: dict[str, str] = {}
        # Held-out films last: of two equal ones the input is the original.
        for name in sorted(ingest_paths, key=lambda name: name in heldout):
            document = documents[name]
            original = first_with.setdefault(document["sha256"], name)
            if original != name:
                left_out.setdefault(name, f"same recording as {original}: no second view of anything")
            if name in left_out:
                size = (int(document["size"][0]), int(document["size"][1]))
                unused[name] = FilmCamera(name, size, np.zeros(0, np.int64), (), status=left_out[name])
                continue
            source = stack.enter_context(open_source(ingest_paths[name]))
            frames, wanted = select_frames(
                name, source.pts_s, clocks, start_s, num_frames / fps, options.margin_s
            )
            focal_px = focal_guess_px(source.size, document.get("focal_35mm_mm"))
            films[name] = Film(name, source, frames, focal_px, wanted)
        given = {name: films[name] for name in ingest_paths if name in films}
        found = recover_cameras(given, [n for n in heldout if n in films], scale_hint, options)
    cameras = {name: unused.get(name) or found.cameras[name] for name in ingest_paths}
    found = dataclasses.replace(found, cameras=cameras)
    for note in found.notes:
        log.warning("%s", note)
    write_film_cameras(output, found)
