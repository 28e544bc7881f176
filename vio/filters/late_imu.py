"""The sliding-window filter for an IMU that begins after the first frames: images alone until then.

The world is that of the first frame then, as gravity was not known: the filter with the IMU, whose
own world is upright, starts at the first frame with a sample, and a fixed transform takes its poses
into the first world. While that frame is in its window, the transform follows the corrections of
its pose, as the first tilt is uncertain.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vio.filters.msckf import Msckf
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import FloatArray, se3_adjoint, se3_inverse
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.records import Estimate, Landmarks, Observations, Prediction, UpdateReport, no_landmarks

_DOWN = np.array([0.0, 0.0, -1.0])


class LateImuMsckf(Msckf):
    """A sliding-window filter with an IMU, which images alone stand in for until its first
    sample.
    """

    def __init__(
        self, camera: StereoCamera, T_cam0_imu: FloatArray, settings: MsckfSettings
    ) -> None:
        """Prepare; the arguments are those of `Msckf`."""
        super().__init__(camera, T_cam0_imu, settings, motion="imu")
        self._without = (
            camera,
            T_cam0_imu,
            replace(settings, calibrate_camera_imu="none", calibrate_imu="off"),
        )
        self._early: Msckf | None = None  # images alone, until the first sample
        # first frame with the IMU, and its pose by images alone
        self._handover: tuple[int, Estimate] | None = None
        self._T_first_world: FloatArray = np.eye(4)  # the upright world in that of the first frame
        self._T_handover: FloatArray = np.eye(4)  # (4, 4) body at the handover in the upright world
        self._early_landmarks: Landmarks | None = None

    def update(self, observations: Observations) -> UpdateReport:
        """Propagate to the time of the frame and update with its observations, see `Msckf`."""
        if self._window is None and not self._propagation.motion.ready:
            if self._early is None:
                camera, T_cam0_imu, settings = self._without
                self._early = Msckf(camera, T_cam0_imu, settings, motion=None)
            return self._early.update(observations)
        report = super().update(observations)
        if self._early is not None:
            report = self._early.update(observations)
            self._handover = observations.frame_index, self._early.estimate()
            self._early_landmarks = self._early.landmarks()
            self._early = None
        self._follow_handover()
        return report

    def restart(self, observations: Observations) -> UpdateReport:
        """Start again at a frame after a divergence, see `Msckf`."""
        return (
            super().restart(observations)
            if self._early is None
            else self._early.restart(observations)
        )

    def _follow_handover(self) -> None:
        """Keep the pose at the handover that of the images alone, while the filter still
        corrects its own.
        """
        if self._handover is None:
            return
        index, by_images = self._handover
        own = super().smoothed(index)
        if own is not None:
            self._T_first_world = by_images.T_world_imu @ se3_inverse(own.T_world_imu)
            self._T_handover = own.T_world_imu

    def predict(self, time_ns: int) -> Prediction | None:
        """Predict a coming frame, see `Msckf`."""
        return super().predict(time_ns) if self._early is None else self._early.predict(time_ns)

    def estimate(self) -> Estimate:
        """Return the estimate at the time of the last event, in the world of the first frame."""
        return (
            self._in_first_world(super().estimate())
            if self._early is None
            else self._early.estimate()
        )

    def smoothed(self, frame_index: int) -> Estimate | None:
        """Return the estimate at a past frame with all frames since.

        None where it has left the window.
        """
        if self._early is not None:
            return self._early.smoothed(frame_index)
        own = super().smoothed(frame_index)
        return None if own is None else self._in_first_world(own)

    def relative(self, older: int, newer: int) -> RelativePose | None:
        """Return the body's motion between two frames of the window, see `Msckf`."""
        return (
            super().relative(older, newer)
            if self._early is None
            else self._early.relative(older, newer)
        )

    def landmarks(self) -> Landmarks:
        """Return the points of all tracks that fix their depth, see `Msckf`."""
        if self._early is not None:
            return self._early.landmarks()
        own = super().landmarks()
        early = self._early_landmarks
        if early is None:
            return own
        own = self._points_in_first_world(own)
        other = ~np.isin(early.ids, own.ids)
        return Landmarks(
            np.concatenate([early.ids[other], own.ids]),
            np.concatenate([early.p_world[other], own.p_world]),
            np.concatenate([early.covariance[other], own.covariance]),
        )

    def take_landmarks(self) -> Landmarks:
        """Return the points that have left the state since the last call, and forget them, see
        `Msckf`.

        None while images stand in for the IMU, or the transform between the two worlds still
        changes.
        """
        if self._early is not None or (
            self._handover and super().smoothed(self._handover[0]) is not None
        ):
            return no_landmarks()
        own = super().take_landmarks()
        early = self._early_landmarks
        if early is None:
            return own
        self._early_landmarks = no_landmarks()
        own = self._points_in_first_world(own)
        return Landmarks(
            np.concatenate([early.ids, own.ids]),
            np.concatenate([early.p_world, own.p_world]),
            np.concatenate([early.covariance, own.covariance]),
        )

    def _points_in_first_world(self, own: Landmarks) -> Landmarks:
        """Points of the upright world in that of the first frame."""
        R = self._T_first_world[:3, :3]
        # Point by point: the rounding of a matrix product depends on how many points were taken at
        # once.
        T = self._T_first_world
        p_world = np.einsum("ij,nj->ni", T[:3, :3], own.p_world) + T[:3, 3]
        return Landmarks(own.ids, p_world, R @ own.covariance @ R.T)

    def _in_first_world(self, own: Estimate) -> Estimate:
        """An estimate in the world of the first frame, with the uncertainty of the images' path to
        the handover.

        `T_imu_first = T_imu_world T_world_first`, so an error of the pose at the handover, of which
        `T_world_first` is made, moves a later pose by the adjoint of the motion since.
        """
        if self._handover is None:
            return own
        by_images = self._handover[1]
        A = se3_adjoint(se3_inverse(own.T_world_imu) @ self._T_handover)
        R = self._T_first_world[:3, :3]
        return replace(
            own,
            T_world_imu=self._T_first_world @ own.T_world_imu,
            covariance=own.covariance + A @ by_images.covariance @ A.T,
            velocity_world=None if own.velocity_world is None else R @ own.velocity_world,
            velocity_covariance=None
            if own.velocity_covariance is None
            else R @ own.velocity_covariance @ R.T,
            gravity_world=R
            @ (
                _DOWN * self._settings.gravity_mps2
                if own.gravity_world is None
                else own.gravity_world
            ),
            tilt_sigma_rad=None,
        )
