"""Simulate inertial and velocity sensors along a motion, with noise and bias random walks.

Reference: Furgale, Rehder, Siegwart, Unified temporal and spatial calibration for multi-sensor
systems (2013), and the Kalibr IMU noise model: white noise of density s has standard deviation s
sqrt(rate) per sample, a bias walks by s_b sqrt(dt).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vio.datasets.samples import velocity_samples
from vio.geometry.lie import FloatArray
from vio.imu.settings import DEFAULT_IMU
from vio.records import S_PER_NS, ImuDensities, ImuRecord, IntArray, VelocitySample
from vio.setting import setting
from vio.sim.motion import MotionSpline, motion_at

GRAVITY_MPS2 = DEFAULT_IMU.gravity_mps2
GRAVITY_WORLD = np.array([0.0, 0.0, -GRAVITY_MPS2])
# EuRoC's figures
ADIS16448 = ImuDensities(gyro=1.6968e-4, gyro_walk=1.9393e-5, accel=2.0e-3, accel_walk=3.0e-3)


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Errors of an inertial measurement unit; the defaults are those of EuRoC's."""

    densities: ImuDensities = ADIS16448  # white noise and bias walks
    gyro_bias_sigma: float = setting(
        5e-3, "standard deviation of the gyroscope bias at the start", unit="rad/s"
    )
    accel_bias_sigma: float = setting(
        5e-2, "standard deviation of the accelerometer bias at the start", unit="m/s^2"
    )
    gyro_limit: float = setting(17.45, "gyroscope saturation, each axis", unit="rad/s")
    accel_limit: float = setting(176.5, "accelerometer saturation, each axis", unit="m/s^2")


NO_IMU_NOISE = ImuNoise(ImuDensities(0.0, 0.0, 0.0, 0.0), gyro_bias_sigma=0.0, accel_bias_sigma=0.0)


@dataclass(frozen=True, slots=True)
class VelocityNoise:
    """White noise of the paper's control input."""

    linear_sigma: float = setting(
        0.5, "standard deviation of the body velocity, each axis", unit="m/s"
    )
    angular_sigma: float = setting(
        0.05, "standard deviation of the angular rate, each axis", unit="rad/s"
    )


def sample_times(spline: MotionSpline, rate_hz: float) -> IntArray:
    """Times (N,) at a fixed rate from the motion's start to its end."""
    count = int((spline.end_ns - spline.start_ns) * S_PER_NS * rate_hz + 1e-9) + 1
    times = spline.start_ns + np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    return times[times <= spline.end_ns]


def simulate_imu(
    spline: MotionSpline, *, rate_hz: float = 200.0, noise: ImuNoise | None = None, seed: int = 0
) -> ImuRecord:
    """Simulate gyroscope and accelerometer along a motion.

    Without `noise` the defaults of `ImuNoise` apply; `NO_IMU_NOISE` yields exact values. Samples
    are instantaneous.
    """
    noise = ImuNoise() if noise is None else noise
    times = sample_times(spline, rate_hz)
    state = motion_at(spline, times)
    n = len(times)
    gyro_rng = np.random.default_rng([seed, 21])
    accel_rng = np.random.default_rng([seed, 22])
    gyro_bias = _walk(gyro_rng, n, rate_hz, noise.densities.gyro_walk, noise.gyro_bias_sigma)
    accel_bias = _walk(accel_rng, n, rate_hz, noise.densities.accel_walk, noise.accel_bias_sigma)
    gyro = state.angular_velocity + gyro_bias
    gyro = gyro + noise.densities.gyro * np.sqrt(rate_hz) * gyro_rng.standard_normal((n, 3))
    R = state.T_world_imu[:, :3, :3]
    accel = np.einsum("nji,nj->ni", R, state.acceleration_world - GRAVITY_WORLD) + accel_bias
    accel = accel + noise.densities.accel * np.sqrt(rate_hz) * accel_rng.standard_normal((n, 3))
    gyro = np.clip(gyro, -noise.gyro_limit, noise.gyro_limit)
    accel = np.clip(accel, -noise.accel_limit, noise.accel_limit)
    return ImuRecord(times, gyro, accel, gyro_bias, accel_bias)


def _walk(
    rng: np.random.Generator, n: int, rate_hz: float, density: float, start_sigma: float
) -> FloatArray:
    """Random-walk bias (n, 3) from a random start."""
    start = start_sigma * rng.standard_normal(3)
    steps = density / np.sqrt(rate_hz) * rng.standard_normal((n, 3))
    steps[0] = 0.0
    return start + np.cumsum(steps, axis=0)


def simulate_velocity(
    spline: MotionSpline,
    *,
    rate_hz: float = 10.0,
    noise: VelocityNoise | None = None,
    seed: int = 0,
) -> Sequence[VelocitySample]:
    """Simulate the paper's control input `u = [v; omega]` along a motion, in the imu frame, with
    the paper's noise.
    """
    noise = VelocityNoise() if noise is None else noise
    times = sample_times(spline, rate_hz)
    state = motion_at(spline, times)
    rng = np.random.default_rng([seed, 23])
    linear = np.einsum("nji,nj->ni", state.T_world_imu[:, :3, :3], state.velocity_world)
    linear = linear + noise.linear_sigma * rng.standard_normal(linear.shape)
    angular = state.angular_velocity + noise.angular_sigma * rng.standard_normal(linear.shape)
    return velocity_samples(times, linear, angular)
