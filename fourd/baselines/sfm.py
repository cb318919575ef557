"""SfM: the sparse points in the held-out view, with the colours of the nearest input camera."""

import cv2
import numpy as np

from fourd.baselines.evidence import Evidence, Unavailable
from fourd.baselines.warp import find_visible

SPLAT_RADIUS_PX = 1


def render(evidence: Evidence) -> np.ndarray:
    """(H, W, 3) uint8 points as squares of 3 px, near ones over far ones, black elsewhere."""
    return draw_points(evidence, SPLAT_RADIUS_PX)[0]


def draw_points(evidence: Evidence, radius_px: int) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) uint8 and (H, W) bool where a point is. Raises Unavailable if none is in view.

    A point has the colour of the input that falls nearest to the view by angle and has the point
    inside its picture.
    """
    height, width = evidence.truth.shape[:2]
    if not len(evidence.points):
        raise Unavailable("there are no sparse points (sfm/points.npz is empty)")
    colours, has_colour = _colour_points(evidence)
    pixels, seen = find_visible(evidence.points, evidence.camera, np.ones((height, width), bool))
    depth = evidence.camera.project(evidence.points)[1]
    chosen = np.flatnonzero(seen & has_colour)
    if not len(chosen):
        raise Unavailable("no sparse point lies in the held-out view and in an input's picture")
    chosen = chosen[np.argsort(-depth[chosen], kind="stable")]
    image = np.zeros((height, width, 3), np.uint8)
    shown = np.zeros((height, width), bool)
    x, y = np.floor(pixels[chosen] + 0.5).astype(int).T
    for column, row, index in zip(x, y, chosen, strict=True):
        window = (
            slice(max(row - radius_px, 0), row + radius_px + 1),
            slice(max(column - radius_px, 0), column + radius_px + 1),
        )
        image[window] = colours[index]
        shown[window] = True
    return image, shown


def _colour_points(evidence: Evidence) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) uint8 and (N,) bool, whether any input has the point inside its picture."""
    points = evidence.points
    best = np.full(len(points), -np.inf)
    colours = np.zeros((len(points), 3), np.uint8)
    to_view = points - evidence.camera.center
    for entry in evidence.inputs.values():
        pixels, seen = find_visible(points, entry.camera, entry.valid)
        to_input = points - entry.camera.center
        norms = np.linalg.norm(to_view, axis=1) * np.linalg.norm(to_input, axis=1)
        cosine = np.einsum("ij,ij->i", to_view, to_input) / np.maximum(norms, 1e-300)
        nearer = seen & (cosine > best)
        x, y = np.floor(pixels[nearer] + 0.5).astype(int).T
        size = entry.camera.size
        colours[nearer] = entry.image[np.minimum(y, size[1] - 1), np.minimum(x, size[0] - 1)]
        best[nearer] = cosine[nearer]
    return colours, np.isfinite(best)


def fill_nearest(image: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 in which every pixel has the colour of the nearest shown one, of which there is one."""
    blank = np.where(shown, 0, 255).astype(np.uint8)
    _, found = cv2.distanceTransformWithLabels(
        blank, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    labels = np.asarray(found, dtype=np.intp)
    colours = np.zeros((int(labels.max()) + 1, 3), np.uint8)
    colours[labels[shown]] = image[shown]
    return colours[labels]
