"""The outline of a thing in one picture: depth says where it is, colour where it ends."""

from collections.abc import Callable

import cv2
import numpy as np

from fourd.edit.plate import Window, is_no_plate, is_plate
from fourd.edit.voxels import MOVER, OBJECT, OTHER, UNKNOWN

# Pixels on either side of an outline by depth that colour may decide.
_INNER_PX, _OUTER_PX = 2, 4
# Beyond it colour may follow what differs from other times, if that is nearer to the thing than to others: a
# foot on the ground has the ground's depth. About a shoe at the size that figures have, px.
_LIMB_PX = 14
# Depth may be as much too wide, px: so deep may what looks as at other times be cut away.
_EDGE_PX = 7
# Depth beside an outline belongs to either side, px.
RIM_PX = 4
# Rounds of fitting colours and cutting.
_ROUNDS = 3
_MIN_PIXELS = 12
_NO_RECTANGLE = (0, 0, 1, 1)


def refine_outline(
    image: np.ndarray,
    kind: np.ndarray,
    likely: np.ndarray,
    find_plate: Callable[[Window], tuple[np.ndarray, ...]],
) -> np.ndarray:
    """(H, W) bool mask of the thing.

    image: (H, W, 3) uint8;  kind: (H, W) uint8 OBJECT, MOVER (another one), OTHER (stands still) or UNKNOWN
    by this picture's own depth
    likely: (H, W) bool where other cameras see the thing, and nobody before it
    find_plate: gives (h, w, 3) uint8 what stands still in a window, and (h, w) bool where that is known
    What lies well inside or outside stays. Along the outline, and where nobody knows, what looks as it does
    at other times is not the thing, and what surely looks unlike is; the rest is cut by colour. Where another
    one is in front, its depth is too wide as well, so the rim of it may be the thing's.
    Source of the cut: C. Rother et al., "GrabCut", SIGGRAPH 2004.
    """
    inside = cv2.morphologyEx((kind == OBJECT).astype(np.uint8), cv2.MORPH_CLOSE, _disc(2))
    inside[kind == OTHER] = 0
    inside[(kind == UNKNOWN) & likely] = 1
    inside = _without_specks(inside)
    if int(inside.sum()) < _MIN_PIXELS:
        return inside > 0
    window = _window(inside, _LIMB_PX + _OUTER_PX)
    part, picture, told, maybe = inside[window], image[window], kind[window], likely[window]
    plate, known = find_plate(window)[:2]
    same = known & is_plate(picture, plate)
    differs = known & ~same
    limbs = _find_limbs(part, differs, told)
    near = (cv2.dilate(part, _disc(_OUTER_PX)) > 0) | limbs
    sure = _open(known & is_no_plate(picture, plate) & (limbs | (part > 0)))
    mover = ((told == MOVER) & (part == 0)).astype(np.uint8)
    core = (part > 0) & (cv2.erode(part | mover, _disc(_INNER_PX)) > 0)
    edge = (cv2.erode(part, _disc(_EDGE_PX)) == 0) & (part > 0)
    trimap = np.full(part.shape, cv2.GC_BGD, np.uint8)
    trimap[near & ~same] = cv2.GC_PR_BGD
    trimap[near & differs] = cv2.GC_PR_FGD
    trimap[(told == OTHER) & ~maybe & (cv2.dilate(part, _disc(1)) == 0) & ~differs] = cv2.GC_BGD
    trimap[mover > 0] = cv2.GC_BGD
    trimap[_find_contact(part, mover) & differs] = cv2.GC_PR_BGD
    trimap[(told == OTHER) & maybe & (part == 0) & ~same] = cv2.GC_PR_FGD
    trimap[part > 0] = cv2.GC_PR_FGD
    trimap[(core & ~same) | sure] = cv2.GC_FGD
    trimap[edge & same] = cv2.GC_PR_BGD
    # Deep inside depth alone decides: dark hair looks like a wall in the shadow.
    trimap[(part > 0) & ~edge] = cv2.GC_FGD
    if not (trimap == cv2.GC_BGD).any() or not (trimap == cv2.GC_FGD).any():
        return inside > 0
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.setRNGSeed(0)
    cv2.grabCut(np.ascontiguousarray(picture), trimap, _NO_RECTANGLE, *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    cut = ((trimap == cv2.GC_FGD) | (trimap == cv2.GC_PR_FGD)).astype(np.uint8)
    mask = np.zeros(kind.shape, bool)
    mask[window] = _without_specks(cut) > 0
    return mask


def _find_contact(part: np.ndarray, mover: np.ndarray) -> np.ndarray:
    """(h, w) bool: the rim of another one that is next to the part, both (h, w) uint8."""
    rim = (mover > 0) & (cv2.erode(mover, _disc(_OUTER_PX + 1)) == 0)
    return rim & (cv2.dilate(part, _disc(_OUTER_PX)) > 0)


def _find_limbs(part: np.ndarray, differs: np.ndarray, told: np.ndarray) -> np.ndarray:
    """(h, w) bool: what hangs together with the part, differs from other times and is no one else's."""
    ours, theirs = (
        cv2.distanceTransform((~region).astype(np.uint8), cv2.DIST_L2, 5)
        for region in (part > 0, told == MOVER)
    )
    free = differs & (told != MOVER) & (ours <= _LIMB_PX) & (ours < theirs)
    free = _open(free)
    joined = (free | (part > 0)).astype(np.uint8)
    labels = np.asarray(cv2.connectedComponents(joined)[1], dtype=np.int64)
    touched = np.zeros(int(labels.max()) + 1, bool)
    touched[np.unique(labels[part > 0])] = True
    return touched[labels] & free


def _open(mask: np.ndarray) -> np.ndarray:
    """The mask without what is thinner than three pixels."""
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0


def widen(mask: np.ndarray, radius: int) -> np.ndarray:
    """(H, W) bool mask, grown by so many px."""
    return cv2.dilate(mask.astype(np.uint8), _disc(radius)) > 0


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _without_specks(mask: np.ndarray) -> np.ndarray:
    """The mask without patches of a few pixels."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    small = stats[:, cv2.CC_STAT_AREA] < _MIN_PIXELS
    return np.where(small[np.asarray(labels, dtype=np.int64)], 0, mask).astype(np.uint8)


def _window(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    left, top, width, height = cv2.boundingRect(mask)
    return (
        slice(max(0, top - margin), min(mask.shape[0], top + height + margin)),
        slice(max(0, left - margin), min(mask.shape[1], left + width + margin)),
    )
