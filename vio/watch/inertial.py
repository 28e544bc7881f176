"""Watch a run's IMU for what makes it useless: units, signs, axes, extrinsics, clocks, clipping, silence.

The camera's motion comes from the stereo tracks of consecutive frames, the gyro and the accelerometer are fitted to it
by *general* linear maps, and every named explanation (the given extrinsics, their inverse, a permutation of axes,
degrees, g, …) is then judged by how much worse it fits than the general map. A fault is named only where the given
calibration fails clearly and the explanation does not; equations (I1) to (I4) stand in docs/inertial.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vio.calibration.inertial import Rates
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import ImuSample, Observations
from vio.watch.accelerometer import judge_force, judge_lever, judge_up, settle_size
from vio.watch.clocks import Coverage
from vio.watch.evidence import FIRST_LOOK, Evidence
from vio.watch.finding import InertialFault, InertialFinding
from vio.watch.force import fit_force
from vio.watch.gyro import judge_gyro
from vio.watch.motion import BATCH, CameraTwists, RecentMotion, Record, record_of
from vio.watch.samples import Samples, Size, judge_size
from vio.watch.turning import AGREES, fit_turning, judge_offset

_LEAST_AT_END = 20  # intervals for a verdict when the run ends
_LATER_LOOKS = 150  # intervals between two looks when there are enough; before, as many as before the first
_ENOUGH = 400  # intervals of turning about all axes after which the watch ends
_NS = 1e-9


class InertialCheck:
    """Watches a run with raw IMU without touching it, and says once what is wrong.

    Give it every sample and every frame's observations in time order, log what `frame` and `finish` return. It stops
    comparing motions once it has seen enough turning about all axes; silences and clipping are watched to the end.
    """

    def __init__(self, camera: StereoCamera, T_cam0_imu: FloatArray) -> None:
        """Prepare.

        Args:
            camera: rectified pair that the observations belong to.
            T_cam0_imu: (4, 4) as the run uses it.
        """
        self._stereo, self._T = camera, np.array(T_cam0_imu, dtype=np.float64)
        self._said: set[str] = set()
        self._samples = Samples()
        self._coverage = Coverage()
        self._frames = 0
        self.again()

    @property
    def done(self) -> bool:
        """Whether the comparison of motions has ended; `again` starts it anew."""
        return self._done

    def again(self) -> None:
        """Compare motions anew from here on; what was said before is not said twice."""
        self._camera, self._motion = CameraTwists(self._stereo), RecentMotion()
        self._since_look = self._seen = 0
        self._suspected: set[InertialFault] = set()
        self._done = False

    def imu(self, sample: ImuSample) -> None:
        """Take one sample."""
        self._samples.take(sample)

    def frame(self, observations: Observations) -> tuple[InertialFinding, ...]:
        """Take the observations of one frame, and return what has become clear with it."""
        self._frames += 1
        self._coverage.frame(observations.time_ns, self._samples.last_ns)
        found = self._coverage.so_far(self._samples.span_ns, self._samples.step_s / _NS)
        if not self._done:
            found += self._compare(observations)
        elif self._frames % BATCH == 0:
            found += self._samples.settle(keep=False)
        return self._fresh(found)

    def finish(self) -> tuple[InertialFinding, ...]:
        """Return what the end of the run makes clear; call it also when the run fails."""
        found = self._coverage.at_end(self._samples.span_ns, self._samples.step_s / _NS)
        found += self._samples.settle(keep=not self._done)
        if not self._done:
            motion = self._camera.flush()
            if motion is not None:
                self._motion.add(motion)
            found += self._judge(last=True)
        return self._fresh(found)

    def _compare(self, observations: Observations) -> list[InertialFinding]:
        """Take a frame's features, and have a look when enough motion has come together.

        Before the end of a run, a fault must be found at two looks in a row.
        """
        motion = self._camera.frame(observations)
        if motion is None:
            return []
        found = self._samples.settle(keep=True)
        self._motion.add(motion)
        self._since_look += len(motion)
        self._seen += len(motion)
        if self._since_look < (FIRST_LOOK if self._seen < _ENOUGH else _LATER_LOOKS):
            return found
        self._since_look = 0
        judged = self._judge(last=False)
        found += [f for f in judged if f.fault in self._suspected]
        self._suspected = {f.fault for f in judged}
        return found

    def _judge(self, *, last: bool) -> list[InertialFinding]:
        """Judge what is remembered."""
        times_ns, values = self._samples.table()
        if len(times_ns) < 2:
            return []
        size = judge_size(times_ns, values[:, 3:])
        motion = self._motion.joined()
        if motion is None:
            return [] if size.finding is None else [size.finding]
        record = record_of(motion, times_ns, values)
        turning = fit_turning(record, _LEAST_AT_END)
        if turning is None:
            return self._judge_at_rest(size, record, last=last)
        force = None if size.unit is None else fit_force(record, turning, self._T[:3, 3])
        evidence = Evidence(
            R_cam0_imu=self._T[:3, :3],
            turning=turning,
            force=force,
            # Which of gyro and extrinsics is at fault, the accelerometer tells: wait for it.
            told=force is not None or size.unit is None or last or turning.count >= _ENOUGH,
            clipped="saturation" in self._said,
            last=last,
        )
        rates = Rates(times_ns, values[:, :3], values[:, 3:], True)
        return self._judge_turning(evidence, size, record, rates)

    def _judge_at_rest(self, size: Size, record: Record, *, last: bool) -> list[InertialFinding]:
        """Judge a camera that does not turn: the size of the readings and, at the end, which way is up."""
        found = [] if size.finding is None else [size.finding]
        means, covered = record.means(np.zeros(1))
        if last and size.unit is not None and int(covered.sum()) >= _LEAST_AT_END:
            found += judge_up(means[0, covered[0], 3:], self._T[:3, :3], measured=False)
        return found

    def _judge_turning(self, evidence: Evidence, size: Size, record: Record, rates: Rates) -> list[InertialFinding]:
        """Judge a camera that turns, and decide whether the watch may end."""
        turning, last = evidence.turning, evidence.last
        size = settle_size(size, evidence)
        offset = judge_offset(turning, record, _LEAST_AT_END)
        found = [f for f in (size.finding, offset) if f is not None]
        rotation = judge_gyro(evidence, size.unit or 1.0)
        found += rotation
        agrees, measured = turning.unexplained < AGREES, False
        if size.unit is not None and agrees and all(f.fault == "gyro units" for f in rotation):
            forces, measured = judge_force(evidence, size.unit)
            found += forces
        enough = turning.count >= _ENOUGH and turning.axes == 3 and (measured or size.unit is None or bool(rotation))
        if not found and (last or enough) and agrees and measured:
            found = judge_lever(record, turning, self._T, rates)
            if not last:
                self._suspected |= {f.fault for f in found}  # so late, one look must do
        self._done = enough and all(f.fault in self._suspected for f in found)
        return found

    def _fresh(self, found: Sequence[InertialFinding]) -> tuple[InertialFinding, ...]:
        """Leave out what was said before, by itself or in other words."""
        out = []
        for finding in found:
            if finding.group not in self._said:
                self._said.add(finding.group)
                out.append(finding)
        return tuple(out)
