"""Options and execution of COLMAP's bundle adjuster."""

from __future__ import annotations

import pycolmap

from vio.errors import EstimationError
from vio.offline.colmap.model import LEFT, RIGHT


def adjustment_config(model: pycolmap.Reconstruction) -> pycolmap.BundleAdjustmentConfig:
    """Return a configuration with all images of a model and fixed intrinsics."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.images:
        config.add_image(image_id)
    for camera_id in (LEFT, RIGHT):
        config.set_constant_cam_intrinsics(camera_id)
    return config


def solver_options(loss_px: float, threads: int) -> pycolmap.BundleAdjustmentOptions:
    """Return options with a soft-L1 loss of a width in pixels, and fixed intrinsics and rig."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.refine_sensor_from_rig = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = 60
    options.ceres.solver_options.function_tolerance = 1e-7
    return options


def solve(adjuster: pycolmap.BundleAdjuster) -> None:
    """Run a bundle adjuster.

    Raises:
        EstimationError: its result is not usable.
    """
    summary = adjuster.solve()
    if not summary.is_solution_usable():
        raise EstimationError(f"the bundle adjustment failed ({summary.brief_report()}); check poses and calibration")
