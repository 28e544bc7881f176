"""Check a run's IMU stamps for gaps: before its first sample, between two, and after its last one."""

from __future__ import annotations

from collections import deque

import numpy as np

from vio.monitor.samples import GAP_S, GAP_STEPS

_NS = 1e-9
_RECENT = 200  # samples whose median distance is the usual one


class ImuSilence:
    """Takes the stamps of samples and frames; reports each gap once, in one line, when its length is known."""

    def __init__(self) -> None:
        self._times: deque[int] = deque(maxlen=_RECENT)
        self._first_imu_ns: int | None = None
        self._first_frame: tuple[int, int] | None = None  # index and time
        self._last_frame: tuple[int, int] | None = None
        self._waiting = 0  # frames before the first sample
        self._late_said = False

    def sample(self, time_ns: int) -> tuple[str, ...]:
        """Take the stamp of a sample; return the line on the gap that it ends."""
        if self._first_imu_ns is None:
            self._first_imu_ns = time_ns
        lines = () if self._last_frame is None else self._gap(time_ns, "")
        self._times.append(time_ns)
        return lines

    def frame(self, index: int, time_ns: int) -> tuple[str, ...]:
        """Take the number and stamp of a frame; return the line on an IMU that began late."""
        self._first_frame = self._first_frame or (index, time_ns)
        self._last_frame = index, time_ns
        first_ns = self._first_imu_ns
        if first_ns is None:
            self._waiting += 1
        elif not self._late_said:
            self._late_said = True
            late_s = (first_ns - self._first_frame[1]) * _NS
            if late_s > GAP_S:
                return (
                    f"frame {index}: the first IMU sample came {late_s:.2f} s after frame {self._first_frame[0]}; "
                    f"until then {self._waiting} frames were carried by images alone, in a world that is not upright",
                )
        return ()

    def finish(self) -> tuple[str, ...]:
        """Return the line on an IMU that ended before the frames, or never began."""
        if self._last_frame is None:
            return ()
        if self._first_imu_ns is None:
            return (f"no IMU sample in any of {self._waiting} frames: all were carried by images alone",)
        return self._gap(self._last_frame[1], " to the end of the run")

    def _gap(self, until_ns: int, where: str) -> tuple[str, ...]:
        """The line on the silence from the last sample to a time, if it is one."""
        if not self._times:
            return ()
        length_s = (until_ns - self._times[-1]) * _NS
        if length_s <= GAP_S:  # as for nearly every sample; the median below is slow
            return ()
        usual_s = float(np.median(np.diff(self._times))) * _NS if len(self._times) > 1 else 0.0
        if length_s <= max(GAP_S, GAP_STEPS * usual_s):
            return ()
        assert self._last_frame is not None
        index = self._last_frame[0]
        return (
            f"frame {index}: no IMU sample for {length_s:.2f} s from {self._times[-1]} ns{where}; carried by images",
        )
