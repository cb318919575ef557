"""Edit files, config/edits/{edit}.yaml: what is marked where, and what is to become of it.

Imports nothing heavy: the workflow reads these files whenever it starts.
"""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fourd.config import SCHEMA_FOLDER, fill_defaults, load_yaml, validate
from fourd.errors import InputError

REMOVE, SEE_BEHIND, KEEP_ONLY, INSERT = "remove", "see_behind", "keep_only", "insert"
SHAPES = ("box", "polygon", "scribble", "mask")
_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
# No honest edit is longer; a file that unfolds into a large one is refused before it does.
_MAX_BYTES = 2_000_000


@dataclasses.dataclass(frozen=True)
class Mark:
    """Something drawn on one frame of one view.

    shape: one of `SHAPES`;  points: corners or points (x, y), px; of a box left, top and right, bottom
    mask: path of a PNG, of the shape `mask` only
    """

    view: str
    frame: int
    shape: str
    points: tuple[tuple[float, float], ...] = ()
    mask: str | None = None
    is_part: bool = True

    def describe(self) -> str:
        """For messages."""
        return f"the {self.shape} on frame {self.frame} of {self.view}"


@dataclasses.dataclass(frozen=True)
class Edit:
    """One edit, as its file states it.

    pictures, shift_frames: what is inserted, of that operation only
    """

    name: str
    scene: str
    operation: str
    order: int
    views: tuple[str, ...]
    marks: tuple[Mark, ...]
    pictures: str | None = None
    shift_frames: int = 0

    def files(self) -> list[str]:
        """Files and folders that it names."""
        named = [mark.mask for mark in self.marks] + [self.pictures]
        return [path for path in named if path is not None]


def read_edit(path: Path | str) -> Edit:
    """An edit file, checked as far as it can be without the scene. Raises InputError."""
    source = Path(path)
    if source.is_file() and source.stat().st_size > _MAX_BYTES:
        raise InputError(
            f"{source}: expected an edit of at most {_MAX_BYTES} bytes, got {source.stat().st_size}: "
            "give a mask as a PNG instead of a list of points"
        )
    return parse_edit(load_yaml(source), source)


def parse_edit(document: dict[str, Any], source: Path) -> Edit:
    """What an edit file says, or is going to say. source: the file. Raises InputError."""
    if not _NAME.fullmatch(source.stem):
        raise InputError(
            f"{source}: expected a name of small letters, digits and _ that begins with a letter, at most "
            "32, because results are stored under it: rename the file"
        )
    schema = load_yaml(SCHEMA_FOLDER / "edit_file.schema.yaml")
    validate(document, schema, str(source))
    document = fill_defaults(document, schema)
    marks = tuple(_read_mark(entry, f"{source}, mark {i + 1}") for i, entry in enumerate(document["marks"]))
    insert = document["insert"] or {}
    edit = Edit(
        source.stem, document["scene"], document["operation"], document["order"], tuple(document["views"]),
        marks, insert.get("pictures"), insert.get("shift_frames", 0),
    )  # fmt: skip
    _check_edit(edit, insert, str(source))
    return edit


def _read_mark(entry: Mapping[str, Any], where: str) -> Mark:
    shapes = [shape for shape in SHAPES if entry.get(shape) is not None]
    if len(shapes) != 1:
        raise InputError(
            f"{where}: expected one of {', '.join(SHAPES)}, got {' and '.join(shapes) or 'none'}: "
            "draw each in a mark of its own"
        )
    shape = shapes[0]
    values: Any = entry[shape]
    points: list[tuple[float, float]] = []
    if shape == "box":
        points = [(float(values[0]), float(values[1])), (float(values[2]), float(values[3]))]
    elif shape != "mask":
        points = [(float(x), float(y)) for x, y in values]
    if not all(math.isfinite(value) for point in points for value in point):
        raise InputError(f"{where}: expected numbers of px in {shape}, got NaN or infinity: fix the points")
    if shape == "box" and not (points[0][0] < points[1][0] and points[0][1] < points[1][1]):
        raise InputError(
            f"{where}: expected a box as left, top, right, bottom with left < right and top < bottom, got "
            f"{list(values)}: swap the numbers"
        )
    is_part = entry.get("is_part", True)
    mask = values if shape == "mask" else None
    return Mark(entry["view"], entry["frame"], shape, tuple(points), mask, is_part)


def _check_edit(edit: Edit, insert: Mapping[str, Any], where: str) -> None:
    if not any(mark.is_part for mark in edit.marks):
        raise InputError(f"{where}: expected a mark of the thing, got only marks of what is not part of it")
    if edit.order != 1 and edit.operation != SEE_BEHIND:
        raise InputError(
            f"{where}: order {edit.order} belongs to see_behind, got {edit.operation}: take it out"
        )
    if (edit.operation == INSERT) != bool(insert):
        raise InputError(
            f"{where}: expected `insert:` with the operation insert and only with it, got the operation "
            f"{edit.operation}: say what to insert, or choose another operation"
        )
    if edit.operation == INSERT:
        if (edit.pictures is None) == (edit.shift_frames == 0):
            raise InputError(
                f"{where}: insert takes either pictures, or shift_frames other than 0: give one of them"
            )
        if edit.pictures is not None and (edit.marks[0].shape != "box" or not edit.marks[0].is_part):
            raise InputError(
                f"{where}: inserted pictures stand in the box of the first mark, got a "
                f"{edit.marks[0].shape}: draw a box where they are to stand"
            )
    for path in edit.files():
        if not Path(path).exists():
            raise InputError(f"{where}: expected a file at {path}, found nothing: correct the path")


def load_edits(
    scene: str,
    cameras: Sequence[str],
    num_frames: int,
    view_frames: Mapping[str, Mapping[int, int]],
    folder: Path | str = "config/edits",
) -> dict[str, Edit]:
    """The edits of a scene by name.

    cameras: physical ones;  num_frames: of the scene;  view_frames: trajectory -> output frame -> scene frame
    Raises InputError for a view or frame that the scene does not have.
    """
    edits = {}
    for path in sorted(Path(folder).glob("*.yaml")):
        edit = read_edit(path)
        if edit.scene == scene:
            _check_views(edit, cameras, num_frames, view_frames, str(path))
            edits[edit.name] = edit
    return edits


def _check_views(
    edit: Edit,
    cameras: Sequence[str],
    num_frames: int,
    view_frames: Mapping[str, Mapping[int, int]],
    where: str,
) -> None:
    trajectories = [name for name in view_frames if name not in cameras]
    for name in (*edit.views, *(mark.view for mark in edit.marks)):
        if name not in cameras and name not in trajectories:
            raise InputError(
                f"{where}: view {name!r} is neither a camera ({', '.join(cameras)}) nor a trajectory "
                f"({', '.join(trajectories)}): correct the name"
            )
    for mark in edit.marks:
        last = (num_frames if mark.view in cameras else len(view_frames[mark.view])) - 1
        if mark.frame > last:
            raise InputError(
                f"{where}: {mark.describe()} lies outside its frames 0 to {last}: choose one of these"
            )
