"""How far a film's views lie from where people filmed: what the estimates cannot know begins there."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import nnls

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.geometry import angle_deg
from fourd.sfm.cameras import SceneCameras
from fourd.views import View

# A view up to half a spacing outside is still nearer to a camera than cameras are to each other.
MAX_SPACINGS = 0.5


def distance_to_hull(point: np.ndarray, corners: np.ndarray) -> float:
    """Distance of a point (3,) to the convex hull of points (N, 3), in their units; 0 inside.

    Any N and flat arrangements are allowed. The nearest point of the hull is a mean of the corners with
    weights from 0 that add up to 1: a non-negative least squares problem, whose sum is held by a row of
    large weight.
    Source: Lawson and Hanson, Solving Least Squares Problems, 23.3 and 20.
    """
    extent = float(np.ptp(corners, axis=0).max()) or 1.0
    system = np.vstack([(corners - point).T / extent, np.full(len(corners), 1e4)])
    weights, _ = nnls(system, np.array([0.0, 0.0, 0.0, 1e4]))
    return float(np.linalg.norm((weights / weights.sum()) @ (corners - point)))


def camera_spacing(centers: np.ndarray) -> float:
    """Median distance of a camera (N, 3) to the nearest at another place; infinite if there is none."""
    gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    return float(np.median(np.min(np.where(gaps > 0, gaps, np.inf), axis=1)))


def describe_view(camera: Camera, inputs: Sequence[Camera]) -> dict[str, Any]:
    """Where a pinhole stands among the cameras of the same instant.

    Returns hull_distance (world units, 0 inside their convex hull), spacing (median distance of
    neighbouring cameras), nearest (index of the nearest camera), turn_deg (smallest angle to a camera's
    direction), is_outside and reason (empty inside).
    """
    if len(inputs) < 2:
        raise InputError(f"expected two or more cameras around the path, got {len(inputs)}: add cameras")
    centers = np.stack([c.center for c in inputs])
    distance, spacing = distance_to_hull(camera.center, centers), camera_spacing(centers)
    angles = angle_deg(np.stack([c.forward for c in inputs]), camera.forward)
    closest = int(np.argmin(angles))
    half_view = np.degrees(np.arctan2(np.hypot(*inputs[closest].size) / 2, inputs[closest].focal_px))
    reasons = []
    if distance > MAX_SPACINGS * spacing:
        reasons.append(f"{distance / spacing:.2f} camera spacings outside the cameras' hull")
    if angles[closest] > half_view:
        reasons.append(f"turned {angles[closest]:.0f} degrees from what any camera films")
    return {
        "hull_distance": distance,
        "spacing": spacing,
        "nearest": int(np.argmin(np.linalg.norm(centers - camera.center, axis=1))),
        "turn_deg": float(angles[closest]),
        "is_outside": bool(reasons),
        "reason": "; ".join(reasons),
    }


def describe_path(view: View, scene: SceneCameras) -> dict[str, Any]:
    """The document of render/{trajectory}.json: every frame of a film among the input cameras.

    Returns `view`, `num_outside`, `spacing` (of the first frame, world units) and `frames`: `frame`,
    `scene_frame`, `center`, `forward` (world), `fov_deg` (vertical), `nearest` (camera name) and the rest
    of `describe_view`.
    """
    frames = []
    for entry in view.frames:
        inputs = [scene.tracks[name].at(entry.scene_frame) for name in scene.inputs]
        facts = describe_view(entry.camera, inputs)
        fov_deg = 2 * np.degrees(np.arctan2(view.size[1], 2 * entry.camera.K[1, 1]))
        frames.append(
            {
                "frame": entry.frame,
                "scene_frame": entry.scene_frame,
                "center": entry.camera.center.tolist(),
                "forward": entry.camera.forward.tolist(),
                "fov_deg": float(fov_deg),
                **facts,
                "nearest": scene.inputs[facts["nearest"]],
            }
        )
    return {
        "view": view.name,
        "num_outside": sum(frame["is_outside"] for frame in frames),
        "spacing": frames[0]["spacing"] if frames else None,
        "frames": frames,
    }
