"""Projection, lenses, rotations and triangulation where they divide by almost nothing."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from fourd.camera import Camera, check_camera
from fourd.geometry import (
    convergence_point,
    interpolate_rotations,
    look_at,
    nearest_rotation,
    triangulate,
)
from fourd.image import undistort
from fourd.sfm.normalize import estimate_similarity
from fourd.stability import rig
from fourd.stability.case import (
    Outcome,
    elementwise_difference,
    judge,
    judge_refusal,
    make_cases,
    reason_of,
    relative_difference,
)

CAMERA = rig.on_arc(0)
PIXELS = np.stack(np.meshgrid(np.arange(rig.SIZE[0]), np.arange(rig.SIZE[1])), axis=-1).astype(np.float64)
EPS = float(np.finfo(np.float64).eps)


def _with_lens(*coefficients: float) -> Camera:
    lens = np.zeros(5)
    lens[: len(coefficients)] = coefficients
    return dataclasses.replace(CAMERA, distortion=lens)


def points_behind_the_camera() -> Outcome:
    """No pixel, and the depth says why."""
    pixels, depth = CAMERA.project(CAMERA.center - CAMERA.forward * np.array([[1e-9], [1.0], [1e9]]))
    return judge(bool(np.isnan(pixels).all() and (depth < 0).all()), f"depths {depth.max():.1g} and below")


def point_at_the_centre_of_projection() -> Outcome:
    """No pixel: depth 0."""
    pixels, depth = CAMERA.project(CAMERA.center + CAMERA.R[:1])
    return judge(bool(np.isnan(pixels).all()), f"depth {depth[0]:.1g}")


def points_on_the_near_plane() -> Outcome:
    """A depth of a billionth is projected like any other."""
    points = CAMERA.unproject(PIXELS, np.full(PIXELS.shape[:2], 1e-9))
    # The offset from the centre is all that is left of the point; its rounding is the error.
    pixels, _ = CAMERA.project(points)
    error = float(np.abs(pixels - PIXELS).max())
    bound = 20 * EPS * np.linalg.norm(CAMERA.center) / 1e-9 * CAMERA.focal_px
    return judge(bool(error < bound), f"within {error:.1g} px, rounding allows {bound:.1g}")


def points_almost_at_infinity() -> Outcome:
    """A depth of 1e300 is projected like any other."""
    depth = np.full(PIXELS.shape[:2], 1e300)
    error = float(np.abs(CAMERA.project(CAMERA.unproject(PIXELS, depth))[0] - PIXELS).max())
    return judge(error < 1e-9, f"within {error:.1g} px")


def projection_in_single_precision() -> Outcome:
    """Pixels of float32 points as of float64 ones, within a thousandth of a pixel."""
    points = CAMERA.unproject(PIXELS, np.full(PIXELS.shape[:2], 6.0))
    single = dataclasses.replace(CAMERA, R=CAMERA.R.astype(np.float32), t=CAMERA.t.astype(np.float32))
    found = single.project(points.astype(np.float32))[0]
    error_px = float(np.abs(found - PIXELS).max())
    return judge(error_px < 1e-3, f"within {error_px:.1g} px", relative_difference(found, PIXELS))


def lens_of_a_phone() -> Outcome:
    """Pixels return through the lens within a millionth of a pixel."""
    camera = _with_lens(0.12, -0.3, 0.001, -0.001, 0.15)
    error = float(np.abs(camera.pixels_from_normalized(camera.rays(PIXELS)[..., :2]) - PIXELS).max())
    return judge(error < 1e-6, f"within {error:.1g} px")


def lens_of_an_action_camera() -> Outcome:
    """Pixels return through the lens within a millionth of a pixel."""
    camera = _with_lens(-0.35, 0.12)
    error = float(np.abs(camera.pixels_from_normalized(camera.rays(PIXELS)[..., :2]) - PIXELS).max())
    return judge(error < 1e-6, f"within {error:.1g} px")


def lens_that_folds_back_inside_the_picture() -> Outcome:
    """Refused: pixels that no ray reaches."""
    return judge_refusal(reason_of(check_camera, _with_lens(-0.9), "cameras.json, camera cam00"), "lens")


def undistorted_there_and_back() -> Outcome:
    """The picture, but for two resamplings, where both lenses look."""
    image = np.asarray(rig.render(CAMERA))
    bent = _with_lens(-0.2, 0.05)
    there, _ = undistort(image, CAMERA, bent)
    back, seen = undistort(there, bent, CAMERA)
    inner = seen.copy()
    inner[:4] = inner[-4:] = inner[:, :4] = inner[:, -4:] = False
    error = float(np.median(np.abs(back.astype(int) - image)[inner]))
    return judge(bool(inner.mean() > 0.5) and error <= 4, f"median {error:.0f} levels off")


def pinhole_of_zero_focal_length() -> Outcome:
    """Refused: the focal length is named."""
    K = CAMERA.K.copy()
    K[0, 0] = 0
    return judge_refusal(reason_of(check_camera, dataclasses.replace(CAMERA, K=K), "cam00"), "focal")


def mirrored_rotation() -> Outcome:
    """Refused: a reflection is no rotation."""
    mirrored = dataclasses.replace(CAMERA, R=np.diag([-1.0, 1, 1]) @ CAMERA.R)
    return judge_refusal(reason_of(check_camera, mirrored, "cam00"), "rotation")


def _triangulation(angle_deg: float) -> tuple[float, float]:
    """Largest relative error of triangulated points, and the condition of their normal matrix."""
    cameras = [rig.on_arc(0), rig.on_arc(angle_deg)]
    points = rig.seen_points(cameras)[:200]
    pixels = np.stack([camera.project(points)[0] for camera in cameras])
    directions = np.stack([c.rays(p) @ c.R for c, p in zip(cameras, pixels, strict=True)])
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    normal = (np.eye(3) - directions[..., :, None] * directions[..., None, :]).sum(axis=0)
    found = triangulate(cameras, pixels)
    distance = np.linalg.norm(points - cameras[0].center, axis=1)
    error = np.linalg.norm(found - points, axis=1) / distance
    return float(error.max()), float(np.linalg.cond(normal).max())


def triangulation_at_10_degrees() -> Outcome:
    """As exact as the condition allows."""
    error, condition = _triangulation(10.0)
    return judge(error < EPS * condition, f"within {error:.1g} of the distance", condition_number=condition)


def triangulation_at_a_hundredth_of_a_degree() -> Outcome:
    """As exact as the condition allows."""
    error, condition = _triangulation(0.01)
    return judge(error < EPS * condition, f"within {error:.1g} of the distance", condition_number=condition)


def triangulation_of_parallel_rays() -> Outcome:
    """No point: NaN, as documented, which every caller drops."""
    right = dataclasses.replace(CAMERA, t=CAMERA.t - np.array([0.5, 0, 0]))
    points = triangulate([CAMERA, right], np.full((2, 3, 2), 40.0))
    return judge(bool(np.isnan(points).all()), "NaN")


def triangulation_from_two_equal_cameras() -> Outcome:
    """No point: NaN, as documented."""
    points = triangulate([CAMERA, CAMERA], np.full((2, 3, 2), 40.0))
    return judge(bool(np.isnan(points).all()), "NaN")


def axes_that_never_meet() -> Outcome:
    """A finite point among the cameras, and the world is centred on them instead."""
    cameras = [dataclasses.replace(CAMERA, t=CAMERA.t - np.array([0.3 * i, 0, 0])) for i in range(4)]
    axes = np.stack([c.forward for c in cameras])
    off_axis = (np.eye(3) - axes[:, :, None] * axes[:, None, :]).sum(axis=0)
    point, similarity = convergence_point(cameras), estimate_similarity(cameras)
    is_right = bool(np.isfinite(point).all()) and not similarity.converges and similarity.scale > 0
    condition = float(np.linalg.cond(off_axis))
    return judge(
        is_right, f"scale {similarity.scale:.2g}, centred on the cameras", condition_number=condition
    )


def all_cameras_in_one_place() -> Outcome:
    """World units are kept: there is no size to take them from."""
    cameras = [rig.on_arc(0, roll_deg=10.0 * i) for i in range(3)]
    similarity = estimate_similarity(cameras)
    return judge(similarity.scale == 1 and not similarity.converges, f"scale {similarity.scale:g}")


def rotation_nearest_to_a_singular_matrix() -> Outcome:
    """A rotation, of determinant 1."""
    found = [nearest_rotation(m) for m in (np.zeros((3, 3)), np.diag([1.0, 1e-300, 0]), -np.eye(3))]
    error = max(float(np.abs(R @ R.T - np.eye(3)).max()) for R in found)
    is_right = error < 1e-12 and all(np.linalg.det(R) > 0.999 for R in found)
    return judge(is_right, f"orthonormal within {error:.1g}")


def rotations_180_degrees_apart() -> Outcome:
    """A path of rotations between them, half way at 90 degrees from both."""
    ends = [np.eye(3), np.diag([-1.0, -1.0, 1.0])]
    middle = interpolate_rotations(ends, np.array([0.5]))[0]
    angles = [np.degrees(Rotation.from_matrix(end.T @ middle).magnitude()) for end in ends]
    return judge(bool(np.allclose(angles, 90)), f"{angles[0]:.6f} and {angles[1]:.6f} degrees")


def camera_that_looks_along_up() -> Outcome:
    """Refused: the roll is not defined."""
    above = np.array([0.0, 0.0, 5.0])
    return judge_refusal(reason_of(look_at, above, np.zeros(3), np.array([0.0, 0, 1])), "along")


def picture_resized_to_one_pixel() -> Outcome:
    """The middle of the picture stays in its middle."""
    tiny = CAMERA.resized((1, 1))
    middle = np.append((np.array(rig.SIZE) - 1) / 2, 1)
    ray = tiny.rays(np.zeros(2)) - np.linalg.inv(CAMERA.K) @ middle
    error = elementwise_difference(1 + ray, np.ones(3))
    return judge(error < 1e-12, f"ray within {error:.1g}")


CASES = make_cases(
    "cameras",
    points_behind_the_camera,
    point_at_the_centre_of_projection,
    points_on_the_near_plane,
    points_almost_at_infinity,
    projection_in_single_precision,
    lens_of_a_phone,
    lens_of_an_action_camera,
    lens_that_folds_back_inside_the_picture,
    undistorted_there_and_back,
    pinhole_of_zero_focal_length,
    mirrored_rotation,
    triangulation_at_10_degrees,
    triangulation_at_a_hundredth_of_a_degree,
    triangulation_of_parallel_rays,
    triangulation_from_two_equal_cameras,
    axes_that_never_meet,
    all_cameras_in_one_place,
    rotation_nearest_to_a_singular_matrix,
    rotations_180_degrees_apart,
    camera_that_looks_along_up,
    picture_resized_to_one_pixel,
)
