"""From keyframes to every frame: landmarks of a film, its other frames, joint adjustment, gaps."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from fourd.sfm.recover.adjust import adjust, drop_outliers
from fourd.sfm.recover.films import Film
from fourd.sfm.recover.model import ImageKey, Model
from fourd.sfm.recover.options import RecoverOptions
from fourd.sfm.recover.patches import STEP_TOLERANCE_PX
from fourd.sfm.recover.tracking import FilmTrack, Landmarks, refine_pose, track_film

MAX_GAP = 3
GRID = (8, 6)
# Most landmarks are measured to hundredths of a pixel, while those on edges of depth or in gloss are
# tenths off, to one side in all frames of a film, so that more frames do not average it away.
LOSS_PER_MEDIAN = 0.4
# Starting from adjusted keyframes the joint adjustment has settled by then.
MAX_JOINT_ITERATIONS = 30


def film_landmarks(model: Model, name: str, count: int) -> np.ndarray:
    """At most `count` landmarks that the film's pictures show, ascending, spread over the picture.

    In every cell of a grid those that most pictures of any camera see come first.
    """
    images = model.images
    mine = np.flatnonzero(np.array([image[0] == name for image in images])[model.obs_image])
    seen, first = np.unique(model.obs_point[mine], return_index=True)
    pixels = model.obs_px[mine[first]]
    cell = np.clip(pixels * GRID / np.array(model.lenses[name].size), 0, np.array(GRID) - 1).astype(int)
    cell_number = cell[:, 0] * GRID[1] + cell[:, 1]
    length = np.bincount(model.obs_point, minlength=len(model.points))[seen]
    order = np.lexsort((seen, -length, cell_number))
    starts = np.searchsorted(cell_number[order], cell_number[order])
    rank = np.empty(len(seen), dtype=np.int64)
    rank[order] = np.arange(len(seen)) - starts
    return np.sort(seen[np.lexsort((seen, -length, rank))[:count]])


def track_films(
    model: Model, landmarks: Landmarks, films: Mapping[str, Film], options: RecoverOptions
) -> Model:
    """The model with all frames of its films that could be placed, and what they see."""
    poses: dict[ImageKey, np.ndarray] = {}
    edges, order = _by_image(model)
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for name in model.cameras:
        keys = [(i, image) for i, image in enumerate(model.images) if image[0] == name]
        seen = {frame: order[edges[i] : edges[i + 1]] for i, (_, frame) in keys}
        known = FilmTrack(
            poses={image[1]: model.poses[image] for _, image in keys},
            rows={frame: model.obs_point[rows] for frame, rows in seen.items()},
            pixels={frame: model.obs_px[rows] for frame, rows in seen.items()},
        )
        track = track_film(
            films[name].frames.tolist(),
            known,
            films[name].read_gray,
            model.lenses[name],
            landmarks,
            film_landmarks(model, name, options.max_landmarks),
            options,
        )
        for frame in sorted(track.rows):
            rows = track.rows[frame]
            found.append((np.full(len(rows), len(poses)), rows, track.pixels[frame]))
            poses[(name, frame)] = track.poses[frame]
    columns = [np.concatenate(column) for column in zip(*found, strict=True)]
    obs_image, obs_point, obs_px = columns
    return dataclasses.replace(model, poses=poses, obs_image=obs_image, obs_point=obs_point, obs_px=obs_px)


def adjust_films(model: Model, options: RecoverOptions) -> Model:
    """All pictures adjusted jointly, or evenly spread `max_adjusted_frames` of them, then the rest.

    The loss follows the observations: its scale is `LOSS_PER_MEDIAN` of the median residual, at most
    `loss_scale_px`. Common errors of all cameras hardly change their residuals, so the few landmarks that
    are far off would decide them.
    """
    total = len(model.poses)
    count = min(total, options.max_adjusted_frames)
    chosen = np.zeros(total, dtype=bool)
    chosen[np.linspace(0, total - 1, count).round().astype(int)] = True
    part = _subset(model, chosen).supported()
    median_px = float(np.nanmedian(np.linalg.norm(part.residuals_px(), axis=1)))
    scale_px = min(options.loss_scale_px, max(LOSS_PER_MEDIAN * median_px, STEP_TOLERANCE_PX))
    part = adjust(part, scale_px, MAX_JOINT_ITERATIONS)
    adjusted = dataclasses.replace(
        model, lenses=part.lenses, poses={**model.poses, **part.poses}, points=part.points
    )
    if count < total:
        adjusted = refine_poses(adjusted, ~chosen, scale_px)
    return drop_outliers(adjusted, options.max_error_px)


def refine_poses(model: Model, chosen: np.ndarray, loss_scale_px: float) -> Model:
    """The model with the poses of the chosen (N,) bool pictures fitted to the points as they are."""
    poses = dict(model.poses)
    edges, order = _by_image(model)
    for i, image in enumerate(model.images):
        if chosen[i]:
            rows = order[edges[i] : edges[i + 1]]
            points = model.points[model.obs_point[rows]]
            lens = model.lenses[image[0]]
            poses[image] = refine_pose(poses[image], model.obs_px[rows], points, lens, loss_scale_px)
    return dataclasses.replace(model, poses=poses)


def _by_image(model: Model) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(model.obs_image, kind="stable")
    return np.searchsorted(model.obs_image[order], np.arange(len(model.poses) + 1)), order


def _subset(model: Model, chosen: np.ndarray) -> Model:
    """The chosen pictures; all points keep their numbers."""
    number = np.cumsum(chosen) - 1
    kept = model.select(chosen[model.obs_image])
    poses = {
        image: pose for image, pose, c in zip(model.images, model.poses.values(), chosen, strict=True) if c
    }
    return dataclasses.replace(kept, poses=poses, obs_image=number[kept.obs_image])


def bridge_gaps(
    poses: Mapping[int, np.ndarray], frames: Sequence[int]
) -> tuple[dict[int, np.ndarray], list[int]]:
    """Poses with gaps of up to `MAX_GAP` frames closed, and the frames that were put in.

    poses: (3, 4) by frame;  frames: that should have one, rising. Centres are interpolated linearly
    and rotations on the great circle. Longer gaps stay open, and so do both ends.
    """
    known = [frame for frame in frames if frame in poses]
    filled, added = dict(poses), []
    for before, after in zip(known, known[1:], strict=False):
        missing = [frame for frame in frames if before < frame < after]
        if not 0 < len(missing) <= MAX_GAP:
            continue
        keys = Rotation.from_matrix(np.stack([poses[before][:, :3], poses[after][:, :3]]))
        centers = [-poses[f][:, :3].T @ poses[f][:, 3] for f in (before, after)]
        for frame in missing:
            share = (frame - before) / (after - before)
            R = Slerp([0, 1], keys)(share).as_matrix()
            center = (1 - share) * centers[0] + share * centers[1]
            filled[frame] = np.concatenate([R, (-R @ center)[:, None]], axis=1)
            added.append(frame)
    return {frame: filled[frame] for frame in sorted(filled)}, added


def longest_run(frames: Sequence[int], known: Mapping[int, np.ndarray]) -> list[int]:
    """The longest run of frames without a hole, the first of equally long ones."""
    runs: list[list[int]] = [[]]
    for frame in frames:
        if frame in known:
            runs[-1].append(frame)
        elif runs[-1]:
            runs.append([])
    return max(runs, key=len)
