"""Pictures that stand in the scene: upright, facing the view, hidden by what is nearer."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.errors import InputError


@dataclasses.dataclass(frozen=True, eq=False)
class Place:
    """Where inserted pictures stand. anchor: (3,) world, below their middle;  height: world units."""

    anchor: np.ndarray
    height: float


def place_in_box(box: Sequence[Sequence[float]], camera: Camera, depth: np.ndarray, what: str) -> Place:
    """The place of a picture that fills a box of a view and stands on what is seen at its lower edge.

    box: left, top and right, bottom, px;  depth: (H, W) float32 z of the view;  what: for the message
    Raises InputError where nothing is known below the box.
    """
    (left, top), (right, bottom) = box
    height, width = depth.shape
    rows = slice(int(np.clip(bottom - 2, 0, height - 1)), int(np.clip(bottom + 3, 1, height)))
    columns = slice(int(np.clip(left, 0, width - 1)), int(np.clip(right + 1, 1, width)))
    below = depth[rows, columns]
    if not np.isfinite(below).any():
        raise InputError(
            f"{what}: expected a surface to stand on at the lower edge of the box, nothing is known there: "
            "draw the box on ground that several cameras see"
        )
    z = float(np.median(below[np.isfinite(below)]))
    anchor = camera.unproject(np.array([[(left + right) / 2, bottom]]), np.array([z]))[0]
    return Place(anchor, (bottom - top) * z / camera.focal_px)


def read_pictures(path: str) -> list[np.ndarray]:
    """(h, w, 4) uint8 RGBA of a PNG or of all PNGs of a folder, by name. Raises InputError."""
    source = Path(path)
    files = sorted(source.glob("*.png")) if source.is_dir() else [source]
    if not files:
        raise InputError(f"insert: expected PNG pictures in {source}, found none: put some there")
    pictures = []
    for file in files:
        try:
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            raise InputError(
                f"insert: expected a picture of ordinary size at {file}, got a larger one: resize it"
            ) from None
        if image is None or image.ndim != 3 or image.shape[2] != 4 or image.dtype != np.uint8:
            given = "nothing that can be decoded" if image is None else f"{image.shape} {image.dtype}"
            raise InputError(
                f"insert: expected an 8-bit RGBA PNG at {file}, got {given}: save it with transparency"
            )
        pictures.append(np.ascontiguousarray(image[:, :, [2, 1, 0, 3]]))
    return pictures


def draw_picture(
    picture: np.ndarray, place: Place, camera: Camera, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture as a view sees it.

    picture: (h, w, 4) uint8 RGBA;  camera: ideal pinhole;  up: (3,) unit, world
    Returns (H, W, 3) uint8, (H, W) float32 opacity 0 to 1 and (H, W) float32 z of the picture's plane.
    """
    size = camera.size
    blank = np.zeros((size[1], size[0], 3), np.uint8), np.zeros(size[::-1], np.float32)
    toward = place.anchor - camera.center
    right = np.cross(toward, up)
    norm = float(np.linalg.norm(right))
    # Seen from straight above, an upright picture is a line.
    if norm < 1e-6 * float(np.linalg.norm(toward)):
        return *blank, np.full(size[::-1], np.inf, np.float32)
    right /= norm
    half = 0.5 * place.height * picture.shape[1] / picture.shape[0]
    top = place.anchor + place.height * up
    corners = np.stack(
        [top - half * right, top + half * right, place.anchor + half * right, place.anchor - half * right]
    )
    pixels, z = camera.project(corners)
    if (z <= 0).any():
        return *blank, np.full(size[::-1], np.inf, np.float32)
    h, w = picture.shape[:2]
    source = np.array([[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]], np.float32)
    homography = cv2.getPerspectiveTransform(source, pixels.astype(np.float32))
    # Premultiplied, so that what is transparent does not bleed.
    values = picture.astype(np.float32)
    values[..., :3] *= values[..., 3:] / 255
    scale = float(np.linalg.norm(pixels[3] - pixels[0])) / h
    if scale < 1:
        values = cv2.GaussianBlur(values, (0, 0), 0.5 / max(scale, 0.02))
    drawn = np.asarray(cv2.warpPerspective(values, homography, size, flags=cv2.INTER_LINEAR))
    alpha = np.clip(drawn[..., 3] / 255, 0, 1)
    rgb = drawn[..., :3] / np.maximum(alpha, 1e-3)[..., None]
    normal = np.cross(right, up)
    grid = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1).astype(np.float64)
    slope = camera.rays(grid) @ (camera.R @ normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = float(normal @ toward) / slope
    plane = np.where(plane > 0, plane, np.inf).astype(np.float32)
    return np.clip(np.rint(rgb), 0, 255).astype(np.uint8), alpha.astype(np.float32), plane
