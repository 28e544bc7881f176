"""Report gaps of the IMU's stamps, and the samples that are left out: spikes, readings that
repeat to the last bit, and those at the end of a sensor's range.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from vio.findings import Finding, begun, ended
from vio.imu.faults import ImuFault, ImuFaultKind, ImuSampleCheck
from vio.monitor.samples import GAP_S, GAP_STEPS
from vio.numerics.robust import median
from vio.records import S_PER_NS, ImuSample

_RECENT = 200  # samples whose median distance is the usual one, and frames whose stamps are known
_GAP = "imu-gap"
_UNITS: dict[ImuFaultKind, str] = {"gyro spike": "rad/s", "accelerometer spike": "m/s^2"}
_RANGES: dict[ImuFaultKind, tuple[str, str]] = {
    "gyro clipped": ("gyro", "rad/s"),
    "accelerometer clipped": ("accelerometer", "m/s^2"),
}
_SENSORS: dict[ImuFaultKind, str] = {
    "stuck IMU": "IMU",
    "stuck gyro": "gyro",
    "stuck accelerometer": "accelerometer",
}


class _FrameTimes:
    """Numbers and stamps of the last frames, for the first one that a fault concerns."""

    def __init__(self) -> None:
        self._frames: deque[tuple[int, int]] = deque(maxlen=_RECENT)

    def add(self, index: int, time_ns: int) -> None:
        """Add a frame in order of time, once or twice."""
        if not self._frames or self._frames[-1][0] != index:
            self._frames.append((index, time_ns))

    def first_after(self, time_ns: int) -> int | None:
        """Return the number of the first frame after a time; None: there is none yet."""
        return next((index for index, stamp in self._frames if stamp > time_ns), None)


class ImuFaultReport:
    """Finds the faulty samples as the filter does; reports each stuck period as it begins and as
    it ends, and spikes with the first and in all.
    """

    def __init__(self) -> None:
        self._check = ImuSampleCheck()
        self._frame = 0
        self._frames = _FrameTimes()
        self._samples = 0
        self._counts: dict[ImuFaultKind, int] = {}  # of spikes, and of rows at the end of a range
        self._largest: dict[ImuFaultKind, float] = {}  # of their sizes

    def frame(self, index: int, time_ns: int) -> None:
        """Take the number and stamp of a frame before the samples up to it, for their lines; again
        is no harm.
        """
        self._frame = index
        self._frames.add(index, time_ns)

    def samples(self, samples: list[ImuSample]) -> tuple[list[ImuSample], list[Finding]]:
        """Take samples; return those that may be used now, and the findings on faults."""
        self._samples += len(samples)
        usable = self._check.take_all(samples)
        return usable, self._found(self._check.new_faults())

    @property
    def is_stuck(self) -> bool:
        """Whether the last sample repeats the one before it by a fault."""
        return self._check.stuck

    def finish(self) -> list[Finding]:
        """Return the findings at the end of the run."""
        findings = self._found(self._check.new_faults())
        for kind, count in self._counts.items():
            if count == 1:
                continue
            largest = self._largest[kind]
            if kind in _RANGES:
                sensor, unit = _RANGES[kind]
                line = (
                    f"the {sensor} was at the end of its range, {largest:.4g} {unit}, {count} times; "
                    "these samples were left out"
                )
            else:
                line = (
                    f"{count} of {self._samples} IMU samples were {kind}s, the largest "
                    f"{largest:.3g} {_UNITS[kind]}; they were left out"
                )
            findings.append(Finding(_code(kind), line, self._frame))
        return findings

    def _found(self, faults: Iterable[ImuFault]) -> list[Finding]:
        found = []
        for fault in faults:
            if fault.kind in _SENSORS:
                found.append(self._stuck(fault))
            else:
                found += [Finding(_code(fault.kind), x, self._frame) for x in self._line(fault)]
        return found

    def _stuck(self, fault: ImuFault) -> Finding:
        """Return that repetitions have begun, or ended."""
        sensor = _SENSORS[fault.kind]
        code = _code(fault.kind)
        is_zero = fault.size == 0.0
        if fault.end_ns is None:
            what = "reads zero in all axes" if is_zero else "repeats one reading to the last bit"
            text = (
                f"the {sensor} {what} since {fault.start_ns} ns: the sensor "
                "or its driver is stuck; its samples are left out, carried by images"
            )
            since = self._frames.first_after(fault.start_ns)
            return begun(code, self._frame, text, since)
        seconds = (fault.end_ns - fault.start_ns) * S_PER_NS
        what = "of zeros" if is_zero else "of one reading"
        text = f"the {sensor} gives new readings again, after {seconds:.2f} s {what}"
        return ended(code, self._frame, text)

    def _line(self, fault: ImuFault) -> list[str]:
        self._counts[fault.kind] = self._counts.get(fault.kind, 0) + 1
        self._largest[fault.kind] = max(self._largest.get(fault.kind, 0.0), fault.size)
        if self._counts[fault.kind] > 1:
            return []
        if fault.kind in _RANGES:
            sensor, unit = _RANGES[fault.kind]
            return [
                f"frame {self._frame}: the {sensor} is at the end of its range, {fault.size:.4g} "
                f"{unit}, from {fault.start_ns} ns: the motion exceeds it; choose a larger range; "
                "such samples are left out, carried by images"
            ]
        return [
            f"frame {self._frame}: {fault.kind}: one sample at {fault.start_ns} ns is "
            f"{fault.size:.3g} "
            f"{_UNITS[fault.kind]} from both its neighbours, a fault of the sensor or its "
            "transfer; it is left out"
        ]


def _code(kind: ImuFaultKind) -> str:
    return "imu-saturated" if kind in _RANGES else "imu-readings"


class ImuSilence:
    """Takes the stamps of samples and frames; reports each gap as it begins, and as it ends."""

    def __init__(self) -> None:
        self._times: deque[int] = deque(maxlen=_RECENT)
        self._first_imu_ns: int | None = None
        self._first_frame: tuple[int, int] | None = None  # index and time
        self._last_frame: tuple[int, int] | None = None
        self._frames = _FrameTimes()
        self._waiting = 0  # frames before the first sample
        self._late_said = False
        self._lasts = False  # the present gap, or that before the first sample, was reported

    def samples(self, times_ns: Sequence[int]) -> Iterator[tuple[int, Finding]]:
        """Take the stamps of one or more samples; yield what is found of each gap, after the place
        of the sample that ends it.
        """
        if self._first_imu_ns is None:
            self._first_imu_ns = times_ns[0]
        before_ns = self._times[-1] if self._times else times_ns[0]
        taken = 0
        for k, time_ns in enumerate(times_ns):
            # nearly no sample ends a gap, and the median that `_gap_s` takes is slow
            if self._last_frame is not None and (time_ns - before_ns) * S_PER_NS > GAP_S:
                self._times.extend(times_ns[taken:k])
                taken = k
                for finding in self._ended(time_ns, self._last_frame[0]):
                    yield k, finding
            before_ns = time_ns
        self._times.extend(times_ns[taken:])

    def frame(self, index: int, time_ns: int) -> tuple[Finding, ...]:
        """Take the number and stamp of a frame; return what is found of a gap that has begun, and
        of an IMU that began late.
        """
        self._first_frame = self._first_frame or (index, time_ns)
        self._last_frame = index, time_ns
        self._frames.add(index, time_ns)
        if self._first_imu_ns is None:
            self._waiting += 1
            return self._not_begun(index, time_ns)
        if not self._late_said:
            self._late_said = True
            return self._began_late(index, self._first_imu_ns)
        return self._begun(index, time_ns)

    def _not_begun(self, index: int, time_ns: int) -> tuple[Finding, ...]:
        """Return that no sample has come yet, some time after the first frame."""
        assert self._first_frame is not None
        first, first_ns = self._first_frame
        waited_s = (time_ns - first_ns) * S_PER_NS
        if self._lasts or waited_s <= GAP_S:
            return ()
        self._lasts = True
        text = (
            f"no IMU sample yet, {waited_s:.2f} s after frame {first}; carried by images alone, in a "
            "world that is not upright"
        )
        return (begun(_GAP, index, text, first),)

    def _began_late(self, index: int, imu_ns: int) -> tuple[Finding, ...]:
        """Return how late the first sample came, if it did."""
        assert self._first_frame is not None
        first, first_ns = self._first_frame
        late_s = (imu_ns - first_ns) * S_PER_NS
        if late_s <= GAP_S:
            return ()
        lasted = self._lasts
        self._lasts = False
        message = (
            f"frame {index}: the first IMU sample came {late_s:.2f} s after frame {first}; until "
            f"then {self._waiting} frames were carried by images alone, in a world that is not "
            "upright"
        )
        return (Finding(_GAP, message, index, first if lasted else None, ended=lasted),)

    def _begun(self, index: int, time_ns: int) -> tuple[Finding, ...]:
        """Return that samples have ceased."""
        gap_s = self._gap_s(time_ns)
        if self._lasts or gap_s is None:
            return ()
        self._lasts = True
        last_ns = self._times[-1]
        text = f"no IMU sample since {last_ns} ns, for {gap_s:.2f} s; carried by images"
        return (begun(_GAP, index, text, self._frames.first_after(last_ns)),)

    def _ended(self, until_ns: int, index: int) -> tuple[Finding, ...]:
        """Return that a sample comes after a gap."""
        gap_s = self._gap_s(until_ns)
        if gap_s is None:
            return ()
        lasted = self._lasts
        self._lasts = False
        message = (
            f"frame {index}: no IMU sample for {gap_s:.2f} s from {self._times[-1]} ns; carried by "
            "images"
        )
        return (Finding(_GAP, message, index, ended=lasted),)

    def finish(self) -> tuple[Finding, ...]:
        """Return what is found of an IMU that ended before the frames, or never began."""
        if self._last_frame is None:
            return ()
        index, time_ns = self._last_frame
        if self._first_imu_ns is None:
            message = (
                f"no IMU sample in any of {self._waiting} frames: all were carried by images alone"
            )
            return (Finding(_GAP, message, index),)
        gap_s = self._gap_s(time_ns)
        if gap_s is None:
            return ()
        message = (
            f"frame {index}: no IMU sample for {gap_s:.2f} s from {self._times[-1]} ns to the end "
            "of the run; carried by images"
        )
        return (Finding(_GAP, message, index),)

    def _gap_s(self, until_ns: int) -> float | None:
        """The silence from the last sample to a time; None: it is usual."""
        if not self._times:
            return None
        length_s = (until_ns - self._times[-1]) * S_PER_NS
        if length_s <= GAP_S:
            return None
        usual_s = 0.0
        if len(self._times) > 1:
            usual_s = median(np.diff(self._times)) * S_PER_NS
        return None if length_s <= GAP_STEPS * usual_s else length_s
