"""One model of all keyframes, whichever pair of pictures the mapper starts from."""

import dataclasses
from collections.abc import Mapping, Sequence

from fourd.sfm.recover.adjust import adjust, drop_outliers
from fourd.sfm.recover.features import Features
from fourd.sfm.recover.mapping import VerifiedPair, map_keyframes
from fourd.sfm.recover.model import ImageKey, Lens, Model
from fourd.sfm.recover.options import RecoverOptions
from fourd.sfm.recover.register import replace_poses

# A model counts as better explained by distortion only if that gains this share of observations.
DISTORTION_GAIN = 1.05
# A mapper that starts from an unlucky pair ends in pieces, or bent. It starts anew from the next pair until
# two models have all pictures that match those of another camera, and about as many observations.
MAX_STARTS = 6
SAME_MODEL = 0.9


def map_from_best_starts(
    features: Mapping[ImageKey, Features],
    pairs: Sequence[VerifiedPair],
    lenses: Mapping[str, Lens],
    options: RecoverOptions,
) -> list[Model]:
    """The keyframes' model, adjusted, and after it one of cameras that do not connect to it, if there is any.

    A distorting lens is tried too: without it a mapper loses the corners. Only adjusted models compare:
    the mapper's own leave observations to chance.
    """
    across = [pair for pair in pairs if pair.left[0] != pair.right[0]]
    linked = {key for pair in across for key in (pair.left, pair.right)}
    found: list[Model] = []
    num_observed: list[int] = []
    for start in rank_starts(across)[:MAX_STARTS]:
        tried = []
        for radial in ((), (0.0,)):
            initial = {name: dataclasses.replace(lens, radial=radial) for name, lens in lenses.items()}
            model = map_keyframes(features, pairs, initial, options, start)
            tried += [_adjust_corners(model, options)] if model is not None else []
        if max(map(_size, tried), default=(0, 0)) > max(map(_size, found), default=(0, 0)):
            found = tried
        num_observed += [len(model.obs_px) for model in tried if linked <= set(model.poses)]
        if sum(number > SAME_MODEL * max(num_observed) for number in num_observed) >= 2:
            break
    if not found:
        return []
    best = _choose_distortion(found)
    apart = rank_starts([p for p in across if not {p.left[0], p.right[0]} & set(best.cameras)])
    other = map_keyframes(features, pairs, lenses, options, apart[0]) if apart else None
    return [best] if other is None else [best, other]


def rank_starts(across: Sequence[VerifiedPair]) -> list[VerifiedPair]:
    """The pair of keyframes with most inliers of every two cameras, the one with most first.

    The mapper's own rule prefers wide angles; in small pictures those have few matches, of which the
    false ones decide.
    """
    best: dict[frozenset[str], VerifiedPair] = {}
    for pair in across:
        cameras = frozenset((pair.left[0], pair.right[0]))
        if cameras not in best or pair.num_inliers > best[cameras].num_inliers:
            best[cameras] = pair
    return sorted(best.values(), key=lambda pair: (-pair.num_inliers, pair.left, pair.right))


def _size(model: Model) -> tuple[int, int]:
    """Pictures and observations, by which models compare."""
    return len(model.poses), len(model.obs_px)


def _choose_distortion(tried: Sequence[Model]) -> Model:
    """The model with distortion, the second, if it has more pictures or clearly more observations."""
    if len(tried) < 2:
        return tried[0]
    plain, distorted = tried
    sizes = [(len(model.cameras), len(model.poses)) for model in tried]
    gain = len(distorted.obs_px) / max(1, len(plain.obs_px))
    return distorted if sizes[1] > sizes[0] or (sizes[1] == sizes[0] and gain > DISTORTION_GAIN) else plain


def _adjust_corners(model: Model, options: RecoverOptions) -> Model:
    """The mapper's model, adjusted, without outliers and with no picture in a pose it cannot leave.

    A model of one camera supports no point and stays as it is.
    """
    if len(model.cameras) < 2:
        return model
    scale_px = options.max_match_error_px / 3
    model = replace_poses(adjust(model, scale_px), options.max_error_px)
    model = adjust(drop_outliers(model, options.max_match_error_px), scale_px)
    return model.supported().compact()
