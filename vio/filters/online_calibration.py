"""Online calibration: how the camera sits on the IMU and how their clocks differ, as states of the filter.

A frame stamped t was exposed at `t + time_offset_s` of the IMU's clock. The extrinsics' error `delta`, with
`T_cam0_imu = T_hat exp(delta)`, is kept on the world's side, `eta = Ad(T_world_imu) delta`, and moves with the body.
Both errors enter where the camera's pose is cloned from the body's, equations (C1) to (C5) of docs/math.md.
Reference: Li & Mourikis, Online temporal calibration for camera-IMU systems (2014).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from vio.filters.imu_terms import CHOSEN, IMU_TERMS, IMU_WALK, ImuTerms, term_sigmas
from vio.filters.settings import MsckfSettings
from vio.filters.stereo_calibration import METRIC_TERMS, TERMS
from vio.geometry.lie import FloatArray, se3_adjoint, se3_exp, se3_inverse
from vio.numerics.statistics import chi_square_quantile
from vio.records import FIELD_TERMS, Estimate, IntArray, MotionSource, StereoFieldEstimate, StereoScaleEstimate

# Columns of the full error [IMU terms; stereo field; baseline and focal length; eta; time offset].
_IMU, _STEREO = np.arange(IMU_TERMS), IMU_TERMS + np.arange(TERMS)
_ETA, _OFFSET = IMU_TERMS + TERMS + np.arange(6), np.array([IMU_TERMS + TERMS + 6])
_FULL = IMU_TERMS + TERMS + 7
_PARTS = slice(0, 3), slice(3, 6)  # of a twist
_NOISE_ONLY = float(chi_square_quantile(0.999, 3))  # squared half of a twist in its standard deviations at standstill
# Random walks of a mount that gives and of clocks that drift, each per root second.
_EXTRINSIC_ROTATION_WALK_DEG = 2.0e-3
_EXTRINSIC_TRANSLATION_WALK_M = 1.0e-4
_TIME_OFFSET_WALK_S = 2.0e-6
STEREO_YAW_SIGMA_DEG = 0.1  # initial standard deviation of the right camera's rotation about its vertical axis
_STEREO_FIELD_SIGMA = 2.0e-3  # the same of the other terms of the stereo field, in focal lengths
_RADIAL = 5.0  # a lens is left with more radial than tangential distortion
_STEREO_WALK = 0.02  # random walk of the stereo field per root second, over its initial standard deviation
# Which coefficients are estimated, by whether those of (R3) and of (R4) are.
_TERMS_OF = {
    (of_field, metric): np.flatnonzero(np.repeat([of_field, metric], [FIELD_TERMS, TERMS - FIELD_TERMS]))
    for of_field in (False, True)
    for metric in (False, True)
}


@dataclass(frozen=True, slots=True)
class Calibration:
    """The estimate of the rig's calibration, and which of it is estimated."""

    T_cam0_imu: FloatArray  # (4, 4)
    time_offset_s: float = 0.0  # a frame stamped t was exposed at t + offset of the IMU's clock
    extrinsics: bool = False  # whether T_cam0_imu is estimated
    timing: bool = False  # whether the offset is estimated
    stereo: FloatArray = field(default_factory=lambda: np.zeros(TERMS))  # (10,) coefficients of (R3) and (R4)
    stereo_field: bool = False  # whether those of (R3) are estimated
    metric: bool = False  # whether those of (R4) are
    imu: ImuTerms = "off"  # which of the IMU's terms are estimated; the navigation state has their means

    @property
    def dim(self) -> int:
        """Error dimensions C, 0 to 32."""
        return self.imu_dim + self.stereo_dim + 6 * self.extrinsics + self.timing

    @property
    def imu_dim(self) -> int:
        """How many of the error's dimensions, the first, belong to the IMU's terms: 0, 6 or 15."""
        return len(CHOSEN[self.imu])

    @property
    def stereo_dim(self) -> int:
        """How many of the error's dimensions, after those of the IMU, belong to the stereo calibration: 0, 2, 8, 10."""
        return FIELD_TERMS * self.stereo_field + (TERMS - FIELD_TERMS) * self.metric

    @property
    def stereo_terms(self) -> IntArray:
        """Which coefficients of the stereo calibration are estimated."""
        return _TERMS_OF[self.stereo_field, self.metric]

    @property
    def moves_camera(self) -> bool:
        """Whether anything is estimated that stands between the body's pose and the camera's."""
        return self.extrinsics or self.timing

    @property
    def columns(self) -> IntArray:
        """Which entries (C,) of the full error `[IMU; stereo; eta; time offset]`, m, rad and s, are estimated."""
        camera = _STEREO[self.stereo_terms], _ETA[: 6 * self.extrinsics], _OFFSET[: 1 * self.timing]
        return np.concatenate([_IMU[CHOSEN[self.imu]], *camera])

    @property
    def stereo_rows(self) -> slice:
        """Which of the error's dimensions belong to the stereo calibration."""
        return slice(self.imu_dim, self.imu_dim + self.stereo_dim)

    @property
    def field_rows(self) -> slice:
        """Which of the error's dimensions belong to the coefficients of (R3), where they are estimated."""
        return slice(self.imu_dim, self.imu_dim + FIELD_TERMS)

    @property
    def extrinsic_rows(self) -> IntArray:
        """Which of the error's dimensions belong to the extrinsics, 6 or none."""
        return self.stereo_rows.stop + np.arange(6 * self.extrinsics)

    def corrected(self, error: FloatArray, T_world_imu: FloatArray) -> Calibration:
        """Return the calibration moved by an error (C,), the body's pose (4, 4) being that of the error."""
        full = self.full(error)
        T = self.T_cam0_imu
        if self.extrinsics:
            T = T @ se3_exp(se3_adjoint(se3_inverse(T_world_imu)) @ full[_ETA])
        return replace(
            self,
            T_cam0_imu=T,
            time_offset_s=self.time_offset_s + float(full[_OFFSET[0]]),
            stereo=self.stereo + full[_STEREO],
        )

    def in_world(self, covariance: FloatArray, T_world_imu: FloatArray) -> FloatArray:
        """Turn the covariance (C, C) of `[IMU; stereo; delta; time offset]` into that of the error, with eta."""
        out, rows = covariance.copy(), self.extrinsic_rows
        if self.extrinsics:
            A = se3_adjoint(T_world_imu)
            out[rows] = A @ out[rows]
            out[:, rows] = out[:, rows] @ A.T
        return out

    def add_to_estimate(self, estimate: Estimate, covariance: FloatArray, T_world_imu: FloatArray) -> Estimate:
        """Return an estimate with what is estimated of the calibration, whose errors have a covariance (C, C).

        Args:
            estimate: the rest.
            covariance: of the calibration's errors.
            T_world_imu: the body's pose (4, 4) of these errors.
        """
        if self.stereo_field:
            own = self.field_rows
            field = StereoFieldEstimate(self.stereo[:FIELD_TERMS], covariance[own, own])
            estimate = replace(estimate, stereo_field=field)
        if self.metric:
            own = slice(self.stereo_rows.stop - METRIC_TERMS, self.stereo_rows.stop)
            scale = StereoScaleEstimate(self.stereo[FIELD_TERMS:], covariance[own, own])
            estimate = replace(estimate, stereo_scale=scale)
        if self.extrinsics:
            of_delta = self.in_world(covariance, se3_inverse(T_world_imu))[
                np.ix_(self.extrinsic_rows, self.extrinsic_rows)
            ]
            estimate = replace(estimate, T_cam0_imu=self.T_cam0_imu, T_cam0_imu_covariance=of_delta)
        if self.timing:
            sigma = float(np.sqrt(covariance[-1, -1]))
            estimate = replace(estimate, time_offset_s=self.time_offset_s, time_offset_sigma_s=sigma)
        return estimate

    def full(self, error: FloatArray) -> FloatArray:
        """Fill an error (..., C) up to (..., 32) with zeros."""
        out = np.zeros((*error.shape[:-1], _FULL))
        out[..., self.columns] = error
        return out


def first_calibration(T_cam0_imu: FloatArray, settings: MsckfSettings, motion: MotionSource | None) -> Calibration:
    """Return the calibration at the start.

    Of camera and IMU nothing is estimated without an IMU, and nothing metric without a metric sensor.
    """
    extrinsics = motion == "imu" and settings.calibrate_camera_imu in ("extrinsics", "both")
    timing = motion == "imu" and settings.calibrate_camera_imu in ("auto", "time_offset", "both")
    return Calibration(
        np.asarray(T_cam0_imu, dtype=np.float64),
        extrinsics=extrinsics,
        timing=timing,
        stereo_field=settings.calibrate_stereo == "on",
        metric=motion is not None and max(settings.stereo_focal_sigma, settings.stereo_baseline_sigma) > 0,
        imu=settings.calibrate_imu if motion == "imu" else "off",
    )


def calibration_covariance(calibration: Calibration, settings: MsckfSettings) -> FloatArray:
    """Return the initial covariance (C, C) of what is estimated of `[IMU; stereo; delta; time offset]`."""
    s = settings
    rotation = np.radians(s.extrinsic_rotation_sigma_deg)
    pose = np.repeat([s.extrinsic_translation_sigma_m, rotation, s.time_offset_sigma_s], [3, 3, 1])
    sigmas = np.concatenate([term_sigmas(), _stereo_sigmas(s), pose])
    return np.diag(sigmas[calibration.columns] ** 2)


def calibration_walk(settings: MsckfSettings) -> FloatArray:
    """Return the variances (32,) that a second of random walk adds to `[IMU; stereo; delta; time offset]`."""
    s = settings
    rotation = np.radians(_EXTRINSIC_ROTATION_WALK_DEG)
    pose = np.repeat([_EXTRINSIC_TRANSLATION_WALK_M, rotation, _TIME_OFFSET_WALK_S], [3, 3, 1])
    walks: FloatArray = np.concatenate([term_sigmas() * IMU_WALK, _stereo_sigmas(s) * _STEREO_WALK, pose])
    return walks**2


def _stereo_sigmas(settings: MsckfSettings) -> FloatArray:
    """Initial standard deviations (10,) of the coefficients of (R3) and (R4)."""
    s = settings
    yaw, other = np.radians(STEREO_YAW_SIGMA_DEG), _STEREO_FIELD_SIGMA
    metric = [s.stereo_baseline_sigma, s.stereo_focal_sigma]
    right, both = [yaw, other, other, other], [_RADIAL * other, _RADIAL * other, other, other]
    return np.array([*right, *both, *metric])


@dataclass(frozen=True, slots=True)
class Twist:
    """The body twist `[v; omega]` at an exposure and how well it is known."""

    mean: FloatArray  # (6,) m/s and rad/s
    covariance: FloatArray  # (6, 6)

    def significant(self) -> FloatArray:
        """The twist (6,), each half shrunk by what its own noise may make of it, equation (C3).

        An estimated twist that is noise alone would pass for a motion, from which the time offset is learned.
        """
        halves, out = self.mean.reshape(2, 3), np.empty((2, 3))
        covariances = np.array([self.covariance[part, part] for part in _PARTS]) + 1e-18 * np.eye(3)
        for k, whitened in enumerate(np.linalg.solve(covariances, halves[..., None])[..., 0]):
            squared = float(halves[k] @ whitened)
            out[k] = halves[k] * math.sqrt(max(1 - _NOISE_ONLY / max(squared, 1e-9), 0.0))
        return out.reshape(6)


def body_twist(T_world_imu: FloatArray, velocity_world: FloatArray, rate: FloatArray) -> FloatArray:
    """Twist (6,) `[v; omega]` in the body frame of a pose (4, 4), a world velocity and a body rate (3,)."""
    return np.concatenate([T_world_imu[:3, :3].T @ velocity_world, rate])
