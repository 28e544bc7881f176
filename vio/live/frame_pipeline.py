"""One frame through the pipeline: predict, front end, selector, filter, and the checks beside
them.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

from vio.dataclass import dataclass
from vio.errors import DataError, DivergedError
from vio.findings import INTEGRITIES
from vio.frontend.rolling_shutter import RollingShutter
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.imu.settings import DEFAULT_IMU
from vio.live.imu_trial import AS_GIVEN, ImuTrial, corrected, corrected_all
from vio.live.recovery import Recovery
from vio.monitor.reading import ReadingCheck
from vio.monitor.run import RunMonitor
from vio.numerics.robust import median
from vio.protocols import Backend, Frontend, Selector
from vio.records import (
    Estimate,
    FrameLog,
    FrameResult,
    FrontendOutput,
    MotionSample,
    MotionSource,
    Observations,
    Prediction,
    Selection,
    StereoFrame,
    UpdateReport,
    no_features,
)
from vio.selection.selectors import KeepAll


@dataclass(frozen=True, slots=True)
class RunParts:
    """The parts that a frame goes through."""

    frontend: Frontend
    selector: Selector
    backend: Backend
    shutter: RollingShutter | None = None  # None: all rows are exposed at once


class FramePipeline:
    """Front end, selector and filter, fed with events in the order of `EventOrder`."""

    def __init__(
        self,
        camera: StereoCamera,
        T_cam0_body: FloatArray,
        motion: MotionSource | None,
        parts: RunParts,
        *,
        use_prior: bool,
        trial: ImuTrial | None = None,
        reading: ReadingCheck | None = None,
        extrinsics_known: bool = True,
        gravity_mps2: float = DEFAULT_IMU.gravity_mps2,
    ) -> None:
        self.frontend = parts.frontend
        self.selector = parts.selector
        self.backend = parts.backend
        self.monitor = RunMonitor(
            camera,
            T_cam0_body,
            imu=motion == "imu",
            extrinsics_known=extrinsics_known,
            gravity_mps2=gravity_mps2,
            selects=not isinstance(parts.selector, KeepAll),
        )
        self._shutter = parts.shutter
        self._motion = motion
        self._use_prior = use_prior
        self._propagate_ms = 0.0  # since the last frame
        self._trial = trial
        self._reading = reading
        self._imu = AS_GIVEN
        self._revised: dict[int, Estimate] = {}
        self._recovery = Recovery()

    def samples(self, samples: Sequence[MotionSample]) -> None:
        """Take motion samples in order of time, all that come before the next frame."""
        start = time.perf_counter()
        self.monitor.samples(samples)
        if self._motion is not None:
            if self._trial is not None:
                self._trial.take_samples(samples)
            if usable := corrected_all(samples, self._imu):
                self.backend.propagate_all(usable)
        self._propagate_ms += 1e3 * (time.perf_counter() - start)

    def frame(self, frame: StereoFrame) -> FrameResult | None:
        """Process one frame; None where the front end refused it, which the monitor reports.

        Raises:
            EstimationError: the filter is lost.
        """
        timer = _StageTimer()
        expected = self.backend.predict(frame.time_ns)
        timer.end("predict")
        try:
            output = self._track(frame, expected)
        except DataError as error:
            self.monitor.refused(frame.index, str(error))
            return None
        timer.end("frontend")
        self.monitor.observations(output.observations, output.warnings, output.findings)
        self.begin_again(frame.index)
        timer.end("monitor")
        seen = output.observations
        if self.backend.stereo_only:
            seen = seen.take(seen.has_right)
        selection = self.selector.select(seen, expected.motion if expected else None)
        timer.end("select")
        if self._motion == "imu" and self._imu == AS_GIVEN:
            self.backend.take_rotation_comparison(self.monitor.rotation_comparison)
        chosen = seen.take(selection.chosen)
        if self._trial is not None:
            self._trial.take(chosen)
        report = self._update(chosen)
        initialisation = self.backend.initialisation
        if not report.started:
            self.monitor.waiting(
                frame, initialisation.waits_for or "the state is not observable yet"
            )
            return None
        self.monitor.begun(frame, initialisation.scale_sigma)
        estimate = self.backend.estimate()
        timer.end("update")
        has_scale = self._has_scale(chosen)
        measured = self._is_measured
        self.monitor.update(frame.index, report, estimate, has_scale=has_scale, measured=measured)
        self._check_reading(output.observations)
        estimate = self._recovered(frame.index, self.monitor.judged(frame.index, estimate))
        timer.ms["filter"] = timer.ms["predict"] + timer.ms["update"] + self._propagate_ms
        self._propagate_ms = 0.0
        return FrameResult(
            frame,
            output,
            selection,
            report,
            estimate,
            _frame_log(frame, timer.ms, output, selection, report, estimate),
        )

    @property
    def _is_measured(self) -> bool:
        """Whether a motion sensor carries the pose between frames."""
        return self._motion is not None and self._imu.used

    def _has_scale(self, seen: Observations) -> bool | None:
        """Whether features that are used, or a motion sensor, measure lengths; None: none is seen."""
        if self._is_measured:
            return True
        return bool(seen.has_right.any()) if len(seen) else None

    def _check_reading(self, seen: Observations) -> None:
        """Report that another reading of the calibration explains the rows, where one does."""
        found = None
        if self._reading is not None:
            found = self._reading.frame(seen, self.monitor.findings)
        if found is not None:
            self.monitor.add(found)

    def _track(self, frame: StereoFrame, expected: Prediction | None) -> FrontendOutput:
        """Return what the front end makes of a frame, nothing of one that was given before."""
        if self.monitor.repeats(frame, expected):
            return no_features(frame)
        checked = self.monitor.without_repeated_depth(frame)
        prior = expected.tracks if expected and self._use_prior else None
        output = self.frontend.process(checked, prior)
        if self._shutter is None:
            return output
        seen = self._shutter.corrected(output.observations)
        found = self._shutter.take_findings()
        if seen is output.observations and not found:
            return output
        return replace(output, observations=seen, findings=(*output.findings, *found))

    def usable(self, sample: MotionSample) -> MotionSample | None:
        """Return a sample as the back end takes it.

        None: it does not, as the sensor was found to be wrong.
        """
        return corrected(sample, self._imu)

    def begin_again(self, index: int) -> None:
        """Where the monitor has become certain that the IMU is wrong, or doubts it, estimate all
        frames again, or, where they are not kept any more, go on with what is left of the IMU.
        """
        trial = self._trial
        verdict = self.monitor.imu_verdict
        self.monitor.can_begin_again = trial is not None and trial.open
        if trial is None:
            return
        if verdict == self._imu:
            if self.monitor.imu_is_judged:
                trial.close()
            return
        if not trial.open:
            self._imu = verdict
            self.monitor.goes_on_from(index, verdict)
            return
        again = trial.again(verdict)
        if again is None:
            return
        self.backend, frames = again
        self._imu = verdict
        self._revised = self.monitor.begun_again(index, verdict, frames)

    def newest(self, index: int, estimate: Estimate | None) -> Estimate | None:
        """Return the estimate of a frame, or the one that has replaced it and was not taken yet."""
        return self._revised.get(index, estimate)

    def take_revised(self) -> dict[int, Estimate]:
        """Return the estimates, by frame number, that replace earlier ones, and forget them.

        There are some where the IMU was found to be wrong, once, in the first minute.
        """
        revised = self._revised
        self._revised = {}
        return revised

    def _recovered(self, index: int, estimate: Estimate) -> Estimate:
        """Begin a back end anew whose state has become impossible; return the frame's estimate."""
        good = self._recovery.take(estimate)
        if good is None:
            return estimate
        anew = self.backend.begin_anew(self.monitor.with_clock_offset(good))
        if anew is None:
            return estimate
        self.monitor.begun_anew(index, good.time_ns, anew)
        return self.monitor.judged(index, anew)

    def _update(self, seen: Observations) -> UpdateReport:
        """Update with a frame; a back end that diverges is restarted."""
        try:
            return self.backend.update(seen)
        except DivergedError as error:
            report = self.backend.restart(seen)
            if report.started:
                self.monitor.restarted(seen.frame_index, str(error), self.backend.estimate())
            else:
                lost = f"{error}; there are no poses until the scale is observable again"
                self.monitor.say(f"frame {seen.frame_index}: {lost}", "estimate-lost")
            return report


class _StageTimer:
    """Wall time of the stages of one frame, the end of one being the beginning of the next."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}
        self._last = time.perf_counter()

    def end(self, stage: str) -> None:
        """Note how long a stage has taken."""
        now = time.perf_counter()
        self.ms[stage] = 1e3 * (now - self._last)
        self._last = now


def _frame_log(
    frame: StereoFrame,
    ms: dict[str, float],
    output: FrontendOutput,
    selection: Selection,
    report: UpdateReport,
    estimate: Estimate,
) -> FrameLog:
    z = output.observations.z[output.observations.has_right]
    return FrameLog(
        index=frame.index,
        time_ns=frame.time_ns,
        read_ms=0.0,  # who reads the images, knows
        frontend_ms=ms["frontend"],
        monitor_ms=ms["monitor"],
        select_ms=ms["select"],
        filter_ms=ms["filter"],
        detected=output.detected,
        tracked=output.tracked,
        matched=output.matched,
        selected=int(selection.chosen.sum()),
        stale=int(output.observations.stale.sum()),
        used=report.used,
        gated=report.gated,
        landmarks=report.landmarks,
        innovation_median_px=report.innovation_median_px,
        nis_per_dof=report.nis_per_dof,
        disparity_median_px=median(z[:, 0] - z[:, 2]) if len(z) else None,
        innovation_ratio=report.innovation_ratio,
        integrity=INTEGRITIES.index(estimate.integrity),
        stages_ms=output.stages_ms,
    )
