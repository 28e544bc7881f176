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

from vio.geometry.lie import FloatArray, so3_exp, so3_hat
from vio.records import IMU_ENTRIES, IntArray, imu_matrices

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
_SENSOR, _ROW, _COLUMN = np.array(IMU_ENTRIES).T
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


def term_sigmas() -> FloatArray:
    """Return the initial standard deviations (15,) of the terms."""
    misalignment = float(np.radians(_PRIORS.misalignment_sigma_deg))
    return np.asarray(
        np.where(_ROW == _COLUMN, _PRIORS.scale_sigma, misalignment), dtype=np.float64
    )


def calibrated(readings: FloatArray, terms: FloatArray) -> FloatArray:
    """Return readings (..., 6) `[gyro, accel]` with scale and misalignment taken out, equation
    (A1).
    """
    M_accel, M_gyro = imu_matrices(terms)
    return np.concatenate([readings[..., :3] @ M_gyro.T, readings[..., 3:] @ M_accel.T], axis=-1)


def raw_rate(rate: FloatArray, terms: FloatArray) -> FloatArray:
    """Return what the gyro reads (3,) where that is `rate` (3,), bias included, by equation
    (A1).
    """
    return np.asarray(np.linalg.solve(imu_matrices(terms)[1], rate), dtype=np.float64)


def accel_D_terms(accel: FloatArray) -> FloatArray:
    """Jacobian (..., 3, 15) of the calibrated accelerometer by the terms, at readings (..., 3):
    equation (A2).
    """
    return _sensor_D_terms(accel, 0)


def gyro_D_terms(gyro: FloatArray) -> FloatArray:
    """Jacobian (..., 3, 15) of the calibrated gyro by the terms, at readings (..., 3): equation
    (A2).
    """
    return _sensor_D_terms(gyro, 1)


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
    moved = readings - usual
    mean = moved.mean(axis=0)
    for part, density in ((slice(0, 3), densities[1]), (slice(3, 6), densities[0])):
        squared = float(mean[part] @ mean[part]) * seconds / density**2
        moved[:, part] *= np.sqrt(max(1 - _LEVER.clear_of_noise / max(squared, 1e-9), 0.0))
    return usual + moved


def term_columns(
    times_ns: FloatArray,
    raw: FloatArray,
    readings: FloatArray,
    T_world_imu: FloatArray,
    velocity: FloatArray,
    gravity: FloatArray,
) -> FloatArray:
    """How errors of the terms move the navigation state's error (15, 15) over an interval, equation
    (A3).

    Args:
        times_ns: (K,) of the readings, from the interval's start to its end.
        raw: (K, 6) readings `[gyro, accel]`.
        readings: (K, 6) the same, calibrated and less the biases.
        T_world_imu: (4, 4) at the start.
        velocity: (3,) there, world, m/s.
        gravity: (3,) world, m/s^2.
    """
    dt = np.diff(times_ns)[:, None] * 1e-9
    left = (times_ns[-1] - 0.5 * (times_ns[1:] + times_ns[:-1]))[:, None, None] * 1e-9
    R = _attitudes(T_world_imu[:3, :3], so3_exp(0.5 * (readings[1:, :3] + readings[:-1, :3]) * dt))
    force = np.einsum("kij,kj->ki", R, readings[:, 3:])
    a = 0.5 * (force[1:] + force[:-1]) + gravity
    v = velocity + np.cumsum(np.concatenate([np.zeros((1, 3)), a * dt]), axis=0)
    moved = (v[:-1] + 0.5 * a * dt) * dt
    p = T_world_imu[:3, 3] + np.cumsum(np.concatenate([np.zeros((1, 3)), moved]), axis=0)
    pm = 0.5 * (p[1:] + p[:-1])[:, :, None]
    vm = 0.5 * (v[1:] + v[:-1])[:, :, None]
    g = gravity[:, None]

    # In the middle of each step: what an error of the terms does to the world's force and rate.
    by_accel = R @ accel_D_terms(raw[:, 3:])
    by_accel = 0.5 * (by_accel[1:] + by_accel[:-1]) * dt[:, :, None]
    middle = 0.5 * (R[1:] + R[:-1])
    by_gyro = middle @ gyro_D_terms(0.5 * (raw[1:, :3] + raw[:-1, :3])) * dt[:, :, None]
    out = np.zeros((15, IMU_TERMS))
    lever = so3_hat((pm + left * (vm + 0.5 * left * g))[:, :, 0])
    swing = so3_hat((vm + left * g)[:, :, 0])
    out[0:3] = np.sum(lever @ by_gyro + left * by_accel, axis=0)
    out[3:6] = np.sum(by_gyro, axis=0)
    out[6:9] = np.sum(swing @ by_gyro + by_accel, axis=0)
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


def _sensor_D_terms(reading: FloatArray, sensor: int) -> FloatArray:
    out = np.zeros((*reading.shape, IMU_TERMS))
    own = np.flatnonzero(sensor == _SENSOR)
    out[..., _ROW[own], own] = reading[..., _COLUMN[own]]
    return out


def _attitudes(R_world_imu: FloatArray, steps: FloatArray) -> FloatArray:
    """Attitudes (K + 1, 3, 3) from the first one on, turned by each of the steps (K, 3, 3)."""
    out = np.empty((len(steps) + 1, 3, 3))
    out[0] = R_world_imu
    for k, step in enumerate(steps):
        out[k + 1] = out[k] @ step
    return out
