"""Faulty IMU samples: spikes, readings that repeat to the last bit, and readings at the end of the
sensor's range; all are left out as if they were missing.

A spike is one sample that lies far from both of its neighbours, while these agree. A rig cannot
turn or accelerate so within one period and back within the next: a sensor's bandwidth is a fraction
of its rate, and vibration at that bandwidth fills the whole record, so the spike is judged by the
changes of the two seconds before it. Healthy flights come to 23 robust standard deviations of these
changes (docs/notes/design_decisions.md, spikes of an IMU).

Noise changes the last bits of every reading, so six equal numbers after six equal numbers are one
reading given twice. How often that is due to coarse quantisation is learned from the record.

Where the motion exceeds the range of a sensor, an axis repeats the largest reading so far, while
the noise of its other axes goes on. From there on, that reading is the end of the range.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled
from vio.numerics.kinds import Capacity
from vio.numerics.robust import median, robust_sigmas
from vio.records import S_PER_NS, BoolArray, ImuSample, IntArray

ImuFaultKind: TypeAlias = Literal[
    "gyro spike",
    "accelerometer spike",
    "stuck IMU",
    "stuck gyro",
    "stuck accelerometer",
    "gyro clipped",
    "accelerometer clipped",
]


@dataclass(frozen=True, slots=True)
class _FaultRules:
    """Which IMU samples count as spikes and as repeated."""

    history_ns: int = 2_000_000_000  # changes between samples that a spike is compared with
    # changes; with fewer nothing is called a spike, nor stuck: a simulated IMU may have no noise
    min_history: int = 20
    # samples between two evaluations of their scale, and the least share of all, 1 / 4
    refresh: Capacity[int] = 20
    refresh_share: Capacity[int] = 4
    spike_sigmas: float = 30.0  # robust standard deviations of the changes; real motion reached 23
    # rad and m/s over the sample's period; below, no spike does harm
    spike_impulse: tuple[float, float, float, float, float, float] = (
        5e-3,
        5e-3,
        5e-3,
        0.15,
        0.15,
        0.15,
    )
    # of the first change, by which the sample after a spike may lie from the one before it; a
    # shock rings
    returned: float = 0.25
    long_periods: float = 3.0  # after a longer interval a change is no spike
    min_repeats: int = 4  # of all six numbers
    # of one sensor alone, which some drivers hold between its own slower samples
    min_part_s: float = 0.25
    rare: float = 0.02  # share of repetitions below which one is held back
    counted: int = 400  # samples over which the share of repetitions is counted


_FAULTS = _FaultRules()
_PARTS: tuple[tuple[ImuFaultKind, slice], ...] = (
    ("stuck IMU", slice(0, 6)),
    ("stuck gyro", slice(0, 3)),
    ("stuck accelerometer", slice(3, 6)),
)
# kinds of faults at the end of each sensor's range
_CLIPPED: tuple[ImuFaultKind, ImuFaultKind] = ("gyro clipped", "accelerometer clipped")
# logarithm of the probability of so many repetitions in a row where they are independent
_LOG_MIN_CHANCE = math.log(1e-8)
_NOISY = 8  # last readings of the other axes, which must turn so often
_MIN_TURNS = 2
_RANGE_SLACK = 1e-3  # of a range's end: a reading beyond it shows that it is none
# (6,) gyro and accelerometer; plain numbers, as arrays of six cost ten times as much
_Reading: TypeAlias = list[float]


@dataclass(frozen=True, slots=True)
class ImuFault:
    """Samples that were left out."""

    kind: ImuFaultKind
    start_ns: int  # of the spike, or of the reading that was repeated
    end_ns: int | None  # of the last sample concerned; None: it has only begun
    # spike: change from its neighbours, rad/s or m/s^2; stuck: the largest of the numbers repeated;
    # clipped: the end of the range
    size: float


class ImuSampleCheck:
    """Passes the samples of one IMU on, without the faulty ones.

    A sample that looks like a spike or like a repetition is held until the next ones decide; all
    others pass at once.
    """

    def __init__(self) -> None:
        self._spikes = _SpikeCheck()
        self._ranges = _Ranges()
        self._repeats = [_Repetition(kind, part) for kind, part in _PARTS]
        self._previous: ImuSample | None = None  # as received
        self._last_reading: _Reading = []  # its numbers
        self._held: list[ImuSample] = []  # repetitions of the last sample that passed
        self._faults: list[ImuFault] = []

    def take_all(self, samples: Sequence[ImuSample]) -> list[ImuSample]:
        """Take samples in order of time, one or more at once; return those that may be used now."""
        if not samples:
            return []
        readings = readings_of(samples)
        clipped = self._ranges.take(readings)
        self._faults += self._ranges.faults(samples, readings, clipped)
        if clipped.any():
            left_out = np.any(clipped, axis=1)
            samples = [x for x, out in zip(samples, left_out.tolist(), strict=True) if not out]
            readings = readings[~left_out]
        times = np.array([x.time_ns for x in samples], dtype=np.int64)
        usable: list[ImuSample] = []
        k = 0
        while k < len(samples):
            passed = self._pass_on(times[k:], readings[k:])
            usable += samples[k : k + passed]
            k += passed
            if passed == 0:
                usable += self._take_unusual(samples[k], readings[k].tolist())
                k += 1
            self._previous = samples[k - 1]
            self._last_reading = readings[k - 1].tolist()
        return usable

    def _pass_on(self, times: IntArray, readings: FloatArray) -> int:
        """Count the first of some samples, of times (K,) and readings (K, 6), that nothing is to
        be said of.
        """
        if self._previous is None or self._held:
            return 0
        for r in self._repeats:
            if r.repeats:
                return 0
        passed = self._spikes.pass_on(times, readings)
        for r in self._repeats:
            r.count_others(passed)
        return passed

    def _take_unusual(self, sample: ImuSample, reading: _Reading) -> list[ImuSample]:
        if self._previous is not None:
            self._count_repeated(self._previous, sample, reading)
        # gravity is never zero in all axes
        if self.stuck or not any(reading[3:]):
            self._held = []
            return []
        if any(r.unusual for r in self._repeats):
            self._held.append(sample)
            return []
        held = self._held
        self._held = []
        usable = [
            x for candidate in held for x in self._spikes.take(candidate, _reading(candidate))
        ]
        usable += self._spikes.take(sample, reading)
        self._faults += self._spikes.new_faults()
        return usable

    def _count_repeated(self, previous: ImuSample, sample: ImuSample, reading: _Reading) -> None:
        equal = [a == b for a, b in zip(self._last_reading, reading, strict=True)]
        for r in self._repeats:
            self._faults += r.take(previous, sample, equal)
        if not any(r.announced for r in self._repeats):
            stuck = [r for r in self._repeats if r.stuck]
            # that of the whole IMU is that of both sensors
            self._faults += [r.announce() for r in stuck[:1]]

    @property
    def stuck(self) -> bool:
        """Whether the last sample repeats the one before it by a fault."""
        return any(r.stuck for r in self._repeats)

    def new_faults(self) -> tuple[ImuFault, ...]:
        """Return the faults since the last call; repetitions twice, as they begin and as they
        end.
        """
        faults = tuple(self._faults)
        self._faults = []
        return faults


class _Repetition:
    """Counts how often some of a reading's numbers are those of the reading before, in a row and
    in all.
    """

    def __init__(self, kind: ImuFaultKind, part: slice) -> None:
        self._kind = kind
        self._part = part
        # repetitions before the present row of them
        self._counted: deque[bool] = deque(maxlen=_FAULTS.counted)
        self._equal = 0  # of these, that were repetitions
        self._start: ImuSample | None = None  # the reading that is repeated
        self.repeats = 0  # in the present row
        self.stuck = False
        self.announced = False  # that it is

    def take(self, previous: ImuSample, sample: ImuSample, equal: list[bool]) -> list[ImuFault]:
        """Count a sample and which (6,) of its numbers are those of the one before; return the
        fault that it ends.
        """
        if all(equal[self._part]):
            self._start = self._start if self.repeats else previous
            self.repeats += 1
            self.stuck = self.stuck or self._improbable(sample.time_ns)
            return []
        ended = []
        if self.announced:
            ended = [self._fault(previous.time_ns)]
        for repeated in (*([True] * (0 if self.stuck else self.repeats)), False):
            self._count(repeated)
        self.repeats = 0
        self.stuck = False
        self.announced = False
        return ended

    def announce(self) -> ImuFault:
        """Return the fault that has begun with the present row of repetitions."""
        self.announced = True
        return self._fault(None)

    def count_others(self, count: int) -> None:
        """Count samples that repeat nothing, after one that repeated nothing."""
        if self._equal == 0:
            self._counted.extend([False] * count)
            return
        for _ in range(count):
            self._count(False)

    @property
    def unusual(self) -> bool:
        """Whether the last sample repeats the one before it, as few did."""
        return self.repeats > 0 and self._share < _FAULTS.rare

    def _fault(self, end_ns: int | None) -> ImuFault:
        """Return the fault that the present row of repetitions is, up to a time."""
        assert self._start is not None
        reading = np.concatenate([self._start.gyro, self._start.accel])[self._part]
        return ImuFault(self._kind, self._start.time_ns, end_ns, float(np.abs(reading).max()))

    def _improbable(self, time_ns: int) -> bool:
        assert self._start is not None
        alone = self._kind != "stuck IMU"
        if not alone and self.repeats >= _FAULTS.min_repeats and not self._start.accel.any():
            return True  # not even gravity is read
        if len(self._counted) < _FAULTS.min_history or self.repeats < _FAULTS.min_repeats:
            return False
        if alone and (time_ns - self._start.time_ns) * S_PER_NS < _FAULTS.min_part_s:
            return False
        return bool(self.repeats * np.log(self._share) < _LOG_MIN_CHANCE)

    @property
    def _share(self) -> float:
        """Probability of a repetition, by Laplace's rule of succession."""
        return (self._equal + 1) / (len(self._counted) + 2)

    def _count(self, equal: bool) -> None:
        if len(self._counted) == _FAULTS.counted:
            self._equal -= self._counted[0]
        self._counted.append(equal)
        self._equal += equal


class _KnownRanges(NamedTuple):
    """What the readings so far say of where both sensors' ranges end."""

    last: FloatArray  # (6,) the reading before
    extreme: FloatArray  # (6,) largest magnitude so far
    repeats: IntArray  # (6,) of it, in a row
    unchanged: IntArray  # (6,) readings so far that repeat the one before, but for those
    changed: IntArray  # (6,) readings so far that do not
    recent: FloatArray  # (S, 6) the last readings, as many as there are
    counts: IntArray  # (2,) readings so far, and recent ones
    ends: FloatArray  # (2,) of the ranges; infinite: unknown


class _Ranges:
    """Learns where the ranges of both sensors end, and tells the readings there."""

    def __init__(self) -> None:
        self._last = np.zeros(6)
        self._extreme = np.zeros(6)
        self._repeats = np.zeros(6, dtype=np.int64)
        self._unchanged = np.zeros(6, dtype=np.int64)
        self._changed = np.zeros(6, dtype=np.int64)
        self._recent = np.zeros((_NOISY, 6))
        self._counts = np.zeros(2, dtype=np.int64)
        self._ends = np.full(2, np.inf)
        self._are_clipped = [False, False]  # the last sample's

    def take(self, readings: FloatArray) -> BoolArray:
        """Return which (K, 2) of the next readings (K, 6) are at the end of each sensor's range."""
        clipped = np.empty((len(readings), 2), dtype=np.bool_)
        known = _KnownRanges(
            self._last,
            self._extreme,
            self._repeats,
            self._unchanged,
            self._changed,
            self._recent,
            self._counts,
            self._ends,
        )
        _mark_clipped(readings, known, _FAULTS.min_history, clipped)
        return clipped

    def faults(
        self, samples: Sequence[ImuSample], readings: FloatArray, clipped: BoolArray
    ) -> list[ImuFault]:
        """Return a fault for each row of samples (K,) at the end of a range, (K, 2), that begins
        here; their readings are (K, 6).
        """
        before = self._are_clipped
        self._are_clipped = clipped[-1].tolist()
        found: list[ImuFault] = []
        if not clipped.any():
            return found
        for sensor, kind in enumerate(_CLIPPED):
            own = clipped[:, sensor]
            began = own & ~np.concatenate([[before[sensor]], own[:-1]])
            for k in np.flatnonzero(began).tolist():
                end = float(np.abs(readings[k, 3 * sensor : 3 * sensor + 3]).max())
                found.append(ImuFault(kind, samples[k].time_ns, samples[k].time_ns, end))
        return found


@compiled
def _mark_clipped(
    readings: FloatArray, known: _KnownRanges, min_history: int, clipped: BoolArray
) -> None:
    """Mark which of the next readings (K, 6) are at the end of a sensor's range, (K, 2), and learn
    from them where it is, from `min_history` readings on.
    """
    n = len(readings)
    equal = np.empty((n, 6), dtype=np.bool_)
    at_end = np.empty(6, dtype=np.bool_)
    _mark_repeated(readings, known, equal)
    for sensor in range(2):
        first = 3 * sensor
        for k in range(n):
            if _is_beyond(readings[k], first, known.ends[sensor]):
                known.ends[sensor] = np.inf
            _mark_at_end(readings[k], equal[k], first, known.extreme, at_end)
            if known.ends[sensor] == np.inf:
                _learn_end(readings, k, at_end, known, sensor, min_history)
            clipped[k, sensor] = _reaches(readings[k], first, known.ends[sensor])
            _count_changes(equal[k], at_end, first, known)
    _remember(readings, known)


@compiled
def _mark_repeated(readings: FloatArray, known: _KnownRanges, equal: BoolArray) -> None:
    """Write which numbers of the readings (K, 6) are those of the reading before."""
    for k in range(len(readings)):
        for i in range(6):
            before = known.last[i] if k == 0 else readings[k - 1, i]
            equal[k, i] = (k > 0 or known.counts[0] > 0) and readings[k, i] == before


@compiled
def _is_beyond(reading: FloatArray, first: int, end: float) -> bool:
    """Whether a reading of a sensor, whose axes begin at `first`, shows that its range does not end
    there.
    """
    beyond = False
    for i in range(first, first + 3):
        beyond = beyond or abs(reading[i]) > (1 + _RANGE_SLACK) * end
    return beyond


@compiled
def _mark_at_end(
    reading: FloatArray, equal: BoolArray, first: int, extreme: FloatArray, at_end: BoolArray
) -> None:
    """Write which numbers (6,) of a sensor repeat the largest one so far while another axis
    changes.
    """
    all_equal = equal[first] and equal[first + 1] and equal[first + 2]
    for i in range(first, first + 3):
        size = abs(reading[i])
        if size > extreme[i]:
            extreme[i] = size
        at_end[i] = equal[i] and size >= extreme[i] and size > 0 and not all_equal


@compiled
def _learn_end(
    readings: FloatArray,
    k: int,
    at_end: BoolArray,
    known: _KnownRanges,
    sensor: int,
    min_history: int,
) -> None:
    """Note the end of a sensor's range if reading k shows it.

    An axis that repeats its largest reading more often than its repetitions so far make probable,
    while another axis of the sensor goes to and fro, is at the end of the range.
    """
    first = 3 * sensor
    seen = known.counts[0] + k
    largest = 0.0
    for i in range(first, first + 3):
        known.repeats[i] = known.repeats[i] + 1 if at_end[i] else 0
        if at_end[i] and seen >= min_history and known.changed[i] >= min_history:
            share = (known.unchanged[i] + 1) / (seen + 2)
            if known.repeats[i] * np.log(share) < _LOG_MIN_CHANCE:
                largest = max(largest, abs(readings[k, i]))
    if largest > 0 and _has_noise(known.recent, known.counts[1], readings, k, at_end, first):
        known.ends[sensor] = largest
        for i in range(first, first + 3):
            known.repeats[i] = 0


@compiled
def _count_changes(equal: BoolArray, at_end: BoolArray, first: int, known: _KnownRanges) -> None:
    """Count which numbers of a sensor's reading (6,) repeat the one before, and which do not."""
    for i in range(first, first + 3):
        known.unchanged[i] += equal[i] and not at_end[i]
        known.changed[i] += not equal[i]


@compiled
def _reaches(reading: FloatArray, first: int, end: float) -> bool:
    """Whether some axis of a sensor reads the known end of its range, or more."""
    reaches = False
    for i in range(first, first + 3):
        reaches = reaches or abs(reading[i]) >= end
    return reaches and end < np.inf


@compiled
def _remember(readings: FloatArray, known: _KnownRanges) -> None:
    """Note that these readings were the last ones."""
    n = len(readings)
    recent = known.recent
    before = known.counts[1]
    kept = min(len(recent), before + n)
    for m in range(kept):  # in order: what is read lies at or behind what is written
        place = before + n - kept + m
        for i in range(6):
            recent[m, i] = recent[place, i] if place < before else readings[place - before, i]
    for i in range(6):
        known.last[i] = readings[n - 1, i]
    known.counts[0] += n
    known.counts[1] = kept


@compiled
def _has_noise(
    recent: FloatArray, count: int, readings: FloatArray, k: int, at_end: BoolArray, first: int
) -> bool:
    """Whether some axis of a sensor, whose axes begin at `first`, that is not at its end in reading
    k went to and fro in the last readings, unlike those of a simulator without noise.
    """
    start = max(0, count + k + 1 - len(recent))
    for i in range(first, first + 3):
        turns = 0
        before = 0.0
        for place in range(start, count + k):
            here = recent[place, i] if place < count else readings[place - count, i]
            after = place + 1
            there = recent[after, i] if after < count else readings[after - count, i]
            change = there - here
            turns += (before < 0 and change > 0) or (before > 0 and change < 0)
            before = change
        if turns >= _MIN_TURNS and not at_end[i]:
            return True
    return False


class _SpikeCheck:
    """Leaves out single samples that lie far from both neighbours."""

    def __init__(self) -> None:
        # time and reading of the last sample that passed
        self._last: tuple[int, _Reading] | None = None
        self._suspect: ImuSample | None = None
        # Of the samples of the last seconds that passed, in parts: their times (S,), and the
        # changes (S, 6) to them.
        self._times: list[IntArray] = []
        self._changes: list[FloatArray] = []
        self._limit: _Reading | None = None  # (6,) a larger change is suspect; None: unknown
        self._limits = np.full(6, np.inf)  # the same, infinite where unknown
        self._period_ns = 0.0
        self._until_refresh = 0
        self._faults: list[ImuFault] = []

    def pass_on(self, times: IntArray, readings: FloatArray) -> int:
        """Take the first of some samples, up to one that is suspect or repeats a reading; return
        how many.
        """
        if self._last is None or self._suspect is not None:
            return 0
        most = max(self._until_refresh, 1)  # then the limits change
        times = times[:most]
        readings = readings[:most]
        changes = np.empty(readings.shape)
        longest = _FAULTS.long_periods * self._period_ns
        last_ns, last = self._last
        passed = _count_plain(
            times, readings, last_ns, np.array(last), self._limits, longest, changes
        )
        if passed:
            self._accept(times[:passed], changes[:passed], readings[passed - 1].tolist())
        return passed

    def take(self, sample: ImuSample, reading: _Reading) -> tuple[ImuSample, ...]:
        if self._last is None:
            self._last = sample.time_ns, reading
            return (sample,)
        suspect = self._suspect
        self._suspect = None
        if suspect is not None:
            if self._has_returned(suspect, reading):
                self._accept_one(sample, reading)
                return (sample,)
            self._accept_one(suspect, _reading(suspect))
        elif self._is_suspect(sample.time_ns, reading):
            self._suspect = sample
            return ()
        self._accept_one(sample, reading)
        return (sample,) if suspect is None else (suspect, sample)

    def new_faults(self) -> list[ImuFault]:
        faults = self._faults
        self._faults = []
        return faults

    def _is_suspect(self, time_ns: int, reading: _Reading) -> bool:
        assert self._last is not None
        if self._limit is None or time_ns - self._last[0] > _FAULTS.long_periods * self._period_ns:
            return False
        pairs = zip(reading, self._last[1], self._limit, strict=True)
        return any(abs(now - last) > limit for now, last, limit in pairs)

    def _has_returned(self, suspect: ImuSample, reading: _Reading) -> bool:
        """Whether the sample after a suspect lies near the one before it; then note the fault."""
        assert self._last is not None
        assert self._limit is not None
        last = np.array(self._last[1])
        jump = np.concatenate([suspect.gyro, suspect.accel]) - last
        axes = np.abs(jump) > self._limit
        back = np.abs(reading - last)
        if (back > self._limit).any() or (back > _FAULTS.returned * np.abs(jump))[axes].any():
            return False
        for kind, part in (("gyro spike", slice(0, 3)), ("accelerometer spike", slice(3, 6))):
            if axes[part].any():
                size = float(np.abs(jump[part]).max())
                self._faults.append(ImuFault(kind, suspect.time_ns, suspect.time_ns, size))  # type: ignore[arg-type]
        return True

    def _accept_one(self, sample: ImuSample, reading: _Reading) -> None:
        assert self._last is not None
        change = np.array(reading) - np.array(self._last[1])
        self._accept(np.array([sample.time_ns], dtype=np.int64), change[None], reading)

    def _accept(self, times: IntArray, changes: FloatArray, reading: _Reading) -> None:
        """Add changes (K, 6) at times (K,); the reading is the last one."""
        self._last = int(times[-1]), reading
        self._times.append(times)
        self._changes.append(changes)
        self._until_refresh -= len(times)
        if self._until_refresh > 0:
            return
        together = np.concatenate(self._times)
        changed = np.concatenate(self._changes)
        old = int(np.searchsorted(together, self._last[0] - _FAULTS.history_ns))
        self._times = [together[old:]]
        self._changes = [changed[old:]]
        if len(together) - old >= _FAULTS.min_history:
            self._until_refresh = max(
                _FAULTS.refresh, (len(together) - old) // _FAULTS.refresh_share
            )
            self._period_ns = median(np.diff(together[old:]))
            least = np.array(_FAULTS.spike_impulse) / max(self._period_ns * S_PER_NS, 1e-6)
            self._limits = np.maximum(_FAULTS.spike_sigmas * robust_sigmas(changed[old:]), least)
            self._limit = self._limits.tolist()


def _reading(sample: ImuSample) -> _Reading:
    return [*sample.gyro.tolist(), *sample.accel.tolist()]


def readings_of(samples: Sequence[ImuSample]) -> FloatArray:
    """Return the readings (K, 6) `[gyro, accel]` of one or more samples."""
    return np.concatenate([part for x in samples for part in (x.gyro, x.accel)]).reshape(-1, 6)


@compiled
def _count_plain(
    times: IntArray,
    readings: FloatArray,
    last_ns: int,
    last: FloatArray,
    limit: FloatArray,
    longest_ns: float,
    changes: FloatArray,
) -> int:
    """Count the first of some samples, of times (K,) and readings (K, 6), that neither stand out
    nor repeat one.

    Their changes (K, 6) are written: none above its limit (6,), unless the sample comes late, is
    suspect.
    """
    for k in range(len(times)):
        before = last if k == 0 else readings[k - 1]
        since_ns = times[k] - (last_ns if k == 0 else times[k - 1])
        for i in range(6):
            changes[k, i] = readings[k, i] - before[i]
        if since_ns <= longest_ns and _exceeds(changes[k], limit):
            return k
        if not _is_new(readings[k], before):
            return k
    return len(times)


@compiled
def _exceeds(change: FloatArray, limit: FloatArray) -> bool:
    """Whether some of the changes (6,) is larger than its limit (6,)."""
    exceeds = False
    for i in range(6):
        exceeds = exceeds or abs(change[i]) > limit[i]
    return exceeds


@compiled
def _is_new(reading: FloatArray, before: FloatArray) -> bool:
    """Whether gyro and accelerometer both read something else than before, the latter not zero."""
    gyro_changed = False
    accel_changed = False
    accel_reads = False
    for i in range(3):
        gyro_changed = gyro_changed or reading[i] != before[i]
        accel_changed = accel_changed or reading[3 + i] != before[3 + i]
        accel_reads = accel_reads or reading[3 + i] != 0.0
    return gyro_changed and accel_changed and accel_reads
