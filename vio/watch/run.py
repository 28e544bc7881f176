"""All that looks on at a run, in one: is the estimate sane and, with raw IMU, can its readings be right?"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import TYPE_CHECKING

from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import Estimate, ImuSample, MotionSample, Observations, UpdateReport
from vio.watch.health import RunHealth
from vio.watch.silence import ImuSilence

if TYPE_CHECKING:
    from vio.watch.finding import InertialFinding
    from vio.watch.inertial import InertialCheck

log = logging.getLogger(__name__)


class RunWatch:
    """Is shown everything that happens in a run, in time order; logs what it finds, and keeps it in `lines`."""

    def __init__(self, camera: StereoCamera, T_cam0_body: FloatArray, *, imu: bool) -> None:
        """Prepare.

        Args:
            camera: rectified pair.
            T_cam0_body: (4, 4) as the run uses it.
            imu: whether raw IMU samples carry the run.
        """
        self._health = RunHealth()
        self._inertial: InertialCheck | None = None
        self._silence = ImuSilence() if imu else None
        if imu:
            from vio.watch.inertial import InertialCheck  # it loads scipy.optimize

            self._inertial = InertialCheck(camera, T_cam0_body)
        self._frames = self._features = 0
        self.lines: list[str] = []

    def sample(self, sample: MotionSample) -> None:
        """See one motion sample."""
        if isinstance(sample, ImuSample):
            if self._silence is not None:
                self._say(self._silence.sample(sample.time_ns))
            if self._inertial is not None:
                self._inertial.imu(sample)

    def observations(self, seen: Observations) -> None:
        """See what the front end gave, before any selection."""
        self._frames += 1
        self._features += len(seen)
        if self._silence is not None:
            self._say(self._silence.frame(seen.frame_index, seen.time_ns))
        if self._inertial is not None:
            self._tell(self._inertial.frame(seen))

    def update(self, index: int, report: UpdateReport, estimate: Estimate) -> None:
        """See what the back end made of a frame."""
        self._say(self._health.frame(index, report, estimate))

    def close(self) -> None:
        """See the end of the run, also of one that failed."""
        if self._frames and not self._features:
            self._say([f"no feature in any of {self._frames} frames: the trajectory says nothing of the motion"])
        if self._silence is not None:
            self._say(self._silence.finish())
        if self._inertial is not None:
            self._tell(self._inertial.finish())

    def _tell(self, findings: Iterable[InertialFinding]) -> None:
        """Log findings; of gaps, the silence's watch tells each one."""
        self._say(finding.message for finding in findings if finding.fault != "IMU gap")

    def _say(self, lines: Iterable[str]) -> None:
        for line in lines:
            log.warning("%s", line)
            self.lines.append(line)
