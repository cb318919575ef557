"""Is a binary COLMAP model whole? pycolmap reads past the end of a cut file, for minutes."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from fourd.errors import InputError

# Number of parameters of camera models 0, 1, 2 ... Source: COLMAP, src/colmap/sensor/models.h.
NUM_PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)

MAX_NAME_LENGTH = 4096


class _Cut(Exception):
    """The file ends within a record."""


def check_binary_model(folder: Path) -> None:
    """Raise InputError if cameras.bin, images.bin or points3D.bin ends too early or too late.

    Files that are not there are passed over.
    Source: COLMAP, src/colmap/scene/reconstruction_io_binary.cc.
    """
    skippers = {"cameras.bin": _skip_camera, "images.bin": _skip_image, "points3D.bin": _skip_point}
    for name, skip in skippers.items():
        path = folder / name
        if path.is_file() and not _is_whole(path, skip):
            raise InputError(
                f"expected a whole COLMAP model in {folder}, but {name} ({path.stat().st_size} bytes) does "
                "not end where its records do: export or copy the model again"
            )


def _is_whole(path: Path, skip_record: Callable[[BinaryIO], None]) -> bool:
    size = path.stat().st_size
    with path.open("rb") as file:
        try:
            for _ in range(_read(file, "<Q")):
                skip_record(file)
                if file.tell() > size:
                    return False
        except _Cut:
            return False
        return file.tell() == size


def _read(file: BinaryIO, layout: str) -> int:
    data = file.read(struct.calcsize(layout))
    if len(data) < struct.calcsize(layout):
        raise _Cut
    return struct.unpack(layout, data)[-1]


def _skip_camera(file: BinaryIO) -> None:
    model_id = _read(file, "<Ii")
    if not 0 <= model_id < len(NUM_PARAMETERS):
        raise InputError(
            f"{file.name}: expected a camera model number below {len(NUM_PARAMETERS)}, got {model_id}: the "
            "file is damaged, or newer than this program"
        )
    file.seek(16 + 8 * NUM_PARAMETERS[model_id], 1)


def _skip_image(file: BinaryIO) -> None:
    _read(file, "<I7dI")
    for _ in range(MAX_NAME_LENGTH):
        if _read(file, "<B") == 0:
            file.seek(24 * _read(file, "<Q"), 1)
            return
    raise _Cut


def _skip_point(file: BinaryIO) -> None:
    file.seek(8 * _read(file, "<Q3d3BdQ"), 1)
