"""A gyro and an accelerometer that have stamps of their own, as one record: in two tables, or in
samples of which each has the readings of one alone and zeros for the other's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.geometry.lie import FloatArray
from vio.numerics.robust import median
from vio.records import ImuRecord, IntArray


class _GapRules(NamedTuple):
    """When an accelerometer's readings have a gap."""

    # An accelerometer's readings further apart than so many usual intervals, and so much time, are
    # a gap, over which its readings are not interpolated.
    usual_intervals: float = 8.0
    min_ns: int = 100_000_000


GAPS = _GapRules()


class _MixedRules(NamedTuple):
    """When each sample has readings of one sensor alone, and not one that fails now and then."""

    min_share_of_each: float = 0.1
    min_share_alone: float = 0.9


_MIXED = _MixedRules()
# what is noted of such samples
JOINED = "they are joined, the acceleration interpolated at the gyro's stamps"


def parted_sensors(gyro: FloatArray, accel: FloatArray) -> tuple[IntArray, IntArray] | None:
    """Return the rows (M,) with readings of the gyro alone and those (K,) of the accelerometer alone,
    zeros in the place of the other's; None: samples have readings of both.

    Args:
        gyro: (N, 3).
        accel: (N, 3).
    """
    gyro_alone = ~accel.any(axis=1)
    accel_alone = ~gyro.any(axis=1) & ~gyro_alone
    fewer = min(gyro_alone.mean(), accel_alone.mean())
    alone = (gyro_alone | accel_alone).mean()
    if fewer < _MIXED.min_share_of_each or alone < _MIXED.min_share_alone:
        return None
    return np.flatnonzero(gyro_alone), np.flatnonzero(accel_alone)


def joined_record(
    gyro: tuple[IntArray, FloatArray], accel: tuple[IntArray, FloatArray]
) -> ImuRecord | None:
    """Return one record of a gyro and an accelerometer with stamps of their own.

    The acceleration is interpolated at the gyro's stamps (N,); those before its first reading,
    behind its last one, or in a gap of it are left out.

    Args:
        gyro: increasing stamps (N,) and rad/s (N, 3).
        accel: increasing stamps (M,) and m/s^2 (M, 3).

    Returns:
        The record; None where no stamp of the gyro lies between readings of the accelerometer.
    """
    times, rates = gyro
    accel_ns, forces = accel
    if len(accel_ns) < 2:
        return None
    after = np.clip(np.searchsorted(accel_ns, times), 1, len(accel_ns) - 1)
    steps = np.diff(accel_ns)
    longest = max(GAPS.usual_intervals * median(steps), GAPS.min_ns)
    inside = (times >= accel_ns[0]) & (times <= accel_ns[-1]) & (steps[after - 1] <= longest)
    if not inside.any():
        return None
    at = (times[inside] - accel_ns[0]).astype(np.float64)
    known = (accel_ns - accel_ns[0]).astype(np.float64)
    columns = [np.interp(at, known, forces[:, axis]) for axis in range(3)]
    return ImuRecord(times[inside], rates[inside], np.stack(columns, axis=1))
