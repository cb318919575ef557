"""Parts of a held-out frame: what moves, what the inputs see, what is only inferred.

What moves comes from true masks, or from what no still picture explains; the others come from the
workflow's own estimates for the view.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import nnls

from fourd.baselines import Evidence
from fourd.baselines.warp import FARTHEST
from fourd.camera import Camera
from fourd.errors import InputError
from fourd.evaluate import EvaluateOptions
from fourd.image import undistort
from fourd.io import read_image

STRIP_ROWS = 64
# How far a view may look from outside the inputs' cone and still count as between them: cameras that
# stand in one plane, as people hold them, span a flat cone.
HULL_TOLERANCE_DEG = 5.0
HULL_STEP_PX = 16


def read_dynamic_mask(folder: Path, frame: int, camera: Camera, target: Camera) -> np.ndarray:
    """(h, w) bool from a true mask `000012.png`, 0 where nothing moves, as the target view sees it.

    Raises InputError if the mask is missing or not of the camera's size.
    """
    path = folder / f"{frame:06d}.png"
    labels = read_image(path)
    if labels.shape[1::-1] != camera.size:
        raise InputError(
            f"expected a mask of the camera's {camera.size[0]} x {camera.size[1]} px at {path}, got "
            f"{labels.shape[1]} x {labels.shape[0]}: give masks of the original size"
        )
    moves = np.repeat((labels > 0).any(axis=2, keepdims=True), 3, axis=2)
    resampled, valid = undistort(moves.astype(np.uint8) * 255, camera, target)
    return (resampled[..., 0] > 127) & valid


class StillPicture:
    """What a camera shows most of the time, from any of its poses: the median of frames of its own.

    Frames are brought together by rotation alone, exact for a camera that turns where it stands;
    what a few centimetres of shake displace is left to the tolerance of `find_dynamic_pixels`.
    """

    def __init__(self, frames: Sequence[tuple[np.ndarray, Camera]]) -> None:
        self._camera = frames[len(frames) // 2][1].without_distortion()
        turned = [undistort(image, _moved(camera, self._camera), self._camera) for image, camera in frames]
        shape = turned[0][0].shape
        self._rgb, self._valid = np.zeros(shape, np.uint8), np.zeros(shape[:2], bool)
        # In strips, since the median needs all frames as float.
        for top in range(0, shape[0], STRIP_ROWS):
            rows = slice(top, top + STRIP_ROWS)
            values = np.stack([np.where(ok[rows, :, None], rgb[rows], np.nan) for rgb, ok in turned])
            self._valid[rows] = ~np.isnan(values[..., 0]).all(axis=0)
            values[:, ~self._valid[rows]] = 0
            self._rgb[rows] = np.floor(np.nanmedian(values, axis=0) + 0.5).astype(np.uint8)

    def seen_from(self, target: Camera) -> tuple[np.ndarray, np.ndarray]:
        """(h, w, 3) uint8 and (h, w) bool as a view of this camera sees it."""
        return undistort(self._rgb, _moved(self._camera, target), target)


def _moved(camera: Camera, to: Camera) -> Camera:
    """The camera with its own direction at another camera's centre."""
    return dataclasses.replace(camera, t=-camera.R @ to.center)


def surface_regions(evidence: Evidence) -> dict[str, np.ndarray]:
    """(H, W) bool: `seen_1`, `seen_2`, `inferred` and `outside_hull` (see `find_outside_hull`).

    seen_N: pixels whose surface, by the depth of the consensus or else of the background, lies in
    the pictures of N inputs and is not hidden there by another surface of the view, or was agreed
    on by pairs of that many cameras. What hides it outside the view is not known.
    inferred: pixels that no estimate covers, or that only the background covers, by depth continued
    from around a hole (`filled`).
    """
    near, far = evidence.foreground["consensus_valid"], evidence.background["farthest_valid"]
    agreed = np.where(near, evidence.foreground["num_cameras"], np.uint8(0))
    num_seen = np.maximum(evidence.warp.num_seen, agreed)
    return {
        "seen_1": num_seen >= 1,
        "seen_2": num_seen >= 2,
        "inferred": ~near & (~far | evidence.background["filled"]),
        "outside_hull": find_outside_hull(
            evidence.depth, evidence.camera, [entry.camera.center for entry in evidence.inputs.values()]
        ),
    }


def find_outside_hull(depth: np.ndarray, camera: Camera, centers: Sequence[np.ndarray]) -> np.ndarray:
    """(H, W) bool: where a view looks at a surface from a direction that lies between no inputs.

    depth: (H, W) z in `camera`, world units, NaN = none;  centers: (3,) of the inputs, world units
    From the surface point, the direction to the view must lie more than 5 degrees outside the convex
    cone of the directions to all inputs, whether they see the point or not. Where there is no depth
    nothing can be said, so the pixel is not outside. Decided on a grid of 16 px: directions turn slowly.
    """
    if not centers:
        return ~np.isnan(depth)
    rows, columns = (np.arange(HULL_STEP_PX // 2, side, HULL_STEP_PX) for side in depth.shape)
    height, width = depth.shape
    grid = np.ix_(rows if len(rows) else [height // 2], columns if len(columns) else [width // 2])
    z = np.minimum(depth[grid].astype(np.float64), FARTHEST)
    y, x = np.broadcast_arrays(*grid)
    points = camera.unproject(np.stack([x, y], axis=-1).astype(np.float64), z)
    outside = np.zeros(z.shape, bool)
    for index in zip(*np.nonzero(~np.isnan(z)), strict=True):
        to_view, *to_inputs = (_unit(center - points[index]) for center in (camera.center, *centers))
        # The residual is the sine of the angle to the cone while that is below 90 degrees, else 1.
        outside[index] = nnls(np.stack(to_inputs, axis=1), to_view)[1] > np.sin(
            np.radians(HULL_TOLERANCE_DEG)
        )
    spread = np.repeat(np.repeat(outside, HULL_STEP_PX, axis=0), HULL_STEP_PX, axis=1)
    spread = np.pad(spread, ((0, HULL_STEP_PX), (0, HULL_STEP_PX)), mode="edge")[:height, :width]
    return spread & ~np.isnan(depth)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def compare_masks(found: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Intersection over union, precision and recall of (H, W) bool masks; NaN for a division by 0."""
    both = int((found & true).sum())
    totals = {"mask_iou": found | true, "mask_precision": found, "mask_recall": true}
    counts = {name: int(total.sum()) for name, total in totals.items()}
    return {name: both / count if count else float("nan") for name, count in counts.items()}


def find_dynamic_pixels(
    truth: np.ndarray,
    still_pictures: Sequence[tuple[np.ndarray, np.ndarray]],
    options: EvaluateOptions,
) -> np.ndarray:
    """(H, W) bool: pixels of a true frame that no still picture explains, cleaned of specks.

    truth: (H, W, 3) uint8;  still_pictures: one or more (H, W, 3) uint8 and where it is known,
    (H, W) bool; a pixel that none knows is not dynamic
    """
    known = np.zeros(truth.shape[:2], bool)
    explained = np.zeros_like(known)
    for still, valid in still_pictures:
        known |= valid
        explained |= valid & (_distance_from_range(truth, still, valid, options) <= options.dynamic_threshold)
    moves = (known & ~explained).astype(np.uint8)
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    moves = cv2.morphologyEx(moves, cv2.MORPH_CLOSE, disk)
    moves = cv2.morphologyEx(moves, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(moves, connectivity=8)
    keeps = stats[:, cv2.CC_STAT_AREA] >= options.dynamic_min_share * moves.size
    keeps[0] = False
    return keeps[np.asarray(labels, dtype=np.intp)]


def _distance_from_range(
    truth: np.ndarray, still: np.ndarray, valid: np.ndarray, options: EvaluateOptions
) -> np.ndarray:
    """(H, W) float32 grey levels, the largest over channels, outside the still picture's range nearby."""
    window = np.ones((2 * options.dynamic_tolerance_px + 1,) * 2, np.uint8)
    # Blanks are put outside the range of the others, so they explain nothing.
    lowest = cv2.erode(np.where(valid[..., None], still, np.uint8(255)), window).astype(np.float32)
    highest = cv2.dilate(np.where(valid[..., None], still, np.uint8(0)), window).astype(np.float32)
    return np.maximum(lowest - truth, truth - highest).max(axis=2)
