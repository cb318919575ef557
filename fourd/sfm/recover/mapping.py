"""A first model from keyframes of all cameras: features, verified matches, incremental mapping."""

import dataclasses
import itertools
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from fourd.sfm.recover.features import Features, match_features
from fourd.sfm.recover.model import HALF_PIXEL, ImageKey, Lens, Model, lens_ids
from fourd.sfm.recover.options import RecoverOptions

SEED = 1
# Keyframes of one film overlap much more than those of two cameras; this many neighbours link them.
NUM_FILM_NEIGHBORS = 2
# Between the rays of the pair that a model grows from. It is halved where that finds none.
MIN_START_ANGLE_DEG = 4.0


@dataclasses.dataclass(frozen=True, eq=False)
class VerifiedPair:
    """Two pictures whose matches agree with one two-view geometry.

    matches: (M, 2) indices of features;  geometry: as COLMAP states it
    """

    left: ImageKey
    right: ImageKey
    matches: np.ndarray
    geometry: pycolmap.TwoViewGeometry

    @property
    def num_inliers(self) -> int:
        return len(self.geometry.inlier_matches)


def verify_pair(
    left: ImageKey,
    right: ImageKey,
    features: Mapping[ImageKey, Features],
    lenses: Mapping[str, Lens],
    options: RecoverOptions,
) -> VerifiedPair | None:
    """The pair with its inliers, None below `min_matches` of them."""
    a, b = features[left], features[right]
    matches = match_features(a, b, (lenses[left[0]].size, lenses[right[0]].size), options)
    if len(matches) < options.min_matches:
        return None
    estimation = pycolmap.TwoViewGeometryOptions()
    estimation.min_num_inliers = options.min_matches
    estimation.detect_watermark = False
    estimation.compute_relative_pose = True
    estimation.ransac.random_seed = SEED
    estimation.ransac.max_error = options.max_match_error_px
    geometry = pycolmap.estimate_two_view_geometry(
        lenses[left[0]].to_colmap(1),
        a.pixels + HALF_PIXEL,
        lenses[right[0]].to_colmap(2),
        b.pixels + HALF_PIXEL,
        matches.astype(np.uint32),
        estimation,
    )
    pair = VerifiedPair(left, right, matches, geometry)
    return pair if pair.num_inliers >= options.min_matches else None


def match_keyframes(
    features: Mapping[ImageKey, Features], lenses: Mapping[str, Lens], options: RecoverOptions
) -> list[VerifiedPair]:
    """Verified pairs: neighbours in each film, and keyframes across cameras.

    Of two cameras the middle keyframes are matched first, and the others only if those verify: a
    pair of cameras that sees nothing in common costs one attempt.
    """
    keyframes: dict[str, list[ImageKey]] = {}
    for key in sorted(features):
        keyframes.setdefault(key[0], []).append(key)
    wanted: list[tuple[ImageKey, ImageKey]] = []
    for keys in keyframes.values():
        for step in range(1, NUM_FILM_NEIGHBORS + 1):
            wanted += list(zip(keys, keys[step:], strict=False))
    pairs = [verify_pair(left, right, features, lenses, options) for left, right in wanted]
    for first, second in itertools.combinations(keyframes, 2):
        candidates = list(_across(keyframes[first], keyframes[second]))
        middle = verify_pair(*candidates[0], features, lenses, options)
        pairs.append(middle)
        if middle is not None:
            pairs += [verify_pair(*pair, features, lenses, options) for pair in candidates[1:]]
    return [pair for pair in pairs if pair is not None]


def _across(left: Sequence[ImageKey], right: Sequence[ImageKey]) -> Sequence[tuple[ImageKey, ImageKey]]:
    """Keyframes at the same part of their films, the middle ones first, each pair once."""
    count = max(len(left), len(right))
    order = sorted(range(count), key=lambda i: (abs(2 * i + 1 - count), i))
    pairs = [(left[i * len(left) // count], right[i * len(right) // count]) for i in order]
    return list(dict.fromkeys(pairs))


def map_keyframes(
    features: Mapping[ImageKey, Features],
    pairs: Sequence[VerifiedPair],
    lenses: Mapping[str, Lens],
    options: RecoverOptions,
    start: VerifiedPair,
) -> Model | None:
    """The model that COLMAP's incremental mapper grows from a pair of pictures, None if it finds none.

    lenses: start of the intrinsics, one COLMAP camera per name, or one for all if the options say so
    Deterministic: one thread, fixed seed.
    """
    keys = sorted(features)
    camera_ids = lens_ids(lenses, options.shared_lens)
    pipeline = _pipeline_options(options)
    pipeline.init_image_id1, pipeline.init_image_id2 = (
        keys.index(key) + 1 for key in (start.left, start.right)
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "database.db"
        _write_database(path, keys, features, pairs, lenses, camera_ids)
        found = pycolmap.incremental_mapping(path, Path(folder), Path(folder) / "models", pipeline)
    if not found:
        return None
    model = _model_of(found[min(found)], keys, lenses, camera_ids)
    return dataclasses.replace(model, is_lens_shared=options.shared_lens)


def _pipeline_options(options: RecoverOptions) -> pycolmap.IncrementalPipelineOptions:
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads = 1
    pipeline.random_seed = SEED
    pipeline.extract_colors = False
    pipeline.multiple_models = False
    pipeline.min_model_size = 2
    pipeline.min_num_matches = options.min_matches
    pipeline.mapper.init_min_num_inliers = 2 * options.min_matches
    pipeline.mapper.init_min_tri_angle = MIN_START_ANGLE_DEG
    pipeline.mapper.abs_pose_min_num_inliers = options.min_matches
    pipeline.mapper.filter_max_reproj_error = options.max_match_error_px
    return pipeline


def _write_database(
    path: Path,
    keys: Sequence[ImageKey],
    features: Mapping[ImageKey, Features],
    pairs: Sequence[VerifiedPair],
    lenses: Mapping[str, Lens],
    camera_ids: Mapping[str, int],
) -> None:
    lens_of = {camera_ids[name]: lens for name, lens in lenses.items()}
    image_ids = {key: i + 1 for i, key in enumerate(keys)}
    database = pycolmap.Database.open(path)
    try:
        for camera_id, lens in lens_of.items():
            database.write_camera(lens.to_colmap(camera_id), use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera_id)
            rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
            database.write_rig(rig, use_rig_id=True)
        for key, image_id in image_ids.items():
            image = pycolmap.Image(
                name=f"{key[0]}/{key[1]:06d}", camera_id=camera_ids[key[0]], image_id=image_id
            )
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=image_id, rig_id=camera_ids[key[0]])
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(image_id, (features[key].pixels + HALF_PIXEL).astype(np.float32))
        for pair in pairs:
            ids = image_ids[pair.left], image_ids[pair.right]
            database.write_matches(*ids, pair.matches.astype(np.uint32))
            database.write_two_view_geometry(*ids, pair.geometry)
    finally:
        database.close()


def _model_of(
    reconstruction: pycolmap.Reconstruction,
    keys: Sequence[ImageKey],
    lenses: Mapping[str, Lens],
    camera_ids: Mapping[str, int],
) -> Model:
    registered = sorted(reconstruction.reg_image_ids())
    poses = {keys[i - 1]: np.asarray(reconstruction.images[i].cam_from_world().matrix()) for i in registered}
    used = {key[0] for key in poses}
    found = {
        name: lens.updated(reconstruction.cameras[camera_ids[name]])
        for name, lens in lenses.items()
        if name in used
    }
    number = {image_id: i for i, image_id in enumerate(registered)}
    point_ids = sorted(reconstruction.point3D_ids())
    rows = [
        (number[e.image_id], p, *reconstruction.images[e.image_id].points2D[e.point2D_idx].xy)
        for p, point_id in enumerate(point_ids)
        for e in reconstruction.points3D[point_id].track.elements
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    points = np.array([reconstruction.points3D[p].xyz for p in point_ids]).reshape(-1, 3)
    return Model(
        lenses=found,
        poses=poses,
        points=points,
        obs_image=table[:, 0].astype(np.int64),
        obs_point=table[:, 1].astype(np.int64),
        obs_px=table[:, 2:] - HALF_PIXEL,
    )
