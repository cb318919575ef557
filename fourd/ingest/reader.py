"""Pictures of a camera: by its own frames (`open_source`) and by the scene's (`open_camera`)."""

import dataclasses
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fourd.errors import InputError, explain_faults
from fourd.image import apply_difference
from fourd.ingest.source import read_frame_image
from fourd.io import Archive, read_json
from fourd.tone import apply_tone, table_at
from fourd.video import VideoInfo, VideoReader

CACHED_FRAMES = 4


class SourceReader:
    """Pictures of one camera by source frame; cheap in rising order. Use as a context manager.

    Keeps the decoder open and the last few pictures; not to be shared between threads.
    """

    def __init__(self, document: Mapping[str, Any], where: Path | str) -> None:
        """document: ingest/{cam}.json;  where: its path. Raises InputError if the source changed."""
        self.camera = str(document["camera"])
        self.size = (int(document["size"][0]), int(document["size"][1]))
        self.fps = float(document["fps"])
        self.pts_s = np.array(document["pts_s"], dtype=np.float64)
        self._source = Path(document["source"])
        self._files = tuple(document["files"])
        self._cache: OrderedDict[int, np.ndarray] = OrderedDict()
        self._check_source(int(document["num_bytes"]), where)
        self._video = None
        if document["kind"] == "video":
            given = {field.name: document[field.name] for field in dataclasses.fields(VideoInfo)}
            times = self.pts_s + document["start_s"]
            stored_size = tuple(document["stored_size"])
            info = VideoInfo(**{**given, "size": self.size, "stored_size": stored_size, "pts_s": times})
            self._video = VideoReader(self._source, info)

    @property
    def num_frames(self) -> int:
        """Number of source frames."""
        return len(self.pts_s)

    def __enter__(self) -> "SourceReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, source_frame: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB, as displayed, of a source frame.

        Raises InputError outside the film or if the picture cannot be decoded.
        """
        if not 0 <= source_frame < self.num_frames:
            raise InputError(
                f"camera {self.camera}: expected a frame of {self._source} in 0..{self.num_frames - 1}, got "
                f"{source_frame}: the film is shorter than what was asked for"
            )
        if source_frame not in self._cache:
            self._cache[source_frame] = self._read(source_frame)
            while len(self._cache) > CACHED_FRAMES:
                self._cache.popitem(last=False)
        self._cache.move_to_end(source_frame)
        return self._cache[source_frame].copy()

    def read_luma(self, source_frame: int, step: int) -> np.ndarray:
        """Every step-th pixel of a stored frame's luma (of images: green), (h, w) float32, 8-bit levels."""
        if self._video is not None:
            return self._video.read_luma(source_frame, step)
        return self._read(source_frame)[::step, ::step, 1].astype(np.float32)

    def close(self) -> None:
        """Let go of the decoder and the kept pictures."""
        self._cache.clear()
        if self._video is not None:
            self._video.close()

    def _read(self, index: int) -> np.ndarray:
        if self._video is not None:
            return self._video.read(index)
        path = self._source / self._files[index] if self._source.is_dir() else self._source
        image = read_frame_image(path)
        if (image.shape[1], image.shape[0]) != self.size:
            raise InputError(
                f"camera {self.camera}: expected every image to be {self.size[0]} x {self.size[1]} like the "
                f"first, {path} is {image.shape[1]} x {image.shape[0]}: replace the image"
            )
        return image

    def _check_source(self, num_bytes: int, where: Path | str) -> None:
        paths = [self._source / name for name in self._files] if self._source.is_dir() else [self._source]
        missing = next((path for path in paths if not path.is_file()), None)
        if missing is not None:
            raise InputError(
                f"camera {self.camera}: expected the source {missing} that {where} was made from, found "
                "nothing: put it back or correct the scene file"
            )
        found = sum(path.stat().st_size for path in paths)
        if found != num_bytes:
            raise InputError(
                f"camera {self.camera}: expected {num_bytes} bytes in {self._source} as when {where} was "
                f"made, got {found}: the source was replaced, delete {where} and run again"
            )


class FrameReader:
    """Pictures of one camera by scene frame; cheap in rising order. Use as a context manager.

    Not to be shared between threads.
    """

    def __init__(
        self, document: Mapping[str, Any], where: Path | str, archive: Archive | None = None
    ) -> None:
        """document: a film on the common clock;  where: its path;  archive: what motion changed in it

        Raises InputError if the source changed.
        """
        check_film(document)
        self._source = SourceReader(document["ingest"], where)
        self.camera = self._source.camera
        self.size = self._source.size
        self.status = str(document["status"])
        self._where = where
        self._source_frame = [int(i) for i in document["source_frame"]]
        self._dt_s = [float(dt) for dt in document["dt_s"]]
        self._archive = archive
        self._tone = document.get("tone")

    @property
    def num_frames(self) -> int:
        """Number of scene frames; none of a camera that is left out."""
        return len(self._source_frame)

    def __enter__(self) -> "FrameReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def source_frame(self, frame: int) -> int:
        """The film's own frame that a scene frame shows."""
        self._check_frame(frame)
        return self._source_frame[frame]

    def dt_s(self, frame: int) -> float:
        """Common time of the picture of a scene frame minus the frame's time, s."""
        self._check_frame(frame)
        return self._dt_s[frame]

    def read(self, frame: int, is_raw: bool = False, is_compensated: bool = True) -> np.ndarray:
        """(H, W, 3) uint8 RGB, as displayed, of a scene frame.

        What moves is brought to the frame's time and colours to those of the scene, as the document
        says; is_raw leaves the camera's picture as it is, is_compensated=False what moves where it was.
        Raises InputError for a camera that is left out, outside the scene's frames, or if the picture
        cannot be decoded.
        """
        self._check_frame(frame)
        image = self._source.read(self._source_frame[frame])
        if is_raw:
            return image
        if is_compensated and self._archive is not None and f"{frame:06d}/where" in self._archive:
            image = apply_difference(image, **self._archive.frame(frame))
        table = table_at(self._tone, frame)
        return image if table is None else apply_tone(image, table)

    def close(self) -> None:
        """Let go of the decoder and the kept pictures."""
        self._source.close()
        if self._archive is not None:
            self._archive.close()

    def _check_frame(self, frame: int) -> None:
        if self.status != "ok":
            raise InputError(
                f"camera {self.camera}: expected a camera that takes part, but {self._where} says: "
                f"{self.status}"
            )
        if not 0 <= frame < self.num_frames:
            raise InputError(
                f"camera {self.camera}: expected a scene frame in 0..{self.num_frames - 1}, got {frame}: "
                "raise num_frames in the scene file"
            )


def read_ingest(path: Path | str) -> dict[str, Any]:
    """ingest/{cam}.json, checked. Raises InputError, naming the file."""
    document = read_json(path)
    with explain_faults(f"the output of the stage ingest in {path}"):
        _check_ingest(document)
    return document


def _check_ingest(document: Mapping[str, Any]) -> None:
    """Raise what `explain_faults` explains for a document that its readers could not rely on."""
    size, pts_s = [int(n) for n in document["size"]], np.array(document["pts_s"], dtype=np.float64)
    if len(size) != 2 or min(size) < 1 or len(document["pts_s"]) != int(document["num_source_frames"]):
        raise ValueError(f"size {size} and {len(pts_s)} times of {document['num_source_frames']} frames")
    if pts_s.ndim != 1 or len(pts_s) == 0 or not np.isfinite(pts_s).all() or (np.diff(pts_s) <= 0).any():
        raise ValueError("times pts_s of the frames that do not rise")
    words = {key: document[key] for key in ("camera", "source", "sha256")}
    unsaid = [key for key, word in words.items() if not isinstance(word, str) or not word]
    if unsaid or document["kind"] not in ("video", "images") or not isinstance(document["files"], list):
        raise ValueError(f"kind {document['kind']!r}, and no text as {unsaid}")


def check_film(document: Mapping[str, Any]) -> None:
    """Raise what `explain_faults` explains unless this is a film on the common clock (docs/formats.md)."""
    _check_ingest(document["ingest"])
    num_source_frames = len(document["ingest"]["pts_s"])
    frames, dt_s = document["source_frame"], np.array(document["dt_s"], dtype=np.float64)
    if len(frames) != len(dt_s) or not all(type(i) is int and 0 <= i < num_source_frames for i in frames):
        raise ValueError(f"{len(frames)} frames of {num_source_frames} and {len(dt_s)} times")
    if dt_s.ndim != 1 or not np.isfinite(dt_s).all() or not isinstance(document["status"], str):
        raise ValueError(f"status {document['status']!r} and times that are no numbers")


def open_source(path: Path | str) -> SourceReader:
    """Reader of a camera's own pictures from ingest/{cam}.json.

    Raises InputError if the file is not of this stage or the source is gone or was replaced.
    """
    document = read_ingest(path)
    with explain_faults(f"the output of the stage ingest in {path}"):
        return SourceReader(document, path)


def open_camera(path: Path | str) -> FrameReader:
    """Reader of a camera's pictures by scene frame, from frames/cameras/{cam}.npz (what moves is brought
    to the frame's time) or align/cameras/{cam}.json (pictures as they are).

    Raises InputError if the file is not of these stages or the source is gone or was replaced.
    """
    with explain_faults(f"the output of the stage frames or align in {path}"):
        if Path(path).suffix != ".npz":
            return FrameReader(read_json(path), path)
        archive = Archive(path)
        return FrameReader(archive.meta, path, archive)
