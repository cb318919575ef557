"""A mark, carried to all cameras and all times.

Within a frame the moving points of all cameras are gathered in voxels; from frame to frame each camera
carries its mask along its own flow, and the voxels hold a vote. So a thing that one camera lost behind
another is found again as soon as any camera has it. Outlines are settled per picture, by colour.
"""

import dataclasses
import logging
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.edit.colours import Colours, learn_colours
from fourd.edit.moving import world_points
from fourd.edit.outline import RIM_PX, refine_outline, widen
from fourd.edit.plate import FARTHEST, Window, plate_of
from fourd.edit.voxels import (
    LOST_SHARE,
    MOVER,
    OBJECT,
    OTHER,
    UNKNOWN,
    MovingVoxels,
    average_belief,
    distances_to,
    find_returned,
    find_specks,
    find_strays,
    gather_voxels,
    is_one_thing,
    settle_labels,
    vote_labels,
)
from fourd.flow import dense_flow

log = logging.getLogger(__name__)
# Side of a voxel in pixels of the picture that was marked, at the depth of the mark.
VOXEL_PX = 3.0
# Flow there and back that ends farther away is not believed, px.
_FLOW_MISS_PX = 1.5
# Half the picture is fine enough for masks, and takes a quarter of the time.
_FLOW_SCALE = 1


@dataclasses.dataclass(frozen=True, eq=False)
class Instant:
    """One frame of the scene, as ideal pinholes see it.

    cameras, images, depths: camera -> Camera, (H, W, 3) uint8, (H, W) float32 z
    moving, untold: camera -> (H, W) bool, see `find_moving`
    still: camera -> what it films at other times, see `plate_of`
    """

    cameras: Mapping[str, Camera]
    images: Mapping[str, np.ndarray]
    depths: Mapping[str, np.ndarray]
    moving: Mapping[str, np.ndarray]
    untold: Mapping[str, np.ndarray]
    still: Mapping[str, Sequence[tuple[Camera, np.ndarray, np.ndarray]]]

    def plate_finder(self, name: str, points: np.ndarray) -> Callable[[Window], tuple[np.ndarray, ...]]:
        """What finds the plate behind the points, (N, 3), in a window of a camera's picture."""
        camera = self.cameras[name]
        z = camera.project(points)[1] if len(points) else np.ones(1)
        nearest = max(float(z.min()), 1e-3 * float(np.abs(z).max()))
        return lambda window: plate_of(camera, window, (nearest, FARTHEST * nearest), self.still[name])


@dataclasses.dataclass(frozen=True, eq=False)
class Found:
    """The marked thing at one frame.

    masks: camera -> (H, W) bool
    kinds: camera -> (H, W) uint8 OBJECT, OTHER of what else moves, UNKNOWN elsewhere
    points: (N, 3) voxel centres of the thing;  others: (M, 3) of what else moves
    still: (K, 3) places near the thing that stand still
    """

    masks: dict[str, np.ndarray]
    kinds: dict[str, np.ndarray]
    points: np.ndarray
    others: np.ndarray
    still: np.ndarray

    def joined(self, other: "Found") -> "Found":
        """Both things as one."""
        masks = {name: mask | other.masks[name] for name, mask in self.masks.items()}
        kinds = {
            name: np.where(other.kinds[name] == OBJECT, OBJECT, kind) for name, kind in self.kinds.items()
        }
        rest = self.others[~np.isfinite(distances_to(self.others, other.points, 1e-9))]
        points, still = (
            np.concatenate(pair) for pair in ((self.points, other.points), (self.still, other.still))
        )
        return Found(masks, kinds, points, rest, still)


@dataclasses.dataclass(frozen=True, eq=False)
class Thing:
    """What the marked frame tells of a thing.

    size: voxels;  is_one: whether what lies apart from it at other times is somebody else's
    """

    colours: Colours
    size: int
    is_one: bool


def voxels_of(instant: Instant, side: float) -> MovingVoxels:
    """Moving pixels of all cameras in voxels."""
    points = {}
    for name, camera in instant.cameras.items():
        depth = np.where(instant.moving[name], instant.depths[name], np.nan)
        points[name] = world_points(camera, depth)
    return gather_voxels(points, {name: d.shape for name, d in instant.depths.items()}, side)


def carry_flow(image: np.ndarray, before: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The mask of a neighbouring frame along the flow.

    image, before: (H, W, 3) uint8 of this and of the neighbouring frame;  mask: (H, W) uint8 of that frame
    Returns (H, W) uint8 OBJECT, OTHER, or UNKNOWN where the flow there and back does not close.
    Source: T. Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016.
    """
    back, forth = (dense_flow(*pair, finest_scale=_FLOW_SCALE) for pair in ((image, before), (before, image)))
    height, width = mask.shape
    x = np.arange(width, dtype=np.float32) + back[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + back[..., 1]
    returned = cv2.remap(
        forth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e6, 1e6)
    )
    miss = np.linalg.norm(back + returned, axis=-1)
    carried = cv2.remap(mask, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=UNKNOWN)
    return np.where(miss <= _FLOW_MISS_PX, carried, UNKNOWN).astype(np.uint8)


def find_frame(
    instant: Instant,
    side: float,
    hints: Mapping[str, np.ndarray],
    before: tuple[np.ndarray, np.ndarray] | None = None,
    thing: Thing | None = None,
) -> Found:
    """The thing at one frame, from what each camera believes of it.

    hints: camera -> (H, W) uint8 OBJECT, OTHER or UNKNOWN
    before, thing: of any but the marked frame: points of the thing and of what else moves in the
    neighbouring one, and what the marked one told of it
    """
    voxels = voxels_of(instant, side)
    if thing is None or before is None:
        labels = settle_labels(voxels, vote_labels(voxels, hints, before))
        is_speck = find_specks(voxels, labels, before)
    else:
        belief = average_belief(voxels, {n: thing.colours.of(image) for n, image in instant.images.items()})
        labels, is_speck = _label_carried(voxels, hints, before, thing, belief)
    points, others = voxels.centers[labels == OBJECT], voxels.centers[(labels == OTHER) & ~is_speck]
    still = _still_nearby(instant, points, side)
    masks, kinds = {}, {}
    for name, image in instant.images.items():
        at, depth = voxels.index[name], instant.depths[name]
        kind = np.where(np.isfinite(depth) & ~instant.untold[name], OTHER, UNKNOWN).astype(np.uint8)
        kind[at >= 0] = labels[at[at >= 0]]
        is_mover = (at >= 0) & (kind == OTHER)
        kind[is_mover] = MOVER
        is_mover[is_mover] = ~is_speck[at[is_mover]]
        ours = splat_points(instant.cameras[name], points, side)
        theirs = splat_points(instant.cameras[name], others, side)
        masks[name] = refine_outline(image, kind, ours < theirs, instant.plate_finder(name, points))
        # What lies in another one's rim is not handed on, or whatever touches the thing would follow it.
        sure, theirs_alone = masks[name] & (ours < theirs), is_mover & ~widen(masks[name], RIM_PX)
        kinds[name] = np.where(sure, OBJECT, np.where(theirs_alone, OTHER, UNKNOWN)).astype(np.uint8)
    return Found(masks, kinds, points, others, still)


def _label_carried(
    voxels: MovingVoxels,
    hints: Mapping[str, np.ndarray],
    before: tuple[np.ndarray, np.ndarray],
    thing: Thing,
    belief: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """(V,) uint8 OBJECT or OTHER, and (V,) bool what is not to be handed on, for `find_frame`."""
    votes = vote_labels(voxels, hints, before, belief)
    labels = settle_labels(voxels, votes)
    is_speck = find_specks(voxels, labels, before)
    if len(before[0]) < LOST_SHARE * thing.size:
        is_back, is_small = find_returned(voxels, votes, belief, thing.size)
        labels[is_back] = OBJECT
        is_speck = (is_speck | is_small) & ~is_back
    if thing.is_one:
        ours = np.flatnonzero(labels == OBJECT)
        labels[ours[find_strays(voxels.centers[ours], voxels.side)]] = OTHER
    return labels, is_speck


def find_rest(instant: Instant, found: Found, side: float) -> Found:
    """All else that moves at the frame of a thing."""
    masks = {}
    for name, image in instant.images.items():
        theirs = found.kinds[name]
        kind = np.where(np.isfinite(instant.depths[name]) & ~instant.untold[name], OTHER, UNKNOWN)
        kind = np.where(theirs == OTHER, OBJECT, np.where(theirs == OBJECT, MOVER, kind)).astype(np.uint8)
        rest = splat_points(instant.cameras[name], found.others, side)
        thing = splat_points(instant.cameras[name], found.points, side)
        plates = instant.plate_finder(name, found.others)
        masks[name] = refine_outline(image, kind, rest < thing, plates) & ~found.masks[name]
    still = _still_nearby(instant, found.others, side)
    return Found(masks, found.kinds, found.others, found.points, still)


def _still_nearby(instant: Instant, points: np.ndarray, side: float) -> np.ndarray:
    """(K, 3) centres of voxels around the thing's that stand still."""
    near = {}
    for name, camera in instant.cameras.items():
        is_still = ~instant.moving[name] & ~instant.untold[name]
        places, index = world_points(camera, np.where(is_still, instant.depths[name], np.nan))
        if len(points):
            low, high = points.min(axis=0) - 4 * side, points.max(axis=0) + 4 * side
            around = ((places >= low) & (places <= high)).all(axis=1)
            places, index = places[around], index[around]
            close = np.isfinite(distances_to(places, points, 4 * side))
            near[name] = places[close], index[close]
    shapes = {name: depth.shape for name, depth in instant.depths.items()}
    return gather_voxels(near, shapes, side).centers


def splat_points(camera: Camera, points: np.ndarray, side: float) -> np.ndarray:
    """(H, W) float32 z of the nearest point, each as wide as a voxel; infinite where there is none."""
    width, height = camera.size
    image = np.full((height, width), np.inf, np.float32)
    if not len(points):
        return image
    pixels, z = camera.project(points)
    front = z > 0
    pixels, z = np.rint(pixels[front]).astype(np.int64), z[front].astype(np.float32)
    if not len(z):
        return image
    radius = int(np.clip(np.ceil(0.6 * side * camera.focal_px / np.median(z)), 1, 8))
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            x, y = pixels[:, 0] + dx, pixels[:, 1] + dy
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            np.minimum.at(image, (y[inside], x[inside]), z[inside])
    return image


def carry_mark(
    hints: Mapping[str, np.ndarray],
    frame: int,
    frames: Sequence[int],
    load: Callable[[int], Instant],
    side: float,
    carry: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> dict[int, Found]:
    """The thing at all frames, from hints at one of them, forth and back in time.

    frames: rising, with `frame` among them;  load: gives the instant of a frame;  side: of a voxel
    carry: takes masks from frame to frame, as `carry_flow` does
    """
    carry = carry or carry_flow
    first = find_frame(load(frame), side, hints)
    parts = {name: (kind == OBJECT, kind == OTHER) for name, kind in first.kinds.items()}
    # A ball that flew past goes with who it passed until it is apart again.
    is_one = is_one_thing(first.points, side)
    thing = Thing(learn_colours(load(frame).images, parts), len(first.points), is_one)
    found = {frame: first}
    start = list(frames).index(frame)
    for order in (frames[start + 1 :], frames[:start][::-1]):
        before, at = load(frame), frame
        for now in order:
            instant = load(now)
            carried = {
                name: carry(image, before.images[name], found[at].kinds[name])
                for name, image in instant.images.items()
            }
            found[now] = find_frame(instant, side, carried, (found[at].points, found[at].others), thing)
            before, at = instant, now
            log.info("frame %d: %d voxels", now, len(found[now].points))
    return found
