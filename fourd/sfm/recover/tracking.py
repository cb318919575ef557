"""Observations of the model's points in many pictures, by patches, and poses of further frames."""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import pycolmap

from fourd.camera import Camera
from fourd.sfm.recover.model import HALF_PIXEL, ImageKey, Lens, Model
from fourd.sfm.recover.options import RecoverOptions
from fourd.sfm.recover.patches import align_patches, extract_templates

SEED = 1
# A patch that ends farther from where its point projects has slid to another place.
MAX_SHIFT_PX = 3.0
# Below this many points a pose is an accident.
MIN_POSE_POINTS = 12
FLOW_WINDOW_PX = 21
FLOW_LEVELS = 4
# A neighbour more frames away than this does not say where to look.
MAX_LOOK_BACK = 4

ReadGray = Callable[[str, int], np.ndarray]


@dataclasses.dataclass(frozen=True, eq=False)
class Landmarks:
    """What the points look like: one patch each, from the picture that sees it most squarely.

    points: (P, 3);  templates: (P, S, S) of `extract_templates`;  valid: (P,) bool
    view: (P,) index into cameras, of the picture that the patch is from;  cameras: those pictures'
    """

    points: np.ndarray
    templates: np.ndarray
    valid: np.ndarray
    view: np.ndarray
    cameras: tuple[Camera, ...]

    def affines(self, camera: Camera, rows: np.ndarray) -> np.ndarray:
        """(N, 2, 2) how the patches of points `rows` map into a camera, for surfaces that face both."""
        affines = np.empty((len(rows), 2, 2))
        for view in np.unique(self.view[rows]):
            here = self.view[rows] == view
            affines[here] = affine_between(self.cameras[view], camera, self.points[rows[here]])
        return affines


def affine_between(first: Camera, second: Camera, points: np.ndarray) -> np.ndarray:
    """(N, 2, 2) derivative of second pixels after first pixels on a surface at the points (N, 3).

    Its normal is the bisector of both viewing directions. NaN where a camera does not see it.
    """
    pixels, _ = first.project(points)
    base, _ = second.project(points)
    to_first = first.center - points
    to_second = second.center - points
    normal = to_first / np.linalg.norm(to_first, axis=1, keepdims=True)
    normal = normal + to_second / np.linalg.norm(to_second, axis=1, keepdims=True)
    columns = []
    for step in ([1.0, 0.0], [0.0, 1.0]):
        rays = first.rays(pixels + np.array(step)) @ first.R
        depth = -(to_first * normal).sum(axis=1) / (rays * normal).sum(axis=1)
        moved, _ = second.project(first.center + rays * depth[:, None])
        columns.append(moved - base)
    return np.stack(columns, axis=-1)


def cut_landmarks(model: Model, read_gray: ReadGray, radius_px: int) -> Landmarks:
    """Templates of the model's points; every point has at least one observation."""
    cameras = tuple(model.camera(image) for image in model.images)
    centers = np.stack([camera.center for camera in cameras])
    directions = centers[model.obs_image] - model.points[model.obs_point]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    mean = np.zeros_like(model.points)
    np.add.at(mean, model.obs_point, directions)
    squareness = (directions * mean[model.obs_point]).sum(axis=1)
    order = np.lexsort((model.obs_image, -squareness, model.obs_point))
    best = order[np.r_[True, np.diff(model.obs_point[order]) > 0]]
    view, pixels = model.obs_image[best], model.obs_px[best]
    size = 2 * radius_px + 3
    templates = np.zeros((len(model.points), size, size))
    valid = np.zeros(len(model.points), dtype=bool)
    for i, (name, frame) in enumerate(model.images):
        rows = np.flatnonzero(view == i)
        if len(rows):
            image = read_gray(name, frame).astype(np.float32)
            templates[rows], valid[rows] = extract_templates(image, pixels[rows], radius_px)
    return Landmarks(model.points, templates, valid, view, cameras)


def find_landmarks(
    gray: np.ndarray, camera: Camera, landmarks: Landmarks, rows: np.ndarray, min_score: float
) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks (indices, ascending) that a picture shows, and (N, 2) px where.

    gray: (H, W) uint8;  camera: about where it is;  rows: landmarks to look for, ascending
    """
    rows = rows[landmarks.valid[rows]]
    start, _ = camera.project(landmarks.points[rows])
    width, height = camera.size
    inside = ((start >= 0) & (start <= [width - 1, height - 1])).all(axis=1)
    rows, start = rows[inside], start[inside]
    affines = landmarks.affines(camera, rows)
    usable = np.isfinite(affines).all(axis=(1, 2))
    rows, start, affines = rows[usable], start[usable], affines[usable]
    found, score = align_patches(
        gray.astype(np.float32), landmarks.templates[rows], start, np.ascontiguousarray(affines), 6
    )
    good = (score >= min_score) & (np.linalg.norm(found - start, axis=1) <= MAX_SHIFT_PX)
    return rows[good], found[good]


def observe(
    model: Model, landmarks: Landmarks, read_gray: ReadGray, images: Sequence[ImageKey], min_score: float
) -> Model:
    """The model with observations of its landmarks in `images` (all have poses), all by patches."""
    number = {image: i for i, image in enumerate(model.images)}
    everything = np.arange(len(model.points))
    found = []
    for image in images:
        gray = read_gray(*image)
        rows, pixels = find_landmarks(gray, model.camera(image), landmarks, everything, min_score)
        found.append((np.full(len(rows), number[image]), rows, pixels))
    return dataclasses.replace(
        model,
        obs_image=np.concatenate([f[0] for f in found]),
        obs_point=np.concatenate([f[1] for f in found]),
        obs_px=np.concatenate([f[2] for f in found]).reshape(-1, 2),
    )


def estimate_pose(
    pixels: np.ndarray, points: np.ndarray, lens: Lens, max_error_px: float, is_focal_known: bool = True
) -> tuple[np.ndarray, Lens, np.ndarray] | None:
    """Pose (3, 4), lens and (N,) bool inliers from pixels (N, 2) of points (N, 3); None if too few agree."""
    if len(pixels) < MIN_POSE_POINTS:
        return None
    camera = lens.to_colmap(1)
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.estimate_focal_length = not is_focal_known
    estimation.ransac.max_error = max_error_px
    estimation.ransac.random_seed = SEED
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = not is_focal_known
    found = pycolmap.estimate_and_refine_absolute_pose(
        pixels + HALF_PIXEL, points, camera, estimation, refinement
    )
    if found is None or found["num_inliers"] < MIN_POSE_POINTS:
        return None
    pose = np.asarray(found["cam_from_world"].matrix())
    return pose, lens.updated(camera), np.asarray(found["inlier_mask"]).ravel()


def refine_pose(
    pose: np.ndarray, pixels: np.ndarray, points: np.ndarray, lens: Lens, loss_scale_px: float
) -> np.ndarray:
    """(3, 4) the pose at the least robust reprojection error of pixels (N, 2) of points (N, 3)."""
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.loss_function_scale = loss_scale_px
    refinement.gradient_tolerance = 1e-6
    found = pycolmap.refine_absolute_pose(
        pycolmap.Rigid3d(np.ascontiguousarray(pose)),
        pixels + HALF_PIXEL,
        points,
        np.ones(len(pixels), dtype=bool),
        lens.to_colmap(1),
        refinement,
    )
    return pose if found is None else np.asarray(found["cam_from_world"].matrix())


@dataclasses.dataclass(frozen=True, eq=False)
class FilmTrack:
    """Poses of one film's frames and what they see.

    poses: (3, 4) by frame;  rows, pixels: by frame, landmarks (N,) and where they are (N, 2) px
    """

    poses: dict[int, np.ndarray]
    rows: dict[int, np.ndarray]
    pixels: dict[int, np.ndarray]


def track_film(
    frames: Sequence[int],
    known: FilmTrack,
    read_gray: Callable[[int], np.ndarray],
    lens: Lens,
    landmarks: Landmarks,
    visible: np.ndarray,
    options: RecoverOptions,
) -> FilmTrack:
    """Poses of all frames of a film, outward from the keyframes, which are `known` and stay as they are.

    visible: landmarks, ascending, that this film may show. Every frame is measured against the
    landmarks themselves, so errors do not add up along the film; its neighbour only says where to
    look. A frame that fails has no entry.
    """
    track = FilmTrack(dict(known.poses), dict(known.rows), dict(known.pixels))
    recent = functools.lru_cache(maxsize=2)(read_gray)
    for order in (frames, frames[::-1]):
        last = None
        for index, frame in enumerate(order):
            if frame not in track.rows:
                guess = None
                if last is not None and index - last <= MAX_LOOK_BACK:
                    before = order[last]
                    here, there = recent(before), recent(frame)
                    guess = _follow(here, there, track.poses[before], lens, landmarks.points[visible])
                if guess is None:
                    continue
                measured = _measure(recent(frame), guess, lens, landmarks, visible, options)
                if measured is None:
                    continue
                track.poses[frame], track.rows[frame], track.pixels[frame] = measured
            last = index
    return track


def _follow(
    before: np.ndarray, gray: np.ndarray, pose: np.ndarray, lens: Lens, points: np.ndarray
) -> np.ndarray | None:
    """Pose of the next picture from the flow of the points; None if they are lost."""
    camera = lens.at(pose[:, :3], pose[:, 3])
    start, _ = camera.project(points)
    width, height = lens.size
    inside = ((start >= 0) & (start <= [width - 1, height - 1])).all(axis=1)
    if inside.sum() < MIN_POSE_POINTS:
        return None
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        before,
        gray,
        start[inside].astype(np.float32)[:, None],
        None,  # type: ignore[call-overload]
        winSize=(FLOW_WINDOW_PX, FLOW_WINDOW_PX),
        maxLevel=FLOW_LEVELS,
    )
    tracked = status.ravel() == 1
    pixels = moved[tracked, 0].astype(np.float64)
    found = estimate_pose(pixels, points[inside][tracked], lens, 2.0)
    return None if found is None else found[0]


def _measure(
    gray: np.ndarray,
    guess: np.ndarray,
    lens: Lens,
    landmarks: Landmarks,
    visible: np.ndarray,
    options: RecoverOptions,
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    camera = lens.at(guess[:, :3], guess[:, 3])
    rows, pixels = find_landmarks(gray, camera, landmarks, visible, options.min_patch_score)
    if len(rows) < MIN_POSE_POINTS:
        return None
    pose = refine_pose(guess, pixels, landmarks.points[rows], lens, options.loss_scale_px)
    projected, _ = lens.at(pose[:, :3], pose[:, 3]).project(landmarks.points[rows])
    good = np.linalg.norm(projected - pixels, axis=1) <= options.max_error_px
    if good.sum() < MIN_POSE_POINTS:
        return None
    return pose, rows[good], pixels[good]
