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
from vio.numerics.kinds import Tolerance
from vio.records import ImuDensities, ImuRecord, IntArray

MOVING_FACTOR = 5.0  # by which densities at rest are multiplied for use while moving, see the page


class _AllanRules(NamedTuple):
    """How densities are read from Allan deviations."""

    min_averages: int = 9  # independent ones of the longest averaging time
    per_decade: int = 10  # averaging times
    min_s: float = 300.0
    white_s: float = 1.0  # where white noise is read: averaging times up to it
    # of the density that averages below a second show over that at a second: it is not white
    vibration: float = 2.0
    drift_blocks: int = 20  # whose means show a drift
    # of the mean step between these, in its standard deviations: it drifts steadily
    drift_sigmas: float = 6.0


_ALLAN = _AllanRules()
_AXES = tuple(f"{sensor} {axis}" for sensor in ("gyro", "accel") for axis in "xyz")
_INSTABILITY = 0.664  # lowest Allan deviation over B


class _UnitRules(NamedTuple):
    """What an IMU at rest shows."""

    gravity: float = 9.81  # m/s^2
    gravity_share: float = 0.1  # by which accelerometers are off, without calibration
    max_gravity_removed: float = 1.0  # m/s^2: an accelerometer without gravity shows less
    # rad/s/sqrt(Hz): poor gyros have a third, and good ones more, if their deg/s are taken for rad/s
    max_gyro_white: float = 3e-3
    max_repeated: float = 0.2  # share of the samples that equal the one before


_UNITS = _UnitRules()
_ROUNDING: Tolerance[float] = 1e-12  # of a reading's size: less spread is none


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
    is_bound = lowest >= len(tau) - 3 or left[-1] <= 0
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
    notes: tuple[str, ...] = ()  # why the densities may be others than the IMU's

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
        DataError: the record is too short, lacks or repeats samples, is in other units or without
            gravity, or the IMU was moved.
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
    _check_readings(record)
    axes = [*record.gyro.T, *record.accel.T]
    for name, values in zip(_AXES, axes, strict=True):
        _check_rest(name, values, rate_hz)
    curves = tuple(allan_curve(values, rate_hz) for values in axes)
    noise = [axis_noise(curve) for curve in curves]
    gyro = _worst(noise[:3])
    return ImuNoise(
        gyro, _worst(noise[3:]), curves, (*_unit_notes(gyro), *_axis_notes(axes, curves))
    )


def _check_readings(record: ImuRecord) -> None:
    """Raise DataError where a sensor is stuck, samples are copies, or gravity is not where it is."""
    readings = np.concatenate([record.gyro, record.accel], axis=1)
    stuck = np.ptp(readings, axis=0) <= _ROUNDING * np.abs(readings).max(axis=0)
    if stuck.any():
        raise DataError(
            f"the readings of {_AXES[int(np.argmax(stuck))]} are all the same: the sensor is stuck, or "
            "this is no record of it"
        )
    repeated = float((readings[1:] == readings[:-1]).all(axis=1).mean())
    if repeated > _UNITS.max_repeated:
        raise DataError(
            f"{100 * repeated:.0f} % of the samples repeat the one before in all readings, as where a "
            "driver copies them to a higher rate: leave these rows out"
        )
    gyro, accel = (float(np.linalg.norm(v.mean(axis=0))) for v in (record.gyro, record.accel))
    if abs(accel / _UNITS.gravity - 1) <= _UNITS.gravity_share:
        return
    shows = f"the accelerometer shows {accel:.3g} m/s^2 at rest, and gravity is {_UNITS.gravity}"
    if abs(gyro / _UNITS.gravity - 1) <= _UNITS.gravity_share:
        why = "the gyro's columns show it: exchange them, or name the columns in a header"
    elif abs(accel - 1) <= _UNITS.gravity_share:
        why = "its unit seems to be g: state it in a header, such as ax [g]"
    elif abs(accel / 1000 - 1) <= _UNITS.gravity_share:
        why = "its unit seems to be mg: state it in a header, such as ax [mg]"
    elif accel < _UNITS.max_gravity_removed:
        why = "gravity seems to be taken out, as of a phone's linear acceleration: record the raw sensor"
    else:
        why = "state its unit in a header, such as ax [m/s^2]"
    raise DataError(f"{shows}; {why}")


def _unit_notes(gyro: AxisNoise) -> tuple[str, ...]:
    """Doubt that a gyro is in rad/s, whose white noise is that of deg/s."""
    if gyro.white.value < _UNITS.max_gyro_white:
        return ()
    return (
        f"the gyro's white noise, {gyro.white.value:.2g} rad/s/sqrt(Hz), is more than such sensors have: "
        "if its readings are in deg/s, state that in a header, such as wx [deg/s]",
    )


def _axis_notes(axes: list[FloatArray], curves: tuple[AllanCurve, ...]) -> tuple[str, ...]:
    """Say where noise is not white below a second, and where a sensor drifts steadily."""
    notes = []
    for name, values, curve in zip(_AXES, axes, curves, strict=True):
        at = curve.tau_s <= _ALLAN.white_s
        white = curve.deviation[at] * np.sqrt(curve.tau_s[at])
        if white.max() > _ALLAN.vibration * white[-1]:
            notes.append(
                f"{name} is {white.max() / white[-1]:.1f} times as noisy below a second as at a second: "
                "something vibrates, such as a fan, or its steps are coarse, and the densities are those "
                "of that"
            )
        size = len(values) // _ALLAN.drift_blocks
        means = values[: size * _ALLAN.drift_blocks].reshape(-1, size).mean(axis=1)
        steps = np.diff(means)
        sigma = float(steps.std(ddof=1)) / np.sqrt(len(steps))
        if abs(steps.mean()) > _ALLAN.drift_sigmas * sigma:
            notes.append(
                f"{name} drifts steadily, by {means[-1] - means[0]:+.2g} over the record, as while it warms "
                "up: its walk is overstated; leave the first minutes out"
            )
    return tuple(notes)


def _check_rest(name: str, values: FloatArray, rate_hz: float) -> None:
    size = max(round(rate_hz), 1)
    blocks = values[: len(values) // size * size].reshape(-1, size)
    means = blocks.mean(axis=1)
    spread = float(np.median(blocks.std(axis=1))) / np.sqrt(size)
    jumps = np.abs(np.diff(means))
    limit = _REST.max_shift_sigmas * max(spread, 1e-12)
    if not jumps.max() > limit:
        return
    second = int(np.argmax(jumps))
    medians = np.median(blocks, axis=1)
    if np.abs(np.diff(medians)).max() > limit:
        raise DataError(f"the IMU was moved at second {second}: the noise needs a record at rest")
    pair = values[second * size : (second + 2) * size]
    worst = int(np.argmax(np.abs(pair - np.median(pair))))
    raise DataError(
        f"{name} shows {pair[worst]:.4g} at second {second + worst / size:.2f}, amid {np.median(pair):.4g}: a "
        "knock, or readings damaged on their way; leave such rows out, or record again"
    )


def _worst(axes: list[AxisNoise]) -> AxisNoise:
    white = max((axis.white for axis in axes), key=lambda density: density.value)
    instability = max((axis.instability for axis in axes), key=lambda density: density.value)
    walk = max(axes, key=lambda axis: axis.walk.value)
    return AxisNoise(white, instability, walk.walk, walk.walk_is_bound)
