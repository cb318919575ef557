"""One edited frame of a view: what is put where, and where every edited pixel came from."""

import dataclasses

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.edit.carry import splat_points
from fourd.edit.moving import world_points
from fourd.edit.outline import refine_outline, widen
from fourd.edit.voxels import MOVER, OBJECT, OTHER, UNKNOWN, distances_to

# What a pixel shows, in the first channel of a provenance picture.
UNTOUCHED, INSERTED, SAME_TIME, OTHER_TIME, INFERRED = 0, 40, 80, 160, 255
NOBODY = 255
# Share of the depth by which a surface lies before the plate.
_IN_FRONT = 0.03
# Below this opacity an edit is not counted.
_LEAST_OPACITY = 0.02


@dataclasses.dataclass(eq=False)
class Canvas:
    """A frame while it is edited.

    image: (H, W, 3) float32 0-255;  kind, camera, time: (H, W) uint8, see `provenance`
    """

    image: np.ndarray
    kind: np.ndarray
    camera: np.ndarray
    time: np.ndarray

    @classmethod
    def of(cls, image: np.ndarray) -> "Canvas":
        """An untouched frame, (H, W, 3) uint8."""
        shape = image.shape[:2]
        nobody = np.full(shape, NOBODY, np.uint8)
        return cls(image.astype(np.float32), np.full(shape, UNTOUCHED, np.uint8), nobody, nobody.copy())

    def lay(self, layer: "Canvas", opacity: np.ndarray) -> None:
        """Put a layer over the frame. opacity: (H, W) float32 0 to 1."""
        self.image += opacity[..., None] * (layer.image - self.image)
        seen = opacity > _LEAST_OPACITY
        for mine, its in ((self.kind, layer.kind), (self.camera, layer.camera), (self.time, layer.time)):
            mine[seen] = its[seen]

    def picture(self) -> np.ndarray:
        """(H, W, 3) uint8."""
        return np.clip(np.rint(self.image), 0, 255).astype(np.uint8)

    def provenance(self) -> np.ndarray:
        """(H, W, 3) uint8: kind, index of the camera and of the frame it came from, 255 = nobody."""
        return np.stack([self.kind, self.camera, self.time], axis=-1)


def soften(mask: np.ndarray, grow_px: float, feather_px: float) -> np.ndarray:
    """(H, W) float32 opacity of an edit: 1 inside the mask, falling off beyond it.

    mask: (H, W) bool. The edge moves by fractions of a pixel, so that nothing jumps from frame to frame.
    """
    if not mask.any():
        return np.zeros(mask.shape, np.float32)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    opacity = np.clip(1 + grow_px - outside + 0.5, 0, 1).astype(np.float32)
    return cv2.GaussianBlur(opacity, (0, 0), feather_px) if feather_px > 0 else opacity


def mask_in_view(
    image: np.ndarray,
    camera: Camera,
    depth: np.ndarray,
    things: tuple[np.ndarray, np.ndarray, np.ndarray],
    side: float,
    background: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """(H, W) bool where a view that has no mask of its own shows the thing.

    depth: (H, W) float32 z that was fused in the view, NaN = unknown;  side: of a voxel
    things: (N, 3) points of the thing, of what else moves, and of what stands still beside it
    background: (H, W, 3) uint8 what stands still, and (H, W) bool where that is known
    """
    points, others, still = things
    kind = np.full(depth.shape, UNKNOWN, np.uint8)
    if len(points):
        kind[np.isfinite(depth)] = OTHER
        low, high = points.min(axis=0) - 2 * side, points.max(axis=0) + 2 * side
        places, index = world_points(camera, depth)
        near = ((places >= low) & (places <= high)).all(axis=1)
        places, index = places[near], index[near]
        ours, theirs, fixed = (distances_to(places, p, 2 * side) for p in (points, others, still))
        nearest = np.minimum(ours, np.minimum(theirs, fixed))
        flat = kind.ravel()
        flat[index[np.isfinite(ours) & (ours == nearest)]] = OBJECT
        flat[index[np.isfinite(theirs) & (theirs < ours)]] = MOVER
    likely = splat_points(camera, points, side) < splat_points(camera, others, side)
    rgb, known = background
    return refine_outline(image, kind, likely, lambda window: (rgb[window], known[window]))


def without_thing(
    composed: np.ndarray,
    consensus: tuple[np.ndarray, np.ndarray, np.ndarray],
    static: tuple[np.ndarray, np.ndarray, np.ndarray],
    origin: tuple[np.ndarray, np.ndarray, np.ndarray],
    frame_index: int,
) -> Canvas:
    """The frame without the thing.

    composed: (H, W, 3) uint8 of the generators
    consensus: (H, W) float32 z without the thing's samples, (H, W) bool valid and (H, W) uint8 camera
    static: (H, W, 3) uint8 what the view itself films at other times, (H, W) bool known, (H, W) float32 z
    origin: (H, W) bool where the background is known, (H, W) uint8 camera and time that saw it
    frame_index: of the frame, in the list of times
    What stands still is taken from the view's own film at other times where that knows it, because no other
    camera shows it as sharply; what moves, from the others at the same time.
    """
    depth, valid, source = consensus
    rgb, known, plate_depth = static
    moves = valid & (depth < plate_depth * (1 - _IN_FRONT))
    moves = cv2.morphologyEx(moves.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    is_static = known & ~widen(moves, 1)
    weight = cv2.GaussianBlur(is_static.astype(np.float32), (0, 0), 0.8) * known
    image = composed.astype(np.float32)
    image += weight[..., None] * (rgb.astype(np.float32) - image)
    layer = Canvas.of(composed)
    layer.image = image
    has_origin, origin_camera, origin_time = origin
    layer.kind[:] = np.where(valid, SAME_TIME, np.where(has_origin, OTHER_TIME, INFERRED))
    layer.camera[:] = np.where(valid, source, np.where(has_origin, origin_camera, NOBODY))
    layer.time[:] = np.where(valid, frame_index, np.where(has_origin, origin_time, NOBODY))
    static_here = is_static & has_origin
    layer.kind[static_here] = OTHER_TIME
    layer.camera[static_here] = origin_camera[static_here]
    layer.time[static_here] = origin_time[static_here]
    return layer
