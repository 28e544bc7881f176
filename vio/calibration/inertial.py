"""Types shared by the inertial calibration: motion samples as arrays, and the sensor's alignment
with the camera.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray
from vio.records import ImuSample, IntArray, MotionSample


@dataclass(frozen=True, slots=True)
class Rates:
    """Motion samples as arrays."""

    times_ns: IntArray  # (S,)
    angular: FloatArray  # (S, 3) rad/s, imu frame
    linear: FloatArray  # (S, 3) specific force in m/s^2, or velocity in m/s
    inertial: bool  # whether `linear` is specific force


def rates_of(samples: Sequence[MotionSample]) -> Rates:
    """Return motion samples of one kind, one at least, as arrays."""
    inertial = isinstance(samples[0], ImuSample)
    pairs = [
        (s.gyro, s.accel) if isinstance(s, ImuSample) else (s.angular, s.linear) for s in samples
    ]
    return Rates(
        np.array([s.time_ns for s in samples], dtype=np.int64),
        np.array([p[0] for p in pairs]),
        np.array([p[1] for p in pairs]),
        inertial,
    )


@dataclass(frozen=True, slots=True)
class ImuAlignment:
    """Rotation, time offset and bias of the gyro relative to the camera."""

    R_cam0_imu: FloatArray  # (3, 3)
    rotation_sigma_deg: FloatArray  # (3,) about the axes of cam0
    # IMU clock minus camera clock: a frame stamped t was exposed at t + offset of the IMU's clock
    time_offset_s: float
    time_offset_sigma_s: float
    gyro_bias: FloatArray  # (3,) rad/s
    residual_radps: float  # robust spread of the rotation rates' difference, each axis
    intervals: int
    weak: str | None  # what the motion leaves unobservable, in words
