"""Scale and misalignment of accelerometer and gyro as states: how readings and the motion depend on
them.

Equations (A1) to (A5) of docs/math.md. The IMU's frame is the accelerometer's: its z axis, and the
plane of its y and z axes. So the accelerometer has six terms, and the gyro, whose axes may be
turned against it, nine.
Reference: Rehder et al., Extending kalibr: calibrating the extrinsics of multiple IMUs and of
individual axes (2016), for the model; the columns are those of the biases in (N1), times the
readings.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from vio.filters.pose_loops import calibrate, shrink_to_signal
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import FloatArray, so3_hat
from vio.records import IMU_ENTRIES, IntArray

ImuTerms = Literal["off", "scale", "full"]
IMU_TERMS = len(IMU_ENTRIES)


class _LeverRules(NamedTuple):
    """When readings say something of the terms."""

    # A lever that contains the noise of its own interval biases a scale by minus the noise's share
    # of the lever's square: at rest the readings are noise, which a scale of zero would explain.
    # This share is kept below 0.2 %, a fifth of what consumer IMUs' scales are off by; without it a
    # gyro's scale moved by 0.5 % in 20 s of standstill.
    clear_of_noise: float = 500.0
    # over which readings are averaged: a tenth of a second of noise is a tenth of it
    averaged_s: float = 1.0


_LEVER = _LeverRules()


class _TermPriors(NamedTuple):
    """What is known of an IMU's scale and misalignment before its readings."""

    scale_sigma: float = 0.01  # initial standard deviation of a scale, over it
    misalignment_sigma_deg: float = 0.5  # initial standard deviation of a misalignment


_PRIORS = _TermPriors()
ENTRIES: IntArray = np.array(IMU_ENTRIES)  # (15, 3) sensor, row and column of each
_SENSOR, _ROW, _COLUMN = ENTRIES.T
_ACCEL = np.flatnonzero(_SENSOR == 0)
# Random walk of the terms per root second, over their initial standard deviation: by their data
# sheets, consumer accelerometers and gyros change by 0.02 to 0.03 % a degree, so two degrees in a
# hundred seconds are 0.05 %.
IMU_WALK = 0.005
# Which terms are estimated.
CHOSEN: dict[ImuTerms, IntArray] = {
    "off": np.zeros(0, dtype=np.int64),
    "scale": np.flatnonzero(_ROW == _COLUMN),
    "full": np.arange(IMU_TERMS),
}


def chosen_terms(settings: MsckfSettings) -> IntArray:
    """Return which terms are estimated of a pair with an IMU.

    Where the rotation from IMU to camera is estimated, too, it would trade against misalignments.
    """
    which = settings.calibrate_imu
    if which == "auto":
        which = "scale" if settings.calibrate_camera_imu in ("extrinsics", "both") else "full"
    return CHOSEN[which]


def term_sigmas() -> FloatArray:
    """Return the initial standard deviations (15,) of the terms."""
    misalignment = float(np.radians(_PRIORS.misalignment_sigma_deg))
    return np.asarray(
        np.where(_ROW == _COLUMN, _PRIORS.scale_sigma, misalignment), dtype=np.float64
    )


def calibrated(readings: FloatArray, terms: FloatArray) -> FloatArray:
    """Return readings (K, 6) `[gyro, accel]` with scale and misalignment taken out, equation
    (A1).
    """
    out = np.empty_like(readings)
    calibrate(readings, ENTRIES, terms, out)
    return out


def accel_D_terms(accel: FloatArray) -> FloatArray:
    """Jacobian (..., 3, 15) of the calibrated accelerometer by the terms, at readings (..., 3):
    equation (A2).
    """
    out = np.zeros((*accel.shape, IMU_TERMS))
    out[..., _ROW[_ACCEL], _ACCEL] = accel[..., _COLUMN[_ACCEL]]
    return out


def usual_reading(before: FloatArray | None, readings: FloatArray, seconds: float) -> FloatArray:
    """Return the mean reading (6,) over about the last second, from what it was and readings (K,
    6) over some time.
    """
    mean: FloatArray = readings.mean(axis=0)
    if before is None:
        return mean
    return before + (1 - np.exp(-seconds / _LEVER.averaged_s)) * (mean - before)


def significant(
    readings: FloatArray, usual: FloatArray, seconds: float, densities: FloatArray
) -> FloatArray:
    """Return readings (K, 6) `[gyro, accel]`, their deviation from the usual one shrunk by their
    noise: (A5).

    Args:
        readings: over an interval.
        usual: (6,) of before.
        seconds: length of the interval.
        densities: (2,) white noise of accelerometer and gyro.
    """
    noise_energy = _LEVER.clear_of_noise * densities[::-1] ** 2 / seconds
    out = np.empty_like(readings)
    shrink_to_signal(readings, usual, noise_energy, out)
    return out


def tilt_columns(T_world_imu: FloatArray, gravity: FloatArray) -> FloatArray:
    """How errors of the terms move the first attitude's error phi (3, 15), which the accelerometer
    gave: (A4).

    Args:
        T_world_imu: (4, 4) the first pose.
        gravity: (3,) world, m/s^2.
    """
    R = T_world_imu[:3, :3]
    out: FloatArray = (
        so3_hat(gravity) @ R @ accel_D_terms(-R.T @ gravity) / float(gravity @ gravity)
    )
    return out
