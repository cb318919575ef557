"""What two cameras see in common, and whether that can be matched after planar rectification.

The common visible volume is the set of points inside both fields of view and both depth ranges:
a convex body. Its vertices tell, before any pixel is matched, which rows, columns and
disparities can correspond, how much of each image that is, and how far it is stretched.
"""

import dataclasses
import itertools

import numpy as np

from fourd.camera import Camera
from fourd.geometry import angle_deg, convergence_point

_BORDER_SAMPLES = 33


@dataclasses.dataclass(frozen=True)
class RectifyOptions:
    """Limits between which a pair is rectified to one plane, swept by planes or refused, and resolution."""

    max_angle_deg: float = 50.0
    min_angle_deg: float = 1.0
    epipole_margin: float = 0.25
    max_focal_ratio: float = 3.0
    max_stretch: float = 3.0
    min_overlap: float = 0.2
    depth_margin: float = 0.05
    scale: float = 1.0


def field_of_view(camera: Camera) -> np.ndarray:
    """(2, 2) lowest and highest x, y at z = 1 of the image's pixels, the lens undone.

    A box around the border: exact without distortion, a little generous with it.
    """
    width, height = camera.size
    across = np.linspace(0, width - 1, _BORDER_SAMPLES)
    down = np.linspace(0, height - 1, _BORDER_SAMPLES)
    edges = [(across, 0 * across), (across, 0 * across + height - 1)]
    edges += [(0 * down, down), (0 * down + width - 1, down)]
    rays = camera.rays(np.concatenate([np.stack(edge, axis=-1) for edge in edges]))[:, :2]
    return np.stack([rays.min(axis=0), rays.max(axis=0)])


def common_volume(
    left: Camera,
    right: Camera,
    R: np.ndarray,
    range_left: tuple[float, float],
    range_right: tuple[float, float],
) -> np.ndarray:
    """Vertices (N, 3) of what both cameras see inside both depth ranges; N = 0 if nothing.

    range_left, range_right: near and far depth in each camera's own frame, world units
    Coordinates are x, y at z = 1 in the left rectified camera, and disparity for focal length 1,
    baseline / depth: in these every field of view and depth bound is a plane, infinity included.
    x - disparity is x in the right rectified camera.
    """
    baseline = float(np.linalg.norm(right.center - left.center))
    planes = [np.array([0.0, 0.0, 1.0, 0.0])]
    for camera, (near, far), shift in ((left, range_left, 0.0), (right, range_right, -1.0)):
        # (x + shift * disparity, y, 1) in the camera's axes, as rows over (x, y, disparity, 1).
        in_camera = camera.R @ R.T
        rows = np.stack([in_camera[:, 0], in_camera[:, 1], shift * in_camera[:, 0], in_camera[:, 2]], axis=1)
        low, high = field_of_view(camera)
        for axis in (0, 1):
            planes += [rows[axis] - low[axis] * rows[2], high[axis] * rows[2] - rows[axis]]
        unit = np.array([0.0, 0.0, 1 / baseline, 0.0])
        planes.append(rows[2] - near * unit)
        if np.isfinite(far):
            planes.append(far * unit - rows[2])
    half_spaces = np.stack(planes)
    half_spaces /= np.linalg.norm(half_spaces, axis=1, keepdims=True)
    triples = half_spaces[list(itertools.combinations(range(len(planes)), 3))]
    # An exactly singular triple makes LAPACK divide by zero on the way to its determinant of 0.
    with np.errstate(divide="ignore", invalid="ignore"):
        triples = triples[np.abs(np.linalg.det(triples[:, :, :3])) > 1e-12]
    vertices = np.linalg.solve(triples[:, :, :3], -triples[:, :, 3:])[..., 0]
    scale = 1 + np.abs(vertices).max(axis=1, initial=0)
    inside = (vertices @ half_spaces[:, :3].T + half_spaces[:, 3]).min(axis=1, initial=np.inf)
    return vertices[inside >= -1e-9 * scale]


def off_axis_deg(camera: Camera, R: np.ndarray) -> float:
    """Largest angle between the corners of an image and the rectified axis.  R: rectified_from_world."""
    corners = np.array([[x, y, 1.0] for x, y in itertools.product(*field_of_view(camera).T)])
    return float(angle_deg(corners @ camera.R, R[2]).max())


def angle_at_scene_deg(
    left: Camera,
    right: Camera,
    R: np.ndarray,
    vertices: np.ndarray,
    range_left: tuple[float, float],
    range_right: tuple[float, float],
) -> float:
    """Angle between the rays from both centres to what both cameras aim at.

    That is the point nearest to both axes if it lies within both depth ranges; cameras in
    parallel aim at nothing, and the middle of the common volume stands for the scene.
    """
    center = convergence_point([left, right])
    depths = [camera.R[2] @ center + camera.t[2] for camera in (left, right)]
    ranges = (range_left, range_right)
    if not all(low <= depth <= high for depth, (low, high) in zip(depths, ranges, strict=True)):
        x, y = vertices[:, :2].mean(axis=0)
        middle = (vertices[:, 2].min() + vertices[:, 2].max()) / 2
        depth = np.linalg.norm(right.center - left.center) / middle
        center = left.center + np.array([x, y, 1.0]) * depth @ R
    return float(angle_deg(center - left.center, center - right.center))


def worst_stretch(left: Camera, right: Camera, R: np.ndarray, vertices: np.ndarray, focal_px: float) -> float:
    """Worst linear magnification, or its inverse, from an image to its rectified form.

    vertices: of `common_volume`;  focal_px: of the rectified images
    """
    worst = 1.0
    for camera, shift in ((left, 0.0), (right, 1.0)):
        x = vertices[:, 0] - shift * vertices[:, 2]
        rays = np.stack([x, vertices[:, 1], np.ones_like(x)], axis=1)
        cos_rectified = 1 / np.linalg.norm(rays, axis=1)
        cos_source = (rays @ (camera.R @ R.T).T)[:, 2] * cos_rectified
        linear = focal_px / camera.focal_px * (cos_source / cos_rectified) ** 1.5
        worst = max(worst, float(np.max(np.maximum(linear, 1 / linear))))
    return worst


def image_overlap(camera: Camera, R: np.ndarray, vertices: np.ndarray, shift: float) -> float:
    """Share of an image inside the box of rows and columns that the other image can match.

    vertices: of `common_volume`;  shift: 0 for the left image, 1 for the right one
    """
    across, down = (np.linspace(0, n - 1, 24) for n in camera.size)
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    rays = camera.rays(pixels) @ (R @ camera.R.T).T
    plane = rays[:, :2] / rays[:, 2:]
    matched = np.stack([vertices[:, 0] - shift * vertices[:, 2], vertices[:, 1]], axis=1)
    inside = (plane >= matched.min(axis=0)) & (plane <= matched.max(axis=0))
    return float(np.all(inside, axis=1).mean())
