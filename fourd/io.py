"""Every file format of the workflow: one reader and one writer each. Nothing else opens files.

A writer writes beside the final name, flushes to disk and renames, so a file under its final
name is always whole. Every file carries `schema_version`.
"""

import contextlib
import csv
import json
import math
import os
import re
import shutil
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fourd.errors import InputError

SCHEMA_VERSION = 1
# A picture of some kilobytes can unpack to gigabytes. OpenCV reads these when it opens its first picture.
MAX_IMAGE_SIDE_PX = 16384
MAX_IMAGE_PIXELS = 2**27
for _limit, _value in {
    "WIDTH": MAX_IMAGE_SIDE_PX,
    "HEIGHT": MAX_IMAGE_SIDE_PX,
    "PIXELS": MAX_IMAGE_PIXELS,
}.items():
    os.environ.setdefault(f"OPENCV_IO_MAX_IMAGE_{_limit}", str(_value))


@contextlib.contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` when the block succeeds.

    Raises OSError with `filename` set to the final path when the disk is full.
    """
    final = Path(path)
    final.parent.mkdir(parents=True, exist_ok=True)
    # The suffix stays last because image writers choose the format by it.
    temporary = final.with_name(f".{final.stem}.tmp{os.getpid()}{final.suffix}")
    try:
        yield temporary
        with temporary.open("rb") as handle:
            os.fsync(handle.fileno())
        temporary.replace(final)
        _remove_leftovers(final)
    except OSError as error:
        if error.filename in (None, str(temporary)):
            error.filename = str(final)
        raise
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_folder(path: Path | str) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; it takes the place of `path` when the block succeeds."""
    final = Path(path)
    final.parent.mkdir(parents=True, exist_ok=True)
    temporary = final.with_name(f".{final.name}.tmp{os.getpid()}")
    temporary.mkdir()
    try:
        yield temporary
        if final.exists():
            shutil.rmtree(final)
        temporary.replace(final)
        _remove_leftovers(final)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _remove_leftovers(final: Path) -> None:
    """Remove what killed jobs left beside a finished file or folder.

    Afterwards, as a job whose engine was killed may live on and still be writing its own.
    """
    stem, name, suffix = map(re.escape, (final.stem, final.name, final.suffix))
    is_left = re.compile(rf"\.({stem}\.tmp\d*{suffix}|{name}\.tmp\d*)").fullmatch
    for path in final.parent.iterdir():
        if is_left(path.name):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def write_text(path: Path | str, text: str) -> None:
    """Write UTF-8 text atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path | str, document: Mapping[str, Any]) -> None:
    """Write a JSON object with `schema_version`. Raises InputError for NaN and infinity (not JSON)."""
    body = {"schema_version": SCHEMA_VERSION, **document}
    write_text(path, json_text(body, path, indent=1) + "\n")


def json_text(document: Any, path: Path | str, **style: Any) -> str:
    """A document as JSON. path: of the file that it is for;  style: of `json.dumps`

    Raises InputError, naming the place, for NaN and infinity.
    """
    try:
        return json.dumps(document, allow_nan=False, **style)
    except ValueError:
        for place, value in _numbers_of(document, ""):
            if not math.isfinite(value):
                raise InputError(
                    f"expected finite numbers to write to {path}, got {value} for {place}: what this job "
                    "read does not determine it, check its inputs"
                ) from None
        raise


def _numbers_of(document: Any, place: str) -> Iterator[tuple[str, float]]:
    if isinstance(document, float):
        yield place, document
    elif isinstance(document, Mapping):
        for key, value in document.items():
            yield from _numbers_of(value, f"{place}.{key}" if place else str(key))
    elif isinstance(document, list | tuple):
        for i, value in enumerate(document):
            yield from _numbers_of(value, f"{place}[{i}]")


def read_json(path: Path | str) -> dict[str, Any]:
    """Read a JSON object. Raises InputError if the file is missing or is not a JSON object."""
    source = Path(path)
    if not source.is_file():
        raise InputError(f"expected a JSON file at {source}, found nothing: check the path")
    try:
        document = json.loads(source.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"expected JSON in {source}, got: {error}; write the file anew, or delete it and run again if "
            "the workflow made it"
        ) from None
    if not isinstance(document, dict):
        raise InputError(f"expected a JSON object in {source}, got a {type(document).__name__}")
    return document


def read_document(path: Path | str) -> dict[str, Any]:
    """A JSON object that this version of the workflow wrote. Raises InputError as `read_json`, or if not."""
    document = read_json(path)
    if document.get("schema_version") != SCHEMA_VERSION:
        raise InputError(
            f"{path}: expected schema_version {SCHEMA_VERSION}, got {document.get('schema_version')}: "
            "delete the file and run again"
        )
    return document


def write_csv(path: Path | str, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows of a table with a header line."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read_csv(path: Path | str) -> list[dict[str, str]]:
    """Rows of a CSV table as dictionaries of strings. Raises InputError for a table that was cut off."""
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file, strict=True))
    except (csv.Error, UnicodeDecodeError) as error:
        raise InputError(f"expected a table in {path}, got: {error}; delete it and run again") from None
    for number, row in enumerate(rows, start=1):
        if None in row or None in row.values():
            raise InputError(
                f"expected as many values as columns in row {number} of {path}, got others: the table is cut "
                "off or damaged, delete it and run again"
            )
    return rows


class ArchiveWriter:
    """A stored (uncompressed) .npz that is written one array at a time.

    Memory is one array, not the archive. Member `000012/depth` is written as
    `000012/depth.npy`, so `numpy.load` reads the file too. Use as a context manager: the file
    appears under its name when the block ends without an exception.
    """

    def __init__(self, path: Path | str, meta: Mapping[str, Any] | None = None) -> None:
        self._path = Path(path)
        self._meta = {"schema_version": SCHEMA_VERSION, **(meta or {})}

    def __enter__(self) -> "ArchiveWriter":
        self._context = atomic_path(self._path)
        self._temporary = self._context.__enter__()
        self._zip = zipfile.ZipFile(self._temporary, "w", zipfile.ZIP_STORED, allowZip64=True)
        return self

    def add(self, name: str, array: np.ndarray) -> None:
        """Append one array under `name`. Time stamps are fixed: same arrays, same bytes."""
        info = zipfile.ZipInfo(name + ".npy", date_time=(1980, 1, 1, 0, 0, 0))
        with self._zip.open(info, "w", force_zip64=True) as member:
            np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)

    def add_frame(self, frame: int, **arrays: np.ndarray) -> None:
        """Append the arrays of one frame as `{frame:06d}/{key}`."""
        for key, array in arrays.items():
            self.add(f"{frame:06d}/{key}", array)

    def __exit__(self, kind: Any, value: Any, traceback: Any) -> None:
        if kind is not None:
            # After a failed write (disk full) closing fails again; the first error is the cause.
            with contextlib.suppress(OSError):
                self._zip.close()
            self._context.__exit__(kind, value, traceback)
            return
        with contextlib.ExitStack() as stack:
            stack.push(self._context)
            text = json_text(self._meta, self._path)
            self.add("meta", np.frombuffer(text.encode(), dtype=np.uint8))
            self._zip.close()


class Archive:
    """Reader of an `ArchiveWriter` file; arrays are read when asked for. May be a context manager."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        try:
            self._zip = zipfile.ZipFile(self.path)
            self.meta: dict[str, Any] = json.loads(self["meta"].tobytes())
            if not isinstance(self.meta, dict) or self.meta.get("schema_version") != SCHEMA_VERSION:
                raise ValueError(f"a meta that is not of schema_version {SCHEMA_VERSION}")
        except (zipfile.BadZipFile, KeyError, OSError, ValueError) as error:
            raise InputError(
                f"expected a whole archive of this workflow at {self.path}, got: {error}; "
                "delete the file and run again"
            ) from None
        self._names = {name.removesuffix(".npy") for name in self._zip.namelist()}

    def __enter__(self) -> "Archive":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getitem__(self, name: str) -> np.ndarray:
        """One array. Raises KeyError if there is none of that name, InputError if its bytes are damaged."""
        try:
            with self._zip.open(name + ".npy") as member:
                return np.lib.format.read_array(member, allow_pickle=False)
        except (zipfile.BadZipFile, ValueError, EOFError) as error:
            raise InputError(
                f"{self.path}: the bytes of {name} are damaged ({error}); delete the file and run again"
            ) from None

    def read(self, name: str, dtype: Any, shape: Sequence[int | None]) -> np.ndarray:
        """One array of a known form.

        shape: None is any length but 0
        Raises InputError if there is none of that name, or it is of another type or shape.
        """
        if name not in self:
            raise InputError(f"expected {name} in {self.path}, found none: delete the file and run again")
        array = self[name]
        fits = len(array.shape) == len(shape) and all(
            given == wanted or (wanted is None and given > 0)
            for given, wanted in zip(array.shape, shape, strict=True)
        )
        if not fits or array.dtype != np.dtype(dtype):
            raise InputError(
                f"expected {name} of type {np.dtype(dtype)} and shape {tuple(shape)} in {self.path}, got "
                f"{array.dtype} {array.shape}: delete the file and run again"
            )
        return array

    def __contains__(self, name: str) -> bool:
        return name in self._names

    def frames(self) -> list[int]:
        """Sorted frame numbers that have at least one array."""
        return sorted({int(n.split("/")[0]) for n in self._names if "/" in n})

    def frame(self, frame: int) -> dict[str, np.ndarray]:
        """All arrays of one frame, by key. Raises KeyError if the frame is not in the file."""
        prefix = f"{frame:06d}/"
        names = sorted(n for n in self._names if n.startswith(prefix))
        if not names:
            raise KeyError(f"frame {frame} is not in {self.path}")
        return {name.removeprefix(prefix): self[name] for name in names}

    def close(self) -> None:
        self._zip.close()


def read_image(path: Path | str) -> np.ndarray:
    """(H, W, 3) uint8, RGB, display-referred (sRGB). Raises InputError if it cannot be decoded."""
    source = Path(path)
    if not source.is_file():
        raise InputError(f"expected an image at {source}, found nothing: check the path")
    try:
        image = cv2.imread(str(source), cv2.IMREAD_COLOR)
    except cv2.error:
        raise InputError(
            f"expected an image of at most {MAX_IMAGE_SIDE_PX} px a side and {MAX_IMAGE_PIXELS} px in all at "
            f"{source}, got a larger one: resize it"
        ) from None
    if image is None:
        raise InputError(f"expected an image that can be decoded at {source}: replace the file")
    return np.ascontiguousarray(image[:, :, ::-1])


def write_png(path: Path | str, image: np.ndarray) -> None:
    """Write (H, W, 3) uint8 RGB or (H, W) uint8 atomically as PNG."""
    array = image[:, :, ::-1] if image.ndim == 3 else image
    # Encoded in memory: OpenCV's file writer reports a full disk as a silent False.
    done, data = cv2.imencode(".png", np.ascontiguousarray(array))
    if not done:
        raise ValueError(f"cannot encode an array of shape {image.shape} as PNG for {path}")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())
