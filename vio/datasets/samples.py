"""Motion samples of a recording, held as arrays; the record of a sample is made when it is read.

An hour of an IMU at 200 Hz takes 40 MB so, in place of 300 as records.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, cast, overload

import numpy as np

from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity
from vio.records import (
    BoolArray,
    ImuRecord,
    ImuSample,
    IntArray,
    MotionSample,
    MotionSource,
    VelocitySample,
)

Sample_co = TypeVar("Sample_co", bound=ImuSample | VelocitySample, covariant=True)
_CHUNK: Capacity[int] = 1000  # samples whose times are plain numbers at once


@dataclass(frozen=True, slots=True, eq=False)
class MotionSamples(Sequence[Sample_co]):
    """Samples of an IMU, velocities, or both."""

    times_ns: IntArray  # (N,)
    # (N, 6) gyro and accelerometer (rad/s, m/s^2), or linear and angular velocity (m/s, rad/s)
    values: FloatArray
    is_imu: BoolArray  # (N,)

    def __post_init__(self) -> None:
        """Raise DataError unless the values are of float64."""
        if len(self):
            self[0]

    def __len__(self) -> int:
        return len(self.times_ns)

    @overload
    def __getitem__(self, index: int) -> Sample_co: ...

    @overload
    def __getitem__(self, index: slice) -> MotionSamples[Sample_co]: ...

    def __getitem__(self, index: int | slice) -> Sample_co | MotionSamples[Sample_co]:
        if isinstance(index, slice):
            return self.take(index)
        k = range(len(self))[index]
        kind = ImuSample if self.is_imu[k] else VelocitySample
        return cast(Sample_co, kind(int(self.times_ns[k]), self.values[k, :3], self.values[k, 3:]))

    def __iter__(self) -> Iterator[Sample_co]:
        for k in range(0, len(self), _CHUNK):
            yield from self.records(slice(k, k + _CHUNK))

    def records(self, rows: slice) -> list[Sample_co]:
        """Return a record of each of some samples."""
        columns = (
            self.times_ns[rows].tolist(),
            self.values[rows, :3],
            self.values[rows, 3:],
            self.is_imu[rows].tolist(),
        )
        made: list[Any] = [
            (ImuSample if is_imu else VelocitySample)(time_ns, first, second)
            for time_ns, first, second, is_imu in zip(*columns, strict=True)
        ]
        return made

    @property
    def kinds(self) -> frozenset[MotionSource]:
        """Which kinds of samples there are."""
        # `np.unique` loads NumPy's masked arrays, which cost more than all samples of a short run
        found: set[MotionSource] = set()
        if self.is_imu.any():
            found.add("imu")
        if not self.is_imu.all():
            found.add("velocity")
        return frozenset(found)

    def take(self, rows: slice | BoolArray | IntArray) -> MotionSamples[Sample_co]:
        """Return some of the samples."""
        return MotionSamples(self.times_ns[rows], self.values[rows], self.is_imu[rows])


def imu_samples(record: ImuRecord) -> MotionSamples[ImuSample]:
    """Convert a record to events."""
    values = np.hstack([record.gyro, record.accel])
    return MotionSamples(record.times_ns, values, np.ones(len(values), dtype=np.bool_))


def velocity_samples(
    times_ns: IntArray, linear: FloatArray, angular: FloatArray
) -> MotionSamples[VelocitySample]:
    """Build samples from times (N,), m/s (N, 3) and rad/s (N, 3), all in the imu frame."""
    values = np.hstack([linear, angular])
    return MotionSamples(times_ns, values, np.zeros(len(values), dtype=np.bool_))


def motion_samples(samples: Sequence[MotionSample]) -> MotionSamples[MotionSample]:
    """Return records (N,) as arrays; those that are arrays already as they are."""
    if isinstance(samples, MotionSamples):
        return samples
    parts = [
        (x.gyro, x.accel) if isinstance(x, ImuSample) else (x.linear, x.angular) for x in samples
    ]
    return MotionSamples(
        np.array([x.time_ns for x in samples], dtype=np.int64),
        np.array(parts, dtype=np.float64).reshape(-1, 6),
        np.array([isinstance(x, ImuSample) for x in samples], dtype=np.bool_),
    )


def in_time_order(*parts: Sequence[MotionSample]) -> MotionSamples[MotionSample]:
    """Join samples, sorted by their times; of equal times those of an earlier part come first."""
    arrays = [motion_samples(part) for part in (*parts, ())]
    times_ns = np.concatenate([part.times_ns for part in arrays])
    whole = MotionSamples[MotionSample](
        times_ns,
        np.concatenate([part.values for part in arrays]),
        np.concatenate([part.is_imu for part in arrays]),
    )
    return whole.take(np.argsort(times_ns, kind="stable"))
