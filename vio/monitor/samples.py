"""The IMU's readings of the last minute, and the faults that they show by themselves: gaps,
clipping, magnitude.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray
from vio.imu.findings import InertialFinding
from vio.imu.two_sensors import GAPS
from vio.numerics.arrays import distinct
from vio.numerics.kinds import Capacity
from vio.numerics.robust import median, robust_sigma
from vio.records import S_PER_NS, BoolArray, ImuSample, IntArray

GAP_S = GAPS.min_ns * S_PER_NS  # readings further apart are a gap …
GAP_STEPS = GAPS.usual_intervals  # … if that is so many times their usual interval
MEMORY_S: Capacity[float] = 60.0  # older readings and motions are dropped


class _ClippingRules(NamedTuple):
    """When readings end at the range."""

    min_run: int = 5  # equal readings at the extreme in a row
    min_chance: float = 1e-8  # probability of such a run by quantisation alone
    # share of changes of another sign than the one before; of noise it is 2/3
    smooth_share: float = 0.1
    min_levels: int = 20  # different readings on the axis


_CLIPPING = _ClippingRules()


class _SizeRules(NamedTuple):
    """From what the magnitude of readings is judged."""

    averaged_s: float = 0.2  # readings are averaged over this time before their magnitude is judged
    min_s: float = 1.0
    # of a gyro's readings that are an accelerometer's: from gravity, and their relative spread …
    as_gravity: float = 0.25
    steady: float = 0.3
    # smaller ones are the Earth's in g, of which the images' metres know nothing
    least_set_mps2: float = 1.3
    no_gravity: float = 0.5  # … and the accelerometer's at most, of gravity


_SIZE = _SizeRules()
EARTH_GRAVITY_MPS2 = 9.80665
_MILLI_G = 1000.0


class Samples:
    """The IMU's readings of the last minute."""

    def __init__(self) -> None:
        self._new: list[ImuSample] = []
        self._times: list[IntArray] = []
        self._values: list[FloatArray] = []
        self._first_ns: int | None = None
        self.last_ns: int | None = None
        self._step_s: float | None = None

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Stamps of the first and the last reading ever added; None: there are none."""
        return (
            None
            if self._first_ns is None or self.last_ns is None
            else (self._first_ns, self.last_ns)
        )

    @property
    def step_s(self) -> float:
        """The usual time between two readings; 0.0 before there are two."""
        if self._step_s is None and len(self._new) > 1:
            self._step_s = median(np.diff([s.time_ns for s in self._new])) * S_PER_NS
        return self._step_s or 0.0

    def add(self, samples: Sequence[ImuSample]) -> None:
        """Add readings in order of time, less those that repeat the stamp of the one before."""
        last_ns = self.last_ns
        times = [sample.time_ns for sample in samples]
        if times and times == sorted(set(times)) and (last_ns is None or times[0] > last_ns):
            later = list(samples)  # as nearly always
            last_ns = times[-1]
        else:
            later = []
            for sample in samples:
                if last_ns is None or sample.time_ns > last_ns:
                    later.append(sample)
                    last_ns = sample.time_ns
        if self._first_ns is None and later:
            self._first_ns = later[0].time_ns
        self.last_ns = last_ns
        self._new += later

    def check_new(self, *, keep: bool) -> list[InertialFinding]:
        """Check the readings since the last call for gaps and clipping, and keep or drop them."""
        if len(self._new) < 2:
            return []
        times, values = self._unchecked()
        before = self._times[-1][-1:] if self._times else times[:0]
        steps = np.diff(np.concatenate([before, times])) * S_PER_NS
        found = [*_gap(times, steps, self.step_s), *_saturation(times, values)]
        if keep:
            self._times.append(times)
            self._values.append(values)
            while self._times[-1][-1] - self._times[0][-1] > MEMORY_S / S_PER_NS:
                del self._times[0], self._values[0]
        else:
            self._times = [times[-1:]]
            self._values = [values[-1:]]
        self._new = []
        return found

    def so_far(self) -> tuple[IntArray, FloatArray]:
        """Return `table` with the readings that were not checked yet."""
        times, values = self.table()
        if not self._new:
            return times, values
        new, readings = self._unchecked()
        return np.concatenate([times, new]), np.concatenate([values, readings])

    def _unchecked(self) -> tuple[IntArray, FloatArray]:
        """Return times (S,) and readings (S, 6) that were not checked yet, of which there are some."""
        times = np.array([s.time_ns for s in self._new], dtype=np.int64)
        return times, np.array([[*s.gyro, *s.accel] for s in self._new])

    def table(self) -> tuple[IntArray, FloatArray]:
        """Return times (S,) and readings (S, 6) [gyro; accel]."""
        if not self._times:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 6))
        return np.concatenate(self._times), np.concatenate(self._values)


def _gap(times_ns: IntArray, steps: FloatArray, usual_s: float) -> Iterator[InertialFinding]:
    """Yield the longest gap before readings at times (S,), if any; steps (S or S - 1,) in
    seconds end there.
    """
    if not len(steps) or steps.max() <= max(GAP_S, GAP_STEPS * usual_s):
        return
    k = len(times_ns) - len(steps) + int(np.argmax(steps))
    yield InertialFinding(
        "IMU gap",
        f"no sample for {steps.max():.3f} s before {times_ns[k]} ns (samples are "
        f"{1e3 * usual_s:.1f} ms apart)",
        "samples were lost; the motion in between is interpolated from the samples on both sides",
    )


def _saturation(times_ns: IntArray, values: FloatArray) -> Iterator[InertialFinding]:
    """Yield runs of equal readings at the extreme of an axis that quantisation or held samples
    do not explain.
    """
    if len(values) < 4 * _CLIPPING.min_run:
        return
    equal = values[1:] == values[:-1]
    for axis in range(6):
        for extreme in (values[:, axis].max(), values[:, axis].min()):
            at = values[:, axis] == extreme
            # no sensor's range ends at 0: that of a simulator without noise, at rest
            if extreme == 0.0:
                run = 0
            else:
                run = _run_at_end(values, equal, at, axis)
            if run == 0:
                continue
            name, unit = ("gyro", "rad/s") if axis < 3 else ("accelerometer", "m/s^2")
            yield InertialFinding(
                "saturation",
                f"{int(at.sum())} samples of the {name}'s {'xyz'[axis % 3]} axis are at "
                f"{extreme:.4g} {unit}, {run} "
                f"in a row, near {times_ns[int(np.argmax(at))]} ns",
                "the motion exceeds the sensor's range; choose a larger range, and expect drift "
                "there",
            )
            return


def _run_at_end(values: FloatArray, equal: BoolArray, at: BoolArray, axis: int) -> int:
    """Return for how many readings in a row an axis is at the end of its range; 0: it is not.

    Args:
        values: (S, 6) readings.
        equal: (S - 1, 6) which are those of the reading before.
        at: (S,) whether the axis is at its extreme.
        axis: of gyro and accelerometer.
    """
    if at.sum() < _CLIPPING.min_run or at.all() or _has_no_noise(values, at, axis):
        return 0
    # Equal neighbours elsewhere are due to chance: a run of n has the probability held^(n-1).
    held = float(np.mean(equal[~(at[1:] & at[:-1]), axis]))
    chance = 0.0
    if held > 0:
        chance = np.log(_CLIPPING.min_chance) / np.log(held)
    run = _longest_run(at)
    if (
        run < max(_CLIPPING.min_run, 1 + chance)
        or len(distinct(values[:, axis])) < _CLIPPING.min_levels
    ):
        return 0
    return run


def _has_no_noise(values: FloatArray, at: BoolArray, axis: int) -> bool:
    """Return whether the other axes of a sensor are smooth, where one is at its extreme.

    A range ends one axis, or two, and the noise of the others goes on: their changes have either
    sign. A simulator without noise gives a steady motion the same reading again and again.

    Args:
        values: (S, 6) readings.
        at: (S,) whether the axis is at its extreme.
        axis: of gyro and accelerometer.
    """
    first = 3 * (axis // 3)
    others = [k for k in range(first, first + 3) if k != axis]
    changes = np.diff(values[:, others], axis=0)
    turns = changes[1:] * changes[:-1] < 0
    inside = at[2:] & at[1:-1] & at[:-2]
    return bool(inside.any() and turns[inside].mean() < _CLIPPING.smooth_share)


def _longest_run(mask: BoolArray) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    if not len(edges):
        return 0
    return int((edges[1::2] - edges[::2]).max())


@dataclass(frozen=True, slots=True)
class Size:
    """Magnitude of the accelerometer's mean readings, and the implied unit."""

    finding: InertialFinding | None
    # factor that makes the readings m/s^2; None: unknown, since gravity was removed
    unit: float | None
    clear: bool = True  # False: biased readings without gravity can have this magnitude, too


def is_long_enough(times_ns: IntArray) -> bool:
    """Whether readings at times (S,) span so much that their magnitude can be judged."""
    return bool((times_ns[-1] - times_ns[0]) * S_PER_NS >= _SIZE.min_s)


def judge_size(
    times_ns: IntArray, accel: FloatArray, gravity_mps2: float = EARTH_GRAVITY_MPS2
) -> Size:
    """Judge the accelerometer's unit by the magnitude of its mean readings (S, 3) at times (S,).

    Args:
        times_ns: increasing.
        accel: readings.
        gravity_mps2: as it is set, which may be another body's.
    """
    if not is_long_enough(times_ns):
        return Size(None, 1.0)
    step_s = median(np.diff(times_ns)) * S_PER_NS
    usual, spread = _usual_size(times_ns, accel)
    return _judge_setting(usual, spread, gravity_mps2) or _judge_median(usual, spread, step_s)


def _judge_setting(usual: float, spread: float, gravity_mps2: float) -> Size | None:
    """Judge a median magnitude by gravity that is set to another than the Earth's; None: it is not, or
    the magnitude is neither.
    """
    if abs(gravity_mps2 / EARTH_GRAVITY_MPS2 - 1.0) < _SIZE.as_gravity or not spread < _SIZE.steady:
        return None
    if abs(usual / gravity_mps2 - 1.0) < _SIZE.as_gravity and gravity_mps2 > _SIZE.least_set_mps2:
        return Size(None, 1.0)
    if abs(usual / EARTH_GRAVITY_MPS2 - 1.0) > _SIZE.as_gravity:
        return None
    finding = InertialFinding(
        "accelerometer units",
        f"the accelerometer's median magnitude is {usual:.4g}, and gravity is set to "
        f"{gravity_mps2:g} m/s^2 (imu.gravity_mps2)",
        "the readings are the Earth's gravity in m/s^2: leave out the setting",
    )
    return Size(finding, 1.0)


def judge_exchange(times_ns: IntArray, values: FloatArray) -> InertialFinding | None:
    """Return the finding that readings (S, 6) have gravity where the gyro's are, and none of it where
    the accelerometer's are; None: they do not.
    """
    if not is_long_enough(times_ns):
        return None
    accel, accel_spread = _usual_size(times_ns, values[:, 3:])
    gyro, gyro_spread = _usual_size(times_ns, values[:, :3])
    steady = abs(gyro / EARTH_GRAVITY_MPS2 - 1.0) < _SIZE.as_gravity and gyro_spread < _SIZE.steady
    if not steady or accel > _SIZE.no_gravity * EARTH_GRAVITY_MPS2:
        return None
    return InertialFinding(
        "gravity removed",
        f"the gyro's median magnitude is {gyro:.3g}, as steady as gravity, and the accelerometer's "
        f"{accel:.3g} (spread {100 * accel_spread:.0f} %)",
        "gyro and accelerometer are exchanged: the gyro's readings come first",
    )


def _usual_size(times_ns: IntArray, accel: FloatArray) -> tuple[float, float]:
    """Return the median magnitude of mean readings (S, 3), and its relative spread."""
    t = np.asarray((times_ns - times_ns[0]) * S_PER_NS, dtype=np.float64)
    integral = np.concatenate(
        [np.zeros((1, 3)), np.cumsum(np.diff(t)[:, None] * (accel[1:] + accel[:-1]) / 2, axis=0)]
    )
    edges = np.arange(0.0, t[-1], _SIZE.averaged_s)
    mean = (
        np.diff(np.stack([np.interp(edges, t, integral[:, k]) for k in range(3)], axis=1), axis=0)
        / _SIZE.averaged_s
    )
    size = np.linalg.norm(mean, axis=1)
    usual = median(size)
    return usual, robust_sigma(size - usual) / max(usual, 1e-300)


def _judge_median(usual: float, spread: float, step_s: float) -> Size:
    """Judge a median magnitude and its relative spread, of samples an interval apart."""
    if 0.5 < usual / EARTH_GRAVITY_MPS2 < 2.5:
        return Size(None, 1.0)
    seen = (
        f"the accelerometer's median magnitude is {usual:.4g} where gravity alone gives 9.8 m/s^2"
    )
    named = _named_unit(usual, spread, seen) or _increments(usual, spread, seen, step_s)
    if named is not None:
        return named
    if usual < 0.5 * EARTH_GRAVITY_MPS2 and (spread >= 0.3 or usual < 0.5):
        return Size(gravity_removed(f"{seen}, and it varies by {100 * spread:.0f} %"), None)
    finding = InertialFinding(
        "accelerometer units",
        f"{seen} (spread {100 * spread:.0f} %)",
        f"the unit or scale is unknown; a factor of {EARTH_GRAVITY_MPS2 / usual:.4g} would make it 9.8",
    )
    return Size(finding, EARTH_GRAVITY_MPS2 / usual, usual > 0.5 * EARTH_GRAVITY_MPS2)


def _named_unit(usual: float, spread: float, seen: str) -> Size | None:
    """Return the judgement of a steady magnitude that is gravity in another unit; None: it is not."""
    if not spread < 0.3:
        return None
    units = {
        1.0: "in g: multiply by 9.81",
        _MILLI_G: "in mg (multiply by 0.00981) or in cm/s^2 (divide by 100)",
        9807.0: "in mm/s^2: divide by 1000",
    }
    for gravity, explanation in units.items():
        if 0.6 < usual / gravity < 1.6:
            # of mg there are two
            factor = None if gravity == _MILLI_G else EARTH_GRAVITY_MPS2 / gravity
            finding = InertialFinding(
                "accelerometer units", seen, f"the readings are {explanation}", factor=factor
            )
            clear = gravity > 1.0 or (abs(usual - 1.0) < 0.1 and spread < 0.06)
            return Size(finding, EARTH_GRAVITY_MPS2 / gravity, clear)
    return None


def _increments(usual: float, spread: float, seen: str, step_s: float) -> Size | None:
    """Return the judgement of a steady magnitude that is gravity times the interval between samples;
    None: it is not.
    """
    excess = abs(usual / (EARTH_GRAVITY_MPS2 * step_s) - 1.0)
    if not (spread < _SIZE.steady and excess < _SIZE.as_gravity):
        return None
    finding = InertialFinding(
        "accelerometer units",
        f"{seen}, and as much as gravity gives in the {step_s:.4g} s between samples",
        "the readings are changes of velocity from sample to sample; divide them, and changes of angle, "
        "by the time between samples",
        factor=1.0 / step_s,
    )
    return Size(finding, 1.0 / step_s, excess < 0.1 and spread < 0.06)


def gravity_removed(seen: str) -> InertialFinding:
    """Return the finding that readings lack gravity, given the observation."""
    return InertialFinding(
        "gravity removed",
        seen,
        "gravity has been taken out ('linear acceleration'), or the sensor is dead; a filter needs "
        "the raw specific "
        "force (+9.8 m/s^2 upwards at standstill)",
    )
