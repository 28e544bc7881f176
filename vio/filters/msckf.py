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

import logging
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import chi2

from vio.errors import ConfigError, EstimationError
from vio.filters.extrinsics import first_calibration
from vio.filters.multiview import (
    CAUCHY,
    MIN_DEPTH,
    Residuals,
    TrackInformation,
    Views,
    eliminate_points,
    first_points,
    landmark_information,
    refine_points,
    residuals,
    robust_weights,
    track_information,
    within,
)
from vio.filters.navigation import DIM, ImuMotion, Transition, TwistMotion
from vio.filters.noise import MotionNoise, StepErrors
from vio.filters.settings import MsckfSettings
from vio.filters.tracks import TrackTable, latest_pixels
from vio.filters.window import Window, posterior
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

log = logging.getLogger(__name__)

_NOISE_GAIN = 0.05  # how fast the pixel noise follows the residuals
_MIN_TRACKS_FOR_NOISE = 15
_MIN_TRACKS_TO_STAND = 15
_MAX_WAIT_FRAMES = 20
_FIRST_STEPS, _LATER_STEPS = 0, 1  # Gauss-Newton steps on each point, before and after the poses moved
_VIEW_LIMIT = 23.5  # chi-square with 4 degrees of freedom, probability 0.9999
# Factors on the motion model's densities: at the start, at least, at most.
_IMU_FACTORS = (5.0, 1.0, 50.0)
_TWIST_FACTORS = (1.0, 0.1, 10.0)
_AGREEMENT = 0.8
_FAR = 0.5  # pixels by which the predicted pose may be off before one step over the window is too few


@dataclass(frozen=True, slots=True)
class _Growth:
    """How the navigation state's error grows over steps."""

    Phi: FloatArray  # (15, 15)
    Q: FloatArray  # (15, 15)
    Q_parts: FloatArray  # (2, 15, 15)

    def then(self, step: Transition) -> _Growth:
        """Append a step."""
        Phi = step.Phi
        return _Growth(Phi @ self.Phi, Phi @ self.Q @ Phi.T + step.Q, Phi @ self.Q_parts @ Phi.T + step.Q_parts)


_NO_STEP = _Growth(np.eye(DIM), np.zeros((DIM, DIM)), np.zeros((2, DIM, DIM)))


class _Tracks:
    """The tracks of one linearisation."""

    def __init__(self, rows: IntArray, p_world: FloatArray, at: Residuals, information: TrackInformation) -> None:
        self.rows, self.p_world, self.at, self.information = rows, p_world, at, information


class Msckf:
    """The sliding-window filter as a back end."""

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
            ConfigError: a value is out of range.
        """
        if settings.clones < 3 or settings.iterations < 1 or settings.max_features < 1 or settings.max_landmarks < 0:
            raise ConfigError("msckf: clones must be at least 3, iterations and max_features 1, max_landmarks 0")
        if settings.calibrate != "none" and motion != "imu":
            raise ConfigError(f"msckf.calibrate: {settings.calibrate} needs --motion imu; set it to none")
        self._camera, self._settings = camera, settings
        self._calibration = first_calibration(T_cam0_imu, settings)
        self._source = motion
        self._motion: ImuMotion | TwistMotion = ImuMotion(settings) if motion == "imu" else TwistMotion(settings)
        self._window: Window | None = None
        self._tracks = TrackTable(settings.clones + 1)
        self._time_ns = 0
        self._began_ns = 0
        self._body_ns = 0  # time of the navigation state, on the IMU's clock
        self._waited = 0
        self._blind = False  # the last frame showed nothing
        self._sigma2 = settings.pixel_sigma_px**2
        self._output: FloatArray = np.zeros((DIM, DIM))  # covariance (15 + C, 15 + C) with all that is seen
        self._noise = MotionNoise(*_IMU_FACTORS) if motion == "imu" else MotionNoise(*_TWIST_FACTORS)
        self._gyro: FloatArray | None = None  # (3,) mean rate measured over the last step
        self._since_frame = _NO_STEP  # how the error has grown since the last frame
        self._map: list[Landmarks] = []

    def propagate(self, sample: MotionSample) -> None:
        """Take a motion sample.

        Raises:
            ConfigError: the sample is not of the kind that was announced.
        """
        expected = {"imu": ImuSample, "velocity": VelocitySample}.get(self._source or "")
        if expected is None or not isinstance(sample, expected):
            raise ConfigError(f"msckf was built for motion {self._source or 'none'}, got a {type(sample).__name__}")
        self._motion.take(sample)
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
                step = self._motion.advance(nav, self._body_ns, body_ns, self._noise.factors)
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

    def _expected_error(self, growth: _Growth) -> FloatArray:
        """Covariance (6, 6) of `xi_curr - xi_prev` where the error at the last frame, xi_prev, has grown to xi_curr."""
        M = growth.Phi[:6] - np.eye(6, DIM)
        out: FloatArray = M @ self._output[:DIM, :DIM] @ M.T + growth.Q[:6, :6]
        return out

    def _expected_tracks(self, window: Window, T_cam0_world: FloatArray, R_cam_prev: FloatArray) -> TrackPrior:
        rows = self._tracks.rows()
        rows = rows[self._tracks.has_point[rows]]
        ids = np.concatenate([self._tracks.ids(rows), window.landmark_ids])
        p_cam = transform_points(T_cam0_world, np.concatenate([self._tracks.points[rows], window.landmarks]))
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
        T, covariance = window.present(output)
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
        return window.calibration.tell(estimate, output[DIM:, DIM:])

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
        """Return the points of all tracks that have been used, with their covariance given the poses.

        A point that came back under its id appears once, as it was seen last.
        """
        window = self._started()
        first, n = window.first_landmark, len(window.landmarks)
        blocks = [window.P[first + 3 * k : first + 3 * k + 3, first + 3 * k : first + 3 * k + 3] for k in range(n)]
        parts = [*self._map, Landmarks(window.landmark_ids, window.landmarks, np.array(blocks).reshape(n, 3, 3))]
        ids = np.concatenate([part.ids for part in parts])[::-1]
        points = np.concatenate([part.p_world for part in parts])[::-1]
        covariances = np.concatenate([part.covariance for part in parts])[::-1]
        kept, last = np.unique(ids, return_index=True)
        return Landmarks(kept, points[last], covariances[last])

    def _remember_landmarks(self, window: Window, chosen: BoolArray) -> None:
        first = window.first_landmark
        rows = [slice(first + 3 * k, first + 3 * k + 3) for k in np.flatnonzero(chosen).tolist()]
        blocks = np.array([window.P[r, r] for r in rows]).reshape(-1, 3, 3)
        self._remember(window.landmark_ids[chosen], window.landmarks[chosen], blocks)

    def _remember(self, ids: IntArray, p_world: FloatArray, covariance: FloatArray) -> None:
        """Add points to the map that is only told, never used."""
        if len(ids):
            self._map.append(Landmarks(ids, p_world, covariance))

    @property
    def pixel_sigma_px(self) -> float:
        """The pixel noise as estimated from the residuals."""
        return float(np.sqrt(self._sigma2))

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
            step = self._motion.advance(window.nav, self._body_ns, body_ns, self._noise.factors)
            self._motion.forget_before(body_ns)
            window.propagate(step)
            self._let_calibration_walk(window, (body_ns - self._body_ns) * 1e-9)
            self._since_frame = self._since_frame.then(step)
            self._gyro = step.gyro
            self._body_ns = body_ns
        self._time_ns = time_ns

    def _let_calibration_walk(self, window: Window, step_s: float) -> None:
        """Estimate the calibration once the motion is known, and let it walk from then on."""
        if window.calibration.dim:
            if not window.calibrating and self._time_ns - self._began_ns >= 1e9 * self._settings.calibrate_after_s:
                window.begin_calibration()
            if window.calibrating:
                window.let_calibration_walk(self._calibration[2] * step_s)

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
            window.commit_measurement(measurement)

    def _use(self, window: Window, seen: Observations) -> UpdateReport:
        """Everything that a frame's observations do."""
        z, weight, found = latest_pixels(seen, window.landmark_ids)
        self._remember_landmarks(window, ~found)
        window.keep_landmarks(found)
        pixels = Views(z[found], weight[found])
        self._tracks.add_frame(len(window.clones) - 1, seen.take(~np.isin(seen.ids, window.landmark_ids)))

        if self._stands(len(window.clones)):
            rest = self._motion.standing(window.nav, self._gyro)
            if rest is not None:
                window.commit_measurement(rest)
        predicted, expected = window.last_move(), self._expected_error(self._since_frame)
        tracks = self._linearise(window, self._choose(window), _FIRST_STEPS)
        innovation = _newest_innovation(tracks.at)
        tracks, P = self._fit(window, tracks, pixels, innovation)
        step = self._step_errors(window, tracks, predicted, expected, P)
        if step is not None:
            missing = step.missing_noise()
            if missing.any() and self._images_agree(tracks.at):
                window.widen(np.einsum("k,kij->ij", missing, self._since_frame.Q_parts))
                tracks, _ = self._fit(window, tracks, pixels, innovation)
            self._noise.follow(step)
        self._since_frame = _NO_STEP

        tracks = self._without_wrong_views(tracks)
        good, nis = self._gate(tracks.at)
        self._follow_noise(tracks.at, nis)
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
        self, window: Window, tracks: _Tracks, pixels: Views, innovation: float | None
    ) -> tuple[_Tracks, FloatArray]:
        """Gauss-Newton over the window; returns the tracks linearised at the estimate, and the covariance (D, D)."""
        P = window.P
        for _ in range(self._settings.iterations):
            everything = np.ones(len(tracks.rows), dtype=np.bool_)
            A, b = self._information(window, tracks, everything, pixels)
            P, shift = posterior(window.P, A, b + A @ window.offset)
            error = shift - window.offset
            self._move_points(tracks, window.exposure_errors(error))
            window.relinearise(error)
            tracks = self._linearise(window, tracks.rows, _LATER_STEPS)
            residual = _newest_innovation(tracks.at)
            # Another step pays only where this one had far to go.
            if innovation is None or residual is None or innovation < max(_FAR, 3 * residual):
                break
            innovation = residual
        return tracks, P

    def _step_errors(
        self,
        window: Window,
        tracks: _Tracks,
        predicted: FloatArray | None,
        expected: FloatArray,
        P: FloatArray,
    ) -> StepErrors | None:
        """The predicted and the corrected motion since the last frame, whose fit left the covariance P (D, D).

        None where too few tracks tell.
        """
        moved = window.last_move()
        if predicted is None or moved is None or len(tracks.rows) < _MIN_TRACKS_FOR_NOISE:
            return None
        remaining = window.last_move_covariance(P)
        A = se3_adjoint(se3_inverse(window.nav.T_world_imu))
        process = A @ self._since_frame.Q[:6, :6] @ A.T
        correction = se3_log(se3_inverse(predicted) @ moved)
        return StepErrors(correction, A @ expected @ A.T, process, A @ remaining @ A.T)

    def _images_agree(self, at: Residuals) -> bool:
        """Whether nearly all views of the newest clone fit: only then may they contradict the motion model."""
        squares, used = np.sum(at.r[:, -1] ** 2, axis=1), np.any(at.z_D_p[:, -1] != 0, axis=(1, 2))
        return bool(used.any() and np.mean(squares[used] < _VIEW_LIMIT * self._sigma2) > _AGREEMENT)

    def _stands(self, clones: int) -> bool:
        """Whether the image stands still: the median track, and nine tenths of all within twice its limit."""
        limit = self._settings.still_px
        moved = self._tracks.moved_px(clones - 1) if clones > 1 and limit > 0 else np.zeros(0)
        if len(moved) < _MIN_TRACKS_TO_STAND:
            return False
        return bool(np.median(moved) < limit and np.quantile(moved, 0.9) < 2 * limit)

    def _choose(self, window: Window) -> IntArray:
        """Rows of the tracks that say something of the poses: two views or more, the most telling first if too many."""
        rows = self._tracks.rows()
        seen = self._tracks.seen(rows)
        length = seen.sum(axis=1)
        rows, seen, length = rows[length >= 2], seen[length >= 2], length[length >= 2]
        if len(rows) > self._settings.max_features:
            # What ends now has its last chance; then the longest.
            ends = ~seen[:, len(window.clones) - 1] | seen[:, 0]
            best = np.lexsort((self._tracks.ids(rows), -length, ~ends))[: self._settings.max_features]
            rows = rows[np.sort(best)]
        return rows

    def _linearise(self, window: Window, rows: IntArray, steps: int) -> _Tracks:
        """Triangulate tracks, from where their points were last, and linearise them at the present estimate."""
        camera, table = self._camera, self._tracks
        views = table.views(rows, len(window.clones))
        T = window.T_cam0_world()
        fresh = ~table.has_point[rows]
        if fresh.any():
            start, known = first_points(camera, T, views.take(fresh))
            table.points[rows[fresh]], table.has_point[rows[fresh]] = start, known
            rows = rows[table.has_point[rows]]
            views = table.views(rows, len(window.clones))
        p = refine_points(camera, T, table.points[rows], views, steps, CAUCHY * self.pixel_sigma_px)
        at = residuals(camera, T, p, views)
        keep = at.ahead & within(camera, T, p, self._settings.max_distance * camera.baseline_m)
        table.points[rows], table.has_point[rows] = p, keep
        rows, p = rows[keep], p[keep]
        at = Residuals(at.r[keep], at.z_D_p[keep], at.ahead[keep])
        return _Tracks(rows, p, at, track_information(at, p, robust_weights(at, self._sigma2)))

    def _move_points(self, tracks: _Tracks, exposure_errors: FloatArray) -> None:
        """Move each point as its own normal equations say once the clones have moved (6N,): back-substitution."""
        info = tracks.information
        right = info.point_gradient - np.einsum("fik,i->fk", info.G, exposure_errors)
        step = np.linalg.solve(info.C, right[..., None])[..., 0]
        self._tracks.points[tracks.rows] = tracks.p_world + step

    def _information(
        self, window: Window, tracks: _Tracks, chosen: BoolArray, pixels: Views | None
    ) -> tuple[FloatArray, FloatArray]:
        """Information matrix (D, D) and vector (D,) of chosen tracks and of this frame's landmarks."""
        poses, size = 6 * len(window.clones), 6 * len(window.clones) + 3 * len(window.landmarks)
        A, b = np.zeros((size, size)), np.zeros(size)
        if chosen.any():
            A[:poses, :poses], b[:poses] = eliminate_points(tracks.information, chosen)
        if pixels is not None and len(pixels.z):
            T = window.T_cam0_world()[-1]
            C, g = landmark_information(self._camera, T, window.landmarks, pixels, self._sigma2)
            window.add_landmark_information(A, b, C, g)
        return window.spread(A / self._sigma2, b / self._sigma2)

    def _without_wrong_views(self, tracks: _Tracks) -> _Tracks:
        """Drop single views that contradict the rest of their track, for good, and linearise what is left."""
        squares = np.sum(tracks.at.r**2, axis=2) / self._sigma2
        wrong: BoolArray = squares > _VIEW_LIMIT
        if not wrong.any():
            return tracks
        self._tracks.drop_views(tracks.rows, wrong)
        kept = ~wrong
        at = Residuals(
            tracks.at.r * kept[..., None], tracks.at.z_D_p * kept[..., None, None], np.ones(len(wrong), dtype=np.bool_)
        )
        enough = np.any(at.z_D_p[:, :, 1, :], axis=2).sum(axis=1) >= 2
        at = Residuals(at.r[enough], at.z_D_p[enough], at.ahead[enough])
        p = tracks.p_world[enough]
        return _Tracks(tracks.rows[enough], p, at, track_information(at, p, robust_weights(at, self._sigma2)))

    def _gate(self, at: Residuals) -> tuple[BoolArray, FloatArray]:
        """Which tracks (F,) pass the chi-square gate, and their squared residual over its degrees of freedom (F,)."""
        pairs: BoolArray = np.any(at.z_D_p[:, :, 1::2, :], axis=3)  # (F, N, 2): seen left, seen right
        dof = np.maximum(2 * pairs.sum(axis=(1, 2)) - 3, 1)
        squares = np.sum(at.r**2, axis=(1, 2)) / self._sigma2
        limit = _chi2_table(self._settings.gate_probability)[np.minimum(dof, 199)]
        passed: BoolArray = squares <= limit
        return passed, squares / dof

    def _follow_noise(self, at: Residuals, nis: FloatArray) -> None:
        """Let the pixel noise follow the median of the squared residuals, robustly and slowly."""
        if len(nis) < _MIN_TRACKS_FOR_NOISE:
            return
        s = self._settings
        # The median of chi-square over its degrees of freedom is below one; 0.85 is right for 4 to 8 degrees.
        ratio = float(np.clip(np.median(nis) / 0.85, 0.25, 4.0))
        self._sigma2 = float(
            np.clip(self._sigma2 * ratio**_NOISE_GAIN, s.pixel_sigma_min_px**2, s.pixel_sigma_max_px**2)
        )

    def _commit(self, window: Window, tracks: _Tracks, good: BoolArray, pixels: Views) -> int:
        """Commit what ends in this frame, keep the output covariance, make room; return how many landmarks are new."""
        newest = len(window.clones) - 1
        full = len(window.clones) > self._settings.clones
        seen = self._tracks.seen(tracks.rows)
        lost, leaving = ~seen[:, newest], seen[:, 0] & full
        ending = lost | leaving
        A, b = self._information(window, tracks, ending & good, pixels)
        window.commit(A, b)

        done = ending & good
        told = np.asarray(self._sigma2 * np.linalg.inv(tracks.information.C[done]), dtype=np.float64)
        self._remember(self._tracks.ids(tracks.rows[done]), tracks.p_world[done], told)

        going_on = good & ~ending
        own = slice(0, window.first_clone)
        if going_on.any():
            A_on = self._information(window, tracks, going_on, None)[0]
            self._output = posterior(window.P, A_on, np.zeros(len(A)))[0][own, own]
        else:
            self._output = window.P[own, own].copy()

        promoted = self._promote(window, tracks, leaving & good & seen[:, newest])
        self._tracks.remove(tracks.rows[promoted])
        ended = ending.copy()
        ended[promoted] = False
        all_rows = self._tracks.rows()
        gone = ~self._tracks.seen(all_rows)[:, newest]
        self._tracks.forget_views(tracks.rows[ended & ~lost])
        self._tracks.remove(all_rows[gone])
        if full:
            window.drop_oldest_clone()
            self._tracks.shift()
        return len(promoted)

    def _promote(self, window: Window, tracks: _Tracks, candidates: BoolArray) -> IntArray:
        """Make landmarks of the longest tracks that leave the window; return which of the tracks (indices)."""
        room = self._settings.max_landmarks - len(window.landmarks)
        chosen = np.flatnonzero(candidates)
        if room <= 0 or not len(chosen):
            return np.zeros(0, dtype=np.int64)
        info = tracks.information
        # The best known points first: smallest largest standard deviation.
        worst = 1 / np.linalg.eigvalsh(info.C[chosen])[:, 0]
        chosen = chosen[np.lexsort((self._tracks.ids(tracks.rows[chosen]), worst))[:room]]
        C_inverse = np.linalg.inv(info.C[chosen])
        p = tracks.p_world[chosen]
        point_D_poses = -C_inverse @ np.swapaxes(info.G[chosen], 1, 2)
        point_D_poses[:, :, -3:] += so3_hat(p)  # the anchor: rotation of the newest exposure
        A = window.chain(point_D_poses)
        ids = self._tracks.ids(tracks.rows[chosen])
        covariance = np.asarray(self._sigma2 * C_inverse, dtype=np.float64)
        window.add_landmarks(ids, p, A.reshape(-1, len(window.P)), covariance)
        return chosen


@lru_cache(maxsize=8)
def _chi2_table(probability: float) -> FloatArray:
    """Quantiles of chi-square for 0 to 199 degrees of freedom."""
    return np.concatenate([[0.0], chi2.ppf(probability, np.arange(1, 200))])


def _newest_innovation(at: Residuals) -> float | None:
    """Median absolute residual in the newest clone before it is corrected, pixels."""
    r, used = at.r[:, -1], np.any(at.z_D_p[:, -1] != 0, axis=2)
    return float(np.median(np.abs(r[used]))) if used.any() else None
