"""How an IMU was sampled, by its record alone: too slow, held between its readings, stamped in
bursts, or not recorded at all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.geometry.lie import FloatArray
from vio.numerics.robust import median
from vio.records import NS_PER_S, ImuRecord, IntArray


class _RateRules(NamedTuple):
    """When samples come often enough, and one by one."""

    # below, rotation between samples is no longer small; usual rates are 100 to 400 Hz
    min_hz: float = 50.0
    slowest_hz: float = 2.0  # below, the unit of its times is doubted
    min_rows: int = 20  # of equal readings, or bursts
    min_repeats: int = 3  # of a reading in a row, that a driver gives again and again
    alike_share: float = 0.8  # share of the rows that are about as long as the median
    burst_share: float = 0.2  # of the mean interval, below which the median one is that of bursts
    pauses_share: float = 0.8  # share of the time that passes between bursts


_RATES = _RateRules()
_UNIT_HINT = "; if it has more, its times are in another unit: state it in the header"


def sampling_notes(record: ImuRecord, where: str) -> tuple[str, ...]:
    """Return notes on a record whose samples are not those of a sensor at its rate.

    Args:
        record: at least one sample.
        where: the file or topic.
    """
    if len(record.times_ns) < 2:
        return ()
    notes = [*_silent(record, where)]
    rate_hz = sampled_hz(record)
    repeats = _repeats(record)
    if burst := burst_length(record.times_ns):
        notes.append(
            f"{where}: the stamps come in bursts of {burst}, as where they are times of arrival; "
            f"the IMU has {_stamped_hz(record.times_ns):.3g} Hz in the mean; record the sensor's "
            "own stamps"
        )
    if repeats:
        notes.append(
            f"{where}: each reading is given {repeats} times, so the IMU has {rate_hz:.3g} Hz, not "
            f"{rate_hz * repeats:.3g}; record each reading once"
        )
    if rate_hz < _RATES.min_hz:
        notes.append(
            f"{where}: the IMU has {rate_hz:.3g} Hz, too few to integrate the motion between "
            f"images; record at least {_RATES.min_hz:g} Hz, or use --motion none"
            f"{_UNIT_HINT if rate_hz < _RATES.slowest_hz else ''}"
        )
    return tuple(notes)


def sampled_hz(record: ImuRecord) -> float:
    """Return the rate of a record of two samples and more, without readings that are given again."""
    return _stamped_hz(record.times_ns) / max(_repeats(record), 1)


def _stamped_hz(times_ns: IntArray) -> float:
    """Return the usual rate of stamps (N,); of bursts the mean one."""
    if burst_length(times_ns):
        return (len(times_ns) - 1) * NS_PER_S / float(np.ptp(times_ns))
    return NS_PER_S / median(np.diff(times_ns))


def _repeats(record: ImuRecord) -> int:
    return repeated_readings(np.hstack([record.gyro, record.accel]))


def _silent(record: ImuRecord, where: str) -> list[str]:
    """Return a note on a sensor whose readings are all exactly zero."""
    return [
        f"{where}: the {name} is 0 in all {len(values)} samples; that sensor was not recorded here"
        for name, values in (("gyro", record.gyro), ("accelerometer", record.accel))
        if not values.any()
    ]


def repeated_readings(values: FloatArray) -> int:
    """Return how often each reading of (N, 6) is given in a row; 0: once, or now and then again.

    An IMU at rest in a simulator without noise repeats one reading for long, which is no rate.
    """
    changed = np.flatnonzero((values[1:] != values[:-1]).any(axis=1))
    lengths = np.diff(changed)
    if len(lengths) < _RATES.min_rows:
        return 0
    usual = round(median(lengths))
    alike = np.mean(np.abs(lengths - usual) <= 1)
    if usual >= _RATES.min_repeats and alike >= _RATES.alike_share:
        return usual
    return 0


def burst_length(times_ns: IntArray) -> int:
    """Return how many stamps of (N,) come at once before a pause; 0: they come one by one."""
    steps = np.diff(times_ns).astype(np.float64)
    mean = float(steps.mean())
    pauses = steps > mean
    if pauses.sum() < _RATES.min_rows or median(steps) >= _RATES.burst_share * mean:
        return 0
    share = float(steps[pauses].sum() / steps.sum())
    if share >= _RATES.pauses_share:
        return round(len(steps) / int(pauses.sum()))
    return 0
