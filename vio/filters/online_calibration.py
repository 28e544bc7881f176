"""Online calibration: how the camera sits on the IMU and how their clocks differ, as states of the filter.

A frame stamped t was exposed at `t + time_offset_s` of the IMU's clock. The extrinsics' error sits on the IMU's side,
`T_cam0_imu = T_hat exp(delta)`. Either error then moves the pixels of a frame exactly as an error of its pose would,
so all that is known about poses carries over by one small matrix per frame, equations (C1) to (C3) of docs/math.md.
References: Li & Mourikis, Online temporal calibration for camera-IMU systems (2014); Qin & Shen, Online temporal
calibration for monocular visual-inertial systems (2018).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vio.filters.settings import MsckfSettings
from vio.filters.stereo_calibration import TERMS
from vio.geometry.lie import FloatArray, se3_adjoint, se3_exp
from vio.records import Estimate, IntArray, StereoFieldEstimate

# Columns of the full error [stereo field; delta; time offset].
_STEREO, _DELTA, _OFFSET = np.arange(TERMS), TERMS + np.arange(6), np.array([TERMS + 6])
_FULL = TERMS + 7
_RADIAL = 5.0  # a lens is left with more radial than tangential distortion
_STEREO_WALK = 0.02  # random walk of the stereo field per root second, over its initial standard deviation


@dataclass(frozen=True, slots=True)
class Calibration:
    """The estimate of the rig's calibration, and which of it is estimated."""

    T_cam0_imu: FloatArray  # (4, 4)
    time_offset_s: float = 0.0  # a frame stamped t was exposed at t + offset of the IMU's clock
    extrinsics: bool = False  # whether T_cam0_imu is estimated
    timing: bool = False  # whether the offset is estimated
    stereo: FloatArray | None = None  # (6,) coefficients of equation (R3); None: not estimated

    @property
    def dim(self) -> int:
        """Error dimensions C, 0 to 13."""
        return self.stereo_dim + 6 * self.extrinsics + self.timing

    @property
    def stereo_dim(self) -> int:
        """How many of the error's dimensions, the first, belong to the stereo field: 0 or 6."""
        return 0 if self.stereo is None else TERMS

    @property
    def columns(self) -> IntArray:
        """Which entries (C,) of the full error `[stereo field; delta; time offset]`, m, rad and s, are estimated."""
        return np.concatenate([_STEREO[: self.stereo_dim], _DELTA[: 6 * self.extrinsics], _OFFSET[: 1 * self.timing]])

    def corrected(self, error: FloatArray) -> Calibration:
        """Return the calibration moved by an error (C,)."""
        full = self.full(error)
        return replace(
            self,
            T_cam0_imu=self.T_cam0_imu @ se3_exp(full[_DELTA]) if self.extrinsics else self.T_cam0_imu,
            time_offset_s=self.time_offset_s + float(full[_OFFSET[0]]),
            stereo=None if self.stereo is None else self.stereo + full[_STEREO],
        )

    def add_to_estimate(self, estimate: Estimate, covariance: FloatArray) -> Estimate:
        """Return an estimate with what is estimated of the calibration, whose errors have a covariance (C, C)."""
        if self.stereo is not None:
            field = StereoFieldEstimate(self.stereo, covariance[: self.stereo_dim, : self.stereo_dim])
            estimate = replace(estimate, stereo_field=field)
        if self.extrinsics:
            rows = slice(self.stereo_dim, self.stereo_dim + 6)
            estimate = replace(estimate, T_cam0_imu=self.T_cam0_imu, T_cam0_imu_covariance=covariance[rows, rows])
        if self.timing:
            sigma = float(np.sqrt(covariance[-1, -1]))
            estimate = replace(estimate, time_offset_s=self.time_offset_s, time_offset_sigma_s=sigma)
        return estimate

    def full(self, error: FloatArray) -> FloatArray:
        """Fill an error (..., C) up to (..., 13) with zeros."""
        out = np.zeros((*error.shape[:-1], _FULL))
        out[..., self.columns] = error
        return out


def first_calibration(T_cam0_imu: FloatArray, settings: MsckfSettings) -> Calibration:
    """Return the calibration at the start."""
    extrinsics, timing = (settings.calibrate in (kind, "both") for kind in ("extrinsics", "time_offset"))
    stereo = np.zeros(TERMS) if settings.calibrate_stereo == "on" else None
    return Calibration(np.asarray(T_cam0_imu, dtype=np.float64), 0.0, extrinsics, timing, stereo)


def calibration_covariance(calibration: Calibration, settings: MsckfSettings) -> tuple[FloatArray, FloatArray]:
    """Return the initial covariance (C, C) of what is estimated, and what a second of random walk adds to it (C, C)."""
    s = settings
    yaw, field = np.radians(s.stereo_yaw_sigma_deg), s.stereo_field_sigma
    stereo = np.array([yaw, field, field, _RADIAL * field, field, field])
    rotation, rotation_walk = np.radians([s.extrinsic_rotation_sigma_deg, s.extrinsic_rotation_walk])
    pose = np.repeat([s.extrinsic_translation_sigma_m, rotation, s.time_offset_sigma_s], [3, 3, 1])
    pose_walk = np.repeat([s.extrinsic_translation_walk, rotation_walk, s.time_offset_walk], [3, 3, 1])
    sigmas, walks = np.concatenate([stereo, pose]), np.concatenate([stereo * _STEREO_WALK, pose_walk])
    return np.diag(sigmas[calibration.columns] ** 2), np.diag(walks[calibration.columns] ** 2)


def body_twists(T_world_imu: FloatArray, velocity_world: FloatArray, rate: FloatArray) -> FloatArray:
    """Twists (..., 6) `[v; omega]` in the body frame of poses (..., 4, 4), world velocities and body rates (..., 3)."""
    v = np.einsum("...ji,...j->...i", T_world_imu[..., :3, :3], velocity_world)
    return np.concatenate([v, rate], axis=-1)


def pose_D_calibration(T_world_imu: FloatArray, twists: FloatArray) -> FloatArray:
    """What errors `[delta; time offset]` of the calibration do to poses, equation (C2).

    Args:
        T_world_imu: poses (N, 4, 4) of the body at the exposures.
        twists: their body twists (N, 6), m/s and rad/s.

    Returns:
        Jacobians (N, 6, 7): the world-side pose errors that move the pixels as the calibration's errors do.
    """
    A = se3_adjoint(T_world_imu)
    return np.concatenate([-A, A @ twists[..., None]], axis=-1)


def with_calibration(A: FloatArray, b: FloatArray, pose_D_calib: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Turn information about poses into information about calibration and poses, equation (C3).

    Args:
        A: information matrix (6N, 6N).
        b: information vector (6N,).
        pose_D_calib: what the calibration does to the poses (6N, C).

    Returns:
        Information matrix (C + 6N, C + 6N) and vector (C + 6N,).
    """
    AM = A @ pose_D_calib
    return np.block([[pose_D_calib.T @ AM, AM.T], [AM, A]]), np.concatenate([pose_D_calib.T @ b, b])
