"""Triangles drawn into a view, with colours from the nearest camera that sees them."""

from collections.abc import Mapping

import numba
import numpy as np

from fourd.camera import Camera

# A surface is hidden in an input if people's bodies there lie nearer by more than this share of depth.
HIDDEN_SHARE = 0.02


def draw_depth(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) float32 z of the nearest triangle in an ideal pinhole, infinite where there is none.

    vertices: (V, 3) world units;  faces: (F, 3) indices. A triangle that is partly behind the camera
    is left out.
    """
    pixels, depth = camera.project(vertices)
    surface = np.full(camera.size[::-1], np.inf, np.float32)
    _draw(pixels, depth, np.ascontiguousarray(faces), surface)
    return surface


@numba.njit(cache=True)
def _draw(pixels: np.ndarray, depth: np.ndarray, faces: np.ndarray, surface: np.ndarray) -> None:
    height, width = surface.shape
    for f in range(len(faces)):
        a, b, c = faces[f]
        if depth[a] <= 0 or depth[b] <= 0 or depth[c] <= 0:
            continue
        ax, ay, bx, by, cx, cy = (
            pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1],
        )  # fmt: skip
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0:
            continue
        top, bottom = max(0, int(np.ceil(min(ay, by, cy)))), min(height - 1, int(np.floor(max(ay, by, cy))))
        left, right = max(0, int(np.ceil(min(ax, bx, cx)))), min(width - 1, int(np.floor(max(ax, bx, cx))))
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                v = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
                w = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
                u = 1 - v - w
                if u >= 0 and v >= 0 and w >= 0:
                    # Inverse depth is linear in the picture.
                    z = 1 / (u / depth[a] + v / depth[b] + w / depth[c])
                    if z < surface[y, x]:
                        surface[y, x] = z


def colour_surface(
    vertices: np.ndarray,
    faces: np.ndarray,
    camera: Camera,
    inputs: Mapping[str, tuple[np.ndarray, np.ndarray, Camera]],
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) uint8 of the drawn triangles, and (H, W) bool where they are.

    inputs: (h, w, 3) uint8 picture, (h, w) bool where it is known, and its pinhole. A point has the
    colour of the input nearest by angle that has it inside its picture and unhidden by the triangles
    themselves; what else may stand before them is not known. What no input sees has the mean colour.
    """
    surface = draw_depth(vertices, faces, camera)
    shown = np.isfinite(surface)
    image = np.zeros((*surface.shape, 3), np.uint8)
    if not shown.any():
        return image, shown
    rows, columns = np.nonzero(shown)
    points = camera.unproject(
        np.stack([columns, rows], axis=1).astype(np.float64), surface[shown].astype(np.float64)
    )
    nearest = np.full(len(points), -np.inf)
    colours = np.zeros((len(points), 3), np.uint8)
    to_view = _unit(camera.center - points)
    for picture, valid, other in inputs.values():
        pixels, depth = other.project(points)
        inside = (
            (depth > 0) & (pixels > -0.5).all(axis=1) & (pixels < np.subtract(other.size, 0.5)).all(axis=1)
        )
        x, y = np.floor(np.where(inside[:, None], pixels, 0) + 0.5).astype(int).T
        hiding = draw_depth(vertices, faces, other)
        sees = inside & valid[y, x] & (depth <= hiding[y, x] * (1 + HIDDEN_SHARE))
        cosine = np.einsum("ij,ij->i", to_view, _unit(other.center - points))
        better = sees & (cosine > nearest)
        nearest[better] = cosine[better]
        colours[better] = picture[y[better], x[better]]
    seen = np.isfinite(nearest)
    if seen.any():
        colours[~seen] = np.floor(colours[seen].mean(axis=0) + 0.5).astype(np.uint8)
    image[shown] = colours
    return image, shown


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
