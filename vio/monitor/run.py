"""All monitors of a run in one: plausibility of the estimate and, with raw IMU data, of the
readings.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence, Set
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vio.errors import NOTE
from vio.findings import Finding, ended
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.guard.repairing import AS_READ
from vio.imu.findings import ImuVerdict
from vio.imu.settings import DEFAULT_IMU
from vio.monitor.frozen import DEPTHS, IMAGES, FrozenImages, RepeatReport
from vio.monitor.health import is_corrected
from vio.monitor.imu_faults import ImuFaultReport, ImuSilence
from vio.monitor.integrity import OF_THE_STATE, IntegrityMonitor, Mark
from vio.monitor.lens_distortion import lens_check
from vio.monitor.mixed_exposures import MixedExposures
from vio.monitor.still_features import StillFeatures
from vio.monitor.update_checks import UpdateChecks, UpdatedFrame
from vio.records import (
    Estimate,
    Image,
    ImuSample,
    MotionSample,
    Observations,
    Prediction,
    RotationComparison,
    StereoFrame,
    UpdateReport,
)

if TYPE_CHECKING:
    from vio.imu.findings import InertialFinding
    from vio.monitor.inertial import InertialCheck

log = logging.getLogger(__name__)

_DOUBT = "imu-in-doubt"
# groups of faults without whose cure one camera finds no scale
_PREVENTS_START = ("size", "overlap")
# what holds of an IMU's samples, however they are read
_OF_SAMPLES = ("imu-gap", "imu-readings", "imu-saturated")


class RunMonitor:
    """Monitor all events of a run in time order; log findings, and keep them in `findings`.

    `repeats` and `without_repeated_depth` decide which frames and depth images are dropped.
    """

    def __init__(
        self,
        camera: StereoCamera,
        T_cam0_body: FloatArray,
        *,
        imu: bool,
        extrinsics_known: bool = True,
        gravity_mps2: float = DEFAULT_IMU.gravity_mps2,
        selects: bool = False,
    ) -> None:
        """Create the monitors of a rectified pair; extrinsics (4, 4), which the filter estimates if
        they are not known; `imu`: raw samples propagate the pose; `selects`: the back end is given
        few of the features on purpose.
        """
        self._updates = UpdateChecks(camera, imu=imu, selects=selects)
        self._of_updates = set[int]()  # places of their findings among all
        self._lasting = set[str]()  # codes of those that have not ended
        self._still = StillFeatures()
        self._mixed = MixedExposures()
        self._image: Image | None = None  # left one of the present frame
        self._seen: Observations | None = None  # of the present frame
        self._baseline_fault = camera.baseline_fault
        self._lenses = lens_check(camera)
        self._inertial: InertialCheck | None = None
        self._silence = ImuSilence() if imu else None
        self._faults = ImuFaultReport() if imu else None
        self._frozen = FrozenImages()
        self._repeats = RepeatReport(IMAGES)
        self._depths = RepeatReport(DEPTHS)
        self._repeated = False  # the present frame shows an earlier exposure
        if imu:
            from vio.monitor.inertial import InertialCheck  # it loads scipy.optimize

            self._inertial = InertialCheck(
                camera,
                T_cam0_body,
                extrinsics_known=extrinsics_known,
                gravity_mps2=gravity_mps2,
            )
        self._new: list[ImuSample] = []  # since the last frame
        self._frames = self._features = 0
        self._index = -1  # of the present frame, and of the one before it
        self._index_before = -1
        self._refused_last = -2
        self.frames_refused = 0
        self.refusal = ""  # of the last of them
        self.frames_waiting = 0  # that have no pose, as the back end had not begun
        self._waiting_since: int | None = None
        self._waits_for = ""
        self._imu_at_fault = False
        self._scale_lines: list[Finding] = []  # not reported yet
        self.imu_verdict = ImuVerdict()  # by the findings so far
        self.findings: list[Finding] = []
        # whether the run begins again once more of its images can be put right
        self.ends_at_repair = False
        # whether the run still can estimate its frames again with what is left of the IMU
        self.can_begin_again = False
        self.repair = AS_READ  # of the recording's images, by what was found so far
        self._integrity = IntegrityMonitor()

    def samples(self, samples: Iterable[MotionSample]) -> None:
        """Add motion samples; they are judged with all others before the next frame."""
        if self._silence is not None:
            self._new += [x for x in samples if type(x) is ImuSample]

    def _take_new(self, index: int, time_ns: int) -> None:
        """Judge the samples since the last frame, which a frame of this number and stamp follows."""
        if self._faults is not None:
            self._faults.frame(index, time_ns)
        self._judge_new()

    def _judge_new(self) -> None:
        """Judge the samples that were not judged yet."""
        new = self._new
        self._new = []
        if self._silence is None or not new:
            return
        taken = 0
        for k, gap in self._silence.samples([x.time_ns for x in new]):
            self._check(new[taken:k])  # what is to be said of earlier samples comes first
            self._add([gap])
            taken = k
        self._check(new[taken:])

    def _check(self, samples: list[ImuSample]) -> None:
        """Report faulty samples, and hand the others on."""
        if self._faults is None or self._inertial is None:
            return
        usable, findings = self._faults.samples(samples)
        self._add(findings)
        if any(finding.code == "imu-saturated" for finding in findings):
            self._inertial.clipped = True
        self._inertial.imu(usable)
        self._frozen.samples(usable)

    def repeats(self, frame: StereoFrame, expected: Prediction | None) -> bool:
        """Return whether a frame shows an earlier exposure again and must not be used; called
        before `observations`.

        Frames come in time order, each with the back end's prediction of it.
        """
        self._index, self._index_before = frame.index, self._index
        self._image = frame.left
        self._take_new(frame.index, frame.time_ns)
        repeated = self._frozen.check(frame, expected)
        self._repeated = repeated is not None
        named = repeated if repeated is not None and repeated.certain else None
        since = None if named is None else named.since
        self._add(
            Finding("frames-repeated", line, frame.index, since)
            for line in self._repeats.frame(frame, named)
        )
        return self._repeated

    def without_repeated_depth(self, frame: StereoFrame) -> StereoFrame:
        """Return a frame that `repeats` let pass, without its depths where they are those of an
        earlier frame.
        """
        if frame.depth is None:
            return frame
        repeated = self._frozen.check_depth(frame)
        self._report("depths-repeated", self._depths.frame(frame, repeated))
        return frame if repeated is None else replace(frame, depth=np.zeros_like(frame.depth))

    def observations(
        self,
        seen: Observations,
        warnings: tuple[str, ...] = (),
        findings: tuple[Finding, ...] = (),
    ) -> None:
        """Add the front end's observations, before feature selection, its own remarks, and the
        findings on the images.
        """
        self._take_new(seen.frame_index, seen.time_ns)
        if self._baseline_fault is not None and not self._frames:
            line = f"{self._baseline_fault}, or the path has another unit"
            self._report("baseline-implausible", [line])
        self._report("front-end", warnings)
        self._add(findings)
        self._frames += 1
        self._features += len(seen)
        self._seen = seen
        if self._silence is not None:
            self._add(self._silence.frame(seen.frame_index, seen.time_ns))
        if self._repeated:
            return
        self._add(self._mixed.frame(seen, self._image))
        distorted = None if self._lenses is None else self._lenses.frame(seen)
        if distorted is not None:
            self._add([distorted])
        self._frozen.observations(seen)
        held_since = self._frozen.take_held()
        if held_since is not None:
            message = (
                f"frame {seen.frame_index}: the images were the same to the last bit since frame "
                f"{held_since}, as of a rig at standstill, and now show a motion that did not begin "
                "just now: the camera or its driver gave them again; how the rig moved meanwhile "
                "is not known"
            )
            self._add([Finding("images-held", message, seen.frame_index, held_since)])
        if self._inertial is not None:
            self._report_findings(self._inertial.frame(seen))
            self._doubt_imu(self._inertial.doubt)

    def _doubt_imu(self, why: str) -> None:
        """Take why the IMU is not to be used for now; nothing: it may be used."""
        if bool(why) == self.imu_verdict.in_doubt:
            return
        self.imu_verdict = replace(self.imu_verdict, in_doubt=bool(why))
        message = f"frame {self._index}: the IMU is in doubt: {why}"
        if not why:
            message = f"frame {self._index}: the IMU is not in doubt any more"
        finding = Finding(_DOUBT, message, self._index, lasts=bool(why), ended=not why)
        self._add([finding])

    def with_clock_offset(self, good: Estimate) -> Estimate:
        """Return an estimate to go on from with the clocks' offset that the rates of gyro and images
        show, where they were compared.
        """
        offset_s = None if self._inertial is None else self._inertial.clock_offset_s
        if offset_s is None or good.time_offset_s is None:
            return good
        return replace(good, time_offset_s=offset_s)

    @property
    def rotation_comparison(self) -> RotationComparison | None:
        """How the camera's rotation compares with the gyro's so far; None: not compared yet, or no
        IMU.

        While the IMU looks faulty, rotations that agree count as not compared: the filter, which
        waits for them to judge the baseline by the IMU, then takes no wrong unit or axis for a
        wrong baseline.
        """
        check = self._inertial
        if check is None or check.rotation_comparison is None:
            return None
        return (
            None
            if check.imu_at_fault and check.rotation_comparison.agree
            else check.rotation_comparison
        )

    @property
    def lines(self) -> list[str]:
        """What was found so far, one line each."""
        return [finding.message for finding in self.findings]

    def say(self, line: str, code: str = "run") -> None:
        """Report what was found elsewhere, in one line."""
        self._report(code, [line])

    def add(self, finding: Finding) -> None:
        """Report what was found elsewhere."""
        self._add([finding])

    def refused(self, index: int, reason: str) -> None:
        """Add a frame that the front end refused, with its reason; a row of such frames is
        reported once.
        """
        if self._refused_last != self._index_before:
            self._report("frame-refused", [f"frame skipped: {reason}"])
        self._refused_last = index
        self.frames_refused = self.frames_refused + 1
        self.refusal = reason

    @property
    def imu_is_judged(self) -> bool:
        """Whether units, axes and signs of the IMU are not compared any more."""
        return self._inertial is None or self._inertial.done

    def begun_again(
        self, index: int, verdict: ImuVerdict, frames: Sequence[UpdatedFrame]
    ) -> dict[int, Estimate]:
        """Report that the frames so far were estimated again with what is left of the IMU; return
        their estimates by number, with the integrity that the images leave them.
        """
        self._goes_on(index, verdict, f"; the {len(frames)} frames so far were estimated again")
        self._updates = self._updates.anew(imu=verdict.used)
        self._scale_lines = []
        before = self._lasting
        self._lasting = set()
        stand = {f.code for f in self._of_sensors() if f.lasts and _stays(f, verdict)}
        estimates = self._judged_again(frames, verdict)
        text = "that does not hold of the estimates that replace those before"
        for code in sorted(before - self._lasting - stand):
            self._add([ended(code, index, text)])
        return estimates

    def _judged_again(
        self, frames: Sequence[UpdatedFrame], verdict: ImuVerdict
    ) -> dict[int, Estimate]:
        """Judge estimates that replace those before: what was found of images and samples stays, and
        what was found by the updates is found anew.
        """
        known = {finding.message for finding in self.findings}
        stays = self._of_sensors()
        before = self._integrity
        self._integrity = IntegrityMonitor()
        estimates: dict[int, Estimate] = {}
        for frame in frames:
            assert frame.seen is not None
            index = frame.seen.frame_index
            while stays and (stays[0].frame is None or stays[0].frame <= index):
                finding = stays.pop(0)
                if _stays(finding, verdict):
                    self._integrity.take(finding)
            shown = bool(frame.seen.has_right.any()) if len(frame.seen) else None
            has_scale = True if verdict.used else shown
            self._judge_update(index, frame, has_scale, measured=verdict.used, known=known)
            estimates[index] = self._integrity.judged(index, frame.estimate)
        self._integrity.go_on_from(before, stays)
        return estimates

    def _of_sensors(self) -> list[Finding]:
        """Return what was found so far by images and samples, not by updates."""
        return [f for k, f in enumerate(self.findings) if k not in self._of_updates]

    def goes_on_from(self, index: int, verdict: ImuVerdict) -> None:
        """Report that the run goes on from a frame with what is left of the IMU; what it has done to
        the estimate since it has been compared stays, and is in the covariance.
        """
        was_used = self._updates.refusals.imu
        self._goes_on(index, verdict)
        if self._inertial is None or verdict.used or not was_used:
            return
        if self._updates.contradiction is not None:
            self._add_of_updates(self._updates.contradiction.end(index))
        since = self._inertial.doubted_since(index)
        message = f"frame {index}: since frame {since} the estimate may have followed a wrong IMU"
        self._add([Finding("estimate-implausible", message, index, since)])

    def _goes_on(self, index: int, verdict: ImuVerdict, more: str = "") -> None:
        """Report what is left of the IMU."""
        self._updates.refusals.imu = verdict.used
        what = "the IMU is not used, and images alone go on"
        if verdict.in_doubt:
            what = "the IMU is not used until motion shows what is wrong with it"
        elif verdict.usable:
            parts = (("gyro", verdict.gyro_factor), ("accelerometer", verdict.accel_factor))
            factors = [
                f"the {name}'s readings are multiplied by {factor:.6g}"
                for name, factor in parts
                if factor != 1
            ]
            angle = np.degrees(np.linalg.norm(verdict.turn_rad))
            if angle > 0.0:
                factors.append(f"the IMU's readings are turned by {angle:.1f} degrees")
            what = " and ".join(factors) or "the IMU is used"
        self._report("imu-not-used", [f"frame {index}: {what}{more}"])

    def waiting(self, frame: StereoFrame, why: str) -> None:
        """Add a frame without a pose, as the back end's start is not observable yet; `why` is
        reported at the end.
        """
        self._waits_for = why
        if self._waiting_since is None:
            self._waiting_since = frame.time_ns
        self.frames_waiting += 1

    def begun(self, frame: StereoFrame, scale_sigma: float | None) -> None:
        """Add a frame with a pose of a back end that may have waited: for the first one, report
        the start.
        """
        since = self._waiting_since
        self._waiting_since = None
        if since is None:
            return
        how = (
            "at standstill"
            if scale_sigma is None
            else f"in motion, its scale known to {100 * scale_sigma:.1f} % by the IMU"
        )
        self._report(
            "one-camera-start",
            [
                f"frame {frame.index}: one camera: the trajectory begins here, {how}; the frames "
                "of "
                f"{(frame.time_ns - since) * 1e-9:.1f} s before have no pose"
            ],
        )

    def restarted(self, index: int, why: str, estimate: Estimate) -> None:
        """Report that the back end diverged in a frame and was started again; repeats within a
        second are one event.
        """
        self._add(self._updates.restarted(index, why, estimate))

    def begun_anew(self, index: int, good_ns: int, estimate: Estimate) -> None:
        """Report that the back end was begun anew in a frame, as its state was impossible; `good_ns`
        is the time of the last estimate that could be used.
        """
        self._scale_lines = []
        self._integrity.end_since(good_ns, "scale-off")
        self._updates.calibration.begin_anew()
        self._add([self._updates.health.begun_anew(index, good_ns, estimate)])

    def update(
        self,
        index: int,
        report: UpdateReport,
        estimate: Estimate,
        *,
        has_scale: bool | None = True,
        measured: bool = True,
    ) -> None:
        """Add the back end's report and estimate of a frame; `has_scale`: whether its features or a
        motion sensor measure lengths, None: it shows nothing; `measured`: whether a sensor does.
        """
        self._judge_update(
            index, UpdatedFrame(self._seen, report, estimate), has_scale, measured=measured
        )
        if report.gyro_jump_radps is not None and self._inertial is not None:
            self._inertial.begin_after_jump(index)
        if self._seen is not None:
            flow_px = None if measured else self._frozen.flow_px
            self._add(self._still.frame(index, self._image, flow_px))
        self._scale_lines += self._updates.health.scale(index, estimate)
        if self._inertial is not None:
            offset_s = self._inertial.clock_offset_s
            since = self._inertial.compared_since
            apart = self._updates.health.clock(index, estimate, offset_s, since)
            self._add_of_updates(apart)
            if apart and self.can_begin_again:  # by images alone; else the filter is begun anew
                self.imu_verdict = replace(self.imu_verdict, usable=False)
        self._report_scale(last=False)

    def _judge_update(
        self,
        index: int,
        frame: UpdatedFrame,
        has_scale: bool | None,
        *,
        measured: bool,
        known: Set[str] = frozenset(),
    ) -> None:
        """Judge a frame by its update, as often as it is estimated; messages that are known already
        are not reported again.
        """
        self._integrity.take_scale(measured=has_scale)
        found = self._updates.frame(index, frame, measured=measured)
        self._add_of_updates(found, known)
        if self._updates.contradiction is not None:
            self._integrity.take_innovation(frame.report.innovation_ratio)
        self._integrity.take_scale_doubt(index, frame.report.scale_doubt)
        if frame.seen is not None:
            drift = self._updates.calibration.frame(frame.seen, frame.estimate)
            self._integrity.take_drift(drift.share, drift.frames)

    def _add_of_updates(self, findings: Iterable[Finding], known: Set[str] = frozenset()) -> None:
        """Report what updates show; messages that are known already, not again."""
        for finding in findings:
            if finding.ended:
                self._lasting.discard(finding.code)
            elif finding.lasts:
                self._lasting.add(finding.code)
            if finding.message in known:
                self._integrity.take(finding)
            else:
                self._of_updates.add(len(self.findings))
                self._add([finding])

    def _report_scale(self, *, last: bool) -> None:
        """Report what the sensor says of the cameras' scale once its axes were compared, and are
        right.
        """
        check = self._inertial
        if check is None or (not check.imu_at_fault and (check.axes_compared or last)):
            self._add_of_updates(self._scale_lines)
            self._scale_lines = []

    def close(self) -> None:
        """Finish at the end of the run, also of a failed one."""
        self._judge_new()
        if self._frames and not self._features:
            self._report(
                "no-features",
                [
                    f"no feature in any of {self._frames} frames: the trajectory contains no "
                    "information on the motion"
                ],
            )
        self._report("frames-repeated", self._repeats.finish())
        self._report("depths-repeated", self._depths.finish())
        if self._silence is not None:
            self._add(self._silence.finish())
        if self._faults is not None:
            self._add(self._faults.finish())
        if self._inertial is not None:
            self._report_findings(self._inertial.finish())
            self._doubt_imu(self._inertial.doubt)
        self._report_scale(last=True)
        self._report_no_pose()
        self._integrity.close(self._index)

    def _report_no_pose(self) -> None:
        """Say why the last frames have no pose, if they have none."""
        if self._waiting_since is not None:
            why = (
                "correct the fault of the IMU that is named above first"
                if self._imu_at_fault
                else self._waits_for
            )
            line = f"one camera: {self.frames_waiting} frames have no pose; {why}"
            self._report("no-pose", [line])

    def _report_findings(self, findings: Iterable[InertialFinding]) -> None:
        """Log findings; gaps are reported one by one by `ImuSilence`."""
        clipped = self._inertial is not None and self._inertial.clipped
        # samples at the end of a range were named when they were left out
        findings = tuple(f for f in findings if not (clipped and f.fault == "saturation"))
        self._imu_at_fault |= any(f.certain and f.group in _PREVENTS_START for f in findings)
        # samples that repeat are left out, and named; that is no matter of clocks
        if self._faults is not None and self._faults.is_stuck:
            findings = tuple(f for f in findings if f.group != "overlap")
        for finding in findings:
            self.imu_verdict = self.imu_verdict.after(finding)
        for finding in findings:
            if finding.fault != "IMU gap":
                self._add([self._of_imu(finding)])

    def _of_imu(self, finding: InertialFinding) -> Finding:
        """Return a finding of the IMU as one of the run; a scale is that of all frames."""
        since = 0 if finding.code == "scale-off" else None
        return Finding(
            finding.code,
            finding.message,
            self._index,
            since,
            lasts=since is not None,
            certain=finding.certain,
        )

    def _report(self, code: str, lines: Iterable[str]) -> None:
        """Report events of one kind, one line each."""
        self._add(Finding(code, line, max(self._index, 0)) for line in lines)

    def _add(self, findings: Iterable[Finding]) -> None:
        for finding in findings:
            repair = self.repair.adding(finding)
            ends = self.ends_at_repair and repair != self.repair
            self.repair = repair
            if not ends:
                level = NOTE if is_corrected(finding) else logging.WARNING
                log.log(level, "%s", finding.message)
            self.findings.append(finding)
            self._integrity.take(finding)

    def judged(self, index: int, estimate: Estimate) -> Estimate:
        """Return the estimate of a frame with its integrity, by what was found so far."""
        return self._integrity.judged(index, estimate)

    def take_marks(self) -> tuple[Mark, ...]:
        """Return which earlier frames are to be marked, as a fault began before it was found."""
        return self._integrity.take_marks()


def _stays(finding: Finding, verdict: ImuVerdict) -> bool:
    """Whether a finding, which no update showed, holds of frames that are estimated again with what
    a verdict leaves of the IMU.
    """
    if finding.code.startswith("imu-"):
        return verdict.used and finding.code in _OF_SAMPLES
    return finding.code not in OF_THE_STATE
