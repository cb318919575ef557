"""Sentences about what is wrong with a capture, and why a camera is not in the model."""

from collections.abc import Mapping, Sequence

import numpy as np
import pycolmap

from fourd.camera import Camera
from fourd.geometry import angle_deg
from fourd.sfm.recover.features import Features, find_features
from fourd.sfm.recover.films import Film
from fourd.sfm.recover.mapping import VerifiedPair, verify_pair
from fourd.sfm.recover.model import ImageKey, Lens, Model
from fourd.sfm.recover.options import RecoverOptions

MIN_CONTRAST = 3.0
MIN_FEATURES = 100
MIN_PARALLAX_DEG = 1.5
MAX_PLANE_THICKNESS = 0.01
MAX_DISTANCE_RATIO = 5.0
TURNED_TOLERANCE_DEG = 30.0
# The share of pairs that one homography explains, from which on the capture as a whole is such.
HOMOGRAPHY_SHARE = 0.8
_HOMOGRAPHY = (
    pycolmap.TwoViewGeometryConfiguration.PLANAR,
    pycolmap.TwoViewGeometryConfiguration.PANORAMIC,
    pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC,
)


def explain_left_out(
    film: Film,
    features: Mapping[ImageKey, Features],
    lenses: Mapping[str, Lens],
    pairs: Sequence[VerifiedPair],
    placed: Sequence[str],
    options: RecoverOptions,
) -> str:
    """Why a film is not in the model, with what to do. placed: cameras that are in it."""
    own = [key for key in sorted(features) if key[0] == film.name]
    if not own:
        return "no frame of the film is within the scene's time: check the film's clock"
    if all(film.read_gray(frame).std() < MIN_CONTRAST for _, frame in own):
        return "the picture is constant (lens covered or film blank): leave the camera out"
    if max(len(features[key].pixels) for key in own) < MIN_FEATURES:
        return "the picture has too little texture to be matched: calibrate the camera by other means"
    partners = {(p.right if p.left[0] == film.name else p.left)[0] for p in pairs if film.name in _names(p)}
    partners -= {film.name}
    if not partners & set(placed) and _matches_mirrored(film, own, features, lenses, placed, options):
        return (
            "the film is mirrored (front camera): its picture matches the others only when it is flipped "
            "left to right; flip the film"
        )
    if not partners:
        return (
            "the picture matches no other camera's: the film shows another place, or from more than about 35 "
            "degrees beside the next camera"
        )
    if not partners & set(placed):
        return (
            f"the picture matches only {', '.join(sorted(partners))}, which do not connect to the other "
            "cameras: film from places in between"
        )
    return (
        f"the picture matches {', '.join(sorted(partners & set(placed)))}, but no pose agrees with enough "
        "matches: film more of the still background"
    )


def _names(pair: VerifiedPair) -> set[str]:
    return {pair.left[0], pair.right[0]}


def _matches_mirrored(
    film: Film,
    own: Sequence[ImageKey],
    features: Mapping[ImageKey, Features],
    lenses: Mapping[str, Lens],
    placed: Sequence[str],
    options: RecoverOptions,
) -> bool:
    """Whether the film's middle keyframe, flipped left to right, matches a placed camera."""
    key = own[len(own) // 2]
    flipped = find_features(film.read_rgb(key[1])[:, ::-1].copy(), options)
    others = [k for k in sorted(features) if k[0] in placed]
    trial = {**features, key: flipped}
    return any(verify_pair(key, other, trial, lenses, options) is not None for other in others)


def describe_homographies(pairs: Sequence[VerifiedPair], names: Sequence[str]) -> str | None:
    """A sentence if most pairs of different cameras are related by one homography, else None."""
    across = [p for p in pairs if p.left[0] != p.right[0] and _names(p) <= set(names)]
    planar = sum(p.geometry.config in _HOMOGRAPHY for p in across)
    if not across or planar < HOMOGRAPHY_SHARE * len(across):
        return None
    return (
        f"{planar} of {len(across)} pairs of pictures are explained by one homography: the scene is a plane, "
        "or the cameras turned on the spot without moving apart, and focal lengths and depths are uncertain"
    )


def describe_geometry(model: Model) -> list[str]:
    """Sentences about a model that is nearly degenerate: no parallax, a plane, a camera far away."""
    notes = []
    cameras = {image: model.camera(image) for image in model.images}
    centers = np.stack([camera.center for camera in cameras.values()])
    seen = centers[model.obs_image] - model.points[model.obs_point]
    mean = np.zeros_like(model.points)
    np.add.at(mean, model.obs_point, seen / np.linalg.norm(seen, axis=1, keepdims=True))
    off = angle_deg(seen, mean[model.obs_point])
    widest = np.zeros(len(model.points))
    np.maximum.at(widest, model.obs_point, 2 * off)
    parallax = float(np.median(widest))
    if parallax < MIN_PARALLAX_DEG:
        notes.append(
            f"the rays of a typical point meet at {parallax:.2g} degrees only: the cameras stand almost at "
            "one place (pure rotation), so depths and distances are uncertain; film from farther apart"
        )
    centered = model.points - np.median(model.points, axis=0)
    near = np.linalg.norm(centered, axis=1) <= np.percentile(np.linalg.norm(centered, axis=1), 90)
    spread = np.linalg.svd(centered[near] - centered[near].mean(axis=0), compute_uv=False)
    if spread[2] < MAX_PLANE_THICKNESS * spread[1]:
        notes.append(
            "all points lie on one plane (a wall): focal lengths from a plane are uncertain; let the picture "
            "show more depth"
        )
    middle = np.median(model.points, axis=0)
    distances = {
        name: float(
            np.median([np.linalg.norm(c.center - middle) for k, c in cameras.items() if k[0] == name])
        )
        for name in model.cameras
    }
    typical = float(np.median(list(distances.values())))
    notes += [
        f"{name} is {distance / typical:.1f} times as far away as the typical camera: its pictures add little"
        for name, distance in distances.items()
        if distance > MAX_DISTANCE_RATIO * typical
    ]
    return notes


def find_turned(cameras: Mapping[str, Camera]) -> dict[str, int]:
    """Cameras whose picture is turned against the others', and by 90, 180 or 270 degrees.

    cameras: one per film. The camera whose upward direction is nearest to all the others' is taken
    to be upright; two cameras cannot outvote each other, so none is named.
    """
    if len(cameras) < 3:
        return {}
    ups = np.stack([-camera.R[1] for camera in cameras.values()])
    apart = angle_deg(ups[:, None], ups[None])
    up = ups[np.median(apart, axis=1).argmin()]
    turned = {}
    for name, camera in cameras.items():
        roll = float(np.degrees(np.arctan2(camera.R[0] @ up, -camera.R[1] @ up)))
        turns = round(roll / 90)
        if turns % 4 and abs(roll - 90 * turns) <= TURNED_TOLERANCE_DEG:
            turned[name] = 90 * (turns % 4)
    return turned
