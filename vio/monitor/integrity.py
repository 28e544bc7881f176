"""Whether the estimate of a frame may be used, by the findings that hold for it.

A covariance is conditional on what the filter assumes. Where a finding says that an assumption does
not hold, the estimate is marked, and the covariance of one that is unusable also covers that the
rig has moved in any direction since the fault began, as fast as it moves at most: what the filter
says of the motion since then may be wrong by all of it. When the fault has ended, the motion is
known again, and the position is not: what the covariance covered stays in it. Where a finding doubts
a share of the motion, that is so of this share.

Where features lie further from their predictions by the IMU than the filter expects, frame after
frame, its new errors are larger by as much as far as anyone can say, whatever the cause is: what the
covariance grows by is, too, long before a cause is found.

Where the left images alone go on, nothing measures lengths any more. Their scale drifts, mostly to
smaller ones, by more than the filter says: its motion model, noise of the pixels and linearisation
pass for knowledge of it. So distances from there on are uncertain by a walk of the scale.

Where what is estimated of the stereo calibration moves, lengths are in doubt by a share, and the
position by this share of the path on which it moved.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.findings import CODES, INTEGRITIES, Finding, Integrity, worst
from vio.geometry.lie import FloatArray, length
from vio.numerics.robust import median
from vio.records import NS_PER_S, Estimate, IntArray

_HOLDS_NS = NS_PER_S  # an event without an end is one of the second after it
# findings on the state that was estimated, not on a sensor
OF_THE_STATE = ("estimate-implausible", "estimate-restarted", "estimate-lost", "scale-off")
_MIN_SPEED_MPS = 0.1  # of a rig that stands still as far as the estimate says
# Levels of what the scale may be off by, over it: from one to the next. Where one is reached,
# earlier frames below it are brought to it.
_SCALE_DOUBT_GROWS = 1.5
_MAX_DRIFT_FRAMES = 40  # for which a calibration has moved before that is seen


class _Levels(NamedTuple):
    """Levels of a doubt of the scale, so that frames are marked again when much has changed."""

    first: float  # doubt at which the first one begins; below is level 0, of no doubt

    def of(self, doubt: float) -> int:
        """Return the level of a doubt."""
        if doubt < self.first:
            return 0
        return 1 + int(np.log(doubt / self.first) / np.log(_SCALE_DOUBT_GROWS))

    def doubt(self, level: int) -> float:
        """Return the doubt at which a level begins."""
        return self.first * _SCALE_DOUBT_GROWS ** (level - 1) if level else 0.0


_SCALE = _Levels(0.005)
# half of what the settings state of a calibration, beside which less does not count
_DRIFT = _Levels(0.0025)


class _InnovationRules(NamedTuple):
    """When the errors of a filter are larger than it says."""

    frames: int = 5  # the newest, of whose ratios the median counts: a shock is one of them
    # innovation over its standard deviation up to which it is usual; of healthy recordings it comes
    # to 1.0 to 1.3, and to 2 in single frames
    usual: float = 2.0


_INNOVATION = _InnovationRules()
# Random walk of the logarithm of the scale by left images alone, a frame. Simulated rooms at pixel
# noise of 0.15, 0.25 px: -6, -15 % in 370 frames where 0.7, 1.2 % is stated; a rendered one -8 % in 75.
_SCALE_WALK = 0.005


@dataclass(frozen=True, slots=True)
class Mark:
    """Frames that are marked after their estimates were given."""

    since: int  # first frame
    before: int  # frame after the last one
    integrity: Integrity
    code: str | None  # of the finding; None: there is none, the covariance alone changes
    scale: float = 0.0  # standard deviation of distances from the first pose, over them
    share: float = 0.0  # of the motion since the first frame that positions may be off by


@dataclass(slots=True)
class _Holding:
    """A finding that holds at present."""

    finding: Finding
    until_ns: int | None  # None: until it is said to have ended


class _FrameTimes:
    """Numbers and times of all frames so far, in 16 bytes each: a live run has no end."""

    def __init__(self) -> None:
        self._rows: IntArray = np.zeros((64, 2), dtype=np.int64)
        self._count = 0

    def add(self, index: int, time_ns: int) -> None:
        """Add a frame after the others, or replace the last one."""
        if not self._count or self._rows[self._count - 1, 0] != index:
            self._count += 1
        if self._count > len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self._count - 1] = index, time_ns

    def of(self, index: int) -> int | None:
        """Return the time of a frame; None: it had no estimate."""
        known = self._rows[: self._count]
        place = int(np.searchsorted(known[:, 0], index))
        if place < len(known) and known[place, 0] == index:
            return int(known[place, 1])
        return None


class IntegrityMonitor:
    """Collects findings, and judges each estimate by those that hold."""

    def __init__(self) -> None:
        self._new: list[Finding] = []
        self._holding: dict[str, _Holding] = {}
        self._marks: list[Mark] = []
        self._last: tuple[int, FloatArray] | None = None  # time and position of the last frame
        self._speed_mps = _MIN_SPEED_MPS  # the fastest so far
        self._times = _FrameTimes()
        self._doubts: list[Finding] = []  # that the motion up to the last frame is in doubt by
        # how long it has been, where a share of the motion counts as that share of the time
        self._doubted_s = 0.0
        self._carried_m = 0.0  # that the position may be off by since earlier faults
        self._doubt_m = 0.0  # the same with the present one
        # innovations over their standard deviations by a motion sensor
        self._ratios = deque[float](maxlen=_INNOVATION.frames)
        self._misled_m = 0.0  # what the position may be off by more than stated, as they say
        # largest variance of the position in any direction, as stated at the last frame
        self._largest = 0.0
        # of the logarithm of a scale that nothing measures, and of what the position is off by for it
        self._unscaled = np.zeros((4, 4))
        # steps of the last frames, and the level of the doubt of their lengths by a calibration
        # that moves
        self._steps_m = deque[float](maxlen=_MAX_DRIFT_FRAMES)
        self._step_levels = deque[int](maxlen=_MAX_DRIFT_FRAMES)
        self._drift: tuple[int, int] = 0, 0  # level and number of frames that the next one shows
        self._drifted_m = 0.0  # that the position may be off by for it
        # frames and the level of the scale's doubt that their covariances have from there on: less
        # in each than in the one before
        self._scale_doubts: list[tuple[int, int]] = []

    def take(self, finding: Finding) -> None:
        """Take a finding; it counts from the next estimate on."""
        self._new.append(finding)

    def end_since(self, good_ns: int, *codes: str) -> None:
        """Let go of findings on a state that has been replaced: that it was impossible, and those
        that hold from a frame on after the last good estimate; what holds for earlier ones is not
        the state's.
        """
        self._holding.pop("estimate-implausible", None)
        for code in codes:
            entry = self._holding.get(code)
            if entry is not None and self._onset_ns(entry.finding, good_ns + 1) > good_ns:
                del self._holding[code]

    def take_scale_doubt(self, index: int, doubt: float) -> None:
        """Take by what the scale may be off, over it, as a frame has shown; it was off in the
        frames before as well.
        """
        level = _SCALE.of(doubt)
        since = index
        while self._scale_doubts and self._scale_doubts[-1][1] <= level:
            before = since
            since, known = self._scale_doubts.pop()
            if known < level:
                variance = _SCALE.doubt(level) ** 2 - _SCALE.doubt(known) ** 2
                scale = float(np.sqrt(variance))
                self._marks.append(Mark(since, before, "nominal", None, scale))
        self._scale_doubts.append((since, level))

    def take_drift(self, share: float, frames: int) -> None:
        """Take by what share lengths may be off, as a calibration has moved in so many frames up to
        the coming estimate's.
        """
        self._drift = _DRIFT.of(share), frames

    def take_innovation(self, ratio: float | None) -> None:
        """Take the innovation of a frame over its standard deviation; None: nothing was seen."""
        if ratio is not None:
            self._ratios.append(ratio)

    def take_scale(self, *, measured: bool | None) -> None:
        """Take whether the coming estimate's frame, or a sensor, measures lengths; None: it shows
        nothing.
        """
        if measured:
            self._unscaled[0] = 0.0
            self._unscaled[:, 0] = 0.0
        elif measured is not None:
            self._unscaled[0, 0] += _SCALE_WALK**2

    def go_on_from(self, other: IntegrityMonitor, new: Sequence[Finding]) -> None:
        """Go on where another one, of estimates that were replaced, has come to: what it knows of the
        sensors holds, and findings are new to both.
        """
        held = {code: entry for code, entry in other._holding.items() if code.startswith("imu-")}
        self._holding |= held
        self._new = list(new)

    def take_marks(self) -> tuple[Mark, ...]:
        """Return the marks of earlier frames since the last call."""
        marks = tuple(self._marks)
        self._marks = []
        return marks

    def close(self, index: int) -> None:
        """Mark the frames up to the last one that findings at the end of the run hold for."""
        for finding in self._new:
            since = finding.first_frame
            if finding.effect != "nominal" and since is not None and since < index:
                self._marks.append(_mark(finding, since, index + 1))
        self._new = []

    def judged(self, index: int, estimate: Estimate) -> Estimate:
        """Return the estimate of a frame with its integrity and, where it is not nominal, the codes
        of what holds.
        """
        self._times.add(index, estimate.time_ns)
        self._update(index, estimate.time_ns)
        held = [entry.finding for entry in self._holding.values()]
        integrity = worst([finding.effect for finding in held])
        step_ns = 0 if self._last is None else estimate.time_ns - self._last[0]
        self._measure_drift(index, estimate)
        self._measure_speed(estimate, usable=integrity != "unusable")
        self._measure_doubt(estimate.time_ns, step_ns, held)
        self._measure_misled(estimate.covariance)
        unscaled = (
            float(np.linalg.eigvalsh(self._unscaled[1:, 1:])[-1]) if self._unscaled.any() else 0.0
        )
        drifted = self._drifted_m**2
        doubt_m = float(np.sqrt(self._doubt_m**2 + self._misled_m**2 + unscaled + drifted))
        if integrity == "nominal" and doubt_m == 0.0:
            return estimate
        codes = tuple(sorted(f.code for f in held if f.effect != "nominal"))
        return _with_doubt(estimate, integrity, codes, doubt_m)

    def _measure_doubt(self, now_ns: int, step_ns: int, held: list[Finding]) -> None:
        """Bring what the position may be off by to the present, a step after the last frame."""
        before = self._doubts
        self._doubts = [f for f in held if _doubted_share(f) > 0.0]
        if not self._doubts:
            self._doubted_s = 0.0
            self._carried_m = self._doubt_m
            return
        codes = {f.code for f in self._doubts}
        goes_on = max((_doubted_share(f) for f in before if f.code in codes), default=0.0)
        self._doubted_s += goes_on * step_ns / NS_PER_S
        # what was in doubt before a finding on it counts from there on, and not twice
        known = max(map(_doubted_share, before), default=0.0)
        for finding in sorted(self._doubts, key=_doubted_share):
            if finding in before:
                continue
            share = _doubted_share(finding)
            ago_s = (now_ns - self._onset_ns(finding, now_ns)) / NS_PER_S
            more_s = max(share - known, 0.0) * ago_s
            self._doubted_s = max(self._doubted_s + more_s, share * ago_s)
            known = max(known, share)
        moved_m = self._speed_mps * self._doubted_s
        self._doubt_m = float(np.hypot(self._carried_m, moved_m))

    def _measure_drift(self, index: int, estimate: Estimate) -> None:
        """Bring what the position may be off by for a calibration that moves to the present frame,
        and mark the frames in which it had moved unseen.
        """
        last = self._last
        position = estimate.T_world_imu[:3, 3]
        self._steps_m.append(0.0 if last is None else length(position - last[1]))
        self._step_levels.append(0)
        level, frames = self._drift
        self._drift = 0, 0
        known = max(self._step_levels)
        if level > known:
            share = float(np.sqrt(_DRIFT.doubt(level) ** 2 - _DRIFT.doubt(known) ** 2))
            self._marks.append(Mark(index - frames, index, "nominal", None, share=share))
        for k in range(max(len(self._steps_m) - frames, 0), len(self._steps_m)):
            before = self._step_levels[k]
            if level > before:
                more = _DRIFT.doubt(level) - _DRIFT.doubt(before)
                self._drifted_m += more * self._steps_m[k]
                self._step_levels[k] = level

    def _measure_misled(self, covariance: FloatArray) -> None:
        """Bring what innovations say of the position's errors to the present frame, of a stated
        covariance (6, 6): its growth is larger by as much, and what it has lost is known again.
        """
        if not self._ratios:
            return
        before = self._largest
        self._largest = largest = float(np.linalg.eigvalsh(covariance[:3, :3])[-1])
        if largest <= before:
            self._misled_m *= float(np.sqrt(largest / before)) if before > 0.0 else 1.0
        elif len(self._ratios) == _INNOVATION.frames:
            factor = max(median(np.array(self._ratios)) / _INNOVATION.usual, 1.0)
            more = (factor**2 - 1.0) * (largest - before)
            self._misled_m = float(np.sqrt(self._misled_m**2 + more))

    def _onset_ns(self, finding: Finding, now_ns: int) -> int:
        """The time of the first frame that a finding holds for."""
        first = finding.first_frame
        known = None if first is None else self._times.of(first)
        return now_ns if known is None else known

    def _update(self, index: int, now_ns: int) -> None:
        """Take the new findings, and let go of those that have ended."""
        for code, entry in list(self._holding.items()):
            if entry.until_ns is not None and entry.until_ns <= now_ns:
                del self._holding[code]
        for finding in self._new:
            if finding.ended:
                self._holding.pop(finding.code, None)
                continue
            if CODES[finding.code].effect == "nominal":
                continue
            until_ns = None if finding.lasts else now_ns + _HOLDS_NS
            held = self._holding.get(finding.code)
            # an event of a second does not end one of the same code that lasts
            if held is None or held.until_ns is not None or finding.lasts:
                self._holding[finding.code] = _Holding(finding, until_ns)
            since = finding.first_frame
            if since is not None and since < index:
                self._marks.append(_mark(finding, since, index))
        self._new = []

    def _measure_speed(self, estimate: Estimate, *, usable: bool) -> None:
        position = estimate.T_world_imu[:3, 3]
        last = self._last
        self._last = estimate.time_ns, position.copy()
        if last is None or not usable or estimate.time_ns <= last[0]:
            return
        step_m = length(position - last[1])
        if self._unscaled[0, 0] > 0.0:
            moved = np.eye(4)
            moved[1:, 0] = position - last[1]
            self._unscaled = moved @ self._unscaled @ moved.T
        self._speed_mps = max(self._speed_mps, step_m * NS_PER_S / (estimate.time_ns - last[0]))


def _doubted_share(finding: Finding) -> float:
    """Share of the motion, while a finding holds, that the estimate may be off by."""
    if finding.effect == "unusable":
        return 1.0
    return finding.figures.get("doubted_share", 0.0)


def _mark(finding: Finding, since: int, before: int) -> Mark:
    share = _doubted_share(finding)
    return Mark(since, before, finding.effect, finding.code, share=share)


def inflated(covariance: FloatArray, sigma_m: float) -> FloatArray:
    """Return a covariance (6, 6) of a pose, with a standard deviation of its position added on
    each axis.
    """
    out = covariance.copy()
    out[:3, :3] += sigma_m**2 * np.eye(3)
    return out


def marked(estimate: Estimate, mark: Mark, sigma_m: float) -> Estimate:
    """Return an earlier estimate with a mark; `sigma_m` is what its position may be off by more."""
    integrity = max(estimate.integrity, mark.integrity, key=INTEGRITIES.index)
    codes = estimate.findings
    if mark.code is not None:
        codes = tuple(sorted({*codes, mark.code}))
    more_m = sigma_m if mark.share > 0.0 or mark.scale > 0.0 else 0.0
    return _with_doubt(estimate, integrity, codes, more_m)


def _with_doubt(
    estimate: Estimate, integrity: Integrity, codes: tuple[str, ...], more_m: float
) -> Estimate:
    """Return an estimate as findings judge it; its position may be off by `more_m` beside what was
    in doubt.
    """
    covariance = estimate.covariance
    doubt_m = estimate.position_doubt_m
    if more_m > 0.0:
        covariance = inflated(covariance, more_m)
        doubt_m = float(np.hypot(doubt_m, more_m))
    return replace(
        estimate,
        integrity=integrity,
        findings=codes,
        covariance=covariance,
        position_doubt_m=doubt_m,
    )
