"""Films and edits as the report tells them: where they leave the cameras, and what their pixels rest on."""

from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from fourd.io import read_csv, read_image, read_json
from fourd.render import list_frames
from fourd.report.current import Current
from fourd.report.numbers import parse

# Origins of edited pixels (edit.csv) and how they are painted: the picture is grey where none applies.
ORIGINS = {
    "same_time": ("what another camera saw at that moment", (0, 114, 178)),
    "other_time": ("what was there at another moment", (0, 158, 115)),
    "inserted": ("put in by the edit", (240, 228, 66)),
    "inferred": ("seen by nobody, guessed", (213, 94, 0)),
}
PAINT = 0.65


def collect_films(results: Path, current: Current) -> list[dict[str, Any]]:
    """The part `films`: how far each film's poses lie from where people filmed (render/NAME.json)."""
    films = []
    for name in current.views:
        path = results / "render" / f"{name}.json"
        if name in current.cameras or not path.is_file():
            continue
        document = read_json(path)
        frames = document["frames"]
        spacing = document["spacing"]
        farthest = max((f["hull_distance"] / f["spacing"] for f in frames if f["spacing"]), default=None)
        films.append(
            {
                "name": name,
                "num_frames": len(frames),
                "num_outside": document["num_outside"],
                "spacing": spacing,
                "max_distance_spacings": farthest,
                "max_turn_deg": max((f["turn_deg"] for f in frames), default=None),
                "outside": describe_runs([(f["frame"], f["reason"]) for f in frames if f["is_outside"]]),
            }
        )
    return films


def describe_runs(frames: list[tuple[int, str]]) -> list[dict[str, Any]]:
    """Runs of frames without a gap as first and last frame, with the reason of the middle one."""
    runs = []
    for _, group in groupby(enumerate(frames), lambda pair: pair[1][0] - pair[0]):
        own = [frame for _, frame in group]
        runs.append({"first": own[0][0], "last": own[-1][0], "reason": own[len(own) // 2][1]})
    return runs


def collect_edits(results: Path, current: Current) -> list[dict[str, Any]]:
    """The part `edits`: per edit and view the shares of its pixels by where they come from."""
    edits = []
    for folder, view in edited_views(results, current):
        rows = [row for path in current.chunks_in(folder, view) for row in _read_rows(path / "edit.csv")]
        if not rows:
            continue
        means = {key: _mean(rows, key) for key in ("changed_share", *ORIGINS)}
        edits.append({"edit": folder.parent.name, "view": view, "num_frames": len(rows), **means})
    return edits


def edited_views(results: Path, current: Current) -> list[tuple[Path, str]]:
    """(folder, view) of everything that was edited and still belongs to the scene."""
    folders = [path for path in sorted((results / "edits").glob("*/*")) if path.is_dir()]
    known = current.cameras | current.views.keys()
    return [(p, p.name) for p in folders if current.has_edit(p.parent.name) and p.name in known]


def _read_rows(path: Path) -> list[dict[str, str]]:
    return read_csv(path) if path.is_file() else []


def _mean(rows: list[dict[str, str]], key: str) -> float:
    return float(np.mean([parse(row.get(key)) or 0.0 for row in rows]))


def edit_pictures(folder: Path, view: str, current: Current) -> tuple[int, np.ndarray, np.ndarray] | None:
    """(frame, edited, painted) of the frame that the edit changed most; None without pictures.

    painted: the edited picture in grey, tinted by the origin of each pixel
    """
    chunks = [path for path in current.chunks_in(folder, view) if path.is_dir()]
    changed = {
        int(row["frame"]): (parse(row["changed_share"]) or 0.0, path)
        for path in chunks
        for row in _read_rows(path / "edit.csv")
    }
    if not changed:
        return None
    frame = max(changed, key=lambda f: (changed[f][0], -f))
    path = changed[frame][1]
    kinds = read_json(path / "provenance.json")
    edited = read_image(list_frames([path])[frame])
    kind = read_image(path / "provenance" / f"{frame:06d}.png")[..., 0]
    return frame, edited, paint_origins(edited, kind, kinds)


def paint_origins(image: np.ndarray, kind: np.ndarray, codes: Mapping[str, Any]) -> np.ndarray:
    """(H, W, 3) uint8: the picture in grey, tinted where it was changed. kind: (H, W); codes: by origin."""
    grey = np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2)
    for name, (_, colour) in ORIGINS.items():
        chosen = kind == codes[name]
        grey[chosen] = (1 - PAINT) * grey[chosen] + PAINT * np.array(colour)
    return np.floor(grey + 0.5).astype(np.uint8)
