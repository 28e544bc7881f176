"""The start with an IMU: standstill or motion, by the samples of the last half second before the
first frame.

White noise averages out over a tenth of a second, a motion does not: at standstill the means of
such blocks agree within the noise, and the mean specific force is as long as gravity. A steady turn
and a steady acceleration look the same to an IMU, so both stay within the standard deviations that
come with the result. Equation (N10) of docs/math.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vio.dataclass import dataclass
from vio.errors import EstimationError
from vio.geometry.lie import FloatArray, so3_exp
from vio.imu.settings import ImuSettings
from vio.imu.standstill import NOISE_FACTOR, STANDSTILL_S, blocks_agree
from vio.records import ImuSample

START_TILT_SIGMA_DEG = 8.0  # initial standard deviation of roll and pitch
# beyond, the direction of gravity is unknown; a larger prior says no more
_MAX_TILT_RAD = np.pi / 4


@dataclass(frozen=True, slots=True)
class ImuStart:
    """What the samples before the first frame determine."""

    still: bool  # whether they look like a standstill (or like a steady turn or acceleration)
    force: FloatArray  # (3,) mean specific force in the body frame of the first frame, m/s^2
    rate: FloatArray  # (3,) what the gyro reads at the first frame, rad/s
    gyro_bias: FloatArray  # (3,) rad/s
    gyro_bias_sigma_radps: float
    accel_sigma_mps2: float  # standard deviation of the mean acceleration, horizontal, per axis


def _recent(
    samples: Sequence[ImuSample], time_ns: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times (S,) in seconds up to the last of the samples before a time, and their gyro and
    accelerometer, (S, 3) each, of the last half second.
    """
    before = [x for x in samples if x.time_ns <= time_ns] or list(samples[:1])
    last_ns = before[-1].time_ns
    recent = [x for x in before if x.time_ns >= last_ns - STANDSTILL_S * 1e9]
    times_s = np.array([x.time_ns - last_ns for x in recent]) * 1e-9
    return times_s, np.array([x.gyro for x in recent]), np.array([x.accel for x in recent])


def imu_start(samples: Sequence[ImuSample], time_ns: int, imu: ImuSettings) -> ImuStart:
    """Judge the last half second of samples before a time.

    Args:
        samples: one or more, in time order; where all are later, the first is taken.
        time_ns: time of the first frame.
        imu: noise densities, standard deviations of the biases, gravity.

    Raises:
        EstimationError: the accelerometer reads nothing.
    """
    times_s, gyro, accel = _recent(samples, time_ns)
    force = np.mean(_turned_to_the_last(times_s, gyro, accel), axis=0)
    length = float(np.linalg.norm(force))
    if length < 1e-3:
        raise EstimationError("the accelerometer reads zero; is it in m/s^2, with gravity in it?")
    s = imu
    span_s = 5e-3
    if len(times_s) > 1:
        span_s = max(-float(times_s[0]), 1e-3)
    force_noise, rate_noise = (
        d / np.sqrt(span_s) for d in (s.accel_noise_density, s.gyro_noise_density)
    )
    tolerance = 3 * np.hypot(s.accel_bias_sigma_mps2, NOISE_FACTOR * force_noise)
    mean_rate = gyro.mean(axis=0)
    turn = float(np.linalg.norm(mean_rate))
    still = blocks_agree(times_s, gyro, s.gyro_noise_density) and blocks_agree(
        times_s, accel, s.accel_noise_density
    )
    agrees = abs(length - s.gravity_mps2) < tolerance and turn < 3 * s.gyro_bias_sigma_radps
    # |f|^2 = g^2 + a^2 where the acceleration is level; what noise alone makes of |f|^2 - g^2 is no
    # evidence.
    level = abs(length**2 - s.gravity_mps2**2) - 4 * s.gravity_mps2 * force_noise
    shown = np.sqrt(max(level, 0.0))
    if still and agrees:
        # The whole reading may be a turn, so the bias is known to its size.
        bias_sigma = float(np.hypot(turn, NOISE_FACTOR * rate_noise))
        return ImuStart(
            True,
            force,
            gyro[-1],
            mean_rate,
            bias_sigma,
            float(np.hypot(shown, NOISE_FACTOR * force_noise)),
        )
    scatter = float(np.sqrt(accel.var(axis=0).sum()))
    base = s.gravity_mps2 * np.radians(START_TILT_SIGMA_DEG)
    sigma = min(
        float(np.linalg.norm([base, shown, scatter])),
        s.gravity_mps2 * float(np.tan(_MAX_TILT_RAD)),
    )
    return ImuStart(False, force, gyro[-1], np.zeros(3), s.gyro_bias_sigma_radps, sigma)


def _turned_to_the_last(times_s: FloatArray, gyro: FloatArray, accel: FloatArray) -> FloatArray:
    """Specific forces (N, 3) in the body frame of the last sample, by integrating the gyro."""
    steps = so3_exp(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(times_s)[:, None])
    out = np.empty_like(accel)  # R takes the body frame of sample k to the last one's
    R = np.eye(3)
    for k in range(len(accel) - 1, -1, -1):
        out[k] = R @ accel[k]
        if k:
            R = R @ steps[k - 1].T
    return out
