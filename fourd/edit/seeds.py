"""From marks to the first opinion of every camera: which of its moving pixels are the marked thing."""

import logging
from collections.abc import Mapping

import numpy as np

from fourd.camera import Camera
from fourd.edit.carry import Found, Instant, splat_points, voxels_of
from fourd.edit.moving import project_ideal, world_points
from fourd.edit.outline import RIM_PX, widen
from fourd.edit.spec import Mark
from fourd.edit.voxels import OBJECT, OTHER, UNKNOWN, distances_to, find_parts, find_strangers
from fourd.errors import InputError

log = logging.getLogger(__name__)
# Less of a mark than this is moving, or has a depth: it is on the background, or on a hole.
_MIN_MOVING_SHARE, _MIN_DEPTH_SHARE = 0.03, 0.1
_MOSTLY_MOVING_SHARE = 0.3
_SAME_SURFACE = 0.02
_SCENE_VOXEL_PX = 1.5
# Share of the marked thing's pixels from which something else in a box may have been meant as well.
_SECOND_SHARE = 0.2
# A speck behind the thing is no second thing: share of the thing's voxels, and least number.
_MIN_HIDDEN_SHARE, _MIN_HIDDEN_VOXELS = 0.04, 10


def surface_of(instant: Instant, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What a view sees by all cameras' depths: (H, W) float32 z, infinite = unknown, and of what moves."""
    everything, moving = [], []
    for name, source in instant.cameras.items():
        points, index = world_points(source, instant.depths[name])
        everything.append(points)
        moving.append(points[instant.moving[name].ravel()[index]])
    points = np.concatenate(everything)
    z = project_ideal(camera, points)[1]
    front = z[z > 0]
    side = _SCENE_VOXEL_PX * float(np.median(front)) / camera.focal_px if len(front) else 1.0
    return splat_points(camera, points, side), splat_points(camera, np.concatenate(moving), side)


def hints_of_mark(
    instant: Instant, mark: Mark, mask: np.ndarray, camera: Camera, side: float
) -> dict[str, np.ndarray]:
    """camera -> (H, W) uint8 OBJECT, OTHER or UNKNOWN, from a mark on any view.

    mask: (H, W) bool of the view;  camera: its ideal pinhole
    Close beside a mark depth is too wide for any opinion. Of a box, only what lies mostly inside is meant.
    Outside a stroke anything may be meant.
    Raises InputError for a mark on a hole, or on nothing that moves.
    """
    if mark.view in instant.cameras:
        depth = np.where(np.isfinite(instant.depths[mark.view]), instant.depths[mark.view], np.inf)
        moving = instant.moving[mark.view]
    else:
        depth, nearest = surface_of(instant, camera)
        moving = np.isfinite(nearest) & (nearest <= depth * (1 + _SAME_SURFACE))
    _check_mark(mark, mask, np.isfinite(depth), moving)
    rim = widen(mask, RIM_PX)
    hints = {}
    for name, source in instant.cameras.items():
        hint = np.full(instant.depths[name].shape, UNKNOWN, np.uint8)
        points, index = world_points(source, np.where(instant.moving[name], instant.depths[name], np.nan))
        pixels, z = project_ideal(camera, points)
        x, y = np.rint(pixels[:, 0]).astype(np.int64), np.rint(pixels[:, 1]).astype(np.int64)
        inside = (z > 0) & (x >= 0) & (x < mask.shape[1]) & (y >= 0) & (y < mask.shape[0])
        x, y, z, index = x[inside], y[inside], z[inside], index[inside]
        visible = np.abs(z - depth[y, x]) <= _SAME_SURFACE * z
        marked = mask[y, x]
        told = visible & (marked | ((mark.shape != "scribble") & ~rim[y, x]))
        hint.ravel()[index[told]] = np.where(marked[told], OBJECT, OTHER)
        hints[name] = hint
    return _drop_passers(instant, mark, hints, side) if mark.shape == "box" else hints


def _check_mark(mark: Mark, mask: np.ndarray, has_depth: np.ndarray, moving: np.ndarray) -> None:
    if not mark.is_part:
        return
    depth_share, moving_share = float(has_depth[mask].mean()), float(moving[mask].mean())
    if depth_share < _MIN_DEPTH_SHARE:
        raise InputError(
            f"{mark.describe()} lies on a hole: {100 * (1 - depth_share):.0f} % of it have no depth, because "
            "too few cameras see it; mark the thing on another frame or camera"
        )
    if moving_share < _MIN_MOVING_SHARE:
        raise InputError(
            f"{mark.describe()} lies on the background: {100 * moving_share:.0f} % of it move in this clip, "
            "and what never moves hides nothing that could be shown; mark something that moves"
        )
    if moving_share < _MOSTLY_MOVING_SHARE:
        log.warning(
            "%s is larger than the thing: only %.0f %% of it move; the rest is left out",
            mark.describe(),
            100 * moving_share,
        )


def _drop_passers(
    instant: Instant, mark: Mark, hints: Mapping[str, np.ndarray], side: float
) -> dict[str, np.ndarray]:
    """Hints without the parts that a box only touches, and those that lie apart from its largest one."""
    voxels = voxels_of(instant, side)
    parts = find_parts(voxels.centers, side)
    num = int(parts.max()) + 1 if len(parts) else 0
    ours, theirs = np.zeros(num), np.zeros(num)
    for name, hint in hints.items():
        at = voxels.index[name]
        for counts, label in ((ours, OBJECT), (theirs, OTHER)):
            counts += np.bincount(parts[at[(at >= 0) & (hint == label)]], minlength=num)
    passes = ours < theirs
    if num:
        inside = np.where(passes, 0, ours)
        passes |= find_strangers(voxels.centers, parts, inside)
        _warn_of_others(mark, inside[passes] > _SECOND_SHARE * inside.max())
    result = {}
    for name, hint in hints.items():
        at = voxels.index[name]
        is_passer = (at >= 0) & passes[parts[np.maximum(at, 0)]] if num else np.zeros(at.shape, bool)
        result[name] = np.where(is_passer & (hint == OBJECT), OTHER, hint).astype(np.uint8)
    return result


def _warn_of_others(mark: Mark, is_large: np.ndarray) -> None:
    if is_large.any():
        log.warning(
            "%s holds %d things: the largest is meant; mark another in an edit of its own, or all of them "
            "with a polygon",
            mark.describe(), 1 + int(is_large.sum()),
        )  # fmt: skip


def merge_hints(several: list[tuple[Mark, dict[str, np.ndarray]]]) -> dict[str, np.ndarray]:
    """One opinion from several marks of one frame: a thing is what any of them shows and none rules out."""
    merged = {name: hint.copy() for name, hint in several[0][1].items()}
    for name, result in merged.items():
        shown = [hints[name] for mark, hints in several if mark.is_part]
        ruled_out = [hints[name] == OBJECT for mark, hints in several if not mark.is_part]
        result[:] = np.min(shown, axis=0)
        result[np.any([hint == OBJECT for hint in shown], axis=0)] = OBJECT
        if ruled_out:
            result[np.any(ruled_out, axis=0)] = OTHER
    return merged


def hints_of_hidden(
    instant: Instant, found: Found, camera: Camera, side: float
) -> dict[str, np.ndarray] | None:
    """Opinions about what moves behind the thing, as a view sees it; None where nothing does.

    camera: ideal pinhole of the view at the instant
    """
    voxels = voxels_of(instant, side)
    is_other = np.isfinite(distances_to(voxels.centers, found.others, side))
    front = splat_points(camera, found.points, side)
    pixels, z = project_ideal(camera, voxels.centers)
    x, y = np.rint(pixels[:, 0]).astype(np.int64), np.rint(pixels[:, 1]).astype(np.int64)
    inside = (z > 0) & (x >= 0) & (x < front.shape[1]) & (y >= 0) & (y < front.shape[0])
    hidden = np.zeros(len(z), bool)
    hidden[inside] = front[y[inside], x[inside]] < z[inside] - side
    hidden &= is_other
    parts = np.zeros(len(z), np.int32)
    parts[is_other] = find_parts(voxels.centers[is_other], side)
    counts = np.bincount(parts[hidden], minlength=int(parts.max(initial=0)) + 1)
    chosen = counts >= max(_MIN_HIDDEN_VOXELS, _MIN_HIDDEN_SHARE * len(found.points))
    if not chosen.any():
        return None
    wanted = chosen[parts] & is_other
    hints = {}
    for name, at in voxels.index.items():
        hints[name] = np.full(at.shape, UNKNOWN, np.uint8)
        hints[name][at >= 0] = np.where(wanted[at[at >= 0]], OBJECT, OTHER)
    return hints
