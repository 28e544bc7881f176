"""Inertial and velocity sensors read off a motion, with noise and drifting biases as data sheets give them.

Reference: Furgale, Rehder, Siegwart, Unified temporal and spatial calibration for multi-sensor systems (2013), and the
Kalibr IMU noise model: white noise of density s has deviation s sqrt(rate) per sample, a bias walks by s_b sqrt(dt).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.records import ImuSample, IntArray, VelocitySample
from vio.setting import setting
from vio.sim.motion import MotionSpline, evaluate

GRAVITY_MPS2 = 9.81
GRAVITY_WORLD = np.array([0.0, 0.0, -GRAVITY_MPS2])
_NS = 1e-9


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Errors of an inertial measurement unit; the defaults are EuRoC's figures for its ADIS16448."""

    gyro_density: float = setting(1.6968e-4, "gyroscope white noise", unit="rad/s/sqrt(Hz)")
    gyro_walk: float = setting(1.9393e-5, "gyroscope bias random walk", unit="rad/s^2/sqrt(Hz)")
    accel_density: float = setting(2.0e-3, "accelerometer white noise", unit="m/s^2/sqrt(Hz)")
    accel_walk: float = setting(3.0e-3, "accelerometer bias random walk", unit="m/s^3/sqrt(Hz)")
    gyro_bias_sigma: float = setting(5e-3, "deviation of the gyroscope bias at the start", unit="rad/s")
    accel_bias_sigma: float = setting(5e-2, "deviation of the accelerometer bias at the start", unit="m/s^2")
    gyro_limit: float = setting(17.45, "gyroscope saturation, each axis", unit="rad/s")
    accel_limit: float = setting(176.5, "accelerometer saturation, each axis", unit="m/s^2")


NO_IMU_NOISE = ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class VelocityNoise:
    """White noise of the paper's control input."""

    linear_sigma: float = setting(0.5, "deviation of the body velocity, each axis", unit="m/s")
    angular_sigma: float = setting(0.05, "deviation of the angular rate, each axis", unit="rad/s")


@dataclass(frozen=True, slots=True)
class ImuRecord:
    """Readings of an inertial measurement unit, with the true biases where they are known."""

    times_ns: IntArray  # (N,) strictly increasing
    gyro: FloatArray  # (N, 3) rad/s, imu frame
    accel: FloatArray  # (N, 3) m/s^2, imu frame, specific force
    gyro_bias: FloatArray | None = field(default=None)  # (N, 3) rad/s; None for a real record
    accel_bias: FloatArray | None = field(default=None)  # (N, 3) m/s^2; None for a real record


def sample_times(spline: MotionSpline, rate_hz: float, start_ns: int | None = None) -> IntArray:
    """Times (N,) at a fixed rate from `start_ns` (None: the motion's start) to the motion's end."""
    first = spline.start_ns if start_ns is None else start_ns
    count = int((spline.end_ns - first) * _NS * rate_hz + 1e-9) + 1
    times = first + np.round(np.arange(max(count, 0)) * (1e9 / rate_hz)).astype(np.int64)
    return times[times <= spline.end_ns]


def simulate_imu(
    spline: MotionSpline, *, rate_hz: float = 200.0, noise: ImuNoise | None = None, seed: int = 0
) -> ImuRecord:
    """Read gyroscope and accelerometer off a motion.

    Without `noise` the defaults of `ImuNoise` apply; `NO_IMU_NOISE` gives the exact values. Samples are instantaneous.
    """
    noise = ImuNoise() if noise is None else noise
    times = sample_times(spline, rate_hz)
    state = evaluate(spline, times)
    n = len(times)
    gyro_rng, accel_rng = np.random.default_rng([seed, 21]), np.random.default_rng([seed, 22])
    gyro_bias = _walk(gyro_rng, n, rate_hz, noise.gyro_walk, noise.gyro_bias_sigma)
    accel_bias = _walk(accel_rng, n, rate_hz, noise.accel_walk, noise.accel_bias_sigma)
    gyro = state.angular_velocity + gyro_bias
    gyro = gyro + noise.gyro_density * np.sqrt(rate_hz) * gyro_rng.standard_normal((n, 3))
    R = state.T_world_imu[:, :3, :3]
    accel = np.einsum("nji,nj->ni", R, state.acceleration_world - GRAVITY_WORLD) + accel_bias
    accel = accel + noise.accel_density * np.sqrt(rate_hz) * accel_rng.standard_normal((n, 3))
    return ImuRecord(
        times,
        np.clip(gyro, -noise.gyro_limit, noise.gyro_limit),
        np.clip(accel, -noise.accel_limit, noise.accel_limit),
        gyro_bias,
        accel_bias,
    )


def _walk(rng: np.random.Generator, n: int, rate_hz: float, density: float, start_sigma: float) -> FloatArray:
    """Brownian bias (n, 3) from a random start."""
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
    times_ns: npt.ArrayLike | None = None,
) -> list[VelocitySample]:
    """Read the paper's control input `u = [v; omega]` off a motion, in the imu frame, with the paper's noise.

    `times_ns` (N,) overrides the rate.
    """
    noise = VelocityNoise() if noise is None else noise
    times = sample_times(spline, rate_hz) if times_ns is None else np.asarray(times_ns, dtype=np.int64)
    state = evaluate(spline, times)
    rng = np.random.default_rng([seed, 23])
    linear = np.einsum("nji,nj->ni", state.T_world_imu[:, :3, :3], state.velocity_world)
    linear = linear + noise.linear_sigma * rng.standard_normal(linear.shape)
    angular = state.angular_velocity + noise.angular_sigma * rng.standard_normal(linear.shape)
    return [VelocitySample(int(t), v, w) for t, v, w in zip(times, linear, angular, strict=True)]


def imu_samples(record: ImuRecord) -> list[ImuSample]:
    """The readings as events."""
    return [ImuSample(int(t), g, a) for t, g, a in zip(record.times_ns, record.gyro, record.accel, strict=True)]


def read_imu_csv(path: Path) -> ImuRecord:
    """Read a real record in EuRoC's form: `timestamp [ns], gyro x y z, accel x y z`.

    Raises:
        DataError: the file is missing, a row is not seven finite numbers, or times do not increase.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot read the IMU record {path}: {error}") from error
    times, values = [], []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words = line.split(",")
        try:
            times.append(int(words[0]))
            row = [float(word) for word in words[1:]]
        except ValueError:
            row = []
        if len(row) != 6 or not np.all(np.isfinite(row)):
            raise DataError(f"{path}, line {number}: expected a time in ns and six finite numbers, got {line[:60]!r}")
        values.append(row)
    if not times:
        raise DataError(f"{path} holds no IMU samples")
    t, data = np.array(times, dtype=np.int64), np.array(values)
    if np.any(np.diff(t) <= 0):
        i = int(np.flatnonzero(np.diff(t) <= 0)[0]) + 1
        raise DataError(f"{path}: times do not increase at sample {i} ({t[i - 1]} ns, then {t[i]} ns)")
    return ImuRecord(t, data[:, :3], data[:, 3:])
