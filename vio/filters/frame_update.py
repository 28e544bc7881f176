"""A frame's update: Gauss-Newton over the window, gates, and what is marginalised into the prior.

Fit to everything that is observed; gate tracks and landmarks; marginalise what ends here (tracks
that were lost, tracks that leave the window); estimate with what passed its gate; drop the oldest
clone. Tracks that continue are linearised anew in every frame and absorbed into the prior once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.cameras.rectification_error import CONSIDERED, ErrorColumns
from vio.dataclass import dataclass
from vio.filters import track_loops
from vio.filters.imu_jump import GyroJump, gyro_doubt, turn_of_images
from vio.filters.landmark_gate import LandmarkGate, leave_one_out_nis
from vio.filters.multiview import (
    MIN_DEPTH,
    landmark_residuals,
    relative_stereo_sigma,
    unweighted,
)
from vio.filters.navigation import NO_STEP
from vio.filters.noise import StepErrors
from vio.filters.overdispersion import Overdispersion
from vio.filters.point_map import PointMap
from vio.filters.prior import Fit
from vio.filters.propagation import FramePosterior, Propagation
from vio.filters.rig_calibration import RigCalibration
from vio.filters.settings import MsckfSettings
from vio.filters.step_by_images import explained_share, linked_points, step_by_images
from vio.filters.stereo_calibration import (
    StereoColumns,
    StereoCorrection,
    eliminate_points,
    stereo_columns,
)
from vio.filters.track_records import ErrorRows, Information, LandmarkResiduals, Views
from vio.filters.tracks import precision, rows_of
from vio.filters.window import Window
from vio.filters.window_posterior import (
    WindowPosterior,
    given,
    landmark_covariance,
    move_covariance,
)
from vio.filters.window_tracks import MIN_TRACKS_FOR_NOISE, LinearTracks, WindowTracks
from vio.geometry.lie import (
    FloatArray,
    se3_adjoint,
    se3_inverse,
    se3_log,
    so3_exp,
    so3_hat,
    so3_left_jacobian_inverse,
    transform_points,
)
from vio.geometry.stereo import depth_of, project
from vio.numerics.robust import median
from vio.records import (
    FIELD_TERMS,
    BoolArray,
    IntArray,
    MotionPrior,
    Observations,
    TrackPrior,
    UpdateReport,
)


@dataclass(frozen=True, slots=True)
class _UpdateRules:
    """How a frame's pixels are fitted and gated."""

    first_steps: int = 0  # Gauss-Newton steps on each point, before and after the poses moved
    later_steps: int = 1
    # Standard deviations of a point's inverse depth over itself, at most. A landmark is
    # linearised and marginalised frame by frame as a Cartesian point, which biases scale in
    # second order of it where the depth comes from motion. With left images and an IMU, position
    # NEES after 2 s is 24 of 3 at 0.2, 15 at 0.05, 6 at 0.02, 2.8 at 0.01, 2.5 without any.
    landmark_depth_sigma: float = 0.01  # by all views
    landmark_stereo_sigma: float = 0.1  # or by the right views alone, which know the scale
    # Standard deviation of the baseline over it, and that of a point's stereo depth by the
    # rectification, over it, at most: while the scale is open, the same bias falls on the
    # baseline, and on the field. With a prior of 5 % and a baseline that is off by 9.5 %, 15 s of
    # a flight with an IMU end at 4.07 +- 0.03 % with landmarks from the start, at 9.02 +- 0.29 %
    # without any. Where no right image gives depths any more, the bias is the lesser evil: on
    # MH_01 36 such frames by images alone cost 86 mm without landmarks, 4 mm with them.
    scale_sigma: float = 0.001
    # by all views; a point of the map is reported with its covariance, and not used
    map_depth_sigma: float = 0.2
    # A fit does not begin at a predicted pose where fewer of the tracks have a usable point, or
    # that is off by more pixels.
    min_usable_share: float = 0.5
    max_start_px: float = 15.0
    # pixels by which the predicted pose may be off before one step over the window is too few
    one_step_px: float = 0.5
    min_progress: float = 1.25  # by which factor a step must have come nearer for another one
    # innovations over their standard deviation (median): more, and the gyro may have jumped
    jump_sigmas: float = 2.0
    # over the window in a frame: one is the rule, two bring in a start in motion, a third is an
    # exception
    max_steps: int = 4


_UPDATE = _UpdateRules()


class _Predicted(NamedTuple):
    """A frame as it was predicted."""

    tracks: LinearTracks  # at the predicted pose
    T_world_imu: FloatArray  # (4, 4) predicted pose of the body
    covariance: FloatArray  # (6, 6) of the camera's motion since the last frame
    innovation: float | None  # of the newest pixels, median
    innovation_ratio: float | None  # over their standard deviation, median


class _Fitted(NamedTuple):
    """A fit to a frame."""

    tracks: LinearTracks
    fit: Fit
    pixels: Views  # of the landmarks
    trusted: bool  # whether the step's errors are those of the motion sensor


class FrameUpdate:
    """Updates a window with what a frame shows."""

    def __init__(
        self,
        settings: MsckfSettings,
        rig: RigCalibration,
        propagation: Propagation,
        points: PointMap,
    ) -> None:
        """Prepare; `points` gets the points of tracks and landmarks that end."""
        self._settings = settings
        self._rig = rig
        self._propagation = propagation
        self._points = points
        self.tracks = WindowTracks(rig.camera, settings)
        self.smoothed: WindowPosterior | None = None  # after the last frame
        self._landmark_gate = LandmarkGate(settings.gate_probability)
        self._overdispersion = Overdispersion()
        self._gyro_jump = GyroJump()

    @property
    def _variance(self) -> float:
        """Variance of one pixel coordinate in this frame that counts as if all of them were
        independent, px^2.
        """
        return self.tracks.variance * self.tracks.common_noise * self._overdispersion.factor

    def expected_tracks(
        self, window: Window, T_cam0_world: FloatArray, motion: MotionPrior
    ) -> TrackPrior:
        """Predict the pixels of all tracks with a point from a camera pose (4, 4) at a coming
        frame.
        """
        table = self.tracks.table
        camera = self._rig.camera
        rows = table.rows()
        rows = rows[table.has_point[rows]]
        ids = np.concatenate([table.ids(rows), window.landmark_ids])
        p_cam = transform_points(
            T_cam0_world, np.concatenate([table.points[rows], window.landmarks])
        )
        ahead = depth_of(camera, p_cam) > MIN_DEPTH * camera.baseline_m
        z = project(camera, p_cam[ahead])
        field = self._rig.field(window)
        if field is not None:
            z = field.seen(z)
        return TrackPrior(ids[ahead], z, motion.T_curr_prev[:3, :3], motion)

    def forget(self) -> None:
        """Forget all tracks and poses."""
        self.tracks = WindowTracks(self._rig.camera, self._settings)
        self.smoothed = None
        self._landmark_gate = LandmarkGate(self._settings.gate_probability)
        self._gyro_jump = GyroJump()

    def turn(self, R: FloatArray) -> None:
        """Turn the world by R (3, 3)."""
        self.tracks.table.points = self.tracks.table.points @ R.T
        if self.smoothed is not None:
            self.smoothed = self.smoothed.rotated(R)

    def update(self, window: Window, seen: Observations, expected: FloatArray) -> UpdateReport:
        """Update with everything that a frame shows.

        Args:
            window: whose newest clone is the frame's.
            seen: its observations.
            expected: covariance (6, 6) of the camera's motion since the last frame, as it was
                predicted.

        Raises:
            numpy.linalg.LinAlgError: the filter has diverged.
        """
        self._rig.learn_rows(window, seen)
        self._rig.end_frame(window, seen)
        propagation = self._propagation
        pixels = self._take_pixels(window, seen)
        motion = window.camera_move_since(-2) if len(window.clones) > 1 else None
        T_world_imu = window.nav.T_world_imu
        tracks = self._linearise_prediction(window, pixels)
        innovation = tracks.newest_innovation()
        innovation_ratio = self.tracks.innovation_ratio(tracks, expected)
        predicted = _Predicted(tracks, T_world_imu, expected, innovation, innovation_ratio)
        tracks, fitted = self._fit(window, tracks, pixels, innovation)
        step = self._step_errors(window, tracks, motion, fitted, expected)
        jump_radps = None
        if step is not None:
            missing = step.missing_noise()
            turn = self._turn_against_gyro(predicted, missing)
            if turn is None:
                jump_radps = self._gyro_jump.agrees(window.nav.gyro_bias)
            trusted = True
            if turn is not None and self._doubts_gyro(window, turn, tracks):
                trusted = False
                tracks, fitted = self._fit(window, tracks, pixels, innovation)
            elif missing.any():
                first = _Fitted(tracks, fitted, pixels, trusted)
                again = self._fit_without_prediction(window, first, predicted, missing)
                tracks, fitted, pixels, trusted = again
            if trusted and not propagation.since_frame.bridged:
                propagation.noise.update(step)
        propagation.since_frame = NO_STEP

        tracks = self.tracks.without_wrong_views(tracks)
        good, nis, dof = self.tracks.gate(tracks.at)
        self.tracks.leave_motion_out(tracks, nis, dof)
        gated_ids = self.tracks.table.ids(tracks.rows[~good])
        pixels, rejected = self._gate_landmarks(window, pixels, fitted)
        gated_ids = np.concatenate([gated_ids, rejected])
        created, spent = self._marginalise(window, tracks, good, pixels, bool(seen.has_right.any()))
        self.tracks.update_pixel_noise(nis, dof, spent)
        return UpdateReport(
            used=int(good.sum()) + int((pixels.weight[:, 0] > 0).sum()),
            gated=len(gated_ids),
            initialised=created,
            landmarks=len(window.landmarks),
            innovation_median_px=innovation,
            nis_per_dof=median(nis / dof) if len(nis) else None,
            gated_ids=gated_ids,
            landmark_ids=window.landmark_ids.copy(),
            innovation_ratio=innovation_ratio,
            gyro_jump_radps=jump_radps,
            scale_doubt=self._rig.scale_doubt(window),
        )

    def _take_pixels(self, window: Window, seen: Observations) -> Views:
        """Give the tracks what a frame shows of them; return what it shows of the landmarks, of
        which those that it does not show leave the state.
        """
        rows, found = rows_of(seen, window.landmark_ids)
        self._keep_landmarks(window, found)
        of_tracks = np.ones(len(seen), dtype=np.bool_)
        of_tracks[rows] = False
        self.tracks.table.add_frame(len(window.clones) - 1, seen.take(of_tracks))
        return Views(seen.z[rows], precision(seen)[rows])

    def _linearise_prediction(self, window: Window, pixels: Views) -> LinearTracks:
        """Linearise the tracks at the predicted pose, or, where that is lost, at one by images."""
        rows = self.tracks.choose(len(window.clones))
        tracks = self._linearise(window, rows, _UPDATE.first_steps)
        if self._is_measured or not self._is_lost(window, tracks, len(rows), pixels):
            return tracks
        self._begin_by_images(window, rows, pixels)
        return self._linearise(window, rows, _UPDATE.first_steps)

    def _turn_against_gyro(self, predicted: _Predicted, missing: FloatArray) -> FloatArray | None:
        """Return the rotation (3,) by which the images contradict a gyro that is off, as noise (2,)
        that its prediction lacks shows, or the innovations; None: they do not, or there is none.
        """
        contradicted = (predicted.innovation_ratio or 0.0) > _UPDATE.jump_sigmas
        off = bool(missing[1]) or contradicted
        settled = self._gyro_jump.is_settled(off=off)
        if not off or not self._has_imu or not settled:
            return None
        return turn_of_images(predicted.tracks, predicted.covariance, predicted.T_world_imu)

    def _fit_without_prediction(
        self, window: Window, first: _Fitted, predicted: _Predicted, missing: FloatArray
    ) -> _Fitted:
        """Fit again where the prediction's noise (2,) is too small: with more of it if the tracks
        agree with one another, else without the features that the IMU did not predict.
        """
        if self.tracks.agree(first.tracks.at):
            growth = self._propagation.since_frame.Q_parts
            window.inflate_process_noise(np.einsum("k,kij->ij", missing, growth))
            again = self._fit(window, first.tracks, first.pixels, predicted.innovation)
            return _Fitted(*again, first.pixels, True)
        if not self._has_imu:
            return first
        doubted = self.tracks.drop_unpredicted(predicted.tracks, predicted.covariance)
        pixels = Views(first.pixels.z, np.zeros_like(first.pixels.weight))
        return _Fitted(*self._fit_again(window, pixels), pixels, not doubted)

    def _doubts_gyro(self, window: Window, turn: FloatArray, tracks: LinearTracks) -> bool:
        """Whether the newest step contradicts the gyro by a rotation (3,) that inflated noise of
        one step does not explain; then its bias becomes uncertain by that.
        """
        seconds = window.last_step_s
        repeats = self._gyro_jump.repeats(turn / seconds)
        if not repeats and self.tracks.agree(tracks.at):
            return False
        sigma = np.sqrt(np.diag(window.prior.P)[9:12])
        self._gyro_jump.doubt(window.nav.gyro_bias, sigma)
        growth = self._propagation.since_frame
        window.inflate_process_noise(gyro_doubt(growth, window.nav, turn, seconds))
        return True

    @property
    def _is_measured(self) -> bool:
        """Whether a sensor has measured the motion since the last frame."""
        propagation = self._propagation
        return propagation.source is not None and not propagation.since_frame.bridged

    @property
    def _has_imu(self) -> bool:
        """Whether an IMU has measured the motion since the last frame."""
        return self._propagation.source == "imu" and self._is_measured

    def _is_lost(self, window: Window, tracks: LinearTracks, given: int, pixels: Views) -> bool:
        """Whether the predicted pose is too far off for a fit to begin there: of the tracks that
        were given, fewer than half could be linearised, or they or the landmarks are far off.
        """
        innovation = tracks.newest_innovation()
        lost = len(tracks.rows) < _UPDATE.min_usable_share * given
        if lost or (innovation is not None and innovation > _UPDATE.max_start_px):
            return True
        if len(pixels.z) <= given or len(window.clones) < 2:
            return False
        T = window.T_cam0_world(-1)[0]
        share = explained_share(
            self._rig.camera,
            T,
            window.landmarks,
            self._corrected(window, pixels).z,
            _UPDATE.max_start_px,
        )
        return share < _UPDATE.min_usable_share

    def _corrected(self, window: Window, pixels: Views) -> Views:
        """Return the landmarks' pixels without the rectification error."""
        field = self._rig.field(window)
        return pixels if field is None else field.corrected(pixels)

    def _begin_by_images(self, window: Window, rows: IntArray, pixels: Views) -> None:
        """Move the newest pose to where the images alone have it; the prior stays where it is, and
        so do points.
        """
        clones = len(window.clones)
        if clones < 2:
            return
        T = window.T_cam0_world(clones - 2)
        camera = self._rig.camera
        p, z = linked_points(camera, self.tracks.views(rows, clones, self._rig.field(window)))
        p = np.concatenate([p, transform_points(T[0], window.landmarks)])
        z = np.concatenate([z, self._corrected(window, pixels).z])
        step = step_by_images(camera, p, z)
        if step is None:
            return
        xi = se3_log(se3_inverse(step @ T[0]) @ T[1])  # of the body, as of the camera: world's side
        state = window.state
        error = np.zeros(state.size)
        error[:6] = xi
        error[state.clone(-1)] = xi
        landmarks = window.landmarks
        kept = (landmarks - landmarks @ so3_exp(xi[3:]).T) @ so3_left_jacobian_inverse(xi[3:]).T
        error[state.landmarks] = kept.reshape(-1)
        window.relinearise(error)

    def _keep_landmarks(self, window: Window, kept: BoolArray) -> None:
        """Drop the landmarks outside a mask (M,) from the state; their points go to the map."""
        if kept.all():
            return
        gone = ~kept
        covariances = self._rig.landmark_covariances(window)
        self._points.store(
            window, window.landmark_ids[gone], window.landmarks[gone], covariances[gone]
        )
        window.keep_landmarks(kept)

    def _linearise(self, window: Window, rows: IntArray, steps: int) -> LinearTracks:
        """Linearise tracks at the window's present means."""
        return self.tracks.linearise(window.T_cam0_world(), rows, steps, self._rig.field(window))

    def _fit(
        self, window: Window, tracks: LinearTracks, pixels: Views, innovation: float | None
    ) -> tuple[LinearTracks, Fit]:
        """Gauss-Newton over the window; returns the tracks linearised at the estimate, and the
        last fit.
        """
        for _ in range(_UPDATE.max_steps):
            everything = np.ones(len(tracks.rows), dtype=np.bool_)
            A, b, _ = self._information(window, tracks, everything, pixels)
            fitted = self._move_to_optimum(window, tracks, tracks.stereo, A, b, len(A))
            tracks = self._linearise(window, tracks.rows, _UPDATE.later_steps)
            residual = tracks.newest_innovation()
            # Another step pays only where this one had far to go, and came nearer.
            if (
                innovation is None
                or residual is None
                or innovation < max(_UPDATE.one_step_px, _UPDATE.min_progress * residual)
            ):
                break
            innovation = residual
        return tracks, fitted

    def _fit_again(self, window: Window, pixels: Views) -> tuple[LinearTracks, Fit]:
        """Fit to what is left of views that contradict the IMU and one another: a person in the
        view, not a shock.
        """
        tracks = self._linearise(
            window, self.tracks.choose(len(window.clones)), _UPDATE.later_steps
        )
        return self._fit(window, tracks, pixels, tracks.newest_innovation())

    def _move_to_optimum(
        self,
        window: Window,
        tracks: LinearTracks,
        columns: StereoColumns | None,
        A: FloatArray,
        b: FloatArray,
        size: int,
    ) -> Fit:
        """Move the means, and the tracks' points with them, to the optimum of the prior and of
        given information.

        Args:
            window: moved; its prior stays.
            tracks: whose points are moved.
            columns: theirs of the coefficients estimated; None: there are none.
            A: information (D, D).
            b: its vector (D,).
            size: how many errors, the first ones, it is about.

        Returns:
            The fit, with their covariance (size, size) there.
        """
        fitted, error = window.optimum(A, b, size)
        self.tracks.move_points(
            tracks, columns, error[window.state.clones], error[window.state.stereo]
        )
        window.relinearise(error)
        return fitted

    def _step_errors(
        self,
        window: Window,
        tracks: LinearTracks,
        predicted: FloatArray | None,
        fitted: Fit,
        expected: FloatArray,
    ) -> StepErrors | None:
        """The predicted and the corrected motion since the last frame, and what its fit leaves of
        their errors.

        It is the camera's motion, seen from the body, so that a new estimate of the extrinsics is
        no motion. None with too few tracks.
        """
        if predicted is None or len(tracks.rows) < MIN_TRACKS_FOR_NOISE:
            return None
        moved = window.camera_move_since(-2)
        remaining = move_covariance(window, len(window.clones) - 2, fitted)
        A = se3_adjoint(se3_inverse(window.nav.T_world_imu))
        process = A @ self._propagation.since_frame.Q[:6, :6] @ A.T
        B = se3_adjoint(se3_inverse(window.calibration.T_cam0_imu))
        correction = B @ se3_log(se3_inverse(predicted) @ moved)
        return StepErrors(correction, A @ expected @ A.T, process, A @ remaining @ A.T)

    def _information(
        self,
        window: Window,
        tracks: LinearTracks,
        chosen: BoolArray,
        pixels: Views | None,
        joint: StereoColumns | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Information of chosen tracks and of this frame's landmarks.

        Args:
            window: with its means.
            tracks: linearised there.
            chosen: mask (F,).
            pixels: of the landmarks; None: without them.
            joint: the tracks' columns of the coefficients estimated and of those considered; None:
                without the latter.

        Returns:
            Its matrix (D, D) and vector (D,), and that of all errors with what is considered (D,
            4).
        """
        field = self._rig.field(window)
        state = window.state
        considered = 0 if joint is None else CONSIDERED
        A, b = eliminate_points(
            tracks.information, chosen, tracks.stereo if joint is None else joint
        )
        A, b, by_considered = state.information(A, b, self._variance, considered)
        if pixels is not None and len(pixels.z):
            at = self._landmark_residuals(window, pixels)
            H = np.empty((len(pixels.z), 4, 0))
            if field is not None or considered:
                H = self._error_columns(field, considered).jacobian(
                    unweighted(pixels.z, at.r, at.precision)
                )
            # In their anchor, the newest clone: dp = xi_f - xi_rho.
            rows = ErrorRows(state.clone(-1).start, state.landmarks.start, state.stereo.start)
            weighted = at._replace(weight=at.weight / self._variance)
            track_loops.add_landmarks(weighted, H, rows, Information(A, b, by_considered))
        return A, b, None if joint is None else by_considered

    def _joint_columns(self, window: Window, tracks: LinearTracks) -> StereoColumns | None:
        """The tracks' columns of the coefficients estimated and of those considered.

        None: none is considered.
        """
        if not self._rig.considered_sigmas(window).any():
            return None
        return stereo_columns(
            self._error_columns(tracks.field, CONSIDERED), tracks.at, tracks.z, tracks.weight
        )

    def _error_columns(self, field: StereoCorrection | None, considered: int) -> ErrorColumns:
        """Columns of the coefficients that are estimated, and of the C considered."""
        if field is None:
            return ErrorColumns(self._rig.camera, np.arange(FIELD_TERMS, FIELD_TERMS + considered))
        return field.columns(considered)

    def _landmark_residuals(self, window: Window, pixels: Views) -> LandmarkResiduals:
        """Residuals of the landmarks' pixels in the newest exposure."""
        T = window.T_cam0_world(-1)[0]
        seen = self._corrected(window, pixels)
        return landmark_residuals(self._rig.camera, T, window.landmarks, seen, self.tracks.variance)

    def _gate_landmarks(self, window: Window, pixels: Views, fitted: Fit) -> tuple[Views, IntArray]:
        """Test the landmarks' pixels after a fit; drop the landmarks that keep failing.

        Returns:
            The pixels of the landmarks left, without weight where rejected, and the ids (R,) of
            those rejected.
        """
        if not len(pixels.z):
            return pixels, window.landmark_ids
        at = self._landmark_residuals(window, pixels)
        J = at.J
        field = self._rig.field(window)
        if field is not None:
            z = unweighted(pixels.z, at.r, at.precision)
            H = field.columns().jacobian(z) * (at.precision * np.any(at.J, axis=2))[..., None]
            J = np.concatenate([J, H], axis=2)
        # that they entered the fit with
        weight = at.weight * (self.tracks.variance / self._variance)
        nis = leave_one_out_nis(
            at.r, J, landmark_covariance(window, fitted), weight, self.tracks.variance
        )
        dof = np.maximum(np.any(at.J, axis=2).sum(axis=1), 1)
        used, dropped = self._landmark_gate.check(window.landmark_ids, nis, dof)
        rejected = window.landmark_ids[~used]
        self._keep_landmarks(window, ~dropped)
        weight = pixels.weight * used[:, None]
        return Views(pixels.z[~dropped], weight[~dropped]), rejected

    def _marginalise(
        self, window: Window, tracks: LinearTracks, good: BoolArray, pixels: Views, stereo: bool
    ) -> tuple[int, float]:
        """Absorb what ends in this frame into the prior, estimate with all that is good, and make
        room.

        Only tracks and landmarks that passed their gates steer the estimate: the means move to the
        optimum of the prior, the landmarks' pixels and the good tracks, also those that go on.

        Returns:
            How many landmarks are new, and how many degrees of freedom the tracks that go on have
            spent on the errors that they share.
        """
        table = self.tracks.table
        newest = len(window.clones) - 1
        full = len(window.clones) > self._settings.clones
        seen = table.seen(tracks.rows)
        lost = ~seen[:, newest]
        leaving = seen[:, 0] & full
        ending = lost | leaving
        ended = (ending & good).nonzero()[0]
        joint = self._joint_columns(window, tracks)
        columns = tracks.stereo if joint is None else joint
        if len(ended):
            directions = np.empty((len(ended), 2))
            track_loops.write_directions(ended, tracks.T_cam0_world[-1], tracks.p_world, directions)
            scored = self.tracks.drift_scores(tracks, ended)
            self._overdispersion.add(table.ids(tracks.rows[ended]), directions, *scored)
        # Errors that last stay in one place of the image, too, and the field takes them in with
        # every frame.
        repeated = self._overdispersion.factor
        A, b, considered = self._information(window, tracks, ending & good, pixels, joint)
        window.absorb(A, b, repeated=repeated, considered=considered)
        depth_sigma = np.sqrt(self.tracks.variance) * tracks.information.relative_depth_sigma()
        candidates = leaving & good & seen[:, newest]
        promoted = self._promote(window, tracks, columns, candidates, depth_sigma, stereo)

        A, b, considered = self._information(window, tracks, good & ~ending, None, joint)
        if columns is not None and not good.all():
            # the points of tracks that are left out move, too
            eliminate_points(tracks.information, ~good, columns)
        size = window.state.clones.stop
        # without landmarks
        P = self._move_to_optimum(window, tracks, columns, A, b, size).covariance()
        fitted = float(np.sum(A[:size, :size] * P))
        V = window.prior.error_D_constants[:size, 1:]
        if considered is not None:
            V = V - P @ (A[:size, :size] @ V + considered[:size])
        reported = P + self._rig.reported_uncertainty(window, V)
        # biases and calibration have priors of their own, which errors of pixels do not widen
        constants = slice(window.motion.biases.start, window.state.own.stop)
        reported += (self._overdispersion.outlasting - 1.0) * given(P, constants)
        self._propagation.posterior = FramePosterior.of(window, P)
        self._propagation.reported = FramePosterior.of(window, reported)
        self.smoothed = WindowPosterior.of(window, P, reported)

        done = (ending & good & (depth_sigma < _UPDATE.map_depth_sigma)).nonzero()[0]
        covariance = self._variance * tracks.information.point_covariance(done)
        if joint is not None:
            of_points = tracks.information.point_D_clones(done) @ V[window.state.clones]
            of_points += joint.point_D_stereo(tracks.information, done)[..., -CONSIDERED:]
            covariance = covariance + self._rig.uncertainty(window, of_points)
        self._points.store(
            window, table.ids(tracks.rows[done]), table.points[tracks.rows[done]], covariance
        )
        spent = leaving & ~lost
        spent[promoted] = False
        self.tracks.end_frame(
            spent=tracks.rows[spent], promoted=tracks.rows[promoted], newest=newest
        )
        if full:
            window.drop_oldest_clone()
            table.shift()
        return len(promoted), fitted

    def _promote(
        self,
        window: Window,
        tracks: LinearTracks,
        columns: StereoColumns | None,
        candidates: BoolArray,
        depth_sigma: FloatArray,
        stereo: bool,
    ) -> IntArray:
        """Make landmarks of the best known points whose tracks leave the window; return which
        tracks (indices).

        Args:
            window: receives the landmarks.
            tracks: linearised at its means.
            columns: theirs of the coefficients estimated and of those considered; None: there are
                none.
            candidates: mask (F,) of the tracks that may become landmarks.
            depth_sigma: (F,) standard deviation of each inverse depth, over itself.
            stereo: whether this frame has right pixels, from which the next tracks will get their
                depths.
        """
        room = self._settings.max_landmarks - len(window.landmarks)
        unsure = _scale_sigma(window) > _UPDATE.scale_sigma
        if room <= 0 or unsure or not candidates.any():
            return np.zeros(0, dtype=np.int64)
        chosen = candidates.nonzero()[0]
        by_stereo = np.sqrt(self.tracks.variance) * relative_stereo_sigma(
            tracks.at, tracks.information.q, chosen
        )
        chosen = chosen[
            (depth_sigma[chosen] < _UPDATE.landmark_depth_sigma)
            | (by_stereo < _UPDATE.landmark_stereo_sigma)
        ]
        field = self._rig.field(window)
        if field is not None:
            p = transform_points(window.T_cam0_world(-1)[0], tracks.p_world[chosen])
            of_field = window.prior.P[window.state.stereo, window.state.stereo]
            limit = _UPDATE.scale_sigma if stereo else _UPDATE.landmark_stereo_sigma
            chosen = chosen[field.depth_sigma(p, of_field) < limit]
        if not len(chosen):
            return chosen
        covariance = self._variance * tracks.information.point_covariance(chosen)
        # The best known points first: smallest largest standard deviation.
        worst = np.linalg.eigvalsh(covariance)[:, 2]
        table = self.tracks.table
        best = np.lexsort((table.ids(tracks.rows[chosen]), worst))[:room]
        chosen = chosen[best]
        covariance = covariance[best]
        p = tracks.p_world[chosen]
        point_D_poses = tracks.information.point_D_clones(chosen)
        point_D_poses[:, :, -3:] += so3_hat(p)  # the anchor: rotation of the newest exposure
        ids = table.ids(tracks.rows[chosen])
        point_D_stereo = None
        by_considered = None
        if columns is not None:
            estimated = window.state.stereo.stop - window.state.stereo.start
            point_D_terms = columns.point_D_stereo(tracks.information, chosen)
            point_D_stereo = point_D_terms[..., :estimated]
            if point_D_terms.shape[2] > estimated:
                by_considered = point_D_terms[..., estimated:].reshape(-1, CONSIDERED)
        A = window.state.jacobian(point_D_poses, point_D_stereo)
        window.add_landmarks(ids, p, A.reshape(-1, window.state.size), covariance, by_considered)
        return chosen


def _scale_sigma(window: Window) -> float:
    """The larger one of the standard deviations of baseline and focal length, over them; 0 where
    they are known.
    """
    if "stereo_scale" not in window.state:
        return 0.0
    return float(np.sqrt(window.prior.P.diagonal()[window.state["stereo_scale"]].max(initial=0.0)))
