"""What a camera delivered: a video, a folder of numbered images or one image."""

import dataclasses
import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

from fourd.audio import probe_audio
from fourd.errors import InputError
from fourd.io import read_image
from fourd.video import VideoInfo, probe_video

IMAGE_EXTENSIONS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


@dataclasses.dataclass(frozen=True, eq=False)
class Source:
    """What a camera delivered.

    info: times since the first picture, s; images have their extension as codec
    start_s: the container's time of the first picture
    files: names of the images in order, none for a video;  num_bytes: all files together
    audio_start_s: time of the first sound sample since the first picture, s, None without sound
    """

    info: VideoInfo
    start_s: float
    files: tuple[str, ...]
    num_bytes: int
    audio_start_s: float | None = None
    audio_duration_s: float | None = None


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


def probe_source(source: Path, fps: float | None, square_pixels: bool = True) -> Source:
    """Probe a video, a folder of images or one image.

    fps: at which images follow each other; videos have times of their own
    Raises InputError if there is nothing at the path or nothing usable, or images have no fps.
    """
    if not source.exists():
        raise InputError(
            f"expected a video or a folder of images at {source}, found nothing: check `source` in the "
            "scene file"
        )
    if source.is_dir() or source.suffix.lower() in IMAGE_EXTENSIONS:
        return _probe_images(source, fps)
    info = probe_video(source, square_pixels)
    start_s = float(info.pts_s[0])
    relative = dataclasses.replace(info, pts_s=info.pts_s - start_s)
    sound = probe_audio(source)
    audio = (None, None) if sound is None else (sound.start_s, sound.duration_s)
    return Source(relative, start_s, (), source.stat().st_size, *audio)


def _probe_images(source: Path, fps: float | None) -> Source:
    if fps is None or not (np.isfinite(fps) and fps > 0):
        raise InputError(
            f"expected fps above 0 for the images of {source}, got {fps}: set `fps` in the scene file"
        )
    files, positions = list_images(source) if source.is_dir() else ([source], np.zeros(1))
    height, width = read_frame_image(files[0]).shape[:2]
    focal_35mm_mm, make, model = _read_exif(files[0])
    info = VideoInfo(
        size=(width, height),
        rotation_deg=0,
        fps=fps,
        codec=files[0].suffix.lower().lstrip("."),
        has_audio=False,
        pts_s=positions / fps,
        keyframes=(),
        stored_size=(width, height),
        focal_35mm_mm=focal_35mm_mm,
        make=make,
        model=model,
    )
    num_bytes = sum(path.stat().st_size for path in files)
    return Source(info, 0.0, tuple(path.name for path in files), num_bytes)


def _read_exif(path: Path) -> tuple[float | None, str | None, str | None]:
    """Focal length for a 36 x 24 mm picture, make and model, each None where the file does not tell."""
    try:
        with Image.open(path) as image:
            exif = image.getexif()
    except (UnidentifiedImageError, OSError, SyntaxError):
        # Metadata that cannot be read tells nothing; the picture itself is judged by its decoder.
        return None, None, None
    focal = exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLengthIn35mmFilm)
    make, model = (str(exif.get(tag, "")).strip("\0 ") for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    return float(focal) if isinstance(focal, int) and focal > 0 else None, make or None, model or None


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
