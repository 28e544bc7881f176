"""Report gaps of the IMU's stamps, and the samples that are left out: spikes, readings that
repeat to the last bit, and those at the end of a sensor's range.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from vio.findings import Finding
from vio.imu.faults import ImuFault, ImuFaultKind, ImuSampleCheck
from vio.monitor.samples import GAP_S, GAP_STEPS
from vio.records import S_PER_NS, ImuSample

_RECENT = 200  # samples whose median distance is the usual one
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


class ImuFaultReport:
    """Finds the faulty samples as the filter does; reports each stuck period, and spikes with
    the first and in all.
    """

    def __init__(self) -> None:
        self._check = ImuSampleCheck()
        self._frame = 0
        self._samples = 0
        self.stuck_at_end = False  # known after `finish`
        self._spikes: dict[ImuFaultKind, list[ImuFault]] = {}

    def frame(self, index: int) -> None:
        """Take the number of a frame, for the lines that follow."""
        self._frame = index

    def samples(self, samples: list[ImuSample]) -> tuple[list[ImuSample], list[Finding]]:
        """Take samples; return those that may be used now, and the findings on faults that have
        ended, or whose end is not waited for.
        """
        self._samples += len(samples)
        usable = self._check.take_all(samples)
        return usable, self._found(self._check.new_faults())

    def finish(self) -> list[Finding]:
        """Return the findings at the end of the run."""
        faults = self._check.finish()
        self.stuck_at_end = any(fault.kind in _SENSORS for fault in faults)
        findings = self._found(faults)
        for kind, spikes in self._spikes.items():
            if len(spikes) > 1 and kind in _RANGES:
                sensor, unit = _RANGES[kind]
                line = (
                    f"the {sensor} was at the end of its range, {spikes[0].size:.4g} {unit}, "
                    f"{len(spikes)} times; these samples were left out"
                )
                findings.append(Finding(_code(kind), line, self._frame))
            elif len(spikes) > 1:
                largest = max(fault.size for fault in spikes)
                line = (
                    f"{len(spikes)} of {self._samples} IMU samples were {kind}s, the largest "
                    f"{largest:.3g} "
                    f"{_UNITS[kind]}; they were left out"
                )
                findings.append(Finding(_code(kind), line, self._frame))
        return findings

    def _found(self, faults: Iterable[ImuFault]) -> list[Finding]:
        return [
            Finding(_code(fault.kind), line, self._frame)
            for fault in faults
            for line in self._line(fault)
        ]

    def _line(self, fault: ImuFault) -> list[str]:
        if fault.kind in _SENSORS:
            seconds = (fault.end_ns - fault.start_ns) * S_PER_NS
            what = (
                "repeated one reading to the last bit"
                if fault.size > 0
                else "read zero in all axes"
            )
            return [
                f"frame {self._frame}: the {_SENSORS[fault.kind]} {what} for {seconds:.2f} s from "
                f"{fault.start_ns} ns: "
                "the sensor or its driver was stuck; its samples are left out, carried by images"
            ]
        self._spikes.setdefault(fault.kind, []).append(fault)
        if len(self._spikes[fault.kind]) > 1:
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
    """Takes the stamps of samples and frames; reports each gap once, in one line, when its
    length is known.
    """

    def __init__(self) -> None:
        self._times: deque[int] = deque(maxlen=_RECENT)
        self._first_imu_ns: int | None = None
        self._first_frame: tuple[int, int] | None = None  # index and time
        self._last_frame: tuple[int, int] | None = None
        self._waiting = 0  # frames before the first sample
        self._late_said = False

    def samples(self, times_ns: Sequence[int]) -> Iterator[tuple[int, str]]:
        """Take the stamps of one or more samples; yield the line on each gap, after the place of
        the sample that ends it.
        """
        if self._first_imu_ns is None:
            self._first_imu_ns = times_ns[0]
        before_ns = self._times[-1] if self._times else times_ns[0]
        taken = 0
        for k, time_ns in enumerate(times_ns):
            # nearly no sample ends a gap, and the median that `_gap` takes is slow
            if self._last_frame is not None and (time_ns - before_ns) * S_PER_NS > GAP_S:
                self._times.extend(times_ns[taken:k])
                taken = k
                for line in self._gap(time_ns, ""):
                    yield k, line
            before_ns = time_ns
        self._times.extend(times_ns[taken:])

    def frame(self, index: int, time_ns: int) -> tuple[str, ...]:
        """Take the number and stamp of a frame; return the line on an IMU that began late."""
        self._first_frame = self._first_frame or (index, time_ns)
        self._last_frame = index, time_ns
        first_ns = self._first_imu_ns
        if first_ns is None:
            self._waiting += 1
        elif not self._late_said:
            self._late_said = True
            late_s = (first_ns - self._first_frame[1]) * S_PER_NS
            if late_s > GAP_S:
                return (
                    f"frame {index}: the first IMU sample came {late_s:.2f} s after frame "
                    f"{self._first_frame[0]}; "
                    f"until then {self._waiting} frames were carried by images alone, in a world "
                    "that is not upright",
                )
        return ()

    def finish(self) -> tuple[str, ...]:
        """Return the line on an IMU that ended before the frames, or never began."""
        if self._last_frame is None:
            return ()
        if self._first_imu_ns is None:
            return (
                f"no IMU sample in any of {self._waiting} frames: all were carried by images alone",
            )
        return self._gap(self._last_frame[1], " to the end of the run")

    def _gap(self, until_ns: int, where: str) -> tuple[str, ...]:
        """The line on the silence from the last sample to a time, if it is one."""
        if not self._times:
            return ()
        length_s = (until_ns - self._times[-1]) * S_PER_NS
        if length_s <= GAP_S:
            return ()
        usual_s = float(np.median(np.diff(self._times))) * S_PER_NS if len(self._times) > 1 else 0.0
        if length_s <= max(GAP_S, GAP_STEPS * usual_s):
            return ()
        assert self._last_frame is not None
        index = self._last_frame[0]
        return (
            f"frame {index}: no IMU sample for {length_s:.2f} s from {self._times[-1]} ns{where}; "
            "carried by images",
        )
