"""The sliding-window filter: right-invariant, multi-state constrained, with long-lived landmarks.

For each frame: propagate (`propagation`); clone the pose; update (`frame_update`). What of the
stereo calibration is estimated, `rig_calibration` decides. The prior is kept in right-invariant
errors, whose unobservable directions (global position and yaw) do not depend on the estimate, so
relinearisation adds no information along them.
References: Mourikis & Roumeliotis (2007); Sun et al. (2018); Wu et al., An invariant-EKF VINS
algorithm for improving consistency (2017); Barrau & Bonnabel (2017).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, TypeAlias

import numpy as np

from vio.errors import ConfigError, DivergedError, EstimationError
from vio.filters.frame_update import FrameUpdate
from vio.filters.imu_terms import IMU_TERMS
from vio.filters.inputs import InputOrder, check_parts, checked_extrinsics
from vio.filters.navigation import (
    DIM,
    ZERO_RATE_SIGMA_RADPS,
    ZERO_VELOCITY_SIGMA_MPS,
    ImuMotion,
    NavState,
)
from vio.filters.noise import MotionNoise
from vio.filters.online_calibration import Calibration, all_imu_terms, first_calibration
from vio.filters.point_map import PointMap
from vio.filters.propagation import Propagation, first_imu_noise
from vio.filters.restart import GoodState, as_good_state, required, restarted
from vio.filters.rig_calibration import RigCalibration
from vio.filters.settings import MsckfSettings
from vio.filters.window import Clone, Window
from vio.geometry.lie import (
    FloatArray,
    length,
    se3_adjoint,
    se3_from_parts,
    se3_inverse,
    so3_exp,
    so3_log,
)
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.geometry.upright import nearest_yaw
from vio.imu.settings import DEFAULT_IMU, ImuSettings
from vio.protocols import Backend
from vio.records import (
    Estimate,
    ImuSample,
    Landmarks,
    MotionSample,
    MotionSource,
    Observations,
    Prediction,
    RotationComparison,
    UpdateReport,
    VelocitySample,
    no_landmarks,
)

_SAMPLES = {"imu": ImuSample, "velocity": VelocitySample}  # of each motion source
# a camera's pose at a frame by the state, the body's, and the covariance of its noise
_Exposure: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
_MAX_SPEED_MPS = 100.0  # with an IMU, whose scale is metric: beyond it the filter has diverged


class Msckf(Backend):
    """The sliding-window filter as a back end."""

    motion_sources: ClassVar[tuple[MotionSource, ...]] = ("imu", "velocity")

    def __init__(
        self,
        camera: StereoCamera,
        T_cam0_imu: FloatArray,
        settings: MsckfSettings,
        *,
        motion: MotionSource | None,
        imu: ImuSettings = DEFAULT_IMU,
    ) -> None:
        """Prepare; the first frame initialises the state.

        Args:
            camera: the rectified stereo camera.
            T_cam0_imu: extrinsics (4, 4).
            settings: the filter's section of the configuration.
            motion: which motion samples will come; None: images alone.
            imu: the IMU's section of the configuration.

        Raises:
            ConfigError: the calibration is to be estimated without an IMU, or an argument is of
                another kind.
            CalibrationError: the extrinsics are no rigid transform.
        """
        check_parts("msckf", camera, settings, MsckfSettings)
        if motion not in (None, *self.motion_sources):
            raise ConfigError(
                f"msckf has no model for motion {motion!r}; give imu, velocity or None"
            )
        if settings.calibrate_camera_imu not in ("auto", "none") and motion != "imu":
            raise ConfigError(
                f"msckf.calibrate_camera_imu: {settings.calibrate_camera_imu} needs --motion imu; "
                "set it to auto or none"
            )
        if settings.calibrate_imu not in ("auto", "off") and motion != "imu":
            raise ConfigError(
                f"msckf.calibrate_imu: {settings.calibrate_imu} needs --motion imu; set it to auto"
            )
        if camera.is_cylinder:  # equation (R4) is a pinhole's
            settings = replace(settings, calibrate_scale="off")
        self._settings = settings
        self._imu = imu
        self._calibration = first_calibration(checked_extrinsics(T_cam0_imu), settings, motion)
        self._order = InputOrder("msckf")
        self._source = motion
        self._window: Window | None = None
        self._rig = RigCalibration(camera, settings)
        self._propagation = Propagation(motion, settings, imu)
        self._points = PointMap()
        self._frame = FrameUpdate(settings, self._rig, self._propagation, self._points)
        self._began_ns = 0
        self._stationary_ns = -(2**62)  # newest frame of the last zero-velocity measurement
        # (3, 3) how the first attitude has been corrected, on the world's side
        self._tilted: FloatArray = np.eye(3)
        self._good: GoodState | None = None  # after the last plausible update

    def propagate(self, sample: MotionSample) -> None:
        """Take a motion sample.

        Raises:
            ConfigError: the sample is not of the kind that was announced.
            DataError: it is out of order or not finite; the filter is unchanged.
        """
        if self._source is None or not isinstance(sample, _SAMPLES[self._source]):
            raise ConfigError(
                f"msckf was built for motion {self._source or 'none'}, got a "
                f"{type(sample).__name__}"
            )
        self._order.sample(sample)
        self._propagation.take(sample)
        if self._source == "velocity" and self._window is not None:
            self._propagation.advance(self._window, sample.time_ns)
            self._measure()

    def propagate_all(self, samples: Sequence[MotionSample]) -> None:
        """Take motion samples, see `propagate`."""
        if self._source == "imu" and self._order.accept_imu(samples):
            self._propagation.take_imu(samples)
        else:  # a velocity moves the state at once, and what is wrong is named by its own sample
            super().propagate_all(samples)

    def begin_with_offset(self, time_offset_s: float) -> None:
        """Take by how much later than its stamp a frame was exposed, on the IMU's clock, before the
        state begins; it stays as uncertain as the settings say.
        """
        self._calibration = replace(self._calibration, time_offset_s=time_offset_s)

    def take_rotation_comparison(self, comparison: RotationComparison | None) -> None:
        """Take how the camera's rotation compares with the gyro's; None: they were not compared
        yet.

        Until they agree, nothing is concluded of the baseline, for which a wrong focal length
        passes.
        """
        self._rig.rotation = comparison

    def predict(self, time_ns: int) -> Prediction | None:
        """Predict a coming frame: the pixels of all tracks with a point, and the camera's
        motion.
        """
        window = self._window
        if window is None or not window.clones or time_ns < self._propagation.time_ns:
            return None
        predicted = self._propagation.predict(window, time_ns)
        return (
            None
            if predicted is None
            else Prediction(self._frame.fit.expected_tracks(window, *predicted), predicted[1])
        )

    def update(self, observations: Observations) -> UpdateReport:
        """Propagate to the time of the frame and update with its observations.

        Raises:
            EstimationError: the motion samples do not cover the step.
            DivergedError: the filter diverged; `restart` goes on from the last good state.
            DataError: the frame is out of order, or its observations are impossible; the filter is
                unchanged.
        """
        reached_ns = None if self._window is None else self._propagation.time_ns
        self._order.frame(observations, reached_ns)
        return self._update(observations)

    def _update(self, observations: Observations) -> UpdateReport:
        seen = observations.take(~observations.stale)
        propagation = self._propagation
        if self._window is None:
            window = self._begin(observations, seen)
        else:
            window = self._advance(self._window, observations, len(seen))
        if window is None:
            return self._wait(observations)
        if window.clones and not len(seen):
            # A frame that shows nothing ends no track; what is seen next decides.
            propagation.blind = True
            _check_sane(window, propagation.reported.own, self._source, observations.frame_index)
            return UpdateReport(0, 0, 0, len(window.landmarks), None, None)
        propagation.blind = False
        now = (window.nav, propagation.since_frame)
        late_s = propagation.late_s
        exposure, expected = propagation.exposure(window, *now, late_s)
        if "time_offset" in window.state.blocks and not window.clocks_compared:
            exposure = self._compare_clocks(window, observations.time_ns, exposure)
        window.add_clone(observations.frame_index, observations.time_ns, exposure)
        self._keep_first_attitude(window)
        # the oldest that stays
        before = window.clones[int(len(window.clones) > self._settings.clones)]
        try:
            report = self._frame.update(window, seen, expected)
            self._apply_zero_velocity(window)
            self._keep_first_yaw(window, before)
        except np.linalg.LinAlgError as error:
            raise DivergedError(_lost(observations.frame_index)) from error
        _check_sane(window, propagation.reported.own, self._source, observations.frame_index)
        if report.used >= report.gated:
            self._good = GoodState(
                observations.frame_index,
                propagation.time_ns,
                window.nav,
                propagation.posterior.own,
                window.calibration,
            )
        return report

    def _begin(self, observations: Observations, seen: Observations) -> Window | None:
        """Begin the state at a frame; None: the frame passes."""
        start = self._start_state(seen)
        if start is None:
            return None
        propagation = self._propagation
        nav, P = start
        if self._source == "imu":
            propagation.noise = self._first_noise(P)
        window = self._window = self._first_window(nav, P, self._calibration)
        state = window.state
        if "imu_terms" in state.blocks and isinstance(propagation.motion, ImuMotion):
            to_tilt = np.eye(state.size)
            to_tilt[3:6, state.blocks["imu_terms"]] = propagation.motion.tilt_D_terms(nav)  # (A4)
            window.prior.transform(to_tilt)
        self._began_ns = observations.time_ns  # one camera begins anew after a divergence
        self._tilted = np.eye(3)
        propagation.begin(window, observations.time_ns, observations.time_ns)
        self._measure()
        return window

    def _advance(self, window: Window, observations: Observations, seen: int) -> Window:
        """Propagate to a frame, which shows so many features."""
        propagation = self._propagation
        if seen and propagation.is_lost and self._good is not None:
            unseen_s = (observations.time_ns - self._good.time_ns) * 1e-9
            raise DivergedError(
                f"msckf has lost its way in {unseen_s:.1f} s without a feature or a motion sensor"
            )
        propagation.advance(window, observations.time_ns)
        return window

    def _compare_clocks(self, window: Window, time_ns: int, exposure: _Exposure) -> _Exposure:
        """Compare the clocks of camera and IMU at a frame; return its camera's Jacobian by the
        state, then.
        """
        # Half a window gives the velocity: before, its product with the offset's error would pass
        # for knowledge of it.
        if len(window.clones) < self._settings.clones // 2:
            return exposure
        propagation = self._propagation
        late_s = propagation.late_s
        twist = propagation.twist(window, window.nav, propagation.since_frame)
        window.compare_clocks(time_ns, late_s, twist)
        return window.camera_D_own(late_s, twist)

    @property
    def can_begin(self) -> bool:
        """Whether a frame begins the state, or it has begun."""
        return self._window is not None or self._propagation.motion.ready

    def _start_state(self, seen: Observations) -> tuple[NavState, FloatArray] | None:
        """The navigation state at the first frame and its covariance (15, 15).

        None: the frame passes.
        """
        motion = self._propagation.motion
        return motion.start(seen.time_ns) if motion.ready else None

    def _first_noise(self, P: FloatArray) -> MotionNoise:
        """The IMU's noise at a start whose navigation state has the covariance P (15, 15)."""
        return first_imu_noise(P)

    def restart(self, observations: Observations) -> UpdateReport:
        """Start again at a frame after a divergence, from the state after the last good update.

        The pose is carried on with an inflated covariance, velocity and biases are uncertain as at
        the start, and the window is emptied; the map's points stay, and so does what is known of
        the calibration.

        Args:
            observations: of the frame at which `update` failed, or of a later one.

        Raises:
            EstimationError: there was no good update.
            DivergedError: the filter diverges again at once.
        """
        self._go_on_from(required(self._good), observations.time_ns)
        return self._update(observations)

    def begin_anew(self, good: Estimate) -> Estimate | None:
        """Go on from the last estimate that could be used, as `restart` does; velocity samples, if
        any, come anyway, and with images alone there is nothing else to begin by.
        """
        if self._good is None:
            return None
        self._good = as_good_state(self._good, good)
        self._go_on_from(self._good, self._propagation.time_ns)
        return self.estimate()

    def _go_on_from(self, good: GoodState, time_ns: int) -> None:
        """Empty the window at the time of a frame, to which a good state is carried."""
        propagation = self._propagation
        nav, P = restarted(good, time_ns, propagation.motion)
        window = self._window = self._first_window(nav, P, good.calibration)
        propagation.begin(window, time_ns, propagation.body_time(window, time_ns))
        self._forget_tracks(good)

    def _forget_tracks(self, good: GoodState) -> None:
        """Forget all tracks and the motion's noise; go on with the calibration of the last good
        state.
        """
        self._calibration = good.calibration
        self._frame.forget()
        self._propagation.noise = self._propagation.unknown_noise()
        self._points.drop_broken()

    def _first_window(self, nav: NavState, P: FloatArray, calibration: Calibration) -> Window:
        """A window without clones; P (15, 15) is the covariance of the navigation state."""
        own = self._rig.first_covariance(calibration, nav.T_world_imu)
        of_nav = len(P)
        covariance = np.zeros((of_nav + len(own), of_nav + len(own)))
        covariance[:of_nav, :of_nav] = P
        covariance[of_nav:, of_nav:] = own
        window = Window(self._propagation.motion, nav, covariance, calibration)
        if self._window is None:
            before = None
        else:
            before = self._window.prior.scale_test
        self._rig.test_scale(window, self._source, before)
        return window

    def estimate(self) -> Estimate:
        """Return the estimate at the time of the last event."""
        window = self._window
        propagation = self._propagation
        if window is None:
            return Estimate(propagation.time_ns, np.eye(4), np.eye(6))
        own = propagation.own_covariance(window)
        motion = propagation.motion
        T, covariance = propagation.exposed(window, own)
        # exp(xi) T_hat on the world's side is T_hat exp(Ad(T_hat^-1) xi); the inverse pose's error
        # is its negative.
        A = se3_adjoint(se3_inverse(T))
        M = window.state.own_identity[:DIM].copy()
        M[:6] = window.since_first(M[:6])
        known = motion.uncertainty(window.nav, M @ own @ M.T)
        R = window.calibration.R_upright_world.T
        return Estimate(
            propagation.time_ns,
            se3_from_parts(R, np.zeros(3)) @ T,
            A @ covariance @ A.T,
            velocity_world=R @ motion.velocity_world(window.nav),
            velocity_covariance=R @ known.velocity_covariance @ R.T,
            gyro_bias=window.nav.gyro_bias,
            gyro_bias_sigma=known.gyro_bias_sigma,
            accel_bias=window.nav.accel_bias,
            accel_bias_sigma=known.accel_bias_sigma,
            **(_vertical(window, own, self._imu) if self._source == "imu" else {}),
            **self._rig.report(window, own),
        )

    def imu_terms_covariance(self) -> FloatArray:
        """Return the covariance (15, 15) of the errors of `Estimate.imu_terms`; zero where a
        term is not estimated.
        """
        if self._window is None or "imu_terms" not in self._window.state.blocks:
            return np.zeros((IMU_TERMS, IMU_TERMS))
        own = self._window.state.blocks["imu_terms"]
        return all_imu_terms(self._propagation.own_covariance(self._window)[own, own])

    @property
    def window_frames(self) -> int:
        """Number of past frames in the window."""
        return self._settings.clones

    def smoothed(self, frame_index: int) -> Estimate | None:
        """Return the estimate at a past frame with all frames since.

        None where it has left the window.
        """
        window = self._window
        smoothed = self._frame.smoothed
        found = None if smoothed is None else smoothed.estimate(frame_index)
        return (
            found
            if found is None or window is None
            else replace(found, gravity_world=_gravity(window, self._imu))
        )

    def relative(self, older: int, newer: int) -> RelativePose | None:
        """Return the body's motion between two frames of the window, by numbers, with all frames
        since.

        None where one of them is not in the window.
        """
        if self._frame.smoothed is None:
            return None
        return self._frame.smoothed.motion(older, newer)

    def landmarks(self) -> Landmarks:
        """Return the points of all tracks that were used and fix their depth, with their covariance
        given the poses.

        A point that came back under its id appears once, as it was seen last.
        """
        window = self._started()
        return self._points.with_landmarks(window, self._rig.landmark_covariances(window))

    def take_landmarks(self) -> Landmarks:
        """Return the points that have left the state since the last call, and forget them;
        `landmarks` has the others.

        None as long as the first tilt may still turn the map.
        """
        window = self._window
        if window is None or not window.clones or window.clones[0].time_ns == self._began_ns:
            return no_landmarks()
        return self._points.take()

    def _wait(self, observations: Observations) -> UpdateReport:
        """Let a frame pass that comes before the first motion sample; the run monitor reports
        it.
        """
        self._propagation.time_ns = observations.time_ns
        return UpdateReport(0, 0, 0, 0, None, None)

    def _started(self) -> Window:
        if self._window is None:
            raise EstimationError("msckf has not seen a frame yet")
        return self._window

    def _measure(self) -> None:
        self._propagation.measure(self._started())

    def _keep_first_attitude(self, window: Window) -> None:
        """Let the world that is reported stay where the first frames have put it, once the first
        one leaves: (N14).
        """
        leaving = (
            len(window.clones) > self._settings.clones
            and window.clones[0].time_ns == self._began_ns
        )
        if self._source == "imu" and leaving and "first_attitude" not in window.state.blocks:
            window.keep_first_attitude(
                window.calibration.estimating("first_attitude", self._settings)
            )

    def _keep_first_yaw(self, window: Window, before: Clone) -> None:
        """Keep the world's yaw that of the start while the first tilt is corrected, equation (N13).

        Corrections of roll and pitch by tens of degrees one after the other make a yaw, to second
        order, that no linear filter sees. The start knew no yaw but that of the shortest turn from
        its first attitude to the true one.

        Args:
            window: after the frame's update.
            before: one of its clones before it, which stays.
        """
        if self._source != "imu" or before.time_ns != self._began_ns:
            return
        after = window.clones.T_world_imu[window.clones.frame_indices == before.frame_index]
        if not len(after):
            return
        old = self._tilted
        phi = so3_log(after[0, :3, :3] @ before.T_world_imu[:3, :3].T)
        t = _half_tangent(old)
        moved = so3_exp(phi) @ old
        yaw = -nearest_yaw(moved)
        self._tilted = so3_exp([0.0, 0.0, yaw]) @ moved
        tilt = _half_tangent(self._tilted) - t
        R, M = window.turn_world(yaw, np.array([-tilt[1], tilt[0], 0.0]))
        propagation = self._propagation
        propagation.posterior = propagation.posterior.transformed(window, M)
        propagation.reported = propagation.reported.transformed(window, M)
        self._frame.turn(R)
        self._points.turn(R)

    def _apply_zero_velocity(self, window: Window) -> None:
        """Absorb a zero-velocity measurement where the whole window is indistinguishable from
        standstill.

        One measurement per window of frames: what two overlapping windows say of a slow motion is
        the same.
        """
        if not self._settings.zero_velocity or len(window.clones) < self._settings.clones:
            return
        if window.clones[0].time_ns <= self._stationary_ns:
            return
        smoothed = self._frame.smoothed
        if smoothed is None or not smoothed.is_stationary(
            ZERO_VELOCITY_SIGMA_MPS, ZERO_RATE_SIGMA_RADPS
        ):
            return
        measurement = self._propagation.motion.zero_velocity(window.nav, self._propagation.gyro)
        if measurement is not None:
            window.absorb_measurement(measurement)
            self._stationary_ns = window.clones[-1].time_ns


def _vertical(window: Window, own: FloatArray, imu: ImuSettings) -> dict[str, Any]:
    """The fields of `Estimate` that say where gravity points, by the upright covariance (15 + C,
    15 + C).
    """
    (xx, xy), (_, yy) = own[3:5, 3:5].tolist()
    sigma = math.sqrt(0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy))  # of the larger eigenvalue
    return {"tilt_sigma_rad": sigma, "gravity_world": _gravity(window, imu)}


def _gravity(window: Window, imu: ImuSettings) -> FloatArray | None:
    """Gravity (3,) in the world that is reported, m/s^2; None: along -z."""
    if "first_attitude" not in window.state.blocks:
        return None
    out: FloatArray = window.calibration.R_upright_world.T @ [0.0, 0.0, -imu.gravity_mps2]
    return out


def _lost(frame_index: int) -> str:
    return f"msckf diverged at frame {frame_index}: too few features for too long, or too many wrong ones"


def _half_tangent(R: FloatArray) -> FloatArray:
    """Rotation vector (3,) of R (3, 3), rescaled to the length `tan(angle / 2)`."""
    phi = so3_log(R)
    half = 0.5 * float(np.linalg.norm(phi))
    out: FloatArray = phi * (0.5 * np.tan(half) / half if half > 1e-6 else 0.5)
    return out


def _check_sane(
    window: Window, reported: FloatArray, source: MotionSource | None, frame_index: int
) -> None:
    """Raise DivergedError where the state, or its covariance as reported (D, D), is not made of
    numbers, or with an IMU of an impossible speed.
    """
    numbers = window.prior.P, window.nav.T_world_imu, reported
    finite = all(np.isfinite(values).all() for values in numbers)
    slow = source != "imu" or length(window.nav.velocity) < _MAX_SPEED_MPS
    if not finite or not slow:
        raise DivergedError(_lost(frame_index))
