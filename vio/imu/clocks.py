"""Overlap of the IMU's time stamps with those of the frames, by the stamps alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.files.epochs import epoch_hint
from vio.imu.findings import InertialFinding
from vio.numerics.robust import median
from vio.records import S_PER_NS, IntArray


class _ClockRules(NamedTuple):
    """When the IMU's stamps cover the frames."""

    min_covered_share: float = 0.97  # share of the frames that must have samples …
    max_uncovered_s: float = 1.0  # … unless the uncovered time is shorter
    max_late_s: float = 0.1  # a frame has a sample if the last one is no older


_CLOCKS = _ClockRules()
_NO_IMU_FRAMES = 10  # missing samples are reported after so many frames and so much time
_NO_IMU_S = 0.4
# … and, where there were some before, after so many of their steps, and after so long
_SLOW_STEPS = 2.0
_SLOW_S = 1.5


def judge_clocks(frame_times_ns: IntArray, imu_times_ns: IntArray) -> tuple[InertialFinding, ...]:
    """Check whether the IMU's stamps (S,) cover those of the frames (F,), both increasing, and
    explain it if not.
    """
    if not len(frame_times_ns):
        return ()
    frames = int(frame_times_ns[0]), int(frame_times_ns[-1])
    if not len(imu_times_ns):
        return (_no_overlap(frames, None, 0.0),)
    imu = int(imu_times_ns[0]), int(imu_times_ns[-1])
    covered = float(np.mean((frame_times_ns >= imu[0]) & (frame_times_ns <= imu[1])))
    step_ns = 0.0
    if len(imu_times_ns) > 1:
        step_ns = median(np.diff(imu_times_ns))
    if covered == 0.0:
        return (_no_overlap(frames, imu, step_ns),)
    uncovered_s = (1 - covered) * (frames[1] - frames[0]) * S_PER_NS
    enough = covered >= _CLOCKS.min_covered_share or uncovered_s < _CLOCKS.max_uncovered_s
    if enough:
        return ()
    return (_part_overlap(frames, imu, step_ns, covered),)


class SampleCoverage:
    """Count the frames that have IMU samples during a run; a gap between samples is no matter of
    clocks.
    """

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._last_ns = 0
        self._frames = self._covered = 0
        self._in_gap = 0  # frames without samples since some frame had them

    def frame(self, time_ns: int, last_imu_ns: int | None) -> None:
        """Count a frame, given the time of the last sample before it."""
        if self._first_ns is None:
            self._first_ns = time_ns
        self._last_ns = time_ns
        self._frames += 1
        if last_imu_ns is not None and (time_ns - last_imu_ns) * S_PER_NS <= _CLOCKS.max_late_s:
            self._covered += 1 + self._in_gap
            self._in_gap = 0
        elif self._covered:
            self._in_gap += 1

    def so_far(self, imu: tuple[int, int] | None, step_ns: float) -> list[InertialFinding]:
        """Report early that no frame has samples.

        Args:
            imu: first and last stamp of the samples, ns; None: no samples.
            step_ns: their usual interval.
        """
        long = self._frames >= _NO_IMU_FRAMES and self._seconds >= _NO_IMU_S
        if imu is not None and long:  # the next sample of a slow sensor may come
            silent_ns = self._last_ns - imu[1]
            long = silent_ns < 0 or silent_ns > max(_SLOW_STEPS * step_ns, _SLOW_S / S_PER_NS)
        if long and self._covered == 0:
            return [_no_overlap(self._span, imu, step_ns)]
        return []

    def at_end(self, imu: tuple[int, int] | None, step_ns: float) -> list[InertialFinding]:
        """Report that none or only a part of the frames had samples; arguments as for `so_far`."""
        if not self._frames or self._covered >= _CLOCKS.min_covered_share * self._frames:
            return []
        if self._covered == 0:
            return [_no_overlap(self._span, imu, step_ns)]
        share = self._covered / self._frames
        if imu is None or (1 - share) * self._seconds < _CLOCKS.max_uncovered_s:
            return []
        late_ns = _CLOCKS.max_late_s / S_PER_NS
        if imu[0] - late_ns <= self._span[0] and self._span[1] <= imu[1] + late_ns:
            return []  # samples that came late, as where live use is under load
        return [_part_overlap(self._span, imu, step_ns, share)]

    @property
    def _span(self) -> tuple[int, int]:
        return (self._last_ns if self._first_ns is None else self._first_ns), self._last_ns

    @property
    def _seconds(self) -> float:
        first_ns, last_ns = self._span
        return (last_ns - first_ns) * S_PER_NS


def _no_overlap(
    frames: tuple[int, int], imu: tuple[int, int] | None, step_ns: float
) -> InertialFinding:
    seen = f"frames from {frames[0]} to {frames[1]} ns"
    if imu is None:
        return InertialFinding(
            "clocks without overlap",
            f"{seen}, no IMU sample among them",
            "the IMU may begin later, its samples may be added later than the frames of their time, "
            "or its stamps count from another epoch or in another unit (ns, us, ms, s); give "
            "both one clock, or use --motion none",
        )
    seen = f"{seen}, IMU samples from {imu[0]} to {imu[1]} ns, without overlap"
    unit = _unit_of_clock(frames, imu, step_ns)
    if unit is not None:
        return InertialFinding("clocks without overlap", seen, unit)
    lengths = [(span[1] - span[0]) * S_PER_NS for span in (frames, imu)]
    offset_s = (imu[0] - frames[0]) * S_PER_NS
    alike = 0.5 < max(lengths[1], 1e-9) / max(lengths[0], 1e-9) < 2
    same = ""
    if alike:
        same = f"both last about as long ({lengths[0]:.1f} and {lengths[1]:.1f} s): "
    return InertialFinding(
        "clocks without overlap",
        seen,
        f"{same}the clocks may have different epochs (the IMU starts {offset_s:+.3f} s from the "
        "frames), or the "
        "files belong to other recordings; convert the IMU's stamps to the camera's clock"
        f"{epoch_hint(frames, imu, 'the IMU')}",
    )


def _part_overlap(
    frames: tuple[int, int], imu: tuple[int, int], step_ns: float, covered: float
) -> InertialFinding:
    unit = _unit_of_clock(frames, imu, step_ns)
    return InertialFinding(
        "clocks overlap in part",
        f"frames from {frames[0]} to {frames[1]} ns, IMU samples from {imu[0]} to {imu[1]} ns: "
        f"{100 * covered:.1f} % of the frames have IMU samples",
        unit
        or "a file may be cut short, or the clocks may be shifted; use the frames that both cover, "
        "or other files",
    )


def _unit_of_clock(frames: tuple[int, int], imu: tuple[int, int], step_ns: float) -> str | None:
    """Return the explanation by a power of 1000 that maps the IMU's stamps to the frames'.

    None: there is none.
    """
    names = {3: "microseconds", 6: "milliseconds", 9: "seconds"}
    for power in (3, 6, 9, -3, -6, -9):
        factor = 10.0**power
        low = imu[0] * factor
        high = imu[1] * factor
        shared = min(high, frames[1]) - max(low, frames[0])
        plausible = step_ns == 0 or 1e5 < step_ns * factor < 1e8  # 10 Hz to 10 kHz
        if plausible and shared > 0.5 * max(frames[1] - frames[0], 1):
            what = (
                f"the IMU's stamps are {names[power]}"
                if power > 0
                else f"the frames' stamps are {names[-power]} (or the IMU's were multiplied twice)"
            )
            return f"times 1e{power:+d} the IMU's stamps cover the frames: {what}, read as nanoseconds; convert them"
    return None
