"""The page and its files."""

import contextlib
import dataclasses
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd.errors import InputError
from fourd.image import resize_area
from fourd.ingest import FrameReader, open_camera
from fourd.io import Archive, atomic_folder, read_image, write_text
from fourd.render import list_frames
from fourd.sfm.cameras import read_cameras
from fourd.viewer import ViewerOptions
from fourd.viewer.manifest import describe_scene, read_points
from fourd.viewer.pack import encode_map, encode_picture, encode_within, pack_runs, picture_address
from fourd.views import View, read_view

ASSETS = Path(__file__).with_name("assets")
SHELL = ("page.html", "viewer.css", "viewer.js")
# What is nearer than all but this share of the known pixels is clipped: one stray point must not cost the
# rest its steps.
NEAREST_SHARE = 0.001
# Part of the room for pictures that is left to the frames of the files.
SPARE_SHARE = 0.01

logger = logging.getLogger(__name__)
Picture = Callable[[int], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Sources:
    """Files that the page is made from. render: folders of frames;  maps: archives of `write_maps`."""

    cameras: Path
    points: Path
    films: Sequence[Path]
    views: Sequence[Path]
    render: Sequence[Path]
    maps: Sequence[Path]


def write_page(sources: Sources, options: ViewerOptions, forecast_mb: float, output: Path) -> None:
    """Write index.html and the folder data beside it. Raises InputError for files that do not fit."""
    scene = read_cameras(sources.cameras)
    views = [read_view(path) for path in sources.views]
    fused, maps = read_maps(sources.maps, views)
    nearest = find_nearest([depth for pictures in maps.values() for depth, _ in pictures])
    points = read_points(sources.points)
    manifest = describe_scene(
        output.resolve().parent.name, scene, views, fused, nearest, points, options.width
    )
    shell = {name: (ASSETS / name).read_text(encoding="utf-8") for name in SHELL}
    files: dict[str, str] = {}
    for name, pictures in maps.items():
        files |= pack_runs("map", name, [encode_map(*picture, nearest) for picture in pictures])
    taken = sum(map(len, (*files.values(), *shell.values(), json.dumps(manifest))))
    with contextlib.ExitStack() as stack:
        read = view_readers(sources.render, views)
        sizes = {camera["name"]: tuple(camera["picture"]) for camera in manifest["cameras"]}
        read |= camera_readers(stack, sources.films, sizes, manifest["frames"])
        room = (options.max_mb * 1e6 - taken) * 3 / 4 * (1 - SPARE_SHARE)
        encoded, quality = encode_within(read, len(manifest["frames"]), options.quality, room)
        start = read[f"view/{views[len(views) // 2].name}"](0)
    for name, pictures in encoded.items():
        kind, sequence = name.split("/")
        files |= pack_runs(kind, sequence, pictures)
    page = draw_page({**manifest, "quality": quality, "files": sorted(files)}, start, quality, shell)
    with atomic_folder(output / "data") as folder:
        for name, text in files.items():
            (folder / name).write_text(text, encoding="ascii")
    write_text(output / "index.html", page)
    logger.info(
        "viewer: %d moments of %d views at quality %d, %.1f MB (forecast %.1f, at most %g)",
        len(manifest["frames"]), len(views), quality,
        (sum(map(len, files.values())) + len(page)) / 1e6, forecast_mb, options.max_mb,
    )  # fmt: skip


def read_maps(
    paths: Sequence[Path], views: Sequence[View]
) -> tuple[list[str], dict[str, list[tuple[np.ndarray, np.ndarray]]]]:
    """Fused cameras by their number in maps, and view -> inverse depth and origin of its frames.

    Raises InputError if a view lacks a frame, or cameras are numbered in two ways.
    """
    found: dict[str, dict[int, tuple[np.ndarray, np.ndarray]]] = {view.name: {} for view in views}
    fused: list[str] | None = None
    for path in paths:
        with contextlib.closing(Archive(path)) as archive:
            cameras = list(archive.meta["cameras"])
            fused = cameras if fused is None else fused
            if cameras != fused or archive.meta["view"] not in found:
                raise InputError(
                    f"expected a map of {', '.join(found)} from cameras {', '.join(fused)} in {path}, got "
                    f"{archive.meta['view']} from {', '.join(cameras)}: delete it and run again"
                )
            for frame in archive.frames():
                arrays = archive.frame(frame)
                found[archive.meta["view"]][frame] = arrays["inverse_depth"], arrays["origin"]
    for view in views:
        _check_frames(view, found[view.name], "maps")
    return fused or [], {name: [pictures[f] for f in sorted(pictures)] for name, pictures in found.items()}


def _check_frames(view: View, found: Mapping[int, Any], what: str) -> None:
    wanted = {entry.frame for entry in view.frames}
    if set(found) != wanted:
        raise InputError(
            f"view {view.name}: expected {what} of frames 0..{len(wanted) - 1}, got {len(found)} of them: "
            "delete its files under lattice and run again"
        )


def find_nearest(depths: Sequence[np.ndarray]) -> float:
    """Inverse depth that maps end at, 1 / world unit; 1 where no depth is known."""
    known = np.concatenate([depth[depth > 0] for depth in depths])
    return float(np.quantile(known, 1 - NEAREST_SHARE)) if known.size else 1.0


def view_readers(folders: Sequence[Path], views: Sequence[View]) -> dict[str, Picture]:
    """`view/NAME` -> function that reads the picture of a moment. Raises InputError if one is missing."""
    read: dict[str, Picture] = {}
    for view in views:
        paths = list_frames([folder for folder in folders if folder.parent.name == view.name])
        _check_frames(view, paths, "pictures")
        read[f"view/{view.name}"] = lambda moment, paths=paths: read_image(paths[moment])
    return read


def camera_readers(
    stack: contextlib.ExitStack,
    films: Sequence[Path],
    sizes: Mapping[str, tuple[int, int]],
    frames: Sequence[int],
) -> dict[str, Picture]:
    """`camera/NAME` -> function that reads what a camera filmed at a moment.

    sizes: camera -> (width, height) px on the page; others are not shown;  frames: of the scene
    """
    read: dict[str, Picture] = {}
    for path in films:
        reader: FrameReader = open_camera(path)
        stack.callback(reader.close)
        if reader.camera in sizes:
            read[f"camera/{reader.camera}"] = lambda moment, reader=reader: resize_area(
                reader.read(frames[moment]), sizes[reader.camera]
            )
    return read


def draw_page(manifest: Mapping[str, Any], start: np.ndarray, quality: int, shell: Mapping[str, str]) -> str:
    """index.html: everything but the pictures, and the first of these.

    manifest: of `describe_scene`;  start: (H, W, 3) uint8, shown before anything is loaded
    shell: `page.html` with the marks STYLE, POSTER, MANIFEST and PROGRAM, and what takes their places
    """
    # A page must not end where a name has a bracket in it.
    text = json.dumps(manifest, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    parts = {
        "STYLE": shell["viewer.css"],
        "POSTER": picture_address(encode_picture(start, quality)),
        "WIDTH": str(start.shape[1]),
        "HEIGHT": str(start.shape[0]),
        "MANIFEST": text,
        "PROGRAM": shell["viewer.js"],
    }
    page = shell["page.html"]
    for mark, part in parts.items():
        page = page.replace(f"[[{mark}]]", part)
    return page
