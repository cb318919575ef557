"""Files of the stage: the plate of a camera, or the pictures that a plate of every frame is made from."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fourd.camera import CameraTrack
from fourd.errors import InputError
from fourd.ingest import FrameReader, open_source
from fourd.io import Archive, ArchiveWriter
from fourd.silhouettes.options import SilhouetteOptions
from fourd.silhouettes.plate import MIN_SAMPLES, Plate, estimate_plate, turned_plate
from fourd.silhouettes.segment import find_unrest
from fourd.views import spread


def read_background_film(path: Path, size: tuple[int, int], num_samples: int) -> list[np.ndarray]:
    """Pictures of the empty scene from ingest/{cam}.json of that film.

    Raises InputError if they are not of the camera's size.
    """
    with open_source(path) as reader:
        if reader.size != size:
            raise InputError(
                f"camera {reader.camera}: expected the film of the empty scene in {path} at {size[0]} x "
                f"{size[1]} like the camera's own, got {reader.size[0]} x {reader.size[1]}: film it anew "
                "with the same settings, or leave it out"
            )
        return [reader.read(frame) for frame in spread(range(reader.num_frames), num_samples)]


def write_plate(
    path: Path,
    film: FrameReader,
    track: CameraTrack,
    background_film: Path | None,
    options: SilhouetteOptions,
) -> None:
    """Write silhouettes/{cam}/plate.npz.

    Raises InputError for a film of the empty scene given to a camera that moves.
    """
    frames = spread(range(film.num_frames), options.num_samples)
    meta = {"camera": film.camera, "status": "ok", "made_from": "own frames", "frames": frames}
    if background_film is not None and not track.is_static:
        raise InputError(
            f"camera {film.camera}: expected a camera that stands still for the film of the empty scene "
            f"{background_film}, got one that moves: leave that film out"
        )
    if background_film is not None:
        meta |= {"made_from": "film of the empty scene", "frames": []}
    elif len(frames) < MIN_SAMPLES:
        meta["status"] = f"no background: a plate takes {MIN_SAMPLES} pictures, got {len(frames)}"
    with ArchiveWriter(path, meta) as writer:
        if meta["status"] != "ok":
            return
        if background_film is None and not track.is_static:
            for frame in frames:
                writer.add_frame(frame, rgb=film.read(frame))
            return
        images = (
            [film.read(frame) for frame in frames]
            if background_film is None
            else read_background_film(background_film, film.size, options.num_samples)
        )
        plate = estimate_plate(images, options.jitter_px)
        writer.add("rgb", plate.rgb)
        writer.add("sigma", plate.sigma)
        writer.add("known", plate.known)
        if background_film is None:
            writer.add("unrest", find_unrest(images, plate, options))


def write_empty(path: Path, camera: str, status: str) -> None:
    """Write a plate or a chunk without arrays, and why."""
    with ArchiveWriter(path, {"camera": camera, "status": status}):
        pass


class Plates:
    """Plate of a camera at every scene frame."""

    def __init__(self, archive: Archive, track: CameraTrack, jitter_px: float) -> None:
        """archive: silhouettes/{cam}/plate.npz with status `ok`"""
        self._track, self._jitter_px = track, jitter_px
        self._frames = archive.frames()
        self._images: Sequence[np.ndarray] = [archive[f"{frame:06d}/rgb"] for frame in self._frames]
        self._plate = None
        if not self._frames:
            keys = ("rgb", "sigma", "known", "unrest")
            self._plate = Plate(*(archive[key] for key in keys if key in archive))

    def at(self, frame: int) -> Plate:
        """The plate as the camera sees it at a scene frame."""
        if self._plate is not None:
            return self._plate
        cameras = [self._track.at(f) for f in self._frames]
        return turned_plate(self._images, cameras, self._track.at(frame), self._jitter_px)
