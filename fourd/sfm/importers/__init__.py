"""Known cameras from the formats that people have: one small adapter per format.

Each adapter is `read(path) -> ImportedCameras`; it converts to our axes and pixel centres once and
leaves the world as the file has it.
"""

import json
from pathlib import Path

import numpy as np

from fourd.errors import InputError
from fourd.sfm.importers.colmap import read_colmap
from fourd.sfm.importers.imported import DepthBounds, ImportedCameras
from fourd.sfm.importers.llff import read_llff
from fourd.sfm.importers.native import read_native
from fourd.sfm.importers.nerfstudio import read_nerfstudio

READERS = {
    "fourd": read_native,
    "colmap": read_colmap,
    "nerfstudio": read_nerfstudio,
    "llff": read_llff,
}
FORMATS = ("auto", *READERS)

__all__ = ["FORMATS", "READERS", "DepthBounds", "ImportedCameras", "detect_format", "read_calibration"]

_DESCRIPTIONS = (
    "fourd (JSON with `cameras`), colmap (folder with cameras, images and points3D as .bin or .txt), "
    "nerfstudio (transforms.json) or llff (poses_bounds.npy)"
)
_FILES_OF_FOLDER = ("transforms.json", "poses_bounds.npy", "cameras.json")
_MODEL_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0")


def read_calibration(path: Path | str, calibration_format: str = "auto") -> ImportedCameras:
    """Read one calibration file or folder.

    calibration_format: one of FORMATS; `auto` decides by the content
    Raises InputError if nothing is there, no format fits, or the reader refuses.
    """
    given = Path(path)
    if not given.exists():
        raise InputError(f"expected a calibration at {given}, found nothing: check the path")
    if calibration_format == "auto":
        calibration_format, given = detect_format(given)
    elif calibration_format not in READERS:
        raise InputError(f"expected a calibration format of {', '.join(FORMATS)}, got {calibration_format!r}")
    elif calibration_format == "colmap":
        given = _find_model(given) or given
    elif given.is_dir():
        raise InputError(f"expected a file in format {calibration_format}, got the folder {given}")
    return READERS[calibration_format](given)


def detect_format(path: Path) -> tuple[str, Path]:
    """Format by content, and the file or folder that its reader wants. Raises InputError."""
    model = _find_model(path)
    if model is not None:
        return "colmap", model
    if path.is_dir():
        for name in _FILES_OF_FOLDER:
            if (path / name).is_file():
                return detect_format(path / name)
        raise InputError(f"expected a calibration in folder {path}, found none of {_DESCRIPTIONS}")
    with path.open("rb") as file:
        magic = file.read(len(np.lib.format.MAGIC_PREFIX))
    if magic == np.lib.format.MAGIC_PREFIX:
        return "llff", path
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError):
        document = None
    if isinstance(document, dict) and isinstance(document.get("cameras"), dict):
        return "fourd", path
    if isinstance(document, dict) and isinstance(document.get("frames"), list):
        return "nerfstudio", path
    raise InputError(f"{path}: the format of this calibration is not known; expected {_DESCRIPTIONS}")


def _find_model(path: Path) -> Path | None:
    """Folder of the COLMAP model at, around (for a file of the model) or below `path`."""
    if path.is_file():
        is_part = path.stem in ("cameras", "images", "points3D") and path.suffix in (".bin", ".txt")
        return path.parent if is_part else None
    for below in _MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            if all((path / below / (stem + suffix)).is_file() for stem in ("cameras", "images")):
                return path / below
    return None
