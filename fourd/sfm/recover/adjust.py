"""Bundle adjustment of a whole model, and the choice of its lens model."""

import dataclasses

import numpy as np
import pycolmap

from fourd.sfm.recover.model import Model, to_reconstruction, update_from_reconstruction


def adjust(
    model: Model, loss_scale_px: float, max_iterations: int = 100, is_scene_fixed: bool = False
) -> Model:
    """Least reprojection error over lenses, poses and points.

    loss_scale_px: residuals beyond this count less (Cauchy)
    is_scene_fixed: only poses and lenses move, the points stay to the last bit
    """
    reconstruction = to_reconstruction(model, has_witness=is_scene_fixed)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = any(lens.principal_px is not None for lens in model.lenses.values())
    options.refine_points3D = not is_scene_fixed
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_scale_px
    solver = options.ceres.solver_options
    solver.max_num_iterations = max_iterations
    solver.function_tolerance = 1e-8
    solver.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in range(1, len(model.poses) + 1):
        config.add_image(image_id)
    pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    return update_from_reconstruction(model, reconstruction)


def drop_outliers(model: Model, max_error_px: float) -> Model:
    """The model without observations beyond `max_error_px`, nor of points that only one camera sees."""
    error = np.linalg.norm(model.residuals_px(), axis=1)
    return model.select(error <= max_error_px).supported()


def with_lenses(model: Model, num_radial: int) -> Model:
    """The model with `num_radial` coefficients of distortion per lens, new ones 0."""
    lenses = {
        name: dataclasses.replace(lens, radial=(lens.radial + (0.0,) * num_radial)[:num_radial])
        for name, lens in model.lenses.items()
    }
    return dataclasses.replace(model, lenses=lenses)
