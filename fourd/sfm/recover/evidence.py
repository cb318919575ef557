"""What the observations themselves decide: the lens model of each phone, and whether it stood still."""

import dataclasses

import numpy as np

from fourd.geometry import nearest_rotation
from fourd.sfm.recover.adjust import adjust, drop_outliers, with_lenses
from fourd.sfm.recover.model import LENS_MODELS, Lens, Model

MIN_LENS_GAIN = 0.2
# Measured: freeing the principal points lowers the cost by 6 % where they are off by 1 % of the
# picture, and by less than 1 % where they are in the middle.
MIN_PRINCIPAL_GAIN = 0.03


def robust_cost(residuals_px: np.ndarray, scale_px: float) -> float:
    """Mean Cauchy cost of (M, 2) residuals, px squared. Source: Ceres Solver, CauchyLoss."""
    squared = (residuals_px**2).sum(axis=1)
    return float((scale_px**2 * np.log1p(squared / scale_px**2)).mean())


def sub_model(model: Model, name: str) -> Model:
    """The pictures of one camera alone, with all points."""
    images = model.images
    mine = np.array([image[0] == name for image in images])
    number = np.cumsum(mine) - 1
    keep = mine[model.obs_image]
    return dataclasses.replace(
        model,
        lenses={name: model.lenses[name]},
        poses={image: model.poses[image] for image in images if image[0] == name},
        obs_image=number[model.obs_image[keep]],
        obs_point=model.obs_point[keep],
        obs_px=model.obs_px[keep],
    )


def choose_lens(model: Model, loss_scale_px: float) -> Lens:
    """The one lens of a model with fixed points: the plainest that explains them.

    A coefficient must lower the cost by `MIN_LENS_GAIN`. An information criterion alone would take
    every coefficient: thousands of landmarks make a tenth of a pixel significant, and their errors
    are not independent, so it buys noise in the focal length.
    """
    lens, cost = None, np.inf
    for num_radial in range(len(LENS_MODELS)):
        fitted = adjust(with_lenses(model, num_radial), loss_scale_px, is_scene_fixed=True)
        candidate = robust_cost(fitted.residuals_px(), loss_scale_px)
        if lens is None or candidate < (1 - MIN_LENS_GAIN) * cost:
            lens, cost = next(iter(fitted.lenses.values())), candidate
    assert lens is not None
    return lens


def choose_lenses(model: Model, loss_scale_px: float, max_error_px: float) -> Model:
    """The model with the distortion that each camera's observations ask for, adjusted.

    Points are first fitted with the richest lens everywhere, so that they favour none, and observations
    beyond `max_error_px` of that are dropped: a coefficient gains most by bending towards them.
    """
    rich = adjust(with_lenses(model, len(LENS_MODELS) - 1), loss_scale_px)
    rich = drop_outliers(rich, max_error_px)
    if model.is_lens_shared:
        lenses = dict.fromkeys(model.lenses, choose_lens(rich, loss_scale_px))
    else:
        lenses = {name: choose_lens(sub_model(rich, name), loss_scale_px) for name in model.lenses}
    return adjust(dataclasses.replace(rich, lenses=lenses), loss_scale_px)


def choose_principal_points(model: Model, loss_scale_px: float) -> Model:
    """An adjusted model, with the principal points of all cameras freed if that is worth it.

    All or none: a shift of one hides behind a turn of its camera, so a single camera shows little of
    it. Outliers must be gone, since the gain is small beside them.
    """
    lenses = {name: dataclasses.replace(lens, principal_px=(0.0, 0.0)) for name, lens in model.lenses.items()}
    freed = adjust(dataclasses.replace(model, lenses=lenses), loss_scale_px)
    costs = [robust_cost(m.residuals_px(), loss_scale_px) for m in (model, freed)]
    return freed if costs[1] < (1 - MIN_PRINCIPAL_GAIN) * costs[0] else model


def mean_pose(poses: np.ndarray) -> np.ndarray:
    """(3, 4) pose of mean rotation and mean centre of poses (N, 3, 4)."""
    R = nearest_rotation(poses[:, :, :3].mean(axis=0))
    center = -np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3]).mean(axis=0)
    return np.concatenate([R, (-R @ center)[:, None]], axis=1)


def is_tripod(model: Model) -> bool:
    """Whether the pictures of a model of one camera moved less than their points are uncertain.

    Compared are the RMS movement of the projections against one mean pose, and the RMS residual.
    """
    if len(model.poses) < 2:
        return True
    pose = mean_pose(np.stack(list(model.poses.values())))
    still = dataclasses.replace(model, poses=dict.fromkeys(model.poses, pose))
    own = model.residuals_px()
    movement = still.residuals_px() - own
    return bool(_rms(movement) < _rms(own))


def rms_px(model: Model) -> float:
    """RMS reprojection error, px."""
    return _rms(model.residuals_px())


def _rms(residuals: np.ndarray) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))
