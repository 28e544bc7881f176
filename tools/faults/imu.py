"""Faults of the IMU."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from tools.faults.changes import (
    Changed,
    Period,
    SampleChange,
    Variant,
    gap,
    imu_readings,
    imu_samples,
    seeded,
    with_events,
)
from vio.geometry.lie import FloatArray, so3_exp
from vio.protocols import Dataset
from vio.records import S_PER_NS, Event, ImuSample, StereoFrame


def stuck_samples(dataset: Dataset, period: Period) -> Changed:
    """Every sample of the period repeats the reading of its first one."""
    last: list[ImuSample] = []

    def stuck(sample: ImuSample) -> ImuSample:
        last.append(sample)
        return ImuSample(sample.time_ns, last[0].gyro, last[0].accel)

    return imu_samples(stuck, during=True)(dataset, period)


def spikes(rng: np.random.Generator, share: float, gyro: float, accel: float) -> Variant:
    """A share of the samples is off by rad/s and m/s^2 in all axes."""

    def spike(s: ImuSample) -> ImuSample:
        signs = rng.choice([-1.0, 1.0], (2, 3)) * (rng.random() < share)
        return ImuSample(s.time_ns, s.gyro + gyro * signs[0], s.accel + accel * signs[1])

    return imu_samples(spike)


def restamped(shift_s: float, jitter_s: float = 0.0) -> Variant:
    """IMU stamps shifted, and scattered."""

    def variant(dataset: Dataset, period: Period) -> Changed:
        def changed(events: Iterable[Event]) -> Iterator[Event]:
            held = list(events)
            old = np.array([e.time_ns for e in held if isinstance(e, ImuSample)], dtype=np.int64)
            scatter = np.random.default_rng(10).normal(shift_s, jitter_s, len(old)) / S_PER_NS
            new = (
                np.sort(old + scatter.astype(np.int64))
                if jitter_s
                else old + scatter.astype(np.int64)
            )
            times = iter(
                (np.maximum.accumulate(new - np.arange(len(new))) + np.arange(len(new))).tolist()
            )
            moved = [
                replace(e, time_ns=next(times)) if isinstance(e, ImuSample) else e for e in held
            ]
            yield from sorted(moved, key=lambda e: (e.time_ns, isinstance(e, StereoFrame)))

        return with_events(dataset, changed)

    return variant


def noisy_imu(rng: np.random.Generator, gyro: float, accel: float) -> SampleChange:
    """White noise on both readings, rad/s and m/s^2."""
    return imu_readings(
        lambda g: g + rng.normal(0.0, gyro, 3), lambda a: a + rng.normal(0.0, accel, 3)
    )


def as_is(values: FloatArray) -> FloatArray:
    """No change."""
    return values


def plus(*bias: float) -> Callable[[FloatArray], FloatArray]:
    """A bias added to a reading."""
    return lambda values: values + np.array(bias)


_ROT5 = so3_exp(np.radians(5.0) * np.ones(3) / np.sqrt(3.0))
ZERO = imu_readings(np.zeros_like, np.zeros_like)

IMU: dict[str, Variant] = {
    "zero": imu_samples(ZERO, during=True),
    "zero always": imu_samples(ZERO),
    "stuck": stuck_samples,
    "silent": gap(frames=False, samples=True),
    "dead later": imu_samples(lambda sample: None, after=True),
    "spikes": seeded(lambda rng: spikes(rng, 0.01, 30.0, 100.0)),
    "small spikes": seeded(lambda rng: spikes(rng, 0.02, 1.0, 5.0)),
    "jitter 3 ms": restamped(0.0, 3e-3),
    "50 ms early": restamped(-0.05),
    "axes exchanged": imu_samples(imu_readings(lambda g: g[[1, 0, 2]], lambda a: a[[1, 0, 2]])),
    "gyro x inverted": imu_samples(imu_readings(lambda g: g * [-1, 1, 1], as_is)),
    "accelerometer z inverted": imu_samples(imu_readings(as_is, lambda a: a * [1, 1, -1])),
    "accelerometer in g": imu_samples(imu_readings(as_is, lambda a: a / 9.80665)),
    "gyro in deg/s": imu_samples(imu_readings(np.degrees, as_is)),
    "accelerometer bias": imu_samples(imu_readings(as_is, plus(0.7, 0.5, -0.5))),
    "gyro bias": imu_samples(imu_readings(plus(0.2, -0.2, 0.1), as_is)),
    "bias jump": imu_samples(imu_readings(plus(0.1, -0.1, 0.05), plus(0.5, 0.3, -0.3)), after=True),
    "gyro clipped": imu_samples(imu_readings(lambda g: np.clip(g, -0.3, 0.3), as_is)),
    "vibration": seeded(lambda rng: imu_samples(noisy_imu(rng, 0.3, 5.0))),
    "turned 5 deg": imu_samples(imu_readings(lambda g: _ROT5 @ g, lambda a: _ROT5 @ a)),
    "scale 1.1": imu_samples(imu_readings(lambda g: 1.1 * g, lambda a: 1.1 * a)),
}
