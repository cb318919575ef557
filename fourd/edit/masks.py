"""The job that carries an edit's marks to all cameras and frames: edit/{edit}/masks.npz."""

import contextlib
import dataclasses
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fourd.camera import Camera
from fourd.edit.carry import VOXEL_PX, Found, Instant, carry_mark, find_rest
from fourd.edit.instants import Instants
from fourd.edit.mark import check_conflicts, draw_mark
from fourd.edit.moving import places_of
from fourd.edit.network import load_network
from fourd.edit.options import EditOptions
from fourd.edit.seeds import hints_of_hidden, hints_of_mark, merge_hints, surface_of
from fourd.edit.shadows import find_dark, find_light
from fourd.edit.spec import KEEP_ONLY, REMOVE, Edit, Mark
from fourd.errors import InputError
from fourd.io import ArchiveWriter
from fourd.sfm.cameras import SceneCameras, read_cameras
from fourd.views import View, read_view

log = logging.getLogger(__name__)
# Frames that tell where the light comes from.
_LIGHT_FRAMES = 3


def run(
    edit: Edit,
    cameras_path: Path,
    films: Sequence[str],
    depths: Sequence[Path],
    view_paths: Sequence[Path],
    options: EditOptions,
    output: Path,
) -> None:
    """Write edit/{edit}/masks.npz (docs/editing.md).

    view_paths: views/{view}.json of marks that are not on an input camera
    Raises InputError for a mark that means nothing, with the reason.
    """
    scene = read_cameras(cameras_path)
    views = {view.name: view for view in map(read_view, view_paths)}
    carry = load_network(options.network) if options.network else None
    with contextlib.closing(Instants(scene, films, depths, options.num_times)) as instants:
        places = [place_of_mark(mark, scene, views) for mark in edit.marks]
        frame, hints, side = first_hints(edit, places, instants)
        frames = instants.frames
        found = carry_mark(hints, frame, frames, instants.at, side, carry)
        check_marked(edit.marks[0], found[frame].masks)
        for _ in range(edit.order - 1):
            found = _with_hidden(found, frame, places[0], scene, views, edit.marks[0], instants, side)
        found = {f: without_specks(result) for f, result in found.items()}
        _warn_of_lost(edit, found)
        meta = {
            "edit": edit.name,
            "operation": edit.operation,
            "cameras": list(instants.names),
            "marked_frame": frame,
            "voxel_side": side,
            "light": _find_light(edit, found, instants, scene.up, side),
            "frames_seen": [f for f in frames if len(found[f].points)],
        }
        with ArchiveWriter(output, meta) as writer:
            for f in frames:
                result = found[f]
                if edit.operation == KEEP_ONLY:
                    result = find_rest(instants.at(f), result, side)
                masks = {name: np.uint8(255) * mask for name, mask in result.masks.items()}
                points = {"points": result.points, "others": result.others, "still": result.still}
                writer.add_frame(f, **masks, **{k: v.astype(np.float32) for k, v in points.items()})


def place_of_mark(mark: Mark, scene: SceneCameras, views: Mapping[str, View]) -> tuple[int, Camera]:
    """Scene frame and ideal pinhole that a mark was drawn on.

    Raises InputError for a camera that has no pose, or a view that is not given.
    """
    if mark.view in scene.left_out:
        raise InputError(
            f"{mark.describe()}: camera {mark.view} was left out of the calibration "
            f"({scene.left_out[mark.view]}), so nothing can be placed by it: mark another camera"
        )
    if mark.view in scene.tracks:
        return mark.frame, scene.tracks[mark.view].at(mark.frame).without_distortion()
    if mark.view not in views:
        raise InputError(f"{mark.describe()}: expected views/{mark.view}.json, got none: give --mark-views")
    entry = views[mark.view].at(mark.frame)
    return entry.scene_frame, entry.camera


def first_hints(
    edit: Edit, places: Sequence[tuple[int, Camera]], instants: Instants
) -> tuple[int, dict[str, np.ndarray], float]:
    """Scene frame of the first mark, opinions of all cameras there, and the side of a voxel, world units.

    All marks have to show one moment: what it shows is carried to all others.
    Raises InputError for marks that contradict each other or mean different moments.
    """
    frame = places[0][0]
    other = [mark for mark, place in zip(edit.marks, places, strict=True) if place[0] != frame]
    if other:
        raise InputError(
            f"{edit.marks[0].describe()} and {other[0].describe()} show different moments of the event: mark "
            "one moment, it is carried to all others"
        )
    if frame not in instants.frames:
        raise InputError(
            f"{edit.marks[0].describe()}: expected a frame of the clip, it has {instants.frames}"
        )
    instant = instants.at(frame)
    masks = [draw_mark(mark, camera.size) for mark, (_, camera) in zip(edit.marks, places, strict=True)]
    check_conflicts(edit.marks, masks)
    side = _voxel_side(instant, edit.marks[0], masks[0], places[0][1])
    several = [
        (mark, hints_of_mark(instant, mark, mask, camera, side))
        for mark, mask, (_, camera) in zip(edit.marks, masks, places, strict=True)
    ]
    return frame, merge_hints(several), side


def check_marked(mark: Mark, masks: Mapping[str, np.ndarray]) -> None:
    """Raise InputError where nothing is left of a mark on its own picture: what moved there was noise.

    masks: camera -> (H, W) bool of the marked frame
    """
    own = [masks[mark.view]] if mark.view in masks else masks.values()
    if not any(mask.any() for mask in own):
        raise InputError(
            f"{mark.describe()}: expected something that moves, but no part of it moves as one thing would; "
            "mark the thing closer, or on another frame or camera"
        )


def without_specks(found: Found) -> Found:
    """Without the voxels of a thing that no camera's picture shows: noise that would edit a trajectory."""
    is_shown = any(mask.any() for mask in found.masks.values())
    return found if is_shown else dataclasses.replace(found, points=found.points[:0])


def _voxel_side(instant: Instant, mark: Mark, mask: np.ndarray, camera: Camera) -> float:
    depth = instant.depths[mark.view] if mark.view in instant.depths else surface_of(instant, camera)[0]
    inside = depth[mask & np.isfinite(depth)]
    # A mark without any depth is refused later, with the reason.
    return VOXEL_PX * float(np.median(inside)) / camera.focal_px if len(inside) else 1.0


def _with_hidden(
    found: dict[int, Found],
    frame: int,
    place: tuple[int, Camera],
    scene: SceneCameras,
    views: Mapping[str, View],
    mark: Mark,
    instants: Instants,
    side: float,
) -> dict[int, Found]:
    """The things found and, as one, what moves behind them in the marked view nearest in time to the mark."""
    for now in sorted(found, key=lambda f: (abs(f - frame), f)):
        camera = place[1]
        if mark.view in scene.tracks:
            camera = scene.tracks[mark.view].at(now).without_distortion()
        elif mark.view in views:
            same = [e for e in views[mark.view].frames if e.scene_frame == now]
            camera = same[0].camera if same else camera
        hints = hints_of_hidden(instants.at(now), found[now], camera, side)
        if hints is not None:
            log.info("order 2: something moves behind the mark at frame %d", now)
            behind = carry_mark(hints, now, instants.frames, instants.at, side)
            return {f: found[f].joined(behind[f]) for f in found}
    log.warning("order 2: nothing that moves was found behind the mark, so order 1 is all there is")
    return found


def _find_light(
    edit: Edit, found: Mapping[int, Found], instants: Instants, up: np.ndarray, side: float
) -> list[float] | None:
    """Direction towards the light, unit vector, from a few frames of all cameras, if shadows are to go."""
    if edit.operation not in (REMOVE, KEEP_ONLY):
        return None
    frames = [f for f in sorted(found) if len(found[f].points)]
    moments = []
    for f in frames[:: max(1, -(-len(frames) // _LIGHT_FRAMES))]:
        instant, dark, lit = instants.at(f), [], []
        for name, image in instant.images.items():
            camera, (height, width) = instant.cameras[name], image.shape[:2]
            window = slice(0, height), slice(0, width)
            plate, known, depth = instant.plate_finder(name, found[f].points)(window)
            is_dark = find_dark(image, plate, known)
            dark.append(places_of(camera, depth, is_dark))
            lit.append(places_of(camera, depth, known & ~is_dark))
        points = np.concatenate([found[f].points, found[f].others])
        moments.append((points, np.concatenate(dark), np.concatenate(lit)))
    light = find_light(moments, up, side)
    log.info("light: %s", "none found, shadows stay" if light is None else light.round(3))
    return None if light is None else light.tolist()


def _warn_of_lost(edit: Edit, found: Mapping[int, Found]) -> None:
    lost = sorted(f for f, result in found.items() if not len(result.points))
    if lost:
        log.warning(
            "%s: the marked thing was found in no view at %d of %d frames (%s), so nothing is done to it "
            "there; if it is to be seen, mark it there in an edit of its own",
            edit.name, len(lost), len(found), _spans(lost),
        )  # fmt: skip


def _spans(frames: Sequence[int]) -> str:
    """`3 to 5, 9` for [3, 4, 5, 9]."""
    runs = np.split(np.array(frames), np.flatnonzero(np.diff(frames) > 1) + 1)
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)
