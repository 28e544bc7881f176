"""What the updates of a back end show, frame after frame, beside the features that it was given."""

from __future__ import annotations

from collections.abc import Iterator

from vio.dataclass import dataclass
from vio.findings import Finding
from vio.geometry.stereo import StereoCamera
from vio.monitor.calibration_drift import CalibrationDrift
from vio.monitor.contradiction import ImuContradiction
from vio.monitor.few_features import FewFeatures
from vio.monitor.frame_order import FrameOrder
from vio.monitor.health import RefusalReport, RunHealth
from vio.monitor.image_geometry import ImageGeometry
from vio.monitor.misfit import TrackMisfit
from vio.monitor.view_change import ViewChange
from vio.records import Estimate, Observations, UpdateReport


@dataclass(frozen=True, slots=True)
class UpdatedFrame:
    """A frame after its update."""

    seen: Observations | None  # None: as the back end was given none
    report: UpdateReport
    estimate: Estimate
    restarted: str = ""  # why the back end was started again in it; empty: it was not


class UpdateChecks:
    """Everything that is judged by updates, and begins anew where frames are estimated again."""

    def __init__(self, camera: StereoCamera, *, imu: bool, selects: bool = False) -> None:
        """Begin; `imu`: raw samples propagate the pose; `selects`: the back end is given few of the
        features on purpose.
        """
        from vio.guard.two_motions import TwoMotions  # loads OpenCV

        self._camera = camera
        self.health = RunHealth()
        self.refusals = RefusalReport(imu=imu)
        # of one camera, the scale is the IMU's own
        self.contradiction = ImuContradiction() if imu and camera.kind != "mono" else None
        self._views = ViewChange()
        self._order = FrameOrder()
        self._geometry = ImageGeometry(camera)
        self._misfit = TrackMisfit()
        self.calibration = CalibrationDrift(camera)
        self._few = None if selects else FewFeatures()
        self._motions = TwoMotions(camera)

    def anew(self, *, imu: bool) -> UpdateChecks:
        """Return what judges updates from the first frame on again; `imu`: it is used."""
        imu_read = self.contradiction is not None
        fresh = UpdateChecks(self._camera, imu=imu_read, selects=self._few is None)
        fresh.refusals.imu = imu
        fresh.health.begin_again(self.health)
        return fresh

    def restarted(self, index: int, why: str, estimate: Estimate) -> tuple[Finding, ...]:
        """Return the findings on a filter that diverged in a frame and was started again."""
        self.calibration.begin_anew()
        return self.health.restarted(index, why, estimate)

    def frame(self, index: int, frame: UpdatedFrame, *, measured: bool) -> Iterator[Finding]:
        """Yield the findings of a frame; `measured`: whether a motion sensor carries the pose."""
        report = frame.report
        ratio = report.innovation_ratio
        if frame.restarted:
            yield from self.restarted(index, frame.restarted, frame.estimate)
        yield from self.health.frame(index, report, frame.estimate)
        position = frame.estimate.T_world_imu[:3, 3]
        yield from self._order.frame(index, position, ratio if measured else None)
        if self.contradiction is not None and self.refusals.imu:
            yield from self.contradiction.frame(index, ratio)
        if self._few is not None:
            yield from self._few.frame(index, report, measured=measured)
        seen = frame.seen
        if seen is None:
            return
        imu = self.refusals.imu
        if self.contradiction is not None:
            imu = imu and not self.contradiction.stands
        yield from self._views.frame(seen, ratio, measured=measured, imu=imu)
        yield from self._geometry.frame(seen, ratio)
        yield from self.refusals.frame(seen, report, frame.estimate)
        misfit = None if measured else report.misfit
        yield from self._misfit.frame(seen, misfit, self._motions.frame(seen))
