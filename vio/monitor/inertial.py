"""Check a run's IMU for wrong units, signs, axes, extrinsics and clocks, for clipping and for gaps.

The camera's motion comes from the stereo tracks of consecutive frames, the gyro and the
accelerometer are fitted to it by *general* linear maps, and every named explanation (the given
extrinsics, their inverse, a permutation of axes, degrees, g, …) is then judged by how much worse it
fits than the general map. A fault is named only where the given calibration fails clearly and the
explanation does not; for equations (I1) to (I4) see docs/inertial.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.imu.clocks import SampleCoverage
from vio.imu.findings import InertialFault, InertialFinding
from vio.monitor.force_fit import (
    MIN_WINDOWS,
    SHORT_WINDOW_S,
    WINDOW_S,
    Evidence,
    ForceFit,
    fit_force,
)
from vio.monitor.gyro_fit import (
    FIRST_EVALUATION,
    GyroFit,
    fit_gyro,
    fits_backwards,
    judge_offset,
    judge_stamps,
)
from vio.monitor.motion import BATCH, CameraTwists, RecentMotion, Record, record_of
from vio.monitor.rotation_comparison import compare_rotations, judge_rotations
from vio.monitor.samples import (
    EARTH_GRAVITY_MPS2,
    Samples,
    Size,
    is_long_enough,
    judge_exchange,
    judge_size,
)
from vio.monitor.turned_imu import Turn, judge_turn
from vio.records import (
    ROTATION_NOT_COMPARABLE,
    S_PER_NS,
    ImuSample,
    Observations,
    RotationComparison,
)

if TYPE_CHECKING:
    from vio.calibration.inertial import Rates


class _EvaluationRules(NamedTuple):
    """When the IMU is judged."""

    min_intervals_at_end: int = 20  # intervals needed to judge at the end of a run
    # intervals between evaluations after `_EVALUATIONS.enough_intervals`; until then
    # `FIRST_EVALUATION`
    later_intervals: int = 150
    # intervals with rotation about all axes after which the comparison ends
    enough_intervals: int = 400


_EVALUATIONS = _EvaluationRules()
# intervals in which an IMU that is in doubt may have been wrong: that it was judged by
_BEFORE_A_DOUBT = 2 * FIRST_EVALUATION


class InertialCheck:
    """Monitor a run with raw IMU data without influencing it, and report each fault once.

    Pass every sample and every frame's observations in time order; log what `frame` and `finish`
    return. The comparison of motions ends after enough rotation about all axes; gaps and clipping
    are checked until the end of the run.
    """

    def __init__(
        self,
        camera: StereoCamera,
        T_cam0_imu: FloatArray,
        *,
        extrinsics_known: bool = True,
        gravity_mps2: float = EARTH_GRAVITY_MPS2,
    ) -> None:
        """Create the check, for observations of a rectified pair and `T_cam0_imu` (4, 4) as the
        run uses it.

        `extrinsics_known`: the filter does not estimate them. `gravity_mps2`: as it is set.
        """
        self._gravity_mps2 = gravity_mps2
        self._turns = extrinsics_known
        self._stereo = camera
        self._T = np.array(T_cam0_imu, dtype=np.float64)
        self._reported: set[str] = set()
        self._samples = Samples()
        self._coverage = SampleCoverage()
        self._frames = 0
        self._jumped = False
        self.compared_since = 0  # first frame since the gyro's bias has last jumped
        self._size_judged = False  # at least for the time being
        # a magnitude that is not that of gravity, by the first readings, while its cause is not known
        self._odd_size = ""
        self.reset()

    def reset(self) -> None:
        """Restart the comparison of motions; reported findings are not repeated."""
        self._camera = CameraTwists(self._stereo)
        self._motion = RecentMotion()
        self._since_evaluation = self._seen = 0
        self._suspected: set[InertialFault] = set()
        self._fault = ""  # what makes the IMU useless, by the newest judgement alone
        self.done = False  # whether the comparison of motions has ended
        # the newest comparison; None: too few frames yet
        self.rotation_comparison: RotationComparison | None = None
        # the accelerometer's with the images' path, or there will be no rotation for it
        self.axes_compared = False
        self.clipped = False  # samples at the end of a range were left out
        # by two evaluations in a row: a frame stamped t was exposed at t + this of the IMU's clock
        self.clock_offset_s: float | None = None
        # by the newest judgement of units, axes, signs and clocks, reported yet or not
        self.imu_at_fault = False

    @property
    def doubt(self) -> str:
        """What makes the IMU useless if it is confirmed; nothing: there is no such doubt."""
        return self._odd_size or self._fault

    def begin_after_jump(self, index: int) -> None:
        """Restart where the gyro's bias has jumped at a frame, as no linear map fits readings before
        and after it.

        Only once in a run: wrong axes or units look like jumps, too, one after the other.
        """
        self.compared_since = index
        if not self._jumped:
            self._jumped = True
            self.reset()

    def doubted_since(self, index: int) -> int:
        """The first frame in which an IMU may have been wrong that is in doubt at one."""
        return max(self.compared_since, index - _BEFORE_A_DOUBT * self._camera.spacing)

    def imu(self, samples: Sequence[ImuSample]) -> None:
        """Add samples in order of time."""
        self._samples.add(samples)

    def frame(self, observations: Observations) -> tuple[InertialFinding, ...]:
        """Add the observations of one frame, and return new findings."""
        self._frames += 1
        self._coverage.frame(observations.time_ns, self._samples.last_ns)
        found = self._coverage.so_far(self._samples.span_ns, self._samples.step_s / S_PER_NS)
        if not self._size_judged:
            self._judge_first_size()
        if not self.done:
            found += self._compare(observations)
        elif self._frames % BATCH == 0:
            found += self._samples.check_new(keep=False)
        return self._unreported(found)

    def finish(self) -> tuple[InertialFinding, ...]:
        """Return the findings at the end of the run; call it also when the run fails."""
        found = self._coverage.at_end(self._samples.span_ns, self._samples.step_s / S_PER_NS)
        found += self._samples.check_new(keep=not self.done)
        if not self.done:
            motion = self._camera.flush()
            if motion is not None:
                self._motion.add(motion)
            found += self._judge(last=True)
        self._odd_size = self._fault = ""
        return self._unreported(found)

    def _judge_first_size(self) -> None:
        """Judge the accelerometer's magnitude as soon as readings show it, without any motion."""
        times_ns, values = self._samples.so_far()
        if len(times_ns) < 2 or not is_long_enough(times_ns):
            return
        size = judge_size(times_ns, values[:, 3:], self._gravity_mps2)
        self._size_judged = True
        if (exchanged := judge_exchange(times_ns, values)) is not None:
            self._odd_size = exchanged.seen
            return
        if size.finding is None:
            self._odd_size = ""
        else:
            self._odd_size = size.finding.seen

    def _compare(self, observations: Observations) -> list[InertialFinding]:
        """Add a frame's features, and evaluate when there is enough motion.

        Before the end of a run, a fault must be found in two consecutive evaluations.
        """
        motion = self._camera.frame(observations)
        if motion is None:
            return []
        found = self._samples.check_new(keep=True)
        self._motion.add(motion)
        self._since_evaluation += len(motion)
        self._seen += len(motion)
        if self._since_evaluation < (
            FIRST_EVALUATION
            if self._seen < _EVALUATIONS.enough_intervals
            else _EVALUATIONS.later_intervals
        ):
            if self.rotation_comparison is None:
                self._compare_first_rotations()
            return found
        self._since_evaluation = 0
        judged = self._judge(last=False)
        confirmed = [f for f in judged if f.fault in self._suspected]
        offsets = (f.offset_s for f in confirmed if f.offset_s is not None)
        self.clock_offset_s = next(offsets, None)
        self._suspected = {f.fault for f in judged}
        found += confirmed
        return found

    def _doubt_if(self, judged: Sequence[InertialFinding]) -> None:
        """Doubt the IMU where a judgement says that it is useless, which is not reported yet."""
        new = (f.seen for f in judged if f.is_disabling and f.group not in self._reported)
        self._fault = next(new, "")

    def _judge(self, *, last: bool) -> list[InertialFinding]:
        """Evaluate the stored samples and motions."""
        times_ns, values = self._samples.table()
        if len(times_ns) < 2:
            return []
        size = judge_size(times_ns, values[:, 3:], self._gravity_mps2)
        self.imu_at_fault = size.finding is not None
        if (exchanged := judge_exchange(times_ns, values)) is not None:
            return [exchanged]  # nothing else can be said of such readings
        if size.finding is None:
            self._odd_size = ""
        motion = self._motion.joined()
        if motion is None:
            return [] if size.finding is None else [size.finding]
        record = record_of(motion, times_ns, values)
        gyro_fit = fit_gyro(record, _EVALUATIONS.min_intervals_at_end)
        if gyro_fit is None:
            return self._judge_stationary(size, record, last=last)
        evidence = self._evidence(size, record, gyro_fit, last=last)
        from vio.calibration.inertial import Rates

        rates = Rates(times_ns, values[:, :3], values[:, 3:], True)
        return self._judge_rotating(evidence, size, record, rates)

    def _evidence(self, size: Size, record: Record, gyro_fit: GyroFit, *, last: bool) -> Evidence:
        """Return what both sensors show beside the images."""
        force: ForceFit | None = None
        early: ForceFit | None = None
        if size.unit is not None:
            early = self._fit_force(record, gyro_fit)
        if early is not None and early.window_s == WINDOW_S:
            self.axes_compared = True
            if early.windows >= MIN_WINDOWS:
                force = early
        return Evidence(
            R_cam0_imu=self._T[:3, :3],
            gyro_fit=gyro_fit,
            record=record,
            force=force,
            early_force=early,
            # The accelerometer decides whether gyro or extrinsics are at fault: wait for it.
            force_final=force is not None
            or size.unit is None
            or last
            or gyro_fit.count >= _EVALUATIONS.enough_intervals,
            clipped=self._is_clipped,
            last=last,
            turn=self._turn(gyro_fit),
        )

    def _fit_force(self, record: Record, gyro_fit: GyroFit) -> ForceFit | None:
        """The accelerometer beside the images, over shorter windows where there are no two of the
        usual length, and the gyro shows that the given rotation is right.
        """
        lever_arm = self._T[:3, 3]
        long = fit_force(record, gyro_fit, lever_arm)
        if long is not None or not gyro_fit.fits(self._T[:3, :3]):
            return long
        return fit_force(record, gyro_fit, lever_arm, SHORT_WINDOW_S)

    @property
    def _is_clipped(self) -> bool:
        """Whether readings were at the end of the range."""
        return self.clipped or "saturation" in self._reported

    def _turn(self, gyro_fit: GyroFit) -> Turn | None:
        """The turn of the IMU against its calibration; none where the filter estimates it."""
        if not self._turns:
            return None
        return judge_turn(gyro_fit, self._T[:3, :3], clipped=self._is_clipped)

    def _judge_stationary(self, size: Size, record: Record, *, last: bool) -> list[InertialFinding]:
        """Judge without rotation: the magnitude of the readings and, at the end, the direction
        of gravity.
        """
        if self._seen >= _EVALUATIONS.enough_intervals:
            self.rotation_comparison = self.rotation_comparison or ROTATION_NOT_COMPARABLE
            self.axes_compared = True
        found = [] if size.finding is None else [size.finding]
        means, covered = record.means(np.zeros(1))
        if (
            last
            and size.unit is not None
            and int(covered.sum()) >= _EVALUATIONS.min_intervals_at_end
        ):
            from vio.monitor.accelerometer import judge_up

            found += judge_up(means[0, covered[0], 3:], self._T[:3, :3], measured=False)
        return found

    def _judge_rotating(
        self, evidence: Evidence, size: Size, record: Record, rates: Rates
    ) -> list[InertialFinding]:
        """Judge with rotation, and decide whether the comparison may end."""
        from vio.monitor.accelerometer import resolve_size
        from vio.monitor.gyro import backwards, judge_gyro

        gyro_fit = evidence.gyro_fit
        size = resolve_size(size, evidence)
        rotation = judge_gyro(evidence, size.unit or 1.0)
        offset = judge_offset(gyro_fit, record, _EVALUATIONS.min_intervals_at_end)
        if (rotation or offset) and fits_backwards(
            record, _EVALUATIONS.min_intervals_at_end, evidence.R_cam0_imu
        ):
            rotation = [backwards(gyro_fit)]
            offset = None
        found = [f for f in (size.finding, offset, judge_stamps(record)) if f is not None]
        found += rotation or self._compare_rotations(record, gyro_fit)
        forces, measured = self._judge_force(evidence, size, rotation)
        found += forces
        # which of gyro and extrinsics is at fault may be open yet
        self._doubt_if([*found, *judge_gyro(replace(evidence, force_final=True), size.unit or 1.0)])
        self.imu_at_fault |= _shows_fault(found, evidence)
        force_is_settled = measured or size.unit is None or bool(rotation)
        enough = force_is_settled and _has_enough_rotation(gyro_fit)
        if measured and not found:
            found = self._judge_lever_arm(evidence, record, rates, enough=enough)
        self.done = enough and all(f.fault in self._suspected for f in found)
        return found

    def _judge_force(
        self, evidence: Evidence, size: Size, rotation: Sequence[InertialFinding]
    ) -> tuple[list[InertialFinding], bool]:
        """Judge the accelerometer where the gyro's axes are known; return also whether it could be
        measured.
        """
        from vio.monitor.accelerometer import judge_force

        axes_known = all(f.fault == "gyro units" for f in rotation)
        if size.unit is None or not evidence.gyro_agrees or not axes_known:
            return [], False
        return judge_force(evidence, size.unit, self._stereo)

    def _judge_lever_arm(
        self, evidence: Evidence, record: Record, rates: Rates, *, enough: bool
    ) -> list[InertialFinding]:
        """Judge the IMU's place on the camera at the end, for which one evaluation suffices."""
        from vio.monitor.accelerometer import judge_lever_arm

        if not (evidence.last or enough):
            return []
        found = judge_lever_arm(record, evidence.gyro_fit, self._T, rates)
        if not evidence.last:
            self._suspected |= {f.fault for f in found}
        return found

    def _compare_first_rotations(self) -> None:
        """Find before the first evaluation that rotations agree, for which the filter waits; to
        differ takes more.
        """
        times_ns, values = self._samples.table()
        motion = self._motion.joined()
        if len(times_ns) < 2 or motion is None:
            return
        self.imu_at_fault = (
            judge_size(times_ns, values[:, 3:], self._gravity_mps2).finding is not None
        )
        record = record_of(motion, times_ns, values)
        gyro_fit = fit_gyro(record, _EVALUATIONS.min_intervals_at_end)
        if gyro_fit is None:
            turns = None
        else:
            turns = compare_rotations(record, gyro_fit, self._T[:3, :3])
        if gyro_fit is None or turns is None:
            return
        offset = judge_offset(gyro_fit, record, _EVALUATIONS.min_intervals_at_end)
        if offset is not None and offset.is_disabling:
            self._doubt_if([offset])
            return
        if np.isfinite(turns.sigma) and turns.agree:
            self.rotation_comparison = turns
            self._fault = ""
            return
        from vio.monitor.gyro import judge_gyro

        evidence = Evidence(
            R_cam0_imu=self._T[:3, :3],
            gyro_fit=gyro_fit,
            record=record,
            force=None,
            early_force=None,
            force_final=True,  # what axes and unit are at fault is not asked yet
            clipped=self._is_clipped,
            last=False,
            turn=self._turn(gyro_fit),
        )
        self._doubt_if(judge_gyro(evidence, 1.0))

    def _compare_rotations(self, record: Record, gyro_fit: GyroFit) -> list[InertialFinding]:
        """Compare the camera's rotation with the gyro's until they differ beyond doubt."""
        known = self.rotation_comparison
        if known is not None and known.differ and known.gyro_agrees:
            return judge_rotations(known, self._stereo)
        self.rotation_comparison = compare_rotations(record, gyro_fit, self._T[:3, :3])
        return judge_rotations(self.rotation_comparison, self._stereo)

    def _unreported(self, found: Sequence[InertialFinding]) -> tuple[InertialFinding, ...]:
        """Return the findings of groups that were not reported before."""
        out = []
        for finding in found:
            if finding.group not in self._reported:
                self._reported.add(finding.group)
                out.append(finding)
                if finding.is_disabling:
                    self._odd_size = self._fault = ""
        return tuple(out)


def _has_enough_rotation(gyro_fit: GyroFit) -> bool:
    return gyro_fit.count >= _EVALUATIONS.enough_intervals and gyro_fit.axes == 3


def _shows_fault(found: Sequence[InertialFinding], evidence: Evidence) -> bool:
    """Whether the IMU is at fault, whatever turns out to be the cause."""
    if any(f.certain and f.fault != "camera stamps" for f in found):
        return True
    return evidence.gyro_agrees and not evidence.gyro_fit.fits(evidence.R_cam0_imu)
