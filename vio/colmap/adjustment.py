"""Bundle adjustment of keyframes and points under the stereo rig, and of the rig under keyframes in motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from vio.colmap.model import LEFT, RIGHT, build_model, frame_id, image_id, matrix, numbered, rig_geometry
from vio.colmap.solver import solve, solver_options, whole_model
from vio.errors import EstimationError
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import StereoCamera
from vio.mapping.points import PointTracks, keep_rows, reprojection
from vio.robust import robust_sigma


@dataclass(frozen=True, slots=True)
class Adjustment:
    """What a bundle adjustment made of keyframes and points."""

    T_world_cam0: FloatArray  # (K, 4, 4)
    tracks: PointTracks  # with moved points, without outliers
    rms_before_px: float  # over all rows that the robust limit kept, each coordinate
    rms_after_px: float
    rows_dropped: int
    sigma_px: float  # robust spread of a coordinate's residual after the first round


@dataclass(frozen=True, slots=True)
class PositionPriors:
    """Where the keyframes' left cameras are believed to be."""

    positions: FloatArray  # (K, 3) world, metres
    covariances: FloatArray  # (K, 3, 3) m^2


def adjust(
    camera: StereoCamera,
    T_world_cam0: FloatArray,
    tracks: PointTracks,
    *,
    priors: PositionPriors | None = None,
    gate_sigma: float = 5.0,
    threads: int = 1,
    progress: Callable[[], None] = lambda: None,
) -> Adjustment:
    """Bundle-adjust keyframes and points under the stereo rig, intrinsics and extrinsics held fixed.

    Two rounds: all rows under a robust loss, then again from the start without the rows that it calls outliers. The
    first keyframe stays where it is.

    Args:
        camera: the rectified pair.
        T_world_cam0: (K, 4, 4) where to start.
        tracks: points and rows.
        priors: a Gaussian on each camera position, weighted against the pixels' own spread.
        gate_sigma: rows off by more than so many robust standard deviations leave the second round.
        threads: of the solver; one makes the result repeatable.
        progress: called after each of the two rounds.

    Raises:
        EstimationError: the solver failed.
    """
    before, _ = reprojection(camera, T_world_cam0, tracks)
    first_T, first_points = _solve(camera, T_world_cam0, tracks, None, 1.0, threads)
    progress()
    residual, ahead = reprojection(camera, first_T, replace(tracks, p_world=first_points))
    entries = np.concatenate([residual[:, :2].ravel(), residual[tracks.has_right, 2:].ravel()])
    sigma_px = max(robust_sigma(entries), 1e-3)
    good = ahead & (np.abs(residual).max(axis=1) < gate_sigma * sigma_px)
    start = keep_rows(tracks, good)
    if not len(start.ids):
        raise EstimationError("not observable because no track is consistent over the keyframes; check the run's poses")
    T, points = _solve(camera, T_world_cam0, start, priors, 2 * sigma_px, threads, sigma_px=sigma_px)
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
    """Poses (K, 4, 4) and points (M, 3) of one bundle adjustment."""
    count = len(T_world_cam0)
    model = build_model(camera, T_world_cam0, tracks, numbered(count))
    config = whole_model(model)
    config.set_constant_sensor_from_rig_pose(model.camera(RIGHT).sensor_id)
    config.set_constant_rig_from_world_pose(frame_id(0))
    options = solver_options(loss_px, threads)
    if priors is None:
        adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    else:
        adjuster = pycolmap.create_pose_prior_bundle_adjuster(
            options, pycolmap.PosePriorBundleAdjustmentOptions(), config, _pose_priors(model, priors, sigma_px), model
        )
    solve(adjuster)
    T_cam0_world = np.array([matrix(model.frame(frame_id(k)).rig_from_world) for k in range(count)])
    points = np.array([model.point3D(m + 1).xyz for m in range(len(tracks.ids))])
    return se3_inverse(T_cam0_world), points


def adjust_rig_in_motion(
    camera: StereoCamera, T_world_cam0: FloatArray, tracks: PointTracks, *, gate_sigma: float = 5.0
) -> tuple[FloatArray, FloatArray]:
    """Bundle-adjust the pose of cam1 in cam0 together with keyframes and points, over tracks in time.

    Motion shows what a single pair leaves to the lens model: a turn of one camera about the vertical shifts all
    disparities, which the way between two frames contradicts.

    Returns `R_cam1_cam0` (3, 3) and the unit direction (3,) from cam0 to cam1 in cam0, of the rectified pair.

    Raises:
        EstimationError: the solver failed, or no track is consistent.
    """
    good = np.ones(len(tracks.point), dtype=np.bool_)
    R, direction = np.eye(3), np.array([1.0, 0.0, 0.0])
    for loss_px in (1.0, 0.5):
        kept = keep_rows(tracks, good)
        if not len(kept.ids):
            raise EstimationError("not observable because no track is consistent over the keyframes")
        count = len(T_world_cam0)
        model = build_model(camera, T_world_cam0, kept, numbered(count))
        config = whole_model(model)
        config.set_constant_rig_from_world_pose(frame_id(0))
        options = solver_options(loss_px, 1)
        options.refine_sensor_from_rig = True
        solve(pycolmap.create_default_bundle_adjuster(options, config, model))
        R, direction = rig_geometry(model)
        model.update_point_3d_errors()
        errors = np.array([model.point3D(m + 1).error for m in range(len(kept.ids))])
        limit = gate_sigma * float(np.median(errors))
        good = np.isin(tracks.ids[tracks.point], kept.ids[errors < limit])
    return R, direction


def _pose_priors(model: pycolmap.Reconstruction, priors: PositionPriors, sigma_px: float) -> list[pycolmap.PosePrior]:
    """One prior for each keyframe's left image; covariances scaled so that pixels may keep unit weight."""
    out = []
    for k, (position, covariance) in enumerate(zip(priors.positions, priors.covariances, strict=True)):
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
