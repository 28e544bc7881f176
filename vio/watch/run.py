"""All monitors of a run in one: plausibility of the estimate and, with raw IMU data, of the readings."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import TYPE_CHECKING

from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import Estimate, ImuSample, MotionSample, Observations, Prediction, StereoFrame, UpdateReport
from vio.watch.frozen import FrozenImages, RepeatReport
from vio.watch.health import RunHealth
from vio.watch.imu_faults import ImuFaultReport
from vio.watch.silence import ImuSilence

if TYPE_CHECKING:
    from vio.watch.finding import InertialFinding
    from vio.watch.inertial import InertialCheck

log = logging.getLogger(__name__)


class RunWatch:
    """Monitor all events of a run in time order; log warnings, and keep them in `lines`."""

    def __init__(self, camera: StereoCamera, T_cam0_body: FloatArray, *, imu: bool) -> None:
        """Create the monitors.

        Args:
            camera: rectified pair.
            T_cam0_body: (4, 4) as the run uses it.
            imu: whether the run propagates with raw IMU samples.
        """
        self._health = RunHealth()
        self._inertial: InertialCheck | None = None
        self._silence = ImuSilence() if imu else None
        self._faults = ImuFaultReport() if imu else None
        self._frozen, self._repeats = FrozenImages(), RepeatReport()
        self._repeated = False  # the present frame shows an earlier exposure
        if imu:
            from vio.watch.inertial import InertialCheck  # it loads scipy.optimize

            self._inertial = InertialCheck(camera, T_cam0_body)
        self._frames = self._features = 0
        self._refused_last = -2
        self.frames_refused = 0
        self.lines: list[str] = []

    def sample(self, sample: MotionSample) -> None:
        """Add one motion sample."""
        if isinstance(sample, ImuSample):
            if self._silence is not None:
                self._report(self._silence.sample(sample.time_ns))
            if self._faults is not None and self._inertial is not None:
                usable, lines = self._faults.sample(sample)
                self._report(lines)
                for x in usable:
                    self._inertial.imu(x)
                    self._frozen.sample(x)

    def repeats(self, frame: StereoFrame, expected: Prediction | None) -> bool:
        """Return whether a frame shows an earlier exposure again and must not be used; called before `observations`.

        Args:
            frame: in time order.
            expected: the back end's prediction of it.
        """
        repeated = self._frozen.check(frame, expected)
        self._repeated = repeated is not None
        self._report(self._repeats.frame(frame, repeated))
        return self._repeated

    def observations(self, seen: Observations, warnings: tuple[str, ...] = ()) -> None:
        """Add the front end's observations, before feature selection, and what it says of the images."""
        self._report(warnings)
        self._frames += 1
        self._features += len(seen)
        if self._silence is not None:
            self._report(self._silence.frame(seen.frame_index, seen.time_ns))
        if self._faults is not None:
            self._faults.frame(seen.frame_index)
        if self._repeated:
            return
        self._frozen.observations(seen)
        if self._inertial is not None:
            self._report_findings(self._inertial.frame(seen))

    def refused(self, index: int, reason: str) -> None:
        """Add a frame that the front end refused, with its reason; a row of such frames is reported once."""
        if index != self._refused_last + 1:
            self._report([f"frame skipped: {reason}"])
        self._refused_last = index
        self.frames_refused += 1

    def restarted(self, index: int, why: str, estimate: Estimate) -> None:
        """Report that the back end diverged in a frame and was started again; repeats within a second are one event."""
        self._report(self._health.restarted(index, why, estimate))

    def update(self, index: int, report: UpdateReport, estimate: Estimate) -> None:
        """Add the back end's report and estimate of a frame."""
        self._report(self._health.frame(index, report, estimate))

    def close(self) -> None:
        """Finish at the end of the run, also of a failed one."""
        if self._frames and not self._features:
            self._report(
                [f"no feature in any of {self._frames} frames: the trajectory contains no information on the motion"]
            )
        self._report(self._repeats.finish())
        if self._silence is not None:
            self._report(self._silence.finish())
        if self._faults is not None:
            self._report(self._faults.finish())
        if self._inertial is not None:
            findings = self._inertial.finish()
            if self._faults is not None and self._faults.stuck_at_end:  # which is no matter of clocks
                findings = tuple(f for f in findings if f.group != "overlap")
            self._report_findings(findings)

    def _report_findings(self, findings: Iterable[InertialFinding]) -> None:
        """Log findings; gaps are reported one by one by `ImuSilence`."""
        self._report(finding.message for finding in findings if finding.fault != "IMU gap")

    def _report(self, lines: Iterable[str]) -> None:
        for line in lines:
            log.warning("%s", line)
            self.lines.append(line)
