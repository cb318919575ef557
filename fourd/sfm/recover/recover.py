"""The whole way from films to cameras; every step stands in a module of its own."""

import dataclasses
import logging
from collections.abc import Mapping, Sequence

import numpy as np

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.film_cameras import FilmCamera, FilmCameras
from fourd.sfm.normalize import estimate_up
from fourd.sfm.recover.adjust import adjust, drop_outliers
from fourd.sfm.recover.diagnose import (
    describe_geometry,
    describe_homographies,
    explain_left_out,
    find_turned,
)
from fourd.sfm.recover.evidence import (
    choose_lenses,
    choose_principal_points,
    is_tripod,
    mean_pose,
    rms_px,
    sub_model,
)
from fourd.sfm.recover.features import Features, find_features
from fourd.sfm.recover.films import Film, gray_reader
from fourd.sfm.recover.frames import (
    adjust_films,
    bridge_gaps,
    longest_run,
    track_films,
)
from fourd.sfm.recover.mapping import VerifiedPair, match_keyframes
from fourd.sfm.recover.model import ImageKey, Lens, Model
from fourd.sfm.recover.options import RecoverOptions
from fourd.sfm.recover.register import (
    describe_landmarks,
    register_film,
    register_remaining,
)
from fourd.sfm.recover.starts import map_from_best_starts
from fourd.sfm.recover.tracking import Landmarks, cut_landmarks, observe, refine_pose

log = logging.getLogger(__name__)


def recover_cameras(
    films: Mapping[str, Film],
    heldout: Sequence[str],
    scale_hint: tuple[str, str, float] | None,
    options: RecoverOptions,
) -> FilmCameras:
    """Cameras of all films in one world, from their pictures alone.

    scale_hint: two cameras and the distance of their centres in metres, or None
    Held-out cameras are placed after everything else is finished. A camera that cannot be placed
    has the reason in its status. Raises InputError if fewer than two input cameras can be placed.
    """
    inputs = {name: film for name, film in films.items() if name not in heldout}
    if len(inputs) < 2:
        raise InputError(
            f"expected films of at least 2 input cameras, got {len(inputs)} ({', '.join(inputs) or 'none'}): "
            "positions come from differences between cameras; add films or hold out fewer"
        )
    features = _detect(inputs, options)
    lenses = _start_lenses(inputs, options)
    pairs = match_keyframes(features, lenses, options)
    models = map_from_best_starts(features, pairs, lenses, options)
    _check_models(models, inputs, features, lenses, pairs, options)
    mapped, landmarks = _refine_keyframes(models[0], inputs, options)
    starts = _like_finished(lenses, mapped)
    keyframes = register_remaining(mapped, landmarks, inputs, features, starts, options)
    notes = _describe_models(models, keyframes.cameras, pairs) + describe_geometry(keyframes)
    model = adjust_films(track_films(keyframes, landmarks, inputs, options), options)
    finished: dict[str, FilmCamera] = {}
    for name, film in inputs.items():
        if name in model.cameras:
            finished[name] = _finish(film, sub_model(model, name), options, notes)
        else:
            status = explain_left_out(film, features, lenses, pairs, keyframes.cameras, options)
            finished[name] = _left_out(film, status)
    middles = _check_usable(finished)
    turned = find_turned(middles)
    notes += [
        f"{name} is turned by about {degrees} degrees against the other cameras: its film probably carries a "
        "wrong rotation flag, or the phone was held so"
        for name, degrees in turned.items()
    ]
    finished |= _place_heldout(films, heldout, keyframes, features, landmarks, model, options, notes)
    notes += [f"{name} is left out: {c.status}" for name, c in finished.items() if c.status != "ok"]
    return FilmCameras(
        cameras={name: finished[name] for name in films},
        points=model.compact().points,
        up=estimate_up([camera for name, camera in middles.items() if name not in turned]),
        metres_per_unit=None if scale_hint is None else _metres_per_unit(finished, *scale_hint),
        notes=tuple(notes),
    )


def _detect(films: Mapping[str, Film], options: RecoverOptions) -> dict[ImageKey, Features]:
    return {
        (name, frame): find_features(film.read_rgb(frame), options)
        for name, film in films.items()
        for frame in film.keyframes(options.num_keyframes)
    }


def _start_lens(film: Film) -> Lens:
    return Lens(film.working_size, film.focal_px * film.working_size[0] / film.size[0])


def _start_lenses(films: Mapping[str, Film], options: RecoverOptions) -> dict[str, Lens]:
    """Lenses to start from. Raises InputError if one lens is said to have taken pictures of two sizes."""
    lenses = {name: _start_lens(film) for name, film in films.items()}
    if not options.shared_lens:
        return lenses
    sizes = {film.size for film in films.values()}
    if len(sizes) > 1:
        shown = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
        raise InputError(
            f"shared_lens: expected films of one size, got {shown}: set it to false in the scene file, or "
            "bring the films to one size"
        )
    return dict.fromkeys(lenses, next(iter(lenses.values())))


def _check_models(
    models: Sequence[Model],
    films: Mapping[str, Film],
    features: Mapping[ImageKey, Features],
    lenses: Mapping[str, Lens],
    pairs: Sequence[VerifiedPair],
    options: RecoverOptions,
) -> None:
    if models and len(models[0].cameras) >= 2:
        return
    placed = models[0].cameras if models else []
    flat = describe_homographies(pairs, list(films))
    reasons = [] if flat is None else [flat]
    if flat is None:
        reasons = [
            f"{name}: {explain_left_out(film, features, lenses, pairs, placed, options)}"
            for name, film in films.items()
        ]
    raise InputError(
        f"expected films that show one scene from different places, but the cameras cannot be placed "
        f"together ({'; '.join(reasons)}): film anew, or give a calibration in the scene file"
    )


def _like_finished(lenses: Mapping[str, Lens], model: Model) -> dict[str, Lens]:
    """Lenses to start from in a finished model: their principal points are free where its are."""
    is_free = any(lens.principal_px is not None for lens in model.lenses.values())
    principal_px = (0.0, 0.0) if is_free else None
    return {name: dataclasses.replace(lens, principal_px=principal_px) for name, lens in lenses.items()}


def _describe_models(
    models: Sequence[Model], used: Sequence[str], pairs: Sequence[VerifiedPair]
) -> list[str]:
    """Sentences about planes and about models apart from the one that is used."""
    flat = describe_homographies(pairs, used)
    notes = [] if flat is None else [flat]
    for other in models[1:]:
        apart = [name for name in other.cameras if name not in used]
        if apart:
            notes.append(
                f"the films fall into separate models: {', '.join(used)} form the larger one, which is used; "
                f"{', '.join(apart)} do not connect to it"
            )
    return notes


def _refine_keyframes(
    model: Model, films: Mapping[str, Film], options: RecoverOptions
) -> tuple[Model, Landmarks]:
    """The keyframes' model measured anew by patches, with lenses by evidence, and its landmarks."""
    read_gray = gray_reader(films)
    landmarks = cut_landmarks(model, read_gray, options.patch_radius_px)
    model = observe(model, landmarks, read_gray, model.images, options.min_patch_score).supported()
    model = choose_lenses(model, options.loss_scale_px, options.max_error_px)
    model = adjust(drop_outliers(model, options.max_error_px), options.loss_scale_px)
    model = choose_principal_points(model, options.loss_scale_px)
    cameras = tuple(model.camera(image) for image in model.images)
    return model, dataclasses.replace(landmarks, points=model.points, cameras=cameras)


def _left_out(film: Film, status: str) -> FilmCamera:
    return FilmCamera(film.name, film.size, np.zeros(0, dtype=np.int64), (), status=status)


def _finish(film: Film, model: Model, options: RecoverOptions, notes: list[str]) -> FilmCamera:
    """The camera of one film from its part of the model: gaps, tripod, full size."""
    lens = model.lenses[film.name]
    poses, added = bridge_gaps(
        {frame: pose for (_, frame), pose in model.poses.items()}, film.frames.tolist()
    )
    if added:
        notes.append(f"{film.name}: the poses of frames {_spans(added)} are interpolated")
    error = rms_px(model) * film.size[0] / film.working_size[0]
    run = longest_run(film.frames.tolist(), poses)
    lost = [frame for frame in film.frames.tolist() if frame not in run]
    if lost:
        first, last = film.wanted or (0, 0)
        is_short = any(first <= frame <= last for frame in lost) if film.wanted else len(lost) > len(run)
        if is_short:
            missing = [frame for frame in lost if frame not in poses]
            return _left_out(film, f"no pose could be found for frames {_spans(missing)}")
        notes.append(f"{film.name}: no pose could be found for frames {_spans(lost)}; they are left out")
    if is_tripod(model):
        pose = _still_pose(model, options)
        run, poses = run[:1], {run[0]: pose}
    cameras = tuple(lens.at(poses[f][:, :3], poses[f][:, 3]).resized(film.size) for f in run)
    is_static = len(run) == 1
    return FilmCamera(
        film.name, film.size, np.array(run, dtype=np.int64), cameras, is_static, reprojection_error_px=error
    )


def _still_pose(model: Model, options: RecoverOptions) -> np.ndarray:
    """(3, 4) the one pose that all observations of a tripod camera share."""
    pose = mean_pose(np.stack(list(model.poses.values())))
    (lens,) = model.lenses.values()
    return refine_pose(pose, model.obs_px, model.points[model.obs_point], lens, options.loss_scale_px)


def _spans(frames: Sequence[int]) -> str:
    """`3-5, 9` for [3, 4, 5, 9]."""
    spans: list[list[int]] = []
    for frame in frames:
        if spans and frame == spans[-1][1] + 1:
            spans[-1][1] = frame
        else:
            spans.append([frame, frame])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in spans)


def _check_usable(finished: Mapping[str, FilmCamera]) -> dict[str, Camera]:
    """The middle camera of every film that takes part. Raises InputError if they are fewer than two."""
    usable = {name: film for name, film in finished.items() if film.status == "ok"}
    if len(usable) < 2:
        reasons = "; ".join(
            f"{name}: {film.status}" for name, film in finished.items() if film.status != "ok"
        )
        raise InputError(
            f"expected at least 2 input cameras that can be placed, got {len(usable)} ({reasons}): film "
            "anew, or give a calibration in the scene file"
        )
    return {name: film.cameras[len(film.cameras) // 2] for name, film in usable.items()}


def _place_heldout(
    films: Mapping[str, Film],
    heldout: Sequence[str],
    keyframes: Model,
    features: Mapping[ImageKey, Features],
    landmarks: Landmarks,
    model: Model,
    options: RecoverOptions,
    notes: list[str],
) -> dict[str, FilmCamera]:
    """Cameras that nothing depends on, against the points as they are in the finished model."""
    landmarks = dataclasses.replace(landmarks, points=model.points)
    described = describe_landmarks(keyframes, features)
    lenses = {name: _start_lens(film) for name, film in films.items()}
    starts = _like_finished(lenses, keyframes)
    finished = {}
    for name in heldout:
        film = films[name]
        own = _detect({name: film}, options)
        placed = register_film(film, own, described, landmarks, starts[name], options)
        if placed is None:
            status = explain_left_out(film, {**features, **own}, lenses, [], model.cameras, options)
            finished[name] = _left_out(film, status)
            continue
        tracked = track_films(placed, landmarks, {name: film}, options)
        finished[name] = _finish(film, tracked, options, notes)
    return finished


def _metres_per_unit(finished: Mapping[str, FilmCamera], first: str, second: str, distance_m: float) -> float:
    """Metres per unit of the world from the mean distance of two cameras. Raises InputError."""
    for name in (first, second):
        if name not in finished or finished[name].status != "ok":
            raise InputError(
                f"scale_hint: expected two cameras that were placed, got {name}: name others in the "
                "scene file"
            )
    centers = [np.mean([c.center for c in finished[name].cameras], axis=0) for name in (first, second)]
    distance = float(np.linalg.norm(centers[0] - centers[1]))
    if not distance_m > 0 or not distance > 0:
        raise InputError(
            f"scale_hint: expected two cameras apart from each other, got {first} and {second} at "
            f"{distance_m} m: correct it in the scene file"
        )
    return distance_m / distance
