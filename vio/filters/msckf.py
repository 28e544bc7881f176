"""The sliding-window filter: right-invariant, multi-state constrained, with long-lived landmarks.

For each frame: propagate; clone the pose; Gauss-Newton over the whole window with everything that is observed; gate
tracks and landmarks; marginalise what ends here (tracks that were lost, tracks that leave the window); estimate with
what passed its gate; drop the oldest clone. Tracks that continue are linearised anew in every frame and absorbed into
the prior once. The prior is kept in right-invariant errors, whose unobservable directions (global position and yaw) do
not depend on the estimate, so relinearisation adds no information along them.
References: Mourikis & Roumeliotis (2007); Sun et al. (2018); Wu et al., An invariant-EKF VINS algorithm for improving
consistency (2017); Barrau & Bonnabel (2017).
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
from scipy.linalg import block_diag

from vio.errors import ConfigError, DivergedError, EstimationError
from vio.filters.imu_terms import CHOSEN, IMU_TERMS
from vio.filters.inputs import InputOrder, check_parts, checked_extrinsics
from vio.filters.landmark_gate import LandmarkGate, leave_one_out_nis
from vio.filters.multiview import (
    MIN_DEPTH,
    LandmarkResiduals,
    Views,
    eliminate_points,
    landmark_residuals,
    relative_stereo_sigma,
)
from vio.filters.navigation import (
    DIM,
    NO_STEP,
    ZERO_RATE_SIGMA_RADPS,
    ZERO_VELOCITY_SIGMA_MPS,
    Growth,
    ImuMotion,
    NavState,
    Transition,
    TwistMotion,
)
from vio.filters.noise import MotionNoise, StepErrors
from vio.filters.online_calibration import (
    Calibration,
    Twist,
    body_twist,
    calibration_covariance,
    calibration_walk,
    first_calibration,
)
from vio.filters.restart import GoodState, restarted
from vio.filters.scale_test import SCALE_SIGMA, ScaleTest
from vio.filters.separate_bias import SeparateBias
from vio.filters.settings import MsckfSettings
from vio.filters.stereo_calibration import (
    LEAST_FIELD_PX,
    TERMS,
    RowField,
    StereoField,
    StereoInformation,
    eliminate_points_from_columns,
    field_jacobian,
    landmark_columns,
)
from vio.filters.tracks import measured, rows_of
from vio.filters.window import NO_TWIST, Clone, Fit, Window
from vio.filters.window_posterior import WindowPosterior
from vio.filters.window_tracks import MIN_TRACKS_FOR_NOISE, LinearTracks, WindowTracks
from vio.geometry.lie import FloatArray, se3_adjoint, se3_inverse, se3_log, so3_exp, so3_hat, so3_log, transform_points
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera, depth_of, project
from vio.numerics.robust import median
from vio.records import (
    ROW_TERMS,
    TURNS_NOT_SHOWN,
    BoolArray,
    Estimate,
    ImuSample,
    IntArray,
    Landmarks,
    MotionPrior,
    MotionSample,
    MotionSource,
    Observations,
    Prediction,
    StereoScaleEstimate,
    TrackPrior,
    TurnComparison,
    UpdateReport,
    VelocitySample,
    no_landmarks,
)

_FIRST_STEPS, _LATER_STEPS = 0, 1  # Gauss-Newton steps on each point, before and after the poses moved
# Factors on the motion model's densities: at the start, at least, at most.
IMU_FACTORS = (1.0, 1.0, 50.0)
# A start with a large uncertainty of the tilt is linearised far from the truth, which shows as process noise.
_FACTOR_PER_TILT_SIGMA = 1 / np.radians(8.0)
_MOST_START_FACTOR = 5.0
_TWIST_FACTORS = (1.0, 0.1, 10.0)
# Standard deviations of a point's inverse depth over itself, at most. A landmark is linearised and marginalised frame
# by frame as a Cartesian point, which biases scale in second order of it where the depth comes from motion. With left
# images and an IMU, position NEES after 2 s is 24 of 3 at 0.2, 15 at 0.05, 6 at 0.02, 2.8 at 0.01, 2.5 without any.
_LANDMARK_DEPTH_SIGMA = 0.01  # by all views
_LANDMARK_STEREO_SIGMA = 0.1  # or by the right views alone, which know the scale
# Standard deviation of the baseline over it, at most: while the scale is open, the same bias falls on the baseline.
# With a prior of 5 % and a baseline that is off by 9.5 %, 15 s of a flight with an IMU end at 4.07 +- 0.03 % with
# landmarks from the start, at 9.02 +- 0.29 % without any.
_SCALE_SIGMA = 0.001
_MAP_DEPTH_SIGMA = 0.2  # by all views; a point of the map is reported with its covariance, and not used
_LEAST_MERGE = 1000  # stored points up to which the map is not merged
_USELESS_RAD = 0.2  # standard deviation of a predicted rotation beyond which its pixels start no search
_FREED_FOCAL_SIGMA = 0.05  # over it, once the turns of camera and gyro differ
_FAR = 0.5  # pixels by which the predicted pose may be off before one step over the window is too few
_MOST_SPEED_MPS = 100.0  # with an IMU, whose scale is metric: beyond it the filter has diverged
_MOST_STEPS = 4  # over the window in a frame: one is the rule, two bring in a start in motion, a third is an exception


class Msckf:
    """The sliding-window filter as a back end."""

    motion_sources: ClassVar[tuple[MotionSource, ...]] = ("imu", "velocity")  # what it has a model for, the best first
    stereo_only = False

    def __init__(
        self,
        camera: StereoCamera,
        T_cam0_imu: FloatArray,
        settings: MsckfSettings,
        *,
        motion: MotionSource | None,
    ) -> None:
        """Prepare; the first frame initialises the state.

        Args:
            camera: the rectified stereo camera.
            T_cam0_imu: extrinsics (4, 4).
            settings: the filter's section of the configuration.
            motion: which motion samples will come; None: images alone.

        Raises:
            ConfigError: the calibration is to be estimated without an IMU, or an argument is of another kind.
            CalibrationError: the extrinsics are no rigid transform.
        """
        check_parts("msckf", camera, settings, MsckfSettings)
        if motion not in (None, *self.motion_sources):
            raise ConfigError(f"msckf has no model for motion {motion!r}; give imu, velocity or None")
        if settings.calibrate_camera_imu not in ("auto", "none") and motion != "imu":
            raise ConfigError(
                f"msckf.calibrate_camera_imu: {settings.calibrate_camera_imu} needs --motion imu; "
                "set it to auto or none"
            )
        if settings.calibrate_imu != "off" and motion != "imu":
            raise ConfigError(f"msckf.calibrate_imu: {settings.calibrate_imu} needs --motion imu; set it to off")
        if camera.is_cylinder:  # equation (R4) is a pinhole's
            settings = replace(settings, stereo_focal_sigma=0.0, stereo_baseline_sigma=0.0)
        self._camera, self._settings = camera, settings
        self._calibration = first_calibration(checked_extrinsics(T_cam0_imu), settings, motion)
        self._walk = calibration_walk(settings)  # (32,) variances a second
        self._order = InputOrder("msckf")
        self._source = motion
        self._motion: ImuMotion | TwistMotion = ImuMotion(settings) if motion == "imu" else TwistMotion(settings)
        self._window: Window | None = None
        self._tracks = WindowTracks(camera, settings)
        self._time_ns = 0
        self._began_ns = 0
        self._body_ns = 0  # time of the navigation state, on the IMU's clock
        self._blind = False  # the last frame showed nothing
        self._output: FloatArray = np.zeros((DIM, DIM))  # covariance (15 + C, 15 + C) with all that is seen
        self._newest: FloatArray = np.zeros((DIM + 6, DIM + 6))  # the same, and the newest camera's after it
        self._frame_pose: FloatArray = np.eye(4)  # (4, 4) of the navigation state after the last frame
        self._expected: FloatArray = np.zeros((6, 6))  # covariance of the camera's motion since, as it was predicted
        self._noise = MotionNoise(*IMU_FACTORS) if motion == "imu" else MotionNoise(*_TWIST_FACTORS)
        self._rows = RowField(camera)
        self._scale_log: float | None = None  # of the baseline over the calibrated one; None: nothing contradicts it
        self._turns: TurnComparison | None = TURNS_NOT_SHOWN  # as others compared them; None: they will
        self._landmark_gate = LandmarkGate(settings.gate_probability)
        self._smoothed: WindowPosterior | None = None  # after the last frame
        self._stationary_ns = -(2**62)  # newest frame of the last zero-velocity measurement
        self._gyro: FloatArray | None = None  # (3,) mean rate measured over the last step
        self._since_frame = NO_STEP  # how the error has grown since the last frame
        self._predicted_step: tuple[int, Transition] | None = None  # integrated by `predict`, with its end
        self._tilted: FloatArray = np.eye(3)  # (3, 3) how the first attitude has been corrected, on the world's side
        self._good: GoodState | None = None  # after the last plausible update
        self._map: list[Landmarks] = []
        self._points_stored = 0  # points in the map since it was merged

    def propagate(self, sample: MotionSample) -> None:
        """Take a motion sample.

        Raises:
            ConfigError: the sample is not of the kind that was announced.
            DataError: it is out of order or not finite; the filter is unchanged.
        """
        expected = {"imu": ImuSample, "velocity": VelocitySample}.get(self._source or "")
        if expected is None or not isinstance(sample, expected):
            raise ConfigError(f"msckf was built for motion {self._source or 'none'}, got a {type(sample).__name__}")
        self._order.sample(sample)
        self._motion.take(sample)
        self._predicted_step = None  # the sample may change what the step looks like
        if isinstance(sample, VelocitySample) and self._window is not None:
            self._advance(sample.time_ns)
            self._measure()

    def take_turns(self, turns: TurnComparison | None) -> None:
        """Take how the camera's turns compare with the gyro's; None: they were not compared yet.

        Until they are, nothing is concluded of the baseline, for which a wrong focal length passes. Where they differ
        for another reason than the gyro, the focal length becomes a state in the next frame.
        """
        self._turns = turns

    def predict(self, time_ns: int) -> Prediction | None:
        """Predict a coming frame: the pixels of all tracks with a point, and the camera's motion."""
        window = self._window
        if window is None or not window.clones or time_ns < self._time_ns:
            return None
        nav, growth = window.nav, self._since_frame
        body_ns = self._body_time(time_ns)
        if body_ns > self._body_ns:
            try:
                step = self._step_to(body_ns)
            except EstimationError:  # the update will say it
                return None
            nav, growth = step.nav, growth.then(step)
        T_cam0_imu, late_s = window.calibration.T_cam0_imu, (body_ns - time_ns) * 1e-9
        twist = self._twist(nav, growth)
        T_world_imu, *camera_D_own = window.camera_D_own(late_s, twist, nav)
        T_cam0_world = T_cam0_imu @ se3_inverse(T_world_imu)
        T_curr_prev = T_cam0_world @ window.exposures()[-1] @ se3_inverse(T_cam0_imu)
        # T_curr_prev = exp(A (xi_prev - xi_curr)) T_hat with A = Ad(T_cam0_world)
        A = se3_adjoint(T_cam0_world)
        expected = self._expected_error(nav, growth, *camera_D_own)
        motion = MotionPrior(T_curr_prev, A @ expected @ A.T)
        of_rotation = motion.covariance[3:, 3:]  # no eigenvalue is larger than its trace
        if of_rotation.trace() > _USELESS_RAD**2 and np.linalg.eigvalsh(of_rotation)[-1] > _USELESS_RAD**2:
            return None
        return Prediction(self._expected_tracks(window, T_cam0_world, motion), motion)

    def _expected_error(self, nav: NavState, growth: Growth, camera_D_own: FloatArray, noise: FloatArray) -> FloatArray:
        """Covariance (6, 6) of `xi_curr - xi_prev`, of the camera, where the errors have grown since the last frame.

        Args:
            nav: the navigation state at the present frame.
            growth: since the last frame.
            camera_D_own: how the camera's pose at the present frame follows them, equation (C2).
            noise: and what that leaves open.
        """
        calibration = self._started().calibration
        if not calibration.moves_camera and not calibration.imu_dim:
            M = growth.Phi[:6] - np.eye(6, DIM)
            out: FloatArray = M @ self._output[:DIM, :DIM] @ M.T + growth.Q[:6, :6]
            return out
        J = camera_D_own
        M = np.concatenate([J @ self._grown(nav, growth), -np.eye(6)], axis=1)
        out = M @ self._newest @ M.T + J[:, :DIM] @ growth.Q @ J[:, :DIM].T + noise
        return np.asarray(out, dtype=np.float64)

    def _grown(self, nav: NavState, growth: Growth) -> FloatArray:
        """Transition (15 + C, 15 + C) of the errors of navigation state and calibration since the last frame."""
        out = np.eye(len(self._output))
        out[:DIM, :DIM] = growth.Phi
        calibration = self._started().calibration
        if growth.Phi_imu is not None:
            out[:DIM, DIM : DIM + calibration.imu_dim] = growth.Phi_imu
        if calibration.extrinsics:
            rows = calibration.extrinsic_rows + DIM
            out[np.ix_(rows, rows)] = se3_adjoint(nav.T_world_imu @ se3_inverse(self._frame_pose))
        return out

    def _twist(self, nav: NavState, growth: Growth) -> Twist:
        """The body's twist, and how well it is known; equation (C3)."""
        if not isinstance(self._motion, ImuMotion) or not self._started().calibration.timing:
            return NO_TWIST
        R = nav.T_world_imu[:3, :3]
        own, rate_D_error = slice(0, self._started().nav_dim), self._motion.rate_D_error(nav)
        Phi = growth.Phi if own.stop == DIM else self._grown(nav, growth)[own, own]
        P = Phi @ self._output[own, own] @ Phi.T
        P[:DIM, :DIM] += growth.Q
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = R.T @ P[6:9, 6:9] @ R  # v = exp(phi) v_hat + xi_v, seen from the body turned by phi
        by_gyro = np.eye(3) * self._motion.rate_variance(self._noise.factors)
        covariance[3:, 3:] = rate_D_error @ P @ rate_D_error.T + by_gyro
        return Twist(body_twist(nav.T_world_imu, nav.velocity, nav.rate), covariance)

    def _expected_tracks(self, window: Window, T_cam0_world: FloatArray, motion: MotionPrior) -> TrackPrior:
        table = self._tracks.table
        rows = table.rows()
        rows = rows[table.has_point[rows]]
        ids = np.concatenate([table.ids(rows), window.landmark_ids])
        p_cam = transform_points(T_cam0_world, np.concatenate([table.points[rows], window.landmarks]))
        ahead = depth_of(self._camera, p_cam) > MIN_DEPTH * self._camera.baseline_m
        z, field = project(self._camera, p_cam[ahead]), self._field(window)
        if field is not None:
            z = field.seen(z)
        return TrackPrior(ids[ahead], z, motion.T_curr_prev[:3, :3], motion)

    def update(self, observations: Observations) -> UpdateReport:
        """Propagate to the time of the frame and update with its observations.

        Raises:
            EstimationError: the motion samples do not cover the step.
            DivergedError: the filter diverged; `restart` goes on from the last good state.
            DataError: the frame is out of order, or its observations are impossible; the filter is unchanged.
        """
        self._order.frame(observations, self._time_ns)
        return self._update(observations)

    def _update(self, observations: Observations) -> UpdateReport:
        seen = observations.take(~observations.stale)
        if self._window is None:
            start = self._start_state(seen)
            if start is None:
                return self._wait(observations)
            nav, P = start
            if self._source == "imu":
                self._noise = self._first_noise(P)
            calibration = self._calibration
            self._window = self._first_window(nav, P, calibration)
            if calibration.imu_dim and isinstance(self._motion, ImuMotion):
                self._window.correlate_first_tilt(self._motion.tilt_D_terms(nav))
            self._time_ns = self._body_ns = self._began_ns = observations.time_ns
            self._begin_output(self._window)
            self._measure()
        else:
            self._advance(observations.time_ns)
        window = self._window
        if window.clones and not len(seen):
            # A frame that shows nothing ends no track; what is seen next decides.
            self._blind = True
            if not self._is_sane(window):
                raise DivergedError(self._lost(observations.frame_index))
            return UpdateReport(0, 0, 0, len(window.landmarks), None, None)
        self._blind = False
        late_s, twist = self._late_s, self._twist(window.nav, self._since_frame)
        exposure = window.camera_D_own(late_s, twist)
        self._expected = self._expected_error(window.nav, self._since_frame, *exposure[1:])
        # Half a window gives the velocity: before, its product with the offset's error would pass for knowledge of it.
        moving = len(window.clones) >= self._settings.clones // 2
        if window.calibration.timing and moving and not window.clocks_compared:
            window.compare_clocks(observations.time_ns, late_s, twist)
            exposure = window.camera_D_own(late_s, twist)
        window.add_clone(observations.frame_index, observations.time_ns, exposure)
        before = window.clones[len(window.clones) > self._settings.clones]  # the oldest that stays
        try:
            report = self._use(window, seen)
            self._keep_first_yaw(window, before)
        except np.linalg.LinAlgError as error:
            raise DivergedError(self._lost(observations.frame_index)) from error
        if not self._is_sane(window):
            raise DivergedError(self._lost(observations.frame_index))
        if report.used >= report.gated:
            self._good = GoodState(
                observations.frame_index, self._time_ns, window.nav, self._output, window.calibration
            )
        return report

    def _start_state(self, seen: Observations) -> tuple[NavState, FloatArray] | None:
        """The navigation state at the first frame and its covariance (15, 15); None: the frame passes."""
        return self._motion.start(seen.time_ns) if self._motion.ready else None

    def _first_noise(self, P: FloatArray) -> MotionNoise:
        """The IMU's noise at a start whose navigation state has the covariance P (15, 15)."""
        tilt_sigma = float(np.sqrt(P[3:5, 3:5].diagonal().max()))
        start = min(IMU_FACTORS[0] + _FACTOR_PER_TILT_SIGMA * tilt_sigma, _MOST_START_FACTOR)
        return MotionNoise(start, *IMU_FACTORS[1:])

    def _free_focal_length(self, window: Window) -> None:
        """Make the focal length a state where camera and gyro turn differently, and the gyro is not the cause.

        What noise and landmarks were learned with the wrong one are forgotten; the other states stay, and move with it.
        """
        turns = self._turns
        if turns is not None and turns.settled:
            window.focal = None  # what is not needed need not be followed
        if turns is None or window.focal is None or not (turns.differ and turns.gyro_agrees):
            return
        # A baseline that was taken over may be what the focal length passed for.
        baseline = self._settings.stereo_baseline_sigma if self._scale_log is None else SCALE_SIGMA
        self._settings = replace(self._settings, stereo_baseline_sigma=baseline, stereo_focal_sigma=_FREED_FOCAL_SIGMA)
        self._walk = calibration_walk(self._settings)
        self._keep_landmarks(window, np.zeros(len(window.landmarks), dtype=np.bool_))
        sigmas = np.array([baseline, _FREED_FOCAL_SIGMA])
        window.free_focal_length(replace(window.calibration, metric=True), np.diag(sigmas**2))
        self._tracks.variance = self._settings.pixel_sigma_px**2
        self._noise = MotionNoise(*IMU_FACTORS)

    def restart(self, observations: Observations) -> UpdateReport:
        """Start again at a frame after a divergence, from the state after the last good update.

        The pose is carried on with an inflated covariance, velocity and biases are uncertain as at the start, and the
        window is emptied; the map's points stay, and so does what is known of the calibration.

        Args:
            observations: of the frame at which `update` failed, or of a later one.

        Raises:
            EstimationError: there was no good update.
            DivergedError: the filter diverges again at once.
        """
        good = self._good
        if good is None:
            raise EstimationError("msckf has no good state to start again from; check calibration and first frames")
        nav, P = restarted(good, observations.time_ns, self._motion, self._settings)
        scale_test = None if self._window is None else self._window.scale_test
        self._window = self._first_window(nav, P, good.calibration)
        if scale_test is not None and not good.calibration.metric:
            self._window.scale_test = ScaleTest(len(self._window.P), scale_test.estimate()[1])
        self._calibration = good.calibration
        self._time_ns, self._body_ns = observations.time_ns, self._body_time(observations.time_ns)
        self._smoothed, self._gyro, self._blind = None, None, False
        self._since_frame, self._predicted_step = NO_STEP, None
        self._reset_tracks()
        self._begin_output(self._window)
        self._map = [part for part in self._map if np.isfinite(part.p_world).all()]
        return self._update(observations)

    def _reset_tracks(self) -> None:
        """Forget all tracks, and what was learned of the motion's noise."""
        self._tracks = WindowTracks(self._camera, self._settings)
        self._landmark_gate = LandmarkGate(self._settings.gate_probability)
        self._noise = MotionNoise(*IMU_FACTORS) if self._source == "imu" else MotionNoise(*_TWIST_FACTORS)

    def _begin_output(self, window: Window) -> None:
        """Take over the covariance of a window without clones."""
        D = len(window.P)
        self._output, self._frame_pose = window.P.copy(), window.nav.T_world_imu
        self._newest = np.zeros((D + 6, D + 6))
        self._newest[:D, :D] = self._output

    def _first_window(self, nav: NavState, P: FloatArray, calibration: Calibration) -> Window:
        """A window without clones; P (15, 15) is the covariance of the navigation state."""
        own = calibration.in_world(calibration_covariance(calibration, self._settings), nav.T_world_imu)
        window = Window(self._motion, nav, np.asarray(block_diag(P, own)), calibration)
        if self._source is not None and not calibration.metric:
            window.scale_test = ScaleTest(len(window.P))
            if self._source == "imu" and self._camera.kind == "stereo" and not self._camera.is_cylinder:
                window.focal = SeparateBias(len(window.P))
        return window

    def _is_sane(self, window: Window) -> bool:
        """Whether the state is made of numbers, and with an IMU of a possible speed."""
        if not np.isfinite(window.P).all() or not np.isfinite(window.nav.T_world_imu).all():
            return False
        return self._source != "imu" or float(np.linalg.norm(window.nav.velocity)) < _MOST_SPEED_MPS

    def estimate(self) -> Estimate:
        """Return the estimate at the time of the last event."""
        if self._window is None:
            return Estimate(self._time_ns, np.eye(4), np.eye(6))
        window, output = self._window, self._grown_output()
        T, covariance = self._current_pose(window, output)
        # exp(xi) T_hat on the world's side is T_hat exp(Ad(T_hat^-1) xi); the inverse pose's error is its negative.
        A = se3_adjoint(se3_inverse(T))
        known = self._motion.uncertainty(window.nav, output[:DIM, :DIM])
        estimate = Estimate(
            self._time_ns,
            T,
            A @ covariance @ A.T,
            velocity_world=self._motion.velocity_world(window.nav),
            velocity_covariance=known.velocity_covariance,
            gyro_bias=window.nav.gyro_bias,
            gyro_bias_sigma=known.gyro_bias_sigma,
            accel_bias=window.nav.accel_bias,
            accel_bias_sigma=known.accel_bias_sigma,
        )
        estimate = window.calibration.add_to_estimate(estimate, output[DIM:, DIM:], window.nav.T_world_imu)
        if window.calibration.imu_dim:
            sigmas = np.sqrt(np.diag(_imu_terms_covariance(window, output)))
            estimate = replace(estimate, imu_terms=window.nav.imu_terms, imu_terms_sigma=sigmas)
        if self._scale_log is not None:
            taken, scale = np.array([self._scale_log, 0.0]), estimate.stereo_scale
            if window.scale_test is not None:
                scale = StereoScaleEstimate(taken, np.diag([window.scale_test.estimate()[1] ** 2, 0.0]))
            elif scale is not None:  # of a camera with the baseline that was taken over
                scale = replace(scale, logs=scale.logs + taken)
            estimate = replace(estimate, stereo_scale=scale)
        if estimate.stereo_field is not None:
            field = estimate.stereo_field
            own, P = self._rows.without_common(field.coefficients), self._rows.covariance
            field = replace(field, rows_rms_px=self._rows.rms_px, rows=own, rows_covariance=P)
            estimate = replace(estimate, stereo_field=field)
        return estimate

    def imu_terms_covariance(self) -> FloatArray:
        """Return the covariance (15, 15) of the errors of `Estimate.imu_terms`; zero where a term is not estimated."""
        if self._window is None:
            return np.zeros((IMU_TERMS, IMU_TERMS))
        return _imu_terms_covariance(self._window, self._grown_output())

    def _current_pose(self, window: Window, output: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pose (4, 4) of the body at the newest exposure and its covariance (6, 6)."""
        if not window.calibration.timing:
            return window.nav.T_world_imu, output[:6, :6]
        if not self._blind:
            J = np.eye(6, len(self._newest), len(output))  # of the camera, and back to the body
            J[:, : len(output)] += window.body_D_error()[-6:, : len(output)]
            return window.clones[-1].T_world_imu, J @ self._newest @ J.T
        twist = self._twist(window.nav, self._since_frame)
        T, J, noise = window.camera_D_own(self._late_s, twist)
        J[:, window.calibration.extrinsic_rows + DIM] = 0.0  # of the body
        return T, J @ output @ J.T + noise

    def _grown_output(self) -> FloatArray:
        """Covariance of navigation state and calibration at the time of the last event."""
        if not self._blind:
            return self._output
        grow = self._grown(self._started().nav, self._since_frame)
        out: FloatArray = grow @ self._output @ grow.T
        out[:DIM, :DIM] += self._since_frame.Q
        return out

    @property
    def _late_s(self) -> float:
        """The navigation state's time on the IMU's clock minus the last frame's stamp."""
        return (self._body_ns - self._time_ns) * 1e-9

    def smoothed(self, frame_index: int) -> Estimate | None:
        """Return the estimate at a past frame with all frames since; None where it has left the window."""
        return None if self._smoothed is None else self._smoothed.estimate(frame_index)

    def relative(self, older: int, newer: int) -> RelativePose | None:
        """Return the body's motion between two frames of the window, by numbers, with all frames since.

        None where one of them is not in the window.
        """
        return None if self._smoothed is None else self._smoothed.motion(older, newer)

    def landmarks(self) -> Landmarks:
        """Return the points of all tracks that were used and fix their depth, with their covariance given the poses.

        A point that came back under its id appears once, as it was seen last.
        """
        window = self._started()
        first, n = window.first_landmark, len(window.landmarks)
        blocks = [window.P[first + 3 * k : first + 3 * k + 3, first + 3 * k : first + 3 * k + 3] for k in range(n)]
        return _newest(
            [*self._map, Landmarks(window.landmark_ids, window.landmarks, np.array(blocks).reshape(n, 3, 3))]
        )

    def take_landmarks(self) -> Landmarks:
        """Return the points that have left the state since the last call, and forget them; `landmarks` has the others.

        None as long as the first tilt may still turn the map.
        """
        window = self._window
        if window is None or not self._map or not window.clones or window.clones[0].time_ns == self._began_ns:
            return no_landmarks()
        taken, self._map, self._points_stored = _newest(self._map), [], 0
        return taken

    def _keep_landmarks(self, window: Window, kept: BoolArray) -> None:
        """Drop the landmarks outside a mask (M,) from the state; their points go to the map."""
        if kept.all():
            return
        first, gone = window.first_landmark, ~kept
        rows = [slice(first + 3 * k, first + 3 * k + 3) for k in np.flatnonzero(gone).tolist()]
        blocks = np.array([window.P[r, r] for r in rows]).reshape(-1, 3, 3)
        self._store_points(window.landmark_ids[gone], window.landmarks[gone], blocks)
        window.keep_landmarks(kept)

    def _store_points(self, ids: IntArray, p_world: FloatArray, covariance: FloatArray) -> None:
        """Add points to the output map, which the filter does not use."""
        if len(ids):
            self._map.append(Landmarks(ids, p_world, covariance))
            self._points_stored += len(ids)
            # Features that stay in view are stored again and again.
            if self._points_stored > _LEAST_MERGE + len(self._map[0].ids):
                self._map, self._points_stored = [_newest(self._map)], 0

    def _wait(self, observations: Observations) -> UpdateReport:
        """Let a frame pass that comes before the first motion sample; the run's watch says so."""
        self._time_ns = observations.time_ns
        return UpdateReport(0, 0, 0, 0, None, None)

    def _started(self) -> Window:
        if self._window is None:
            raise EstimationError("msckf has not seen a frame yet")
        return self._window

    def _lost(self, frame_index: int) -> str:
        return f"msckf diverged at frame {frame_index}: too few features for too long, or too many wrong ones"

    def _advance(self, time_ns: int) -> None:
        body_ns = self._body_time(time_ns)
        if body_ns > self._body_ns:
            window = self._started()
            step = self._step_to(body_ns)
            self._motion.forget_before(body_ns)
            walk = self._walk[window.calibration.columns] * ((body_ns - self._body_ns) * 1e-9)
            window.propagate(step, np.diag(walk))
            self._since_frame = self._since_frame.then(step)
            self._gyro = step.gyro
            self._body_ns = body_ns
        self._predicted_step = None
        self._time_ns = time_ns

    def _step_to(self, body_ns: int) -> Transition:
        """The motion model's step from the present state; what `predict` has integrated is not integrated again."""
        if self._predicted_step is None or self._predicted_step[0] != body_ns:
            step = self._motion.advance(self._started().nav, self._body_ns, body_ns, self._noise.factors)
            self._predicted_step = body_ns, step
        return self._predicted_step[1]

    def _body_time(self, time_ns: int) -> int:
        """The time on the IMU's clock to which the navigation state is carried for a frame."""
        calibration = self._started().calibration
        if not calibration.timing or not isinstance(self._motion, ImuMotion):
            return time_ns
        return self._motion.covered(time_ns + round(1e9 * calibration.time_offset_s))

    def _keep_first_yaw(self, window: Window, before: Clone) -> None:
        """Keep the world's yaw that of the start while the first tilt is corrected, equation (N13).

        Corrections of roll and pitch by tens of degrees one after the other make a yaw, to second order, that no
        linear filter sees. The start knew no yaw but that of the shortest turn from its first attitude to the true one.

        Args:
            window: after the frame's update.
            before: one of its clones before it, which stays.
        """
        if self._source != "imu" or before.time_ns != self._began_ns:
            return
        after = next((c for c in window.clones if c.frame_index == before.frame_index), None)
        if after is None:
            return
        old = self._tilted
        phi, t = so3_log(after.T_world_imu[:3, :3] @ before.T_world_imu[:3, :3].T), _half_tangent(old)
        moved = so3_exp(phi) @ old
        yaw = -float(np.arctan2(moved[1, 0] - moved[0, 1], moved[0, 0] + moved[1, 1]))
        self._tilted = so3_exp([0.0, 0.0, yaw]) @ moved
        tilt = _half_tangent(self._tilted) - t
        R, M = window.turn_world(yaw, np.array([-tilt[1], tilt[0], 0.0]))
        own = slice(0, window.first_clone)
        self._output = M[own, own] @ self._output @ M[own, own].T
        newest = np.concatenate([np.arange(window.first_clone), np.r_[window.clone_rows(len(window.clones) - 1)]])
        turn = M[np.ix_(newest, newest)]
        self._newest, self._frame_pose = turn @ self._newest @ turn.T, window.nav.T_world_imu
        self._tracks.table.points = self._tracks.table.points @ R.T
        if self._smoothed is not None:
            self._smoothed = self._smoothed.rotated(R)
        self._map = [Landmarks(m.ids, m.p_world @ R.T, R @ m.covariance @ R.T) for m in self._map]

    def _measure(self) -> None:
        window = self._started()
        measurement = self._motion.measurement(window.nav)
        if measurement is None:
            return
        if self._blind:
            window.measure(measurement)
        else:  # the frame's fit will move the means, and better
            window.absorb_measurement(measurement)

    def _use(self, window: Window, seen: Observations) -> UpdateReport:
        """Update with everything that a frame shows."""
        self._calibrate_stereo(window, seen)
        self._free_focal_length(window)
        self._test_scale(window, seen)
        rows, found = rows_of(seen, window.landmark_ids)
        self._keep_landmarks(window, found)
        pixels = Views(seen.z[rows], measured(seen.has_right[rows]))
        of_tracks = np.ones(len(seen), dtype=np.bool_)
        of_tracks[rows] = False
        self._tracks.table.add_frame(len(window.clones) - 1, seen.take(of_tracks))

        predicted = window.camera_move_since(-2) if len(window.clones) > 1 else None
        tracks = self._linearise(window, self._tracks.choose(len(window.clones)), _FIRST_STEPS)
        at_prediction, innovation = tracks, tracks.newest_innovation()
        tracks, fitted = self._fit(window, tracks, pixels, innovation)
        step = self._step_errors(window, tracks, predicted, fitted)
        if step is not None:
            missing, doubted = step.missing_noise(), False
            if missing.any() and self._tracks.agree(tracks.at):
                window.inflate_process_noise(np.einsum("k,kij->ij", missing, self._since_frame.Q_parts))
                tracks, fitted = self._fit(window, tracks, pixels, innovation)
            elif missing.any() and self._source == "imu" and not self._since_frame.bridged:
                doubted = self._tracks.drop_unpredicted(at_prediction, self._expected)
                pixels = Views(pixels.z, np.zeros_like(pixels.weight))
                tracks, fitted = self._fit_again(window, pixels)
            if not (self._since_frame.bridged or doubted):
                self._noise.update(step)
        self._since_frame = NO_STEP

        tracks = self._tracks.without_wrong_views(tracks)
        good, nis, dof = self._tracks.gate(tracks.at)
        gated_ids = self._tracks.table.ids(tracks.rows[~good])
        self._tracks.update_pixel_noise(nis, dof)
        pixels, rejected = self._gate_landmarks(window, pixels, fitted)
        created = self._marginalise(window, tracks, good, pixels)
        self._apply_zero_velocity(window)
        return UpdateReport(
            used=int(good.sum()) + int((pixels.weight[:, 0] > 0).sum()),
            gated=int((~good).sum()) + rejected,
            initialised=created,
            landmarks=len(window.landmarks),
            innovation_median_px=innovation,
            nis_per_dof=median(nis / dof) if len(nis) else None,
            gated_ids=gated_ids,
            landmark_ids=window.landmark_ids.copy(),
        )

    def _gate_landmarks(self, window: Window, pixels: Views, fitted: Fit) -> tuple[Views, int]:
        """Test the landmarks' pixels after a fit; drop the landmarks that keep failing.

        Returns:
            The pixels of the landmarks left, without weight where rejected, and how many observations were rejected.
        """
        if not len(pixels.z):
            return pixels, 0
        at = self._landmark_residuals(window, pixels)
        J, field = at.J, self._field(window)
        if field is not None:
            H = field.jacobian(pixels.z - at.r) * np.any(at.J, axis=2)[..., None]
            J = np.concatenate([J, H], axis=2)
        nis = leave_one_out_nis(at.r, J, window.landmark_covariance(fitted), at.weight, self._tracks.variance)
        dof = np.maximum(np.any(at.J, axis=2).sum(axis=1), 1)
        used, dropped = self._landmark_gate.check(window.landmark_ids, nis, dof)
        self._keep_landmarks(window, ~dropped)
        weight = pixels.weight * used[:, None]
        return Views(pixels.z[~dropped], weight[~dropped]), int((~used).sum())

    def _apply_zero_velocity(self, window: Window) -> None:
        """Absorb a zero-velocity measurement where the whole window is indistinguishable from standstill.

        One measurement per window of frames: what two overlapping windows say of a slow motion is the same.
        """
        if not self._settings.zero_velocity or len(window.clones) < self._settings.clones:
            return
        if window.clones[0].time_ns <= self._stationary_ns:
            return
        if self._smoothed is None or not self._smoothed.is_stationary(ZERO_VELOCITY_SIGMA_MPS, ZERO_RATE_SIGMA_RADPS):
            return
        measurement = self._motion.zero_velocity(window.nav, self._gyro)
        if measurement is not None:
            window.absorb_measurement(measurement)
            self._stationary_ns = window.clones[-1].time_ns

    def _calibrate_stereo(self, window: Window, seen: Observations) -> None:
        """Learn the rows of a frame; begin to estimate the stereo field where they show that it is needed."""
        if self._settings.calibrate_stereo == "off":
            return
        self._rows.update(seen)
        known_off = self._camera.residual_px > LEAST_FIELD_PX
        if not window.calibration.stereo_field and (known_off or self._rows.is_significant):
            calibration = replace(window.calibration, stereo_field=True)
            P = calibration_covariance(calibration, self._settings)
            own = calibration.field_rows
            window.start_stereo_field(calibration, P[own, own])

    def _test_scale(self, window: Window, seen: Observations) -> None:
        """Take the scale of IMU or velocities, from the frame on at which they contradict that of the baseline."""
        if not seen.has_right.any():  # then the scale is not the baseline's, but the sensor's already
            window.scale_test = None
        test = window.scale_test
        if test is not None:
            test.frames += 1
        if test is None or (self._scale_log is None and not test.contradicted):
            return
        if self._scale_log is None and (self._turns is None or not self._turns.agree):
            return  # a wrong focal length passes for it
        factor = window.adopt_scale()
        self._scale_log = (self._scale_log or 0.0) + float(np.log(factor))
        self._camera = replace(self._camera, baseline_m=self._camera.baseline_m * factor)
        self._tracks.scale(self._camera, factor)

    def _linearise(self, window: Window, rows: IntArray, steps: int) -> LinearTracks:
        """Linearise tracks at the window's present means."""
        return self._tracks.linearise(window.T_cam0_world(), rows, steps, self._field(window))

    def _field(self, window: Window) -> StereoField | None:
        """The stereo calibration's faults at the window's present means; None where they are not estimated."""
        calibration = window.calibration
        if not calibration.stereo_dim:
            return None
        rows, rows_D_common = np.zeros(ROW_TERMS), None
        if calibration.stereo_field:
            rows = self._rows.coefficients
        # Lenses that bend both images alike pass for a focal length: 2 ± 0.4 % for k1 = -0.03. Where that counts as
        # known, drives come out no better without their part of the rows: KITTI 03 by 20 %, 06 and 0039 not.
        if calibration.stereo_field and calibration.metric:
            rows, rows_D_common = self._rows.without_common(calibration.stereo), self._rows.rows_D_common
        return StereoField(self._camera, rows, calibration.stereo, calibration.stereo_terms, rows_D_common)

    def _fit(
        self, window: Window, tracks: LinearTracks, pixels: Views, innovation: float | None
    ) -> tuple[LinearTracks, Fit]:
        """Gauss-Newton over the window; returns the tracks linearised at the estimate, and the last fit."""
        for _ in range(_MOST_STEPS):
            everything = np.ones(len(tracks.rows), dtype=np.bool_)
            A, b = self._information(window, tracks, everything, pixels)
            fitted = self._move_to_optimum(window, tracks, A, b, len(A))
            tracks = self._linearise(window, tracks.rows, _LATER_STEPS)
            residual = tracks.newest_innovation()
            # Another step pays only where this one had far to go.
            if innovation is None or residual is None or innovation < max(_FAR, 3 * residual):
                break
            innovation = residual
        return tracks, fitted

    def _fit_again(self, window: Window, pixels: Views) -> tuple[LinearTracks, Fit]:
        """Fit to what is left of views that contradict the IMU and one another: a person in the view, not a shock."""
        tracks = self._linearise(window, self._tracks.choose(len(window.clones)), _LATER_STEPS)
        return self._fit(window, tracks, pixels, tracks.newest_innovation())

    def _move_to_optimum(self, window: Window, tracks: LinearTracks, A: FloatArray, b: FloatArray, size: int) -> Fit:
        """Move the means, and the tracks' points with them, to the optimum of the prior and of given information.

        Args:
            window: moved; its prior stays.
            tracks: whose points are moved.
            A: information (D, D).
            b: its vector (D,).
            size: how many errors, the first ones, it is about.

        Returns:
            The fit, with their covariance (size, size) there.
        """
        fitted, error = window.optimum(A, b, size)
        self._tracks.move_points(tracks, window.exposure_errors(error), error[window.stereo_rows])
        window.relinearise(error)
        return fitted

    def _step_errors(
        self,
        window: Window,
        tracks: LinearTracks,
        predicted: FloatArray | None,
        fitted: Fit,
    ) -> StepErrors | None:
        """The predicted and the corrected motion since the last frame, and what its fit leaves of their errors.

        It is the camera's motion, seen from the body, so that a new estimate of the extrinsics is no motion. None with
        too few tracks.
        """
        if predicted is None or len(tracks.rows) < MIN_TRACKS_FOR_NOISE:
            return None
        moved = window.camera_move_since(-2)
        remaining = window.move_covariance(len(window.clones) - 2, fitted)
        A = se3_adjoint(se3_inverse(window.nav.T_world_imu))
        process = A @ self._since_frame.Q[:6, :6] @ A.T
        B = se3_adjoint(se3_inverse(window.calibration.T_cam0_imu))
        correction = B @ se3_log(se3_inverse(predicted) @ moved)
        return StepErrors(correction, A @ self._expected @ A.T, process, A @ remaining @ A.T)

    def _information(
        self, window: Window, tracks: LinearTracks, chosen: BoolArray, pixels: Views | None
    ) -> tuple[FloatArray, FloatArray]:
        """Information matrix (D, D) and vector (D,) of chosen tracks and of this frame's landmarks."""
        poses, variance, field = 6 * len(window.clones), self._tracks.variance, self._field(window)
        A, b, stereo = np.zeros((poses, poses)), np.zeros(poses), None
        if field is not None:
            stereo = StereoInformation.none(len(field.terms), poses + 3 * len(window.landmarks))
        if chosen.any():
            A, b = eliminate_points(tracks.information, chosen)
            if stereo is not None and tracks.stereo is not None:
                stereo = stereo + eliminate_points_from_columns(tracks.stereo, tracks.information, chosen)
        at = self._landmark_residuals(window, pixels) if pixels is not None and len(pixels.z) else None
        if at is not None and pixels is not None and field is not None and stereo is not None:
            H = field.jacobian(pixels.z - at.r)  # at the predicted pixels
            stereo = stereo + landmark_columns(at, H, len(window.clones))
        scaled = None if stereo is None else stereo.scaled(1 / variance)
        A, b = window.lift_information(A / variance, b / variance, scaled)
        if at is not None:
            window.add_landmarks_information(A, b, at, variance)
        return A, b

    def _focal_information(
        self, window: Window, tracks: LinearTracks, chosen: BoolArray, pixels: Views
    ) -> FloatArray | None:
        """Cross information (D,) of errors and focal length from `_information`; None where it is not followed."""
        if window.focal is None:
            return None
        first = 0 if window.calibration.stereo_field else TERMS - 1
        said = StereoInformation.none(TERMS - first, 6 * len(window.clones) + 3 * len(window.landmarks))
        rows = np.flatnonzero(chosen)
        if len(rows):
            everything = np.ones(len(rows), dtype=np.bool_)
            said = said + eliminate_points_from_columns(*self._tracks.focal_columns(tracks, rows), everything)
        if len(pixels.z):
            at = self._landmark_residuals(window, pixels)
            H = field_jacobian(self._camera, pixels.z - at.r, first, TERMS - first)
            said = said + landmark_columns(at, H, len(window.clones))
        return window.lift_focal(said.scaled(1 / self._tracks.variance))

    def _landmark_residuals(self, window: Window, pixels: Views) -> LandmarkResiduals:
        """Residuals of the landmarks' pixels in the newest exposure."""
        field = self._field(window)
        if field is not None:
            pixels = field.corrected(pixels)
        T = window.T_cam0_world(-1)[0]
        return landmark_residuals(self._camera, T, window.landmarks, pixels, self._tracks.variance)

    def _marginalise(self, window: Window, tracks: LinearTracks, good: BoolArray, pixels: Views) -> int:
        """Absorb what ends in this frame into the prior, estimate with all that is good, and make room.

        Only tracks and landmarks that passed their gates steer the estimate: the means move to the optimum of the
        prior, the landmarks' pixels and the good tracks, also those that go on.

        Returns:
            How many landmarks are new.
        """
        table, newest = self._tracks.table, len(window.clones) - 1
        full = len(window.clones) > self._settings.clones
        seen = table.seen(tracks.rows)
        lost, leaving = ~seen[:, newest], seen[:, 0] & full
        ending = lost | leaving
        focal = self._focal_information(window, tracks, ending & good, pixels)
        window.absorb(*self._information(window, tracks, ending & good, pixels), focal=focal)
        depth_sigma = np.sqrt(self._tracks.variance) * tracks.information.relative_depth_sigma()
        promoted = self._promote(window, tracks, leaving & good & seen[:, newest], depth_sigma)

        A, b = self._information(window, tracks, good & ~ending, None)
        P = self._move_to_optimum(window, tracks, A, b, window.first_landmark).covariance()  # no landmark is in it
        if self._scale_log is not None and window.scale_test is not None:
            size = window.first_landmark
            P = P + window.scale_covariance(A[:size, :size], P)
        own = slice(0, window.first_clone)
        self._output = P[own, own]
        rows = np.concatenate([np.arange(window.first_clone), np.r_[window.clone_rows(newest)]])
        self._newest, self._frame_pose = P[np.ix_(rows, rows)], window.nav.T_world_imu
        self._smoothed = WindowPosterior.of(window, P)

        done = np.flatnonzero(ending & good & (depth_sigma < _MAP_DEPTH_SIGMA))
        covariance = self._tracks.variance * tracks.information.point_covariance(done)
        self._store_points(table.ids(tracks.rows[done]), table.points[tracks.rows[done]], covariance)
        spent = leaving & ~lost
        spent[promoted] = False
        self._tracks.end_frame(spent=tracks.rows[spent], promoted=tracks.rows[promoted], newest=newest)
        if full:
            window.drop_oldest_clone()
            table.shift()
        return len(promoted)

    def _promote(
        self, window: Window, tracks: LinearTracks, candidates: BoolArray, depth_sigma: FloatArray
    ) -> IntArray:
        """Make landmarks of the best known points whose tracks leave the window; return which tracks (indices).

        Args:
            window: receives the landmarks.
            tracks: linearised at its means.
            candidates: mask (F,) of the tracks that may become landmarks.
            depth_sigma: (F,) standard deviation of each inverse depth, over itself.
        """
        room = self._settings.max_landmarks - len(window.landmarks)
        unsure = window.calibration.stereo_field or window.scale_sigma() > _SCALE_SIGMA
        if room <= 0 or unsure or not candidates.any():
            return np.zeros(0, dtype=np.int64)
        by_stereo = np.sqrt(self._tracks.variance) * relative_stereo_sigma(tracks.at, tracks.information.q)
        has_depth = (depth_sigma < _LANDMARK_DEPTH_SIGMA) | (by_stereo < _LANDMARK_STEREO_SIGMA)
        chosen = np.flatnonzero(candidates & has_depth)
        if not len(chosen):
            return chosen
        covariance = self._tracks.variance * tracks.information.point_covariance(chosen)
        # The best known points first: smallest largest standard deviation.
        worst = np.linalg.eigvalsh(covariance)[:, 2]
        table = self._tracks.table
        best = np.lexsort((table.ids(tracks.rows[chosen]), worst))[:room]
        chosen, covariance = chosen[best], covariance[best]
        p, point_D_poses = tracks.p_world[chosen], tracks.information.point_D_clones(chosen)
        point_D_poses[:, :, -3:] += so3_hat(p)  # the anchor: rotation of the newest exposure
        point_D_stereo = None
        if tracks.stereo is not None:
            point_D_stereo = tracks.stereo.point_D_stereo(tracks.information)[chosen]
        A = window.chain(point_D_poses, point_D_stereo)
        point_D_focal = None
        if window.focal is not None:
            columns, information = self._tracks.focal_columns(tracks, chosen)
            point_D_focal = columns.point_D_stereo(information)[..., -1].reshape(-1)
        ids = table.ids(tracks.rows[chosen])
        window.add_landmarks(ids, p, A.reshape(-1, len(window.P)), covariance, point_D_focal)
        return chosen


def _half_tangent(R: FloatArray) -> FloatArray:
    """Rotation vector (3,) of R (3, 3), rescaled to the length `tan(angle / 2)`."""
    phi = so3_log(R)
    half = 0.5 * float(np.linalg.norm(phi))
    out: FloatArray = phi * (0.5 * np.tan(half) / half if half > 1e-6 else 0.5)
    return out


def _newest(parts: list[Landmarks]) -> Landmarks:
    """Join parts of a map; of points that came back under their ids, the last ones."""
    ids = np.concatenate([part.ids for part in parts])[::-1]
    points = np.concatenate([part.p_world for part in parts])[::-1]
    covariances = np.concatenate([part.covariance for part in parts])[::-1]
    kept, last = np.unique(ids, return_index=True)
    return Landmarks(kept, points[last], covariances[last])


def _imu_terms_covariance(window: Window, output: FloatArray) -> FloatArray:
    """Covariance (15, 15) of the IMU's terms out of that of navigation state and calibration; zero where known."""
    out, chosen, own = np.zeros((IMU_TERMS, IMU_TERMS)), CHOSEN[window.calibration.imu], slice(DIM, window.nav_dim)
    out[np.ix_(chosen, chosen)] = output[own, own]
    return out
