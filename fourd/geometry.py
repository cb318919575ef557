"""Rotations, look-at poses, triangulation. World and camera frames as in `fourd.camera`."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from fourd.camera import Camera


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between vectors (..., 3), degrees; exact for tiny and for flat angles.

    Source: W. Kahan, "How Futile are Mindless Assessments of Roundoff", section 12.
    """
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    difference = np.linalg.norm(a - b, axis=-1)
    total = np.linalg.norm(a + b, axis=-1)
    return np.degrees(2 * np.arctan2(difference, total))


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Rotation closest to a (3, 3) matrix in the Frobenius norm (orthogonal Procrustes)."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


def look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R (3, 3), t (3,) cam_from_world of a camera at `center` that looks at `target`.

    up: (3,) world direction that appears upward in the image
    Raises ValueError if the target is at the centre or the view is along `up`.
    """
    forward = target - center
    right = np.cross(forward, up)
    if np.linalg.norm(forward) == 0 or np.linalg.norm(right) <= 1e-9 * np.linalg.norm(forward):
        raise ValueError("look_at needs a target apart from the centre and a view not along `up`")
    z = forward / np.linalg.norm(forward)
    x = right / np.linalg.norm(right)
    R = np.stack([x, np.cross(z, x), z])
    return R, -R @ center


def interpolate_rotations(rotations: Sequence[np.ndarray], at: np.ndarray) -> np.ndarray:
    """(M, 3, 3) rotations at positions `at` (M,) in units of key index, great-circle between keys."""
    keys = Rotation.from_matrix(np.stack(rotations))
    if len(rotations) == 1:
        return np.repeat(keys.as_matrix(), len(at), axis=0)
    return Slerp(np.arange(len(rotations)), keys)(np.clip(at, 0, len(rotations) - 1)).as_matrix()


def convergence_point(cameras: Sequence[Camera]) -> np.ndarray:
    """(3,) world point nearest, in the least squares sense, to all optical axes.

    For parallel axes the problem is singular; the minimum-norm correction from the mean centre
    is returned, which then lies among the cameras: callers check its depth.
    """
    centers = np.stack([c.center for c in cameras])
    axes = np.stack([c.forward for c in cameras])
    off_axis = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    origin = centers.mean(axis=0)
    rhs = (off_axis @ (centers - origin)[:, :, None]).sum(axis=0)[:, 0]
    return origin + np.linalg.lstsq(off_axis.sum(axis=0), rhs, rcond=1e-9)[0]


def triangulate(cameras: Sequence[Camera], pixels: np.ndarray) -> np.ndarray:
    """World points from two or more views by the linear method on normalised rays.

    pixels: (V, N, 2) px, one row of N points per camera, all finite
    Returns (N, 3) world units; NaN where the rays are parallel.
    Source: Hartley and Zisserman, Multiple View Geometry, 12.2 (inhomogeneous, midpoint form).
    """
    centers = np.stack([c.center for c in cameras])
    origin = centers.mean(axis=0)
    directions = np.stack([c.rays(p) @ c.R for c, p in zip(cameras, pixels, strict=True)])
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    off_ray = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    normal = off_ray.sum(axis=0)
    rhs = (off_ray @ (centers - origin)[:, None, :, None]).sum(axis=0)
    singular = np.linalg.cond(normal) > 1e12
    normal[singular] = np.eye(3)
    points = np.linalg.solve(normal, rhs)[..., 0] + origin
    points[singular] = np.nan
    return points
