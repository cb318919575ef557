"""Cameras placed against finished landmarks: held-out ones, and inputs that the mapper left out."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.spatial import KDTree

from fourd.sfm.recover.adjust import adjust
from fourd.sfm.recover.evidence import choose_lens
from fourd.sfm.recover.features import Features, match_features
from fourd.sfm.recover.films import Film
from fourd.sfm.recover.model import ImageKey, Lens, Model
from fourd.sfm.recover.options import RecoverOptions
from fourd.sfm.recover.tracking import Landmarks, estimate_pose, observe

# A landmark and a feature this close in a picture are the same corner.
SAME_CORNER_PX = 1.0


def replace_poses(model: Model, max_error_px: float) -> Model:
    """The model with those pictures placed anew that fit the points of the others better elsewhere.

    A mapper that has only a few points yet may place a picture degrees off; the pose is a minimum of its
    own, which no adjustment leaves. The pose within `max_error_px` of more points is kept.
    """
    poses = dict(model.poses)
    residual = np.linalg.norm(model.residuals_px(), axis=1)
    is_seen_twice_more = np.bincount(model.obs_point, minlength=len(model.points))[model.obs_point] > 2
    for i, image in enumerate(model.images):
        rows = np.flatnonzero((model.obs_image == i) & is_seen_twice_more)
        points, lens = model.points[model.obs_point[rows]], model.lenses[image[0]]
        found = estimate_pose(model.obs_px[rows], points, lens, max_error_px)
        if found is not None and found[2].sum() > (residual[rows] <= max_error_px).sum():
            poses[image] = found[0]
    return dataclasses.replace(model, poses=poses)


@dataclasses.dataclass(frozen=True, eq=False)
class DescribedLandmarks:
    """Those of one keyframe's features that are landmarks.

    size: (width, height) px of the keyframe;  landmark: (N,) number of each feature
    """

    features: Features
    size: tuple[int, int]
    landmark: np.ndarray


def describe_landmarks(model: Model, features: Mapping[ImageKey, Features]) -> list[DescribedLandmarks]:
    """Features of the model's landmarks, one entry per keyframe."""
    described = []
    for i, image in enumerate(model.images):
        rows = np.flatnonzero(model.obs_image == i)
        if image not in features or len(rows) == 0:
            continue
        own = features[image]
        distance, nearest = KDTree(own.pixels).query(model.obs_px[rows])
        near = distance <= SAME_CORNER_PX
        chosen = np.asarray(nearest)[near]
        seen = Features(own.pixels[chosen], own.descriptors[chosen])
        described.append(DescribedLandmarks(seen, model.lenses[image[0]].size, model.obs_point[rows[near]]))
    return described


def register_keyframe(
    features: Features,
    described: list[DescribedLandmarks],
    points: np.ndarray,
    lens: Lens,
    options: RecoverOptions,
) -> tuple[np.ndarray, Lens] | None:
    """Pose (3, 4) and lens of a picture from its matches with the landmarks; None if it has too few."""
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for view in described:
        matches = match_features(features, view.features, (lens.size, view.size), options)
        pairs.append(np.stack([matches[:, 0], view.landmark[matches[:, 1]]], axis=1))
    unique = np.unique(np.concatenate(pairs), axis=0)
    pixels, seen = features.pixels[unique[:, 0]], points[unique[:, 1]]
    found = estimate_pose(pixels, seen, lens, options.max_match_error_px, is_focal_known=False)
    if found is None or found[2].sum() < options.min_matches:
        return None
    return found[0], found[1]


def register_remaining(
    model: Model,
    landmarks: Landmarks,
    films: Mapping[str, Film],
    features: Mapping[ImageKey, Features],
    lenses: Mapping[str, Lens],
    options: RecoverOptions,
) -> Model:
    """The model of the keyframes with those films, too, that match it only as a whole.

    A film that sees a little in common with each of several cameras has no pair of pictures with
    enough matches, but may have enough landmarks. lenses: start of the intrinsics
    """
    described = describe_landmarks(model, features)
    for name, film in films.items():
        if name not in model.cameras:
            placed = register_film(film, features, described, landmarks, lenses[name], options)
            model = model if placed is None else model.joined(placed)
    return model


def register_film(
    film: Film,
    features: Mapping[ImageKey, Features],
    described: list[DescribedLandmarks],
    landmarks: Landmarks,
    lens: Lens,
    options: RecoverOptions,
) -> Model | None:
    """Keyframes of one film in the landmarks' world, with its lens; None if none could be placed.

    The model has the landmarks as points, to the last bit.
    """
    found = {
        key: register_keyframe(features[key], described, landmarks.points, lens, options)
        for key in sorted(features)
        if key[0] == film.name
    }
    placed = {key: value for key, value in found.items() if value is not None}
    if not placed:
        return None
    focal_px = float(np.median([lens.focal_px for _, lens in placed.values()]))
    start = dataclasses.replace(lens, focal_px=focal_px)
    nothing = np.zeros(0, dtype=np.int64)
    poses = {key: pose for key, (pose, _) in placed.items()}
    model = Model({film.name: start}, poses, landmarks.points, nothing, nothing, np.zeros((0, 2)))
    for _ in range(2):
        model = observe(
            model, landmarks, lambda _, frame: film.read_gray(frame), model.images, options.min_patch_score
        )
        if len(model.obs_px) < options.min_matches:
            return None
        model = adjust(model, options.loss_scale_px, is_scene_fixed=True)
    chosen = dataclasses.replace(model, lenses={film.name: choose_lens(model, options.loss_scale_px)})
    model = adjust(chosen, options.loss_scale_px, is_scene_fixed=True)
    error = np.linalg.norm(model.residuals_px(), axis=1)
    return model.select(error <= options.max_error_px)
