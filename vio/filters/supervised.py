"""A sliding-window filter with an IMU over its whole life: images stand in for an IMU that begins
late, and a filter whose state has become impossible is begun anew. One world for all of them.

Each filter has a world of its own: that of images alone is the first frame's, one with an IMU is
upright. A fixed transform takes the poses of the present filter into the world that is reported,
and its uncertainty is that of the pose at the handover.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vio.errors import EstimationError
from vio.filters.msckf import Msckf
from vio.filters.restart import held_covariance
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import (
    FloatArray,
    se3_adjoint,
    se3_from_parts,
    se3_inverse,
    so3_exp,
)
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.geometry.upright import nearest_yaw
from vio.imu.settings import DEFAULT_IMU, ImuSettings
from vio.imu.standstill import STANDSTILL_S
from vio.protocols import Backend
from vio.records import (
    NS_PER_S,
    Estimate,
    ImuSample,
    Initialisation,
    Landmarks,
    MotionSample,
    Observations,
    Prediction,
    RotationComparison,
    UpdateReport,
    no_landmarks,
)

_DOWN = np.array([0.0, 0.0, -1.0])
# What a filter that is begun anew is given first: enough for its start, and for a window after it.
_RECENT_NS = round((STANDSTILL_S + 1.0) * NS_PER_S)


@dataclass(frozen=True, slots=True)
class _Handover:
    """How the world of the present filter lies in the reported one."""

    frame_index: int
    pose: Estimate  # at that frame, in the reported world
    T_own: FloatArray  # (4, 4) the same pose in the filter's own world
    T_reported_own: FloatArray  # (4, 4)
    is_upright: bool  # whether the reported world is
    follows: bool  # as long as the filter corrects its pose at that frame, the transform follows

    def estimate(self, own: Estimate, gravity_mps2: float) -> Estimate:
        """Return an estimate in the reported world, with the uncertainty of the handover's pose.

        `T_imu_reported = T_imu_own T_own_reported`, so an error of the pose at the handover, of
        which `T_own_reported` is made, moves a later pose by the adjoint of the motion since.
        """
        A = se3_adjoint(se3_inverse(own.T_world_imu) @ self.T_own)
        R = self.T_reported_own[:3, :3]
        gravity = own.gravity_world
        if gravity is None and not self.is_upright:
            gravity = _DOWN * gravity_mps2
        velocity_world = None
        if own.velocity_world is not None:
            velocity_world = R @ own.velocity_world
        velocity_covariance = None
        if own.velocity_covariance is not None:
            velocity_covariance = R @ own.velocity_covariance @ R.T
        gravity_world = None
        if gravity is not None:
            gravity_world = R @ gravity
        tilt_sigma_rad = None
        if self.is_upright:
            tilt_sigma_rad = own.tilt_sigma_rad
        return replace(
            own,
            T_world_imu=self.T_reported_own @ own.T_world_imu,
            covariance=own.covariance + A @ self.pose.covariance @ A.T,
            velocity_world=velocity_world,
            velocity_covariance=velocity_covariance,
            gravity_world=gravity_world,
            tilt_sigma_rad=tilt_sigma_rad,
        )

    def points(self, own: Landmarks) -> Landmarks:
        """Return points in the reported world."""
        T = self.T_reported_own
        R = T[:3, :3]
        # Point by point: the rounding of a matrix product depends on how many points were taken at
        # once.
        p_world = np.einsum("ij,nj->ni", R, own.p_world) + T[:3, 3]
        return Landmarks(own.ids, p_world, R @ own.covariance @ R.T)


class SupervisedMsckf(Backend):
    """A sliding-window filter with an IMU and two cameras, or depth images."""

    motion_sources = Msckf.motion_sources

    def __init__(
        self,
        camera: StereoCamera,
        T_cam0_imu: FloatArray,
        settings: MsckfSettings,
        imu: ImuSettings = DEFAULT_IMU,
    ) -> None:
        """Prepare; the arguments are those of `Msckf`."""
        self._given = (camera, T_cam0_imu, settings)
        self._imu = imu
        self._filter = self._new()
        self._stand_in: Msckf | None = None  # images alone, until the first sample
        self._handover: _Handover | None = None
        self._earlier: Landmarks | None = None  # of the filters before, in the reported world
        self._recent: list[MotionSample | Observations] = []
        self._rotation: RotationComparison | None = None

    def _new(self) -> Msckf:
        camera, T_cam0_imu, settings = self._given
        return Msckf(camera, T_cam0_imu, settings, motion="imu", imu=self._imu)

    def _without_imu(self) -> Msckf:
        camera, T_cam0_imu, settings = self._given
        without = replace(settings, calibrate_camera_imu="none", calibrate_imu="off")
        return Msckf(camera, T_cam0_imu, without, motion=None, imu=self._imu)

    @property
    def _active(self) -> Msckf:
        """The filter whose estimates are reported."""
        return self._filter if self._stand_in is None else self._stand_in

    def propagate(self, sample: MotionSample) -> None:
        """Take a motion sample, see `Msckf`."""
        self.propagate_all([sample])

    def propagate_all(self, samples: Sequence[MotionSample]) -> None:
        """Take motion samples, see `Msckf`."""
        self._filter.propagate_all(samples)
        self._recent += samples

    def update(self, observations: Observations) -> UpdateReport:
        """Propagate to the time of the frame and update with its observations, see `Msckf`."""
        self._keep(observations)
        if not self._filter.can_begin:
            if self._stand_in is None:
                self._stand_in = self._without_imu()
            return self._stand_in.update(observations)
        report = self._filter.update(observations)
        stand_in = self._stand_in
        if stand_in is not None:
            report = stand_in.update(observations)
            pose = stand_in.estimate()
            self._earlier = stand_in.landmarks()
            self._stand_in = None
            self._handover = _Handover(
                observations.frame_index, pose, np.eye(4), np.eye(4), False, True
            )
        self._follow()
        return report

    def _keep(self, observations: Observations) -> None:
        """Keep what a filter that is begun anew would be given."""
        recent = self._recent
        recent.append(observations)
        since_ns = observations.time_ns - _RECENT_NS
        old = 0
        for event in recent:
            if event.time_ns >= since_ns:
                break
            old += 1
        del recent[:old]

    def _follow(self) -> None:
        """Keep the pose at the handover that of the images alone, while the filter still corrects
        its own: the first tilt is uncertain.
        """
        handover = self._handover
        if handover is None or not handover.follows:
            return
        own = self._filter.smoothed(handover.frame_index)
        if own is not None:
            T_reported_own = handover.pose.T_world_imu @ se3_inverse(own.T_world_imu)
            self._handover = replace(handover, T_own=own.T_world_imu, T_reported_own=T_reported_own)

    def restart(self, observations: Observations) -> UpdateReport:
        """Start again at a frame after a divergence, see `Msckf`."""
        return self._active.restart(observations)

    def begin_anew(self, good: Estimate) -> Estimate | None:
        """Replace a filter whose state has become impossible by a new one, see `Backend`.

        The new filter takes the samples and frames of the last seconds, so it has a window already.
        Its tilt is the accelerometer's; position, yaw and the clocks' offset are those of `good`,
        the former with the uncertainty of what the rig may have done since.
        """
        if self._stand_in is not None:
            return None
        new = self._new()
        if good.time_offset_s is not None:
            new.begin_with_offset(good.time_offset_s)
        frame = self._give_recent(new)
        if frame is None:
            return None
        new.take_rotation_comparison(self._rotation)
        self._earlier = self.landmarks()
        self._handover = self._placed(good, new.estimate(), frame)
        self._filter = new
        return self.estimate()

    def _give_recent(self, new: Msckf) -> int | None:
        """Give a filter the last seconds; return the number of the newest frame.

        None: it did not begin, or diverged.
        """
        begin_ns = self._recent[0].time_ns + round(STANDSTILL_S * NS_PER_S)
        frame = None
        try:
            for event in self._recent:
                if isinstance(event, ImuSample):
                    new.propagate(event)
                elif isinstance(event, Observations) and event.time_ns >= begin_ns:
                    if not new.can_begin:
                        return None
                    new.update(event)
                    frame = event.frame_index
        except EstimationError:
            return None
        return frame

    def _placed(self, good: Estimate, own: Estimate, frame: int) -> _Handover:
        """Place a new filter's world, upright as it is, where the last good pose is."""
        if self._handover is None:
            before = np.eye(3)
        else:
            before = self._handover.T_reported_own[:3, :3]
        upright = self._handover is None or self._handover.is_upright
        R_good = before.T @ good.T_world_imu[:3, :3]
        yaw = so3_exp([0.0, 0.0, nearest_yaw(R_good @ own.T_world_imu[:3, :3].T)])
        R = before @ yaw
        T_reported_own = se3_from_parts(R, good.T_world_imu[:3, 3] - R @ own.T_world_imu[:3, 3])
        pose = replace(own, T_world_imu=T_reported_own @ own.T_world_imu)
        pose = replace(pose, covariance=held_covariance(good, pose, before @ -_DOWN))
        return _Handover(frame, pose, own.T_world_imu, T_reported_own, upright, False)

    def take_rotation_comparison(self, comparison: RotationComparison | None) -> None:
        """Take how the camera's rotation compares with the gyro's, see `Msckf`."""
        self._rotation = comparison
        self._filter.take_rotation_comparison(comparison)

    @property
    def initialisation(self) -> Initialisation:
        """How the state was initialised."""
        return self._active.initialisation

    @property
    def window_frames(self) -> int:
        """Number of past frames in the window."""
        return self._filter.window_frames

    def predict(self, time_ns: int) -> Prediction | None:
        """Predict a coming frame, see `Msckf`."""
        return self._active.predict(time_ns)

    def estimate(self) -> Estimate:
        """Return the estimate at the time of the last event, in the world of the first frame."""
        return self._reported(self._active.estimate())

    def _reported(self, estimate: Estimate) -> Estimate:
        if self._stand_in is not None or self._handover is None:
            return estimate
        return self._handover.estimate(estimate, self._imu.gravity_mps2)

    def smoothed(self, frame_index: int) -> Estimate | None:
        """Return the estimate at a past frame with all frames since.

        None where it has left the window.
        """
        own = self._active.smoothed(frame_index)
        return None if own is None else self._reported(own)

    def relative(self, older: int, newer: int) -> RelativePose | None:
        """Return the body's motion between two frames of the window, see `Msckf`."""
        return self._active.relative(older, newer)

    def landmarks(self) -> Landmarks:
        """Return the points of all tracks that fix their depth, see `Msckf`."""
        own = self._active.landmarks()
        if self._stand_in is not None:
            return own
        earlier = self._earlier
        if self._handover is None or earlier is None:
            return own
        own = self._handover.points(own)
        other = ~np.isin(earlier.ids, own.ids)
        return _joined(
            Landmarks(earlier.ids[other], earlier.p_world[other], earlier.covariance[other]),
            own,
        )

    def take_landmarks(self) -> Landmarks:
        """Return the points that have left the state since the last call, and forget them, see
        `Msckf`.

        None while images stand in for the IMU, or the transform between the two worlds still
        changes.
        """
        handover = self._handover
        if self._stand_in is not None:
            return no_landmarks()
        if handover is None:
            return self._filter.take_landmarks()
        if handover.follows and self._filter.smoothed(handover.frame_index) is not None:
            return no_landmarks()
        own = self._filter.take_landmarks()
        earlier = self._earlier
        self._earlier = no_landmarks()
        own = handover.points(own)
        return own if earlier is None else _joined(earlier, own)


def _joined(a: Landmarks, b: Landmarks) -> Landmarks:
    return Landmarks(
        np.concatenate([a.ids, b.ids]),
        np.concatenate([a.p_world, b.p_world]),
        np.concatenate([a.covariance, b.covariance]),
    )
