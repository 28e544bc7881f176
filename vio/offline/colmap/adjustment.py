"""Bundle adjustment of keyframes and points with fixed stereo extrinsics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from vio.errors import EstimationError
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import StereoCamera
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import robust_sigma
from vio.offline.colmap.model import (
    LEFT,
    RIGHT,
    build_model,
    frame_id,
    image_id,
    numbered_images,
    pose_rows,
)
from vio.offline.points import PointTracks, keep_rows, reprojection
from vio.records import BoolArray

_MIN_SIGMA_PX: Tolerance[float] = 1e-3  # of exact pixels, as simulated ones may be
# robust standard deviations beyond which rows are excluded from the second round
_GATE_SIGMAS = 5.0


@dataclass(frozen=True, slots=True)
class Adjustment:
    """The result of a bundle adjustment."""

    T_world_cam0: FloatArray  # (K, 4, 4)
    tracks: PointTracks  # with adjusted points, without outliers
    rms_before_px: float  # over all inlier rows, per coordinate
    rms_after_px: float
    rows_dropped: int
    sigma_px: float  # robust spread of a coordinate's residual after the first round, of tracks


@dataclass(frozen=True, slots=True)
class PositionPriors:
    """Prior positions of the keyframes' left cameras."""

    positions: FloatArray  # (K, 3) world, metres
    covariances: FloatArray  # (K, 3, 3) m^2


def adjust(
    camera: StereoCamera,
    T_world_cam0: FloatArray,
    tracks: PointTracks,
    *,
    priors: PositionPriors | None = None,
    threads: int = 1,
    progress: Callable[[], None] = lambda: None,
) -> Adjustment:
    """Bundle-adjust keyframes and points, with fixed intrinsics and stereo extrinsics.

    Two rounds: all rows with a robust loss, then from the initial values again without the outliers
    of the first. The pose of the first keyframe is fixed. Rows of points that loops join have a
    standard deviation of their own in what counts as an outlier: ORB's pixels are less exact than
    those of tracks.

    Args:
        camera: the rectified pair.
        T_world_cam0: (K, 4, 4) initial poses.
        tracks: points and rows.
        priors: a Gaussian on each camera position, weighted against the pixels' standard deviation.
        threads: of the solver; one makes the result repeatable.
        progress: called after each of the two rounds.

    Raises:
        EstimationError: the solver failed.
    """
    before, _ = reprojection(camera, T_world_cam0, tracks)
    first_T, first_points = _solve(camera, T_world_cam0, tracks, None, 1.0, threads)
    progress()
    residual, ahead = reprojection(camera, first_T, replace(tracks, p_world=first_points))
    sigma_px = _sigma_px(residual, tracks.has_right, ~tracks.by_loop)
    sigmas = np.where(
        tracks.by_loop, _sigma_px(residual, tracks.has_right, tracks.by_loop), sigma_px
    )
    good = ahead & (np.abs(residual).max(axis=1) < _GATE_SIGMAS * sigmas)
    start = keep_rows(tracks, good)
    if not len(start.ids):
        raise EstimationError(
            "not observable because no track is consistent over the keyframes; check the run's "
            "poses"
        )
    T, points = _solve(
        camera, T_world_cam0, start, priors, 2 * sigma_px, threads, sigma_px=sigma_px
    )
    progress()
    done = replace(start, p_world=points)
    after, _ = reprojection(camera, T, done)
    return Adjustment(
        T_world_cam0=T,
        tracks=done,
        rms_before_px=_rms(before[good]),
        rms_after_px=_rms(after),
        rows_dropped=len(tracks.point) - len(start.point),
        sigma_px=sigma_px,
    )


def _sigma_px(residual: FloatArray, has_right: BoolArray, rows: BoolArray) -> float:
    """Robust standard deviation of a coordinate's residual (R, 4) over a mask (R,) of rows."""
    if not rows.any():
        return _MIN_SIGMA_PX
    entries = np.concatenate([residual[rows, :2].ravel(), residual[rows & has_right, 2:].ravel()])
    return max(robust_sigma(entries), _MIN_SIGMA_PX)


def _rms(residual: FloatArray) -> float:
    return float(np.sqrt(np.mean(residual**2)))


def _solve(
    camera: StereoCamera,
    T_world_cam0: FloatArray,
    tracks: PointTracks,
    priors: PositionPriors | None,
    loss_px: float,
    threads: int,
    *,
    sigma_px: float = 1.0,
) -> tuple[FloatArray, FloatArray]:
    """Return poses (K, 4, 4) and points (M, 3) of one bundle adjustment."""
    count = len(T_world_cam0)
    model = build_model(camera, T_world_cam0, tracks, numbered_images(count))
    config = adjustment_config(model)
    config.set_constant_sensor_from_rig_pose(model.camera(RIGHT).sensor_id)
    config.set_constant_rig_from_world_pose(frame_id(0))
    options = solver_options(loss_px, threads)
    if priors is None:
        adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    else:
        adjuster = pycolmap.create_pose_prior_bundle_adjuster(
            options,
            pycolmap.PosePriorBundleAdjustmentOptions(),
            config,
            _pose_priors(model, priors, sigma_px),
            model,
        )
    solve(adjuster)
    T_cam0_world = np.array(
        [pose_rows(model.frame(frame_id(k)).rig_from_world) for k in range(count)]
    )
    points = np.array([model.point3D(m + 1).xyz for m in range(len(tracks.ids))])
    return se3_inverse(T_cam0_world), points


def _pose_priors(
    model: pycolmap.Reconstruction, priors: PositionPriors, sigma_px: float
) -> list[pycolmap.PosePrior]:
    """Return a prior for each keyframe's left image; covariances are scaled to pixels of unit
    weight.
    """
    out = []
    for k, (position, covariance) in enumerate(
        zip(priors.positions, priors.covariances, strict=True)
    ):
        out.append(
            pycolmap.PosePrior(
                pose_prior_id=k + 1,
                corr_data_id=model.image(image_id(k, LEFT)).data_id,
                position=position,
                position_covariance=covariance / sigma_px**2,
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
        )
    return out


def adjustment_config(model: pycolmap.Reconstruction) -> pycolmap.BundleAdjustmentConfig:
    """Return a configuration with all images of a model and fixed intrinsics."""
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
    for camera_id in (LEFT, RIGHT):
        config.set_constant_cam_intrinsics(camera_id)
    return config


def solver_options(loss_px: float, threads: int) -> pycolmap.BundleAdjustmentOptions:
    """Return options with a soft-L1 loss of a width in pixels, and fixed intrinsics and rig."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = (
        False
    )
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
        raise EstimationError(
            f"the bundle adjustment failed ({summary.brief_report()}); check poses and calibration"
        )
