"""Report the IMU samples that are left out as faulty: spikes, and readings that repeat to the last bit."""

from __future__ import annotations

from vio.imu.faults import ImuFault, ImuFaultKind, ImuSampleCheck
from vio.records import ImuSample

_NS = 1e-9
_UNITS: dict[ImuFaultKind, str] = {"gyro spike": "rad/s", "accelerometer spike": "m/s^2"}
_SENSORS: dict[ImuFaultKind, str] = {
    "stuck IMU": "IMU",
    "stuck gyro": "gyro",
    "stuck accelerometer": "accelerometer",
}


class ImuFaultReport:
    """Finds the faulty samples as the filter does; reports each stuck period, and spikes with the first and in all."""

    def __init__(self) -> None:
        self._check = ImuSampleCheck()
        self._frame = 0
        self._samples = 0
        self.stuck_at_end = False  # known after `finish`
        self._spikes: dict[ImuFaultKind, list[ImuFault]] = {}

    def frame(self, index: int) -> None:
        """Take the number of a frame, for the lines that follow."""
        self._frame = index

    def samples(self, samples: list[ImuSample]) -> tuple[list[ImuSample], list[str]]:
        """Take samples; return those that may be used now, and the lines on faults that have ended."""
        self._samples += len(samples)
        usable = self._check.take_all(samples)
        return usable, [line for fault in self._check.new_faults() for line in self._line(fault)]

    def finish(self) -> list[str]:
        """Return the lines at the end of the run."""
        faults = self._check.finish()
        self.stuck_at_end = any(fault.kind in _SENSORS for fault in faults)
        lines = [line for fault in faults for line in self._line(fault)]
        for kind, spikes in self._spikes.items():
            if len(spikes) > 1:
                largest = max(fault.size for fault in spikes)
                lines.append(
                    f"{len(spikes)} of {self._samples} IMU samples were {kind}s, the largest {largest:.3g} "
                    f"{_UNITS[kind]}; they were left out"
                )
        return lines

    def _line(self, fault: ImuFault) -> list[str]:
        if fault.kind in _SENSORS:
            seconds = (fault.end_ns - fault.start_ns) * _NS
            what = "repeated one reading to the last bit" if fault.size > 0 else "read zero in all axes"
            return [
                f"frame {self._frame}: the {_SENSORS[fault.kind]} {what} for {seconds:.2f} s from {fault.start_ns} ns: "
                "the sensor or its driver was stuck; its samples are left out, carried by images"
            ]
        self._spikes.setdefault(fault.kind, []).append(fault)
        if len(self._spikes[fault.kind]) > 1:
            return []
        return [
            f"frame {self._frame}: {fault.kind}: one sample at {fault.start_ns} ns is {fault.size:.3g} "
            f"{_UNITS[fault.kind]} from both its neighbours, a fault of the sensor or its transfer; it is left out"
        ]
