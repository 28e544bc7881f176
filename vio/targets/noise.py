"""Noise of an IMU at rest: overlapping Allan deviation, and the densities that Kalibr's file states.

White noise falls as `N / sqrt(tau)`, a random walk rises as `K sqrt(tau / 3)`, and between them lies
the bias instability, 0.664 B. Intervals follow from the number of independent averages.
References: IEEE Std 952-1997, annex C; Riley, Handbook of frequency stability analysis, NIST special
publication 1065 (2008), sections 5.2.4 and 5.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.records import ImuDensities, ImuRecord, IntArray

MOVING_FACTOR = 5.0  # by which densities at rest are multiplied for use while moving, see the page


class _AllanRules(NamedTuple):
    """How densities are read from Allan deviations."""

    min_averages: int = 9  # independent ones of the longest averaging time
    per_decade: int = 10  # averaging times
    min_s: float = 300.0
    white_s: float = 1.0  # where white noise is read: averaging times up to it


_ALLAN = _AllanRules()
_INSTABILITY = 0.664  # lowest Allan deviation over B


class _RestRules(NamedTuple):
    """When an IMU is at rest."""

    max_gap_periods: float = 3.0  # between samples
    # of a mean over a second against its neighbour, white sigmas: it moved
    max_shift_sigmas: float = 10.0


_REST = _RestRules()


@dataclass(frozen=True, slots=True)
class AllanCurve:
    """Overlapping Allan deviation of one axis."""

    tau_s: FloatArray  # (T,) averaging times
    deviation: FloatArray  # (T,) in the signal's unit
    relative_error: FloatArray  # (T,) one standard deviation of `deviation`


@dataclass(frozen=True, slots=True)
class Density:
    """A density and its interval of 95 %."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class AxisNoise:
    """What the Allan deviation of one sensor says, the worst of its three axes."""

    white: Density  # unit / sqrt(Hz)
    instability: Density  # unit
    walk: Density  # unit / s / sqrt(Hz); an upper bound where the record is too short to show it
    walk_is_bound: bool


def overlapping_allan(values: FloatArray, rate_hz: float, averages: IntArray) -> FloatArray:
    """Return the overlapping Allan deviation (T,) of rates (N,) over numbers of samples (T,)."""
    phase = np.concatenate([[0.0], np.cumsum(values)]) / rate_hz
    out = np.empty(len(averages))
    for k, m in enumerate(averages.tolist()):
        second = phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m]
        out[k] = np.sqrt(np.mean(second**2) / 2) * rate_hz / m
    return out


def allan_curve(values: FloatArray, rate_hz: float) -> AllanCurve:
    """Return the curve of one axis (N,) at averaging times spread over decades."""
    longest = len(values) // _ALLAN.min_averages
    decades = np.log10(max(longest, 1))
    averages = np.unique(
        np.logspace(0, decades, int(_ALLAN.per_decade * decades) + 1).astype(np.int64)
    )
    independent = len(values) / averages
    relative = 1 / np.sqrt(2 * np.maximum(independent - 1, 1))
    return AllanCurve(averages / rate_hz, overlapping_allan(values, rate_hz, averages), relative)


def axis_noise(curve: AllanCurve) -> AxisNoise:
    """Return the densities that a curve shows."""
    tau = curve.tau_s
    at = np.flatnonzero(tau <= _ALLAN.white_s)
    white = curve.deviation[at] * np.sqrt(tau[at])
    weight = 1 / curve.relative_error[at] ** 2
    N = float(white @ weight / weight.sum())
    lowest = int(np.argmin(curve.deviation))
    rising = np.arange(lowest, len(tau))
    # What white noise leaves there is that of the walk.
    left = curve.deviation[rising] ** 2 - N**2 / tau[rising]
    slope = np.sqrt(3 / tau[-1])
    last = float(np.sqrt(max(left[-1], 0.0)) * slope)
    bound = float(curve.deviation[-1] * np.sqrt(3 / tau[-1]))
    is_bound = lowest >= len(tau) - 3
    K = bound if is_bound else last
    return AxisNoise(
        _interval(N, float(1 / np.sqrt(weight.max()))),
        _interval(
            float(curve.deviation[lowest]) / _INSTABILITY, float(curve.relative_error[lowest])
        ),
        _interval(K, float(curve.relative_error[-1])),
        is_bound,
    )


def _interval(value: float, relative: float) -> Density:
    return Density(value, value * max(1 - 1.96 * relative, 0.0), value * (1 + 1.96 * relative))


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise of an IMU, and the curves (6) of gyroscope and accelerometer that show it."""

    gyro: AxisNoise
    accel: AxisNoise
    curves: tuple[AllanCurve, ...]

    @property
    def densities(self) -> ImuDensities:
        """The densities as measured at rest."""
        return ImuDensities(
            self.gyro.white.value,
            self.gyro.walk.value,
            self.accel.white.value,
            self.accel.walk.value,
        )


def measure_noise(record: ImuRecord) -> ImuNoise:
    """Return the noise of an IMU that was at rest.

    Raises:
        DataError: the record is too short, lacks samples, or the IMU was moved.
    """
    seconds = 1e-9 * (record.times_ns - record.times_ns[0])
    if len(seconds) < 2 or seconds[-1] < _ALLAN.min_s:
        length = 0.0
        if len(seconds):
            length = float(seconds[-1])
        raise DataError(
            f"the IMU's record has {length:.0f} s, and the noise needs {_ALLAN.min_s:.0f}: record "
            "an hour or more at rest, on a heavy table"
        )
    steps = np.diff(seconds)
    period = float(np.median(steps))
    if steps.max() > _REST.max_gap_periods * period:
        k = int(np.argmax(steps))
        raise DataError(
            f"samples of the IMU are missing for {steps[k]:.2f} s at second {seconds[k]:.1f}: "
            "record again without gaps"
        )
    rate_hz = 1 / period
    axes = [*record.gyro.T, *record.accel.T]
    for values in axes:
        _check_rest(values, rate_hz)
    curves = tuple(allan_curve(values, rate_hz) for values in axes)
    noise = [axis_noise(curve) for curve in curves]
    return ImuNoise(_worst(noise[:3]), _worst(noise[3:]), curves)


def _check_rest(values: FloatArray, rate_hz: float) -> None:
    size = max(round(rate_hz), 1)
    blocks = values[: len(values) // size * size].reshape(-1, size)
    means = blocks.mean(axis=1)
    spread = float(np.median(blocks.std(axis=1))) / np.sqrt(size)
    jumps = np.abs(np.diff(means))
    if jumps.max() > _REST.max_shift_sigmas * max(spread, 1e-12):
        raise DataError(
            f"the IMU was moved at second {int(np.argmax(jumps))}: the noise needs a record at rest"
        )


def _worst(axes: list[AxisNoise]) -> AxisNoise:
    white = max((axis.white for axis in axes), key=lambda density: density.value)
    instability = max((axis.instability for axis in axes), key=lambda density: density.value)
    walk = max(axes, key=lambda axis: axis.walk.value)
    return AxisNoise(white, instability, walk.walk, walk.walk_is_bound)
