"""The sliding-window filter: right-invariant, multi-state constrained, with long-lived landmarks.

A frame's work: predict; clone the pose; Gauss-Newton over the whole window with all that is seen, which gives the
estimate; then commit for good what ends here (tracks that were lost, tracks that leave the window) and forget the
oldest clone. Tracks that go on are linearised anew in every frame and committed once. The prior is kept in
right-invariant errors, whose unobservable directions (global position and yaw) are the same whatever the estimate, so
relinearising gains no information along them.
References: Mourikis & Roumeliotis (2007); Sun et al. (2018); Wu et al., An invariant-EKF VINS algorithm for improving
consistency (2017); Barrau & Bonnabel (2017).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from scipy.linalg import block_diag

from vio.errors import ConfigError, EstimationError
from vio.filters.multiview import MIN_DEPTH, Views, eliminate_points, landmark_information, relative_stereo_sigma
from vio.filters.navigation import DIM, NO_STEP, Growth, ImuMotion, Transition, TwistMotion
from vio.filters.noise import MotionNoise, StepErrors
from vio.filters.online_calibration import first_calibration
from vio.filters.settings import MsckfSettings
from vio.filters.tracks import latest_pixels
from vio.filters.window import Window, posterior
from vio.filters.window_tracks import MIN_TRACKS_FOR_NOISE, LinearTracks, WindowTracks
from vio.geometry.lie import FloatArray, se3_adjoint, se3_inverse, se3_log, so3_hat, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.records import (
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
    TrackPrior,
    UpdateReport,
    VelocitySample,
)

_MAX_WAIT_FRAMES = 20
_FIRST_STEPS, _LATER_STEPS = 0, 1  # Gauss-Newton steps on each point, before and after the poses moved
# Factors on the motion model's densities: at the start, at least, at most.
_IMU_FACTORS = (5.0, 1.0, 50.0)
_TWIST_FACTORS = (1.0, 0.1, 10.0)
# Standard deviations of a point's inverse depth over itself, at most. A landmark is linearised and marginalised frame
# by frame as a Cartesian point, which biases scale in second order of it where the depth comes from motion. With left
# images and an IMU, position NEES after 2 s is 24 of 3 at 0.2, 15 at 0.05, 6 at 0.02, 2.8 at 0.01, 2.5 without any.
_LANDMARK_DEPTH_SIGMA = 0.01  # by all views
_LANDMARK_STEREO_SIGMA = 0.1  # or by the right views alone, which know the scale
_MAP_DEPTH_SIGMA = 0.2  # by all views; a point of the map is reported with its covariance, and not used
_LEAST_MERGE = 1000  # points told again beside which merging the map costs nothing
_FAR = 0.5  # pixels by which the predicted pose may be off before one step over the window is too few
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
        """Start without any belief; the first frame begins it.

        Args:
            camera: the rectified stereo camera.
            T_cam0_imu: extrinsics (4, 4).
            settings: the filter's section of the configuration.
            motion: which motion samples will come; None: images alone.

        Raises:
            ConfigError: the calibration is to be estimated without an IMU.
        """
        if settings.calibrate != "none" and motion != "imu":
            raise ConfigError(f"msckf.calibrate: {settings.calibrate} needs --motion imu; set it to none")
        self._camera, self._settings = camera, settings
        self._calibration = first_calibration(T_cam0_imu, settings)
        self._source = motion
        self._motion: ImuMotion | TwistMotion = ImuMotion(settings) if motion == "imu" else TwistMotion(settings)
        self._window: Window | None = None
        self._tracks = WindowTracks(camera, settings)
        self._time_ns = 0
        self._began_ns = 0
        self._body_ns = 0  # time of the navigation state, on the IMU's clock
        self._waited = 0
        self._blind = False  # the last frame showed nothing
        self._output: FloatArray = np.zeros((DIM, DIM))  # covariance (15 + C, 15 + C) with all that is seen
        self._noise = MotionNoise(*_IMU_FACTORS) if motion == "imu" else MotionNoise(*_TWIST_FACTORS)
        self._gyro: FloatArray | None = None  # (3,) mean rate measured over the last step
        self._since_frame = NO_STEP  # how the error has grown since the last frame
        self._predicted_step: tuple[int, Transition] | None = None  # integrated by `predict`, with its end
        self._map: list[Landmarks] = []
        self._points_stored = 0  # points in the map since it was merged

    def propagate(self, sample: MotionSample) -> None:
        """Take a motion sample.

        Raises:
            ConfigError: the sample is not of the kind that was announced.
        """
        expected = {"imu": ImuSample, "velocity": VelocitySample}.get(self._source or "")
        if expected is None or not isinstance(sample, expected):
            raise ConfigError(f"msckf was built for motion {self._source or 'none'}, got a {type(sample).__name__}")
        self._motion.take(sample)
        self._predicted_step = None  # the sample may change what the step looks like
        if isinstance(sample, VelocitySample) and self._window is not None:
            self._advance(sample.time_ns)
            self._measure()

    def predict(self, time_ns: int) -> Prediction | None:
        """Tell what a coming frame should show: the pixels of all tracks with a point, and the camera's motion."""
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
        T_cam0_imu = window.calibration.T_cam0_imu
        T_cam0_world = T_cam0_imu @ se3_inverse(window.exposure(nav, (body_ns - time_ns) * 1e-9))
        T_curr_prev = T_cam0_world @ window.exposures()[-1] @ se3_inverse(T_cam0_imu)
        # T_curr_prev = exp(A (xi_prev - xi_curr)) T_hat with A = Ad(T_cam0_world)
        A = se3_adjoint(T_cam0_world)
        motion = MotionPrior(T_curr_prev, A @ self._expected_error(growth) @ A.T)
        return Prediction(self._expected_tracks(window, T_cam0_world, T_curr_prev[:3, :3]), motion)

    def _expected_error(self, growth: Growth) -> FloatArray:
        """Covariance (6, 6) of `xi_curr - xi_prev` where the error at the last frame, xi_prev, has grown to xi_curr."""
        M = growth.Phi[:6] - np.eye(6, DIM)
        out: FloatArray = M @ self._output[:DIM, :DIM] @ M.T + growth.Q[:6, :6]
        return out

    def _expected_tracks(self, window: Window, T_cam0_world: FloatArray, R_cam_prev: FloatArray) -> TrackPrior:
        table = self._tracks.table
        rows = table.rows()
        rows = rows[table.has_point[rows]]
        ids = np.concatenate([table.ids(rows), window.landmark_ids])
        p_cam = transform_points(T_cam0_world, np.concatenate([table.points[rows], window.landmarks]))
        ahead = p_cam[:, 2] > MIN_DEPTH * self._camera.baseline_m
        return TrackPrior(ids[ahead], project(self._camera, p_cam[ahead]), R_cam_prev)

    def update(self, observations: Observations) -> UpdateReport:
        """Predict to the time of the frame and take in its observations.

        Raises:
            EstimationError: the motion samples do not cover the step, or the filter diverged.
        """
        seen = observations.take(~observations.stale)
        if self._window is None:
            if not self._motion.ready:
                return self._wait(observations)
            nav, P = self._motion.start(observations.time_ns)
            calibration, P_calibration, _ = self._calibration
            self._window = Window(self._motion, nav, np.asarray(block_diag(P, P_calibration)), calibration)
            self._time_ns = self._body_ns = self._began_ns = observations.time_ns
            self._measure()
        else:
            self._advance(observations.time_ns)
        window = self._window
        if window.clones and not len(seen):
            # A frame that shows nothing ends no track; what is seen next decides.
            self._blind = True
            return UpdateReport(0, 0, 0, len(window.landmarks), None, None)
        self._blind = False
        late_s = (self._body_ns - observations.time_ns) * 1e-9
        window.add_clone(observations.frame_index, observations.time_ns, late_s)
        try:
            report = self._use(window, seen)
        except np.linalg.LinAlgError as error:
            raise EstimationError(self._lost(observations.frame_index)) from error
        if not np.isfinite(window.P).all() or not np.isfinite(window.nav.T_world_imu).all():
            raise EstimationError(self._lost(observations.frame_index))
        return report

    def estimate(self) -> Estimate:
        """Return the belief at the time of the last event."""
        if self._window is None:
            return Estimate(self._time_ns, np.eye(4), np.eye(6))
        window = self._window
        output = self._grown_output()
        T, covariance = window.current_pose(output)
        # exp(xi) T_hat on the world's side is T_hat exp(Ad(T_hat^-1) xi); the inverse pose's error is its negative.
        A = se3_adjoint(se3_inverse(T))
        estimate = Estimate(
            self._time_ns,
            T,
            A @ covariance @ A.T,
            velocity_world=self._motion.velocity_world(window.nav),
            gyro_bias=window.nav.gyro_bias,
            accel_bias=window.nav.accel_bias,
        )
        return window.calibration.add_to_estimate(estimate, output[DIM:, DIM:])

    def _grown_output(self) -> FloatArray:
        """Covariance of navigation state and calibration at the time of the last event."""
        if not self._blind:
            return self._output
        grow = np.eye(len(self._output))
        grow[:DIM, :DIM] = self._since_frame.Phi
        out: FloatArray = grow @ self._output @ grow.T
        out[:DIM, :DIM] += self._since_frame.Q
        return out

    def pose_of(self, frame_index: int) -> FloatArray | None:
        """Return `T_world_imu` (4, 4) of a past frame as the window has it now; None where it has left the window."""
        clones = [] if self._window is None else self._window.clones
        return next((clone.T_world_imu for clone in clones if clone.frame_index == frame_index), None)

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

    def _store_landmarks(self, window: Window, chosen: BoolArray) -> None:
        first = window.first_landmark
        rows = [slice(first + 3 * k, first + 3 * k + 3) for k in np.flatnonzero(chosen).tolist()]
        blocks = np.array([window.P[r, r] for r in rows]).reshape(-1, 3, 3)
        self._store_points(window.landmark_ids[chosen], window.landmarks[chosen], blocks)

    def _store_points(self, ids: IntArray, p_world: FloatArray, covariance: FloatArray) -> None:
        """Add points to the map that is only told, never used."""
        if len(ids):
            self._map.append(Landmarks(ids, p_world, covariance))
            self._points_stored += len(ids)
            # Features that stay in view are told again and again.
            if self._points_stored > _LEAST_MERGE + len(self._map[0].ids):
                self._map, self._points_stored = [_newest(self._map)], 0

    def _wait(self, observations: Observations) -> UpdateReport:
        """Let a frame pass that comes before the first motion sample.

        Raises:
            EstimationError: too many frames have passed.
        """
        self._waited += 1
        if self._waited > _MAX_WAIT_FRAMES:
            raise EstimationError(
                f"{self._waited} frames without an IMU sample; check the clocks, or use --motion none"
            )
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
            window.propagate(step)
            self._propagate_calibration(window, (body_ns - self._body_ns) * 1e-9)
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

    def _propagate_calibration(self, window: Window, step_s: float) -> None:
        """Estimate the calibration once the motion is known, and let it walk from then on."""
        if window.calibration.dim:
            if not window.calibrating and self._time_ns - self._began_ns >= 1e9 * self._settings.calibrate_after_s:
                window.start_calibration()
            if window.calibrating:
                window.add_calibration_noise(self._calibration[2] * step_s)

    def _body_time(self, time_ns: int) -> int:
        """The time on the IMU's clock to which the navigation state is carried for a frame."""
        calibration = self._started().calibration
        if not calibration.timing or not isinstance(self._motion, ImuMotion):
            return time_ns
        return self._motion.covered(time_ns + round(1e9 * calibration.time_offset_s))

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
        """Everything that a frame's observations do."""
        z, weight, found = latest_pixels(seen, window.landmark_ids)
        self._store_landmarks(window, ~found)
        window.keep_landmarks(found)
        pixels = Views(z[found], weight[found])
        self._tracks.table.add_frame(len(window.clones) - 1, seen.take(~np.isin(seen.ids, window.landmark_ids)))

        if self._tracks.is_stationary(len(window.clones)):
            rest = self._motion.zero_velocity(window.nav, self._gyro)
            if rest is not None:
                window.absorb_measurement(rest)
        predicted, expected = window.last_move(), self._expected_error(self._since_frame)
        tracks = self._tracks.linearise(window.T_cam0_world(), self._tracks.choose(len(window.clones)), _FIRST_STEPS)
        innovation = tracks.newest_innovation()
        tracks, P = self._fit(window, tracks, pixels, innovation)
        step = self._step_errors(window, tracks, predicted, expected, P)
        if step is not None:
            missing = step.missing_noise()
            if missing.any() and self._tracks.agree(tracks.at):
                window.inflate_process_noise(np.einsum("k,kij->ij", missing, self._since_frame.Q_parts))
                tracks, _ = self._fit(window, tracks, pixels, innovation)
            self._noise.follow(step)
        self._since_frame = NO_STEP

        tracks = self._tracks.without_wrong_views(tracks)
        good, nis = self._tracks.gate(tracks.at)
        self._tracks.update_pixel_noise(nis)
        report = self._commit(window, tracks, good, pixels)
        return UpdateReport(
            used=int(good.sum()) + len(pixels.z),
            gated=int((~good).sum()),
            initialised=report,
            landmarks=len(window.landmarks),
            innovation_median_px=innovation,
            nis_per_dof=float(np.median(nis)) if len(nis) else None,
        )

    def _fit(
        self, window: Window, tracks: LinearTracks, pixels: Views, innovation: float | None
    ) -> tuple[LinearTracks, FloatArray]:
        """Gauss-Newton over the window; returns the tracks linearised at the estimate, and the covariance (D, D)."""
        P = window.P
        for _ in range(_MOST_STEPS):
            everything = np.ones(len(tracks.rows), dtype=np.bool_)
            A, b = self._information(window, tracks, everything, pixels)
            P, shift = posterior(window.P, A, b + A @ window.prior_delta)
            error = shift - window.prior_delta
            self._tracks.move_points(tracks, window.exposure_errors(error))
            window.relinearise(error)
            tracks = self._tracks.linearise(window.T_cam0_world(), tracks.rows, _LATER_STEPS)
            residual = tracks.newest_innovation()
            # Another step pays only where this one had far to go.
            if innovation is None or residual is None or innovation < max(_FAR, 3 * residual):
                break
            innovation = residual
        return tracks, P

    def _step_errors(
        self,
        window: Window,
        tracks: LinearTracks,
        predicted: FloatArray | None,
        expected: FloatArray,
        P: FloatArray,
    ) -> StepErrors | None:
        """The predicted and the corrected motion since the last frame, whose fit left the covariance P (D, D).

        None where too few tracks tell.
        """
        moved = window.last_move()
        if predicted is None or moved is None or len(tracks.rows) < MIN_TRACKS_FOR_NOISE:
            return None
        remaining = window.last_move_covariance(P)
        A = se3_adjoint(se3_inverse(window.nav.T_world_imu))
        process = A @ self._since_frame.Q[:6, :6] @ A.T
        correction = se3_log(se3_inverse(predicted) @ moved)
        return StepErrors(correction, A @ expected @ A.T, process, A @ remaining @ A.T)

    def _information(
        self, window: Window, tracks: LinearTracks, chosen: BoolArray, pixels: Views | None
    ) -> tuple[FloatArray, FloatArray]:
        """Information matrix (D, D) and vector (D,) of chosen tracks and of this frame's landmarks."""
        poses, size = 6 * len(window.clones), 6 * len(window.clones) + 3 * len(window.landmarks)
        A, b, variance = np.zeros((size, size)), np.zeros(size), self._tracks.variance
        if chosen.any():
            A[:poses, :poses], b[:poses] = eliminate_points(tracks.information, chosen)
        if pixels is not None and len(pixels.z):
            T = window.T_cam0_world()[-1]
            C, g = landmark_information(self._camera, T, window.landmarks, pixels, variance)
            window.add_landmark_information(A, b, C, g)
        return window.lift_information(A / variance, b / variance)

    def _commit(self, window: Window, tracks: LinearTracks, good: BoolArray, pixels: Views) -> int:
        """Commit what ends in this frame, keep the output covariance, make room; return how many landmarks are new."""
        table, newest = self._tracks.table, len(window.clones) - 1
        full = len(window.clones) > self._settings.clones
        seen = table.seen(tracks.rows)
        lost, leaving = ~seen[:, newest], seen[:, 0] & full
        ending = lost | leaving
        A, b = self._information(window, tracks, ending & good, pixels)
        window.absorb(A, b)

        done = ending & good & (self._depth_sigma(tracks) < _MAP_DEPTH_SIGMA)
        told = self._tracks.variance * tracks.information.point_covariance()[done]
        self._store_points(table.ids(tracks.rows[done]), tracks.p_world[done], told)

        going_on = good & ~ending
        own = slice(0, window.first_clone)
        if going_on.any():
            A_on = self._information(window, tracks, going_on, None)[0]
            self._output = posterior(window.P, A_on, np.zeros(len(A)))[0][own, own]
        else:
            self._output = window.P[own, own].copy()

        promoted = self._promote(window, tracks, leaving & good & seen[:, newest])
        spent = leaving & ~lost
        spent[promoted] = False
        self._tracks.end_frame(spent=tracks.rows[spent], promoted=tracks.rows[promoted], newest=newest)
        if full:
            window.drop_oldest_clone()
            table.shift()
        return len(promoted)

    def _promote(self, window: Window, tracks: LinearTracks, candidates: BoolArray) -> IntArray:
        """Make landmarks of the best known points whose tracks leave the window; return which tracks (indices)."""
        room = self._settings.max_landmarks - len(window.landmarks)
        by_stereo = np.sqrt(self._tracks.variance) * relative_stereo_sigma(tracks.at, tracks.information.q)
        has_depth = (self._depth_sigma(tracks) < _LANDMARK_DEPTH_SIGMA) | (by_stereo < _LANDMARK_STEREO_SIGMA)
        chosen = np.flatnonzero(candidates & has_depth)
        if room <= 0 or not len(chosen):
            return np.zeros(0, dtype=np.int64)
        covariance = self._tracks.variance * tracks.information.point_covariance()
        # The best known points first: smallest largest standard deviation.
        worst = np.linalg.eigvalsh(covariance[chosen])[:, 2]
        table = self._tracks.table
        chosen = chosen[np.lexsort((table.ids(tracks.rows[chosen]), worst))[:room]]
        p, point_D_poses = tracks.p_world[chosen], tracks.information.point_D_clones()[chosen]
        point_D_poses[:, :, -3:] += so3_hat(p)  # the anchor: rotation of the newest exposure
        A = window.chain(point_D_poses)
        window.add_landmarks(table.ids(tracks.rows[chosen]), p, A.reshape(-1, len(window.P)), covariance[chosen])
        return chosen

    def _depth_sigma(self, tracks: LinearTracks) -> FloatArray:
        """Standard deviation (F,) of the inverse depth of the tracks' points, over itself."""
        out: FloatArray = np.sqrt(self._tracks.variance) * tracks.information.relative_depth_sigma()
        return out


def _newest(parts: list[Landmarks]) -> Landmarks:
    """Join parts of a map; of points that came back under their ids, the last ones."""
    ids = np.concatenate([part.ids for part in parts])[::-1]
    points = np.concatenate([part.p_world for part in parts])[::-1]
    covariances = np.concatenate([part.covariance for part in parts])[::-1]
    kept, last = np.unique(ids, return_index=True)
    return Landmarks(kept, points[last], covariances[last])
