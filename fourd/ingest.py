"""Stage `ingest`: which picture of a camera belongs to which frame of the scene.

In: a video, a folder of images or one image. Out: `ingest/{cam}.json` (docs/formats.md).

The camera's clock starts at its first frame. `offset_s` is the time of that frame on the common
clock, so scene frame k, at k / fps on the common clock, is at k / fps - offset_s on the camera's.
"""

import argparse
import dataclasses
import hashlib
import logging
import re
import sys
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd.cli import add_options, options_from_args, run_stage, set_num_threads
from fourd.errors import InputError
from fourd.io import read_image, read_json, write_json
from fourd.video import VideoInfo, VideoReader, probe_video

STAGE_VERSION = 1

IMAGE_EXTENSIONS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
CACHED_FRAMES = 4
# Of two frames that are equally near, take the earlier, whatever the last bits of their times say.
_TIE_S = 1e-6

logger = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class IngestOptions:
    """Settings of the stage (config/schemas/ingest.schema.yaml)."""

    max_dt_frames: float = 0.75
    verify: bool = True


@dataclasses.dataclass(frozen=True, eq=False)
class Source:
    """What a camera delivered.

    info: times since the first picture, s; images have their extension as codec
    start_s: the container's time of the first picture
    files: names of the images in order, none for a video;  num_bytes: all files together
    """

    info: VideoInfo
    start_s: float
    files: tuple[str, ...]
    num_bytes: int


def list_images(folder: Path) -> tuple[list[Path], np.ndarray]:
    """Images of a folder by the last number in their names, and their place in time in frames.

    Numbers may start anywhere and rise by a constant step; a missing number leaves a hole in time.
    Returns paths and (N,) float64 positions, first 0.
    Raises InputError if there is no image, a name has no number or two have the same.
    """
    files = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_EXTENSIONS and p.name[0] != "."]
    if not files:
        raise InputError(
            f"expected images ({', '.join(IMAGE_EXTENSIONS)}) in the folder {folder}, found none: check the "
            "path, or name the video file itself"
        )
    by_number: dict[int, Path] = {}
    for path in sorted(files):
        digits = re.findall(r"\d+", path.stem)
        if not digits and len(files) > 1:
            raise InputError(
                f"expected a number in the name of every image, got {path}: rename it or move it away"
            )
        number = int(digits[-1]) if digits else 0
        if number in by_number:
            raise InputError(
                f"expected one image per number in {folder}, got {by_number[number].name} and {path.name}: "
                "keep one of them"
            )
        by_number[number] = path
    numbers = np.array(sorted(by_number), dtype=np.float64)
    step = np.diff(numbers).min() if len(numbers) > 1 else 1.0
    return [by_number[int(n)] for n in numbers], (numbers - numbers[0]) / step


def probe_source(source: Path, fps: float) -> Source:
    """Probe a video, a folder of images or one image; images follow each other at `fps`.

    Raises InputError if there is nothing at the path or nothing usable.
    """
    if source.is_dir() or source.suffix.lower() in IMAGE_EXTENSIONS:
        files, positions = list_images(source) if source.is_dir() else ([source], np.zeros(1))
        height, width = read_frame_image(files[0]).shape[:2]
        codec = files[0].suffix.lower().lstrip(".")
        info = VideoInfo((width, height), 0, fps, codec, False, positions / fps, ())
        num_bytes = sum(path.stat().st_size for path in files)
        return Source(info, 0.0, tuple(path.name for path in files), num_bytes)
    info = probe_video(source)
    start_s = float(info.pts_s[0])
    relative = dataclasses.replace(info, pts_s=info.pts_s - start_s)
    return Source(relative, start_s, (), source.stat().st_size)


def match_frames(
    pts_s: np.ndarray, fps: float, num_frames: int, offset_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """For each scene frame the source frame nearest in time.

    pts_s: (N,) s since the source's first frame, rising;  fps: of the scene
    offset_s: time of the source's first frame on the common clock, s
    Returns source_frame (num_frames,) int64 and dt_s (num_frames,) float64, the time of the source
    frame minus the wanted time. Of two equally near frames the earlier is taken.
    """
    wanted = np.arange(num_frames) / fps - offset_s
    later = np.clip(np.searchsorted(pts_s, wanted), 0, len(pts_s) - 1)
    earlier = np.maximum(later - 1, 0)
    take_later = np.abs(pts_s[later] - wanted) < np.abs(pts_s[earlier] - wanted) - _TIE_S
    source_frame = np.where(take_later, later, earlier)
    return source_frame, pts_s[source_frame] - wanted


def check_match(
    camera: str, source: Path, pts_s: np.ndarray, dt_s: np.ndarray, fps: float, offset_s: float, max_dt: float
) -> None:
    """Raise InputError unless every scene frame has a source frame within max_dt scene frames."""
    num_frames = len(dt_s)
    first = int(np.ceil((offset_s + pts_s[0]) * fps - max_dt - 1e-6))
    last = int(np.floor((offset_s + pts_s[-1]) * fps + max_dt + 1e-6))
    if first > 0 or last < num_frames - 1:
        advice = f"set num_frames to {last + 1} or less" if first <= 0 <= last else "correct its offset_s"
        raise InputError(
            f"camera {camera}: expected pictures for scene frames 0..{num_frames - 1} ({fps:g} fps), but "
            f"{source}, {len(pts_s)} frames with offset_s {offset_s:g}, covers scene frames {first}..{last}: "
            f"{advice} in the scene file"
        )
    distant = np.abs(dt_s) * fps > max_dt + 1e-6
    if distant.any():
        frame = int(distant.argmax())
        raise InputError(
            f"camera {camera}: expected a picture within {max_dt:g} frames of scene frame {frame}, but the "
            f"nearest in {source} is {abs(dt_s[frame]) * fps:.2f} frames ({abs(dt_s[frame]) * 1e3:.1f} ms) "
            "away: pictures are missing there or the source's frame rate is lower, so lower fps in the scene "
            "file or raise ingest.max_dt_frames"
        )


def hash_source(source: Path, files: Sequence[str]) -> str:
    """SHA-256 of a file, or of the names and bytes of a folder's images in order."""
    digest = hashlib.sha256()
    for name in files or (source.name,):
        path = source / name if source.is_dir() else source
        if source.is_dir():
            digest.update(name.encode() + b"\0" + path.stat().st_size.to_bytes(8, "little"))
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def read_frame_image(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 RGB. Raises InputError also for a JPEG that was cut short."""
    if path.suffix.lower() in (".jpg", ".jpeg") and path.is_file() and not _has_jpeg_end(path.read_bytes()):
        raise InputError(f"expected a whole JPEG file at {path}, but its end is missing: copy it again")
    return read_image(path)


def _has_jpeg_end(data: bytes) -> bool:
    """Whether an end marker follows the picture's own data; decoders paint the rest grey without it.

    Source: ITU-T T.81, annex B (markers and their lengths).
    """
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return data.find(b"\xff\xd9", at) >= 0


class FrameReader:
    """Pictures of one camera by scene frame; cheap in rising order. Use as a context manager.

    Keeps the decoder open and the last few pictures; not to be shared between threads.
    """

    def __init__(self, document: dict[str, Any], where: Path | str) -> None:
        """document: ingest/{cam}.json;  where: its path. Raises InputError if the source changed."""
        self.camera = str(document["camera"])
        self.size = (int(document["size"][0]), int(document["size"][1]))
        self._source_frame = [int(i) for i in document["source_frame"]]
        self._source = Path(document["source"])
        self._files = tuple(document["files"])
        self._cache: OrderedDict[int, np.ndarray] = OrderedDict()
        self._check_source(int(document["num_bytes"]), where)
        self._video = None
        if document["kind"] == "video":
            given = {field.name: document[field.name] for field in dataclasses.fields(VideoInfo)}
            times = np.array(document["pts_s"], dtype=np.float64) + document["start_s"]
            info = VideoInfo(**{**given, "size": self.size, "pts_s": times})
            self._video = VideoReader(self._source, info)

    @property
    def num_frames(self) -> int:
        """Number of scene frames."""
        return len(self._source_frame)

    def __enter__(self) -> "FrameReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, frame: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB, upright, of a scene frame.

        Raises InputError outside the scene's frames or if the picture cannot be decoded.
        """
        if not 0 <= frame < self.num_frames:
            raise InputError(
                f"camera {self.camera}: expected a scene frame in 0..{self.num_frames - 1}, got {frame}: "
                "raise num_frames in the scene file"
            )
        index = self._source_frame[frame]
        if index not in self._cache:
            self._cache[index] = self._read_source(index)
            while len(self._cache) > CACHED_FRAMES:
                self._cache.popitem(last=False)
        self._cache.move_to_end(index)
        return self._cache[index].copy()

    def close(self) -> None:
        self._cache.clear()
        if self._video is not None:
            self._video.close()

    def _read_source(self, index: int) -> np.ndarray:
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


def open_camera(path: Path | str) -> FrameReader:
    """Reader of a camera's pictures from its ingest/{cam}.json.

    Raises InputError if the file is not of this stage or the source is gone or was replaced.
    """
    document = read_json(path)
    try:
        return FrameReader(document, path)
    except (KeyError, TypeError) as error:
        raise InputError(
            f"expected the output of the stage ingest in {path}, got {error!r}: delete it and run again"
        ) from None


def run(
    camera: str,
    source: Path,
    fps: float,
    num_frames: int,
    offset_s: float,
    output: Path,
    options: IngestOptions,
) -> None:
    """Write ingest/{cam}.json. Raises InputError for a source that cannot serve every scene frame."""
    if not (np.isfinite(fps) and fps > 0 and num_frames >= 1 and np.isfinite(offset_s)):
        raise InputError(
            f"camera {camera}: expected fps above 0, num_frames of 1 or more and a finite offset_s, got "
            f"{fps}, {num_frames} and {offset_s}: correct the scene file"
        )
    if not source.exists():
        raise InputError(
            f"camera {camera}: expected a video or a folder of images at {source}, found nothing: check "
            "`source` in the scene file"
        )
    probed = probe_source(source, fps)
    source_frame, dt_s = match_frames(probed.info.pts_s, fps, num_frames, offset_s)
    check_match(camera, source, probed.info.pts_s, dt_s, fps, offset_s, options.max_dt_frames)
    document = _document(camera, source, probed, source_frame, dt_s, offset_s)
    if options.verify:
        _verify_frames(document, output)
    document["sha256"] = hash_source(source, probed.files)
    write_json(output, document)
    logger.info(
        "%s: %s, %d frames of %d x %d, largest time error %.1f ms",
        camera, source, len(probed.info.pts_s), *probed.info.size, np.abs(dt_s).max() * 1e3,
    )  # fmt: skip


def _document(
    camera: str, source: Path, probed: Source, source_frame: np.ndarray, dt_s: np.ndarray, offset_s: float
) -> dict[str, Any]:
    info = probed.info
    return {
        "camera": camera,
        "source": str(source),
        "kind": "images" if probed.files else "video",
        "num_source_frames": len(info.pts_s),
        **dataclasses.asdict(info),
        "pts_s": info.pts_s.tolist(),
        "start_s": probed.start_s,
        "files": probed.files,
        "num_bytes": probed.num_bytes,
        "offset_s": offset_s,
        "source_frame": source_frame.tolist(),
        "dt_s": dt_s.tolist(),
    }


def _verify_frames(document: dict[str, Any], output: Path) -> None:
    """Decode every picture in use once, so that damage stops here and not hours later."""
    with FrameReader(document, output) as reader:
        for frame in range(reader.num_frames):
            reader.read(frame)


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of the stage."""
    parser = argparse.ArgumentParser(prog="python -m fourd.ingest", description=__doc__)
    parser.add_argument("--camera", required=True)
    parser.add_argument("--source", required=True, help="video, folder of images or image")
    parser.add_argument("--fps", type=float, required=True, help="of the scene's clock")
    parser.add_argument("--num-frames", type=int, required=True, help="of the scene")
    parser.add_argument("--offset-s", type=float, default=0.0, help="common time of the source's first frame")
    parser.add_argument("--output", type=Path, required=True)
    add_options(parser, IngestOptions)
    args = parser.parse_args(argv)
    set_num_threads(1)
    run(
        args.camera,
        Path(args.source),
        args.fps,
        args.num_frames,
        args.offset_s,
        args.output,
        options_from_args(IngestOptions, args),
    )


if __name__ == "__main__":
    sys.exit(run_stage(main))
