"""What the adjustment of a run with an IMU begins with: keyframes, states, noise, and the priors
of its rig.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vio.calibration.stereo_field import DisplacementField
from vio.files.tables import Rows
from vio.filters.imu_terms import term_sigmas
from vio.filters.online_calibration import stereo_yaw_rad
from vio.filters.rig_calibration import constant_sigmas, field_sigmas
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import FloatArray
from vio.imu.preintegration import BodyStates, Readings
from vio.imu.settings import ImuSettings
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import robust_sigma
from vio.offline.inertial_adjustment import InertialAdjustment, Optimum, RigPrior
from vio.offline.keyframes import TrackedPath, loop_ends
from vio.offline.points import PointTracks, build_tracks, reprojection
from vio.records import FIELD_TERMS, ROW_TERMS, ImuSample, IntArray, MotionSample


class _AdjustmentRules(NamedTuple):
    """What is adjusted, and how sure its rows are."""

    every_s: float = 0.25  # from keyframe to keyframe
    # On the standard deviations of pixels: errors of a track last longer than from keyframe to
    # keyframe. The same as on the motions of a map's odometry, where it was measured.
    lasting_factor: float = 2.0
    min_sigma_px: Tolerance[float] = 1e-3  # of exact pixels, as simulated ones may be
    tiny: Tolerance[float] = 1e-7  # focal lengths: of coefficients that are known


_ADJUSTMENT = _AdjustmentRules()


@dataclass(frozen=True, slots=True)
class InertialRun:
    """What the adjustment takes from a run."""

    path: TrackedPath
    known: Rows  # rows of `vio.runs.tables.ESTIMATE` of the path's frames
    samples: Sequence[MotionSample]
    T_cam0_imu: FloatArray  # (4, 4) as given
    field: DisplacementField | None  # what was taken out of the path's pixels
    settings: MsckfSettings
    imu: ImuSettings


@dataclass(frozen=True, slots=True)
class InertialRefinement:
    """The keyframes of a run after the adjustment."""

    T_world_cam0: FloatArray  # (K, 4, 4)
    before: PointTracks  # as triangulated from the run's poses
    after: PointTracks  # adjusted, without what the rig is off by
    best: Optimum


def inertial_keyframes(path: TrackedPath, most: int | None) -> IntArray:
    """Return rows (K,) of the trajectory, a quarter of a second apart or as `most` allows, and
    both ends of loops.
    """
    seconds = _seconds(path)
    seconds = seconds - seconds[0]
    ends = loop_ends(path, most)
    count = int(np.ceil(seconds[-1] / _ADJUSTMENT.every_s)) + 1
    if most is not None:
        count = max(min(count, most - len(ends)), 2)
    near = np.searchsorted(seconds, np.linspace(0, seconds[-1], count) - 1e-6)
    return np.union1d(near, ends)


def adjust_with_imu(
    run: InertialRun,
    keyframes: IntArray,
    *,
    covariance_of: IntArray | None = None,
    progress: Callable[[], None] = lambda: None,
) -> InertialRefinement:
    """Adjust the keyframes of a run with its IMU, from the run's poses, biases and velocities.

    `covariance_of` and `progress` are those of `InertialAdjustment.solve`.

    Raises:
        VioError: the run has too few views or no consistent track.
    """
    path = run.path
    s = run.imu
    T = path.trajectory.T_world_body[keyframes]
    tracks = build_tracks(path, keyframes, T)
    here = run.known[keyframes]
    last = run.known[-1]
    if np.isfinite(last["T_cam0_imu"]).all():
        T_cam0_imu = last["T_cam0_imu"]
    else:
        T_cam0_imu = run.T_cam0_imu
    late_s = float(np.nan_to_num(last["time_offset_s"]))
    T_world_imu = T @ T_cam0_imu
    # The map may have turned the world.
    turned = T_world_imu[:, :3, :3] @ np.swapaxes(here["T_world_imu"][:, :3, :3], 1, 2)
    velocity = np.einsum("kij,kj->ki", turned, here["velocity_world"])
    bias = np.nan_to_num(np.concatenate([here["gyro_bias"], here["accel_bias"]], axis=1))
    motion = [x for x in run.samples if isinstance(x, ImuSample)]
    values = np.array([[*x.gyro, *x.accel] for x in motion])
    problem = InertialAdjustment(
        path.camera,
        tracks,
        _seconds(path)[keyframes] + late_s,
        Readings(
            1e-9 * np.array([x.time_ns for x in motion]), values[:, :3], values[:, 3:], s.densities
        ),
        T_cam0_imu,
        _rig_prior(run, last),
        _row_sigmas(path, T, tracks),
        np.repeat([s.gyro_bias_sigma_radps, s.accel_bias_sigma_mps2], 3),
        s.gravity_mps2,
    )
    best = problem.solve(BodyStates(T_world_imu, velocity, bias), covariance_of, progress)
    found = replace(tracks, p_world=best.at.p_world, z=problem.corrected_pixels(best.at))
    return InertialRefinement(problem.cameras(best.at), tracks, found, best)


def _seconds(path: TrackedPath) -> FloatArray:
    """Times (N,) of a run with an IMU."""
    times_ns = path.trajectory.times_ns
    assert times_ns is not None
    return np.asarray(1e-9 * times_ns, dtype=np.float64)


def _row_sigmas(path: TrackedPath, T_world_cam0: FloatArray, tracks: PointTracks) -> FloatArray:
    """Standard deviations (R,) of a row's pixel coordinates, robust: one of tracks, one of
    points that loops join.
    """
    r = reprojection(path.camera, T_world_cam0, tracks)[0][:, :3]
    out = np.ones(len(r))
    for group in (tracks.by_loop, ~tracks.by_loop):
        seen = group & tracks.has_right
        if seen.any():
            out[group] = _ADJUSTMENT.lasting_factor * max(
                robust_sigma(r[seen]), _ADJUSTMENT.min_sigma_px
            )
    return out


def _rig_prior(run: InertialRun, last: np.void) -> RigPrior:
    """What the rig may be off by before the run's tracks were seen; its rows, which are no
    pixels here, as it ended.
    """
    s = run.settings
    field = _ADJUSTMENT.tiny * np.eye(FIELD_TERMS + ROW_TERMS)
    at_start = np.zeros(FIELD_TERMS + ROW_TERMS)
    if run.field is not None:
        rms_px = float(last["stereo_rows_rms_px"])
        sigmas = field_sigmas(run.path.camera, rms_px, stereo_yaw_rad(s))
        field[:FIELD_TERMS, :FIELD_TERMS] = np.diag(sigmas)
        at_start[:FIELD_TERMS] = run.field.coefficients[:FIELD_TERMS] / sigmas
        rows = last["stereo_rows_covariance"]
        field[FIELD_TERMS:, FIELD_TERMS:] = np.linalg.cholesky(
            rows + _ADJUSTMENT.tiny**2 * np.eye(ROW_TERMS)
        )
    return RigPrior(
        field,
        at_start,
        constant_sigmas(s),
        np.repeat([s.extrinsic_translation_sigma_m, np.radians(s.extrinsic_rotation_sigma_deg)], 3),
        s.time_offset_sigma_s,
        float(term_sigmas()[0]),
    )
