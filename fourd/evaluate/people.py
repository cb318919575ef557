"""Bodies fitted to the people in the inputs, once for all held-out cameras: they share their moments.

The archive `evaluate/people.npz` has per scene frame `fits`, (N, P) float64 parameters of the body
(`fourd.baselines.humans.body`), and in its meta `status`: `ok`, or why nobody was looked for.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fourd.baselines.humans import NO_MODELS, load_models, missing_models
from fourd.camera import Camera
from fourd.errors import InputError
from fourd.image import undistort
from fourd.ingest import FrameReader, open_camera
from fourd.io import Archive, ArchiveWriter
from fourd.render import with_progress
from fourd.sfm import SceneCameras, read_cameras
from fourd.views import physical_view, read_view

OK = "ok"
HOW_TO_MAKE = "nobody was looked for: run `python -m fourd.evaluate people` and give --people"


def see_input(
    reader: FrameReader, scene: SceneCameras, name: str, scene_frame: int, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, Camera]:
    """(h, w, 3) uint8 picture of an input camera, (h, w) bool where it looked, and its ideal pinhole.

    reader: of its film;  size: (w, h) of the held-out view
    """
    camera = physical_view(scene, name, [scene_frame], size).frames[0].camera
    image = reader.read(scene_frame, is_compensated=True)
    return *undistort(image, scene.tracks[name].at(scene_frame), camera), camera


def run_people(
    views: Sequence[Path], cameras: Path, films: Mapping[str, Path], humans: str, output: Path
) -> None:
    """Fit the people of every moment that a held-out camera is scored at.

    views: of the held-out cameras, of one size;  films: by input camera;  humans: folder of the models.
    Without models the archive says so. Raises InputError.
    """
    scene = read_cameras(cameras)
    heldout = [view for view in map(read_view, views) if view.frames]
    sizes = {view.size for view in heldout}
    if len(sizes) > 1:
        raise InputError(f"expected held-out views of one size, got {sorted(sizes)}: place them again")
    missing = [name for name in scene.inputs if name not in films]
    if missing:
        raise InputError(f"expected camera {missing[0]} in --films, got {', '.join(films)}: add it")
    frames = sorted({entry.scene_frame for view in heldout for entry in view.frames})
    reason = missing_models(humans)
    with ArchiveWriter(output, {"status": reason or OK}) as writer:
        if reason is not None or not frames:
            return
        models = load_models(humans)
        readers = {name: open_camera(films[name]) for name in scene.inputs}
        try:
            for frame in with_progress(frames, "people"):
                seen = {name: see_input(r, scene, name, frame, *sizes) for name, r in readers.items()}
                fits = models.fit_people({name: (image, camera) for name, (image, _, camera) in seen.items()})
                writer.add_frame(frame, fits=fits)
        finally:
            for reader in readers.values():
                reader.close()


def read_people(path: Path | None, humans: str) -> tuple[dict[int, np.ndarray], str]:
    """Fits by scene frame, and why there are none; the reason is empty where people were looked for.

    path: of `run_people`, None where it was not asked for. Raises InputError for another file.
    """
    if path is None:
        return {}, HOW_TO_MAKE if humans else NO_MODELS
    archive = Archive(path)
    try:
        if archive.meta.get("status") != OK:
            return {}, str(archive.meta.get("status"))
        return {frame: archive.frame(frame)["fits"] for frame in archive.frames()}, ""
    finally:
        archive.close()
