"""Checks of what comes into a filter, before it changes anything: order in time, finite values,
ids, types.

What is refused leaves the filter as it was, so that the caller may go on with the next frame or
sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeGuard, cast

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.errors import CalibrationError, ConfigError, DataError
from vio.geometry.lie import FloatArray, rigid_fault
from vio.geometry.stereo import StereoCamera
from vio.imu.faults import readings_of
from vio.records import ImuSample, MotionSample, Observations
from vio.setting import Section

# of a pixel, m/s, rad/s or m/s^2: beyond any sensor, and no square overflows below it
LARGEST = 1e6
_FARTHEST_M = 1e3  # between IMU and camera


def check_parts(name: str, camera: object, settings: object, section: type[Section]) -> None:
    """Raise ConfigError unless a filter gets a camera and its own section of the configuration."""
    if not isinstance(camera, StereoCamera):
        raise ConfigError(f"{name} takes a StereoCamera, got {type(camera).__name__}")
    if not isinstance(settings, section):
        raise ConfigError(
            f"{name} takes {section.__name__}, got {type(settings).__name__}; give its own section"
        )


def checked_extrinsics(T_cam0_imu: npt.ArrayLike) -> FloatArray:
    """Return a copy of extrinsics (4, 4) as float64, to the bit.

    Raises:
        CalibrationError: they are no rigid transform.
    """
    try:
        T = np.array(T_cam0_imu, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise CalibrationError(
            f"T_cam0_imu is no matrix of numbers ({error}); give a (4, 4) array"
        ) from error
    fault: str | None
    if T.shape != (4, 4):
        fault = f"has the shape {T.shape} instead of (4, 4)"
    else:
        fault = rigid_fault(T)
    if fault is None and not np.abs(T[:3, 3]).max() <= _FARTHEST_M:
        fault = f"puts the camera {np.abs(T[:3, 3]).max() / 1e3:g} km from the IMU; translations are in metres"
    if fault is not None:
        raise CalibrationError(
            f"T_cam0_imu {fault}; it maps the IMU's coordinates to the left camera's"
        )
    return T


@dataclass(slots=True)
class InputOrder:
    """Accepts motion samples and frames in order of time."""

    name: str  # of the filter, for messages
    _sample_ns: int | None = None
    _frame_ns: int | None = None

    def sample(self, sample: MotionSample) -> None:
        """Check a motion sample.

        Raises:
            DataError: it is not after the last one, a velocity is before the last frame, or a value
                is not finite or absurdly large.
        """
        if isinstance(sample, ImuSample):
            imu = True
            first = sample.gyro
            second = sample.accel
        else:
            imu = False
            first = sample.linear
            second = sample.angular
        kind = "IMU" if imu else "velocity"
        now = sample.time_ns
        (a, b, c) = first.tolist()
        (d, e, f) = second.tolist()
        most = LARGEST
        # Written out, as it is asked of every sample.
        if not (-most < a < most and -most < b < most and -most < c < most) or not (
            -most < d < most and -most < e < most and -most < f < most
        ):
            raise DataError(
                f"{self.name}: the {kind} sample at {now} ns holds {_values(first, second)}; drop "
                "it"
            )
        if self._sample_ns is not None and now <= self._sample_ns:
            raise DataError(
                f"{self.name}: the {kind} sample at {now} ns is not after the last one "
                f"({self._sample_ns} ns); "
                "sort the samples, and drop doubled ones"
            )
        if not imu and self._frame_ns is not None and now < self._frame_ns:
            raise DataError(
                f"{self.name}: the velocity at {now} ns is before the last frame ({self._frame_ns} "
                "ns); give "
                "samples and frames in order of time"
            )
        self._sample_ns = now

    def accept_imu(self, samples: Sequence[MotionSample]) -> TypeGuard[Sequence[ImuSample]]:
        """Take one or more samples of an IMU at once, and return True; where `sample` refuses one
        of them, or one is of another kind, take none.
        """
        before_ns = self._sample_ns
        for x in samples:
            if type(x) is not ImuSample or (before_ns is not None and x.time_ns <= before_ns):
                return False
            before_ns = x.time_ns
        if not np.abs(readings_of(cast("Sequence[ImuSample]", samples))).max() < LARGEST:
            return False
        self._sample_ns = before_ns
        return True

    def frame(self, seen: Observations, reached_ns: int | None) -> None:
        """Check the observations of a frame.

        Args:
            seen: the observations.
            reached_ns: time of the filter's state; None: it has none yet.

        Raises:
            DataError: the frame is not after the last one or before the state, an id occurs twice,
                or a pixel is not finite.
        """
        where = f"{self.name}: frame {seen.frame_index}"
        now = seen.time_ns
        before = self._frame_ns
        if before is not None and now <= before:
            raise DataError(
                f"{where} at {now} ns is not after the last frame ({before} ns); give frames in "
                "order of time"
            )
        if reached_ns is not None and now < reached_ns:
            raise DataError(
                f"{where} at {now} ns is before the last velocity ({reached_ns} ns); give both in "
                "order of time"
            )
        ids = seen.ids.copy()
        ids.sort()
        if (ids[1:] == ids[:-1]).any():
            doubled = int(ids[1:][ids[1:] == ids[:-1]][0])
            raise DataError(f"{where} observes feature {doubled} twice; an id names one feature")
        finite = np.abs(seen.z) < LARGEST
        if not finite.all() and not (finite[:, :2].all() and finite[seen.has_right].all()):
            row = int(np.argmin(finite.all(axis=1)))
            raise DataError(
                f"{where}: feature {int(seen.ids[row])} is at the pixels {seen.z[row].tolist()}; "
                "leave it out, or "
                "clear has_right where only the right one is missing"
            )
        self._frame_ns = now


def _values(*vectors: FloatArray) -> str:
    return " and ".join(str(vector.tolist()) for vector in vectors)
