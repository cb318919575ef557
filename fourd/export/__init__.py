"""Stage `export`: a finished scene in the formats of other programs, and their cameras back.

`pictures` and `depth` make what several formats share, once per camera; `write` writes one format;
`read` turns another program's cameras into a calibration for a scene file. docs/export.md tells what
every format holds. Cameras, depths and points are in the calibration's world, not in the scene's.
"""

import dataclasses
import importlib.util

from fourd.errors import InputError

STAGE_VERSION = 2
# Formats of the event's cameras, pictures and points; and of rendered films.
EVENT_FORMATS = (
    "colmap",
    "nerfstudio",
    "n3dv",
    "easyvolcap",
    "dynamic3dg",
    "videos",
    "pose2sim",
    "anipose",
    "caliscope",
    "qualisys",
    "opencv",
    "ply",
    "glb",
)
FILM_FORMATS = ("exr", "png16")
# Formats whose cameras are read.
READ_FORMATS = (
    "anipose",
    "caliscope",
    "colmap",
    "dynamic3dg",
    "easymocap",
    "easyvolcap",
    "fourd",
    "llff",
    "n3dv",
    "nerfstudio",
    "opencv",
    "pose2sim",
    "qualisys",
)


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """What is exported; the meaning of each key is in the schema."""

    size: tuple[int, ...] = ()
    scale: float = 1.0
    max_points: int = 50000
    glb_points: int = 3000


def chosen_formats(words: str) -> tuple[str, ...]:
    """Formats from names with commas between them, or `all`, which has EXR only where it can be written.

    Raises InputError for an unknown one.
    """
    known = (*EVENT_FORMATS, *FILM_FORMATS)
    if words == "all":
        can_write_exr = importlib.util.find_spec("OpenImageIO") is not None
        return tuple(name for name in known if name != "exr" or can_write_exr)
    names = tuple(word.strip() for word in words.split(","))
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(f"format is {unknown[0]!r}, expected all, or some of {', '.join(known)}")
    return names
