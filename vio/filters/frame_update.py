"""A frame's update: Gauss-Newton over the window, gates, and what is marginalised into the prior.

Fit to everything that is observed; gate tracks and landmarks; marginalise what ends here (tracks
that were lost, tracks that leave the window); estimate with what passed its gate; drop the oldest
clone. Tracks that continue are linearised anew in every frame and absorbed into the prior once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.cameras.rectification_error import CONSIDERED
from vio.filters.imu_jump import GyroJump, ShownMotion, bias_sigma
from vio.filters.landmark_gate import LandmarkGate
from vio.filters.new_landmarks import NewLandmarks
from vio.filters.noise import StepErrors
from vio.filters.point_map import PointMap
from vio.filters.prior import Fit
from vio.filters.propagation import FramePosterior, Propagation
from vio.filters.rig_calibration import RigCalibration
from vio.filters.settings import MsckfSettings
from vio.filters.step_by_images import begin_by_images, is_lost
from vio.filters.track_records import Views
from vio.filters.tracks import precision, rows_of
from vio.filters.window import Window
from vio.filters.window_fit import WindowFit
from vio.filters.window_posterior import WindowPosterior, given, move_covariance
from vio.filters.window_tracks import MIN_TRACKS_FOR_NOISE, LinearTracks
from vio.geometry.lie import FloatArray
from vio.numerics.robust import median
from vio.records import BoolArray, IntArray, Observations, UpdateReport

# Standard deviation of a point's inverse depth over itself, by all views, up to which it is
# reported in the map, with its covariance; it is not used.
_MAP_DEPTH_SIGMA = 0.2


class _Predicted(NamedTuple):
    """A frame as it was predicted."""

    tracks: LinearTracks  # at the predicted pose
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
        self.fit = WindowFit(rig, settings)
        self._new_landmarks = NewLandmarks(rig, self.fit, settings.max_landmarks)
        self.smoothed: WindowPosterior | None = None  # after the last frame
        self._landmark_gate = LandmarkGate(settings.gate_probability)
        self._gyro_jump = GyroJump()

    def forget(self) -> None:
        """Forget all tracks and poses."""
        self.fit.forget()
        self.smoothed = None
        self._landmark_gate = LandmarkGate(self._settings.gate_probability)
        self._gyro_jump = GyroJump()

    def turn(self, R: FloatArray) -> None:
        """Turn the world by R (3, 3)."""
        table = self.fit.tracks.table
        table.points = table.points @ R.T
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
        motion = None
        if len(window.clones) > 1:
            motion = window.camera_move_since(-2)
        tracks = self._linearise_prediction(window, pixels)
        innovation = tracks.newest_innovation()
        innovation_ratio = self.fit.tracks.innovation_ratio(tracks, expected)
        predicted = _Predicted(tracks, expected, innovation, innovation_ratio)
        is_shocked = self._take_shock(window, predicted)
        if is_shocked:
            tracks = self.fit.linearise(window, tracks.rows)
        tracks, fitted = self.fit.fit(window, tracks, pixels, innovation)
        step = self._step_errors(window, tracks, motion, fitted, expected)
        jump_radps = None
        if step is not None:
            missing = step.missing_noise()
            self._gyro_jump.take(off=is_shocked or bool(missing[1]))
            if not is_shocked:
                jump_radps = self._gyro_jump.agrees(window.nav.gyro_bias, bias_sigma(window))
            trusted = not is_shocked
            if trusted and missing.any():
                first = _Fitted(tracks, fitted, pixels, trusted)
                again = self._fit_without_prediction(window, first, predicted, missing)
                tracks, fitted, pixels, trusted = again
            if trusted and not propagation.since_frame.bridged:
                propagation.noise.update(step)
                if self._has_imu and self._gyro_jump.doubts_lasting(
                    window, step, propagation.since_frame
                ):
                    tracks, fitted = self.fit.fit(window, tracks, pixels, innovation)
        propagation.end_step()

        tracks = self.fit.tracks.without_wrong_views(tracks)
        good, nis, dof = self.fit.tracks.gate(tracks.at)
        self.fit.tracks.leave_motion_out(tracks, nis, dof)
        gated_ids = self.fit.tracks.table.ids(tracks.rows[~good])
        pixels, rejected = self._gate_landmarks(window, pixels, fitted)
        gated_ids = np.concatenate([gated_ids, rejected])
        created, spent = self._marginalise(window, tracks, good, pixels, bool(seen.has_right.any()))
        self.fit.tracks.update_pixel_noise(nis, dof, spent)
        nis_per_dof = None
        if len(nis):
            nis_per_dof = median(nis / dof)
        return UpdateReport(
            used=int(good.sum()) + int((pixels.weight[:, 0] > 0).sum()),
            gated=len(gated_ids),
            initialised=created,
            landmarks=len(window.landmarks),
            innovation_median_px=innovation,
            nis_per_dof=nis_per_dof,
            gated_ids=gated_ids,
            landmark_ids=window.landmark_ids.copy(),
            innovation_ratio=innovation_ratio,
            gyro_jump_radps=jump_radps,
            scale_doubt=self._rig.scale_doubt(window),
            misfit=self.fit.tracks.misfit,
        )

    def _take_shock(self, window: Window, predicted: _Predicted) -> bool:
        """Move the newest pose to where the images show it, and make it uncertain by as much,
        where they contradict an IMU that agreed before; return whether they do.
        """
        if not self._has_imu or not self._gyro_jump.is_asked(predicted.innovation_ratio):
            return False
        rows = predicted.tracks.rows
        motion = ShownMotion(window, predicted.covariance, lambda: self.fit.linearise(window, rows))
        shown = motion.find(predicted.tracks)
        if shown is None:
            return False
        self._gyro_jump.doubt_step(window, shown, self._propagation.since_frame)
        return True

    def _take_pixels(self, window: Window, seen: Observations) -> Views:
        """Give the tracks what a frame shows of them; return what it shows of the landmarks, of
        which those that it does not show leave the state.
        """
        rows, found = rows_of(seen, window.landmark_ids)
        self._keep_landmarks(window, found)
        of_tracks = np.ones(len(seen), dtype=np.bool_)
        of_tracks[rows] = False
        self.fit.tracks.table.add_frame(len(window.clones) - 1, seen.take(of_tracks))
        return Views(seen.z[rows], precision(seen)[rows])

    def _linearise_prediction(self, window: Window, pixels: Views) -> LinearTracks:
        """Linearise the tracks at the predicted pose, or, where that is lost, at one by images."""
        rows = self.fit.tracks.choose(len(window.clones))
        tracks = self.fit.linearise(window, rows)
        if self._is_measured or not is_lost(self.fit, window, tracks, len(rows), pixels):
            return tracks
        begin_by_images(self.fit, window, rows, pixels)
        return self.fit.linearise(window, rows)

    def _fit_without_prediction(
        self, window: Window, first: _Fitted, predicted: _Predicted, missing: FloatArray
    ) -> _Fitted:
        """Fit again where the prediction's noise (2,) is too small: with more of it if the tracks
        agree with one another, else without the features that the IMU did not predict.
        """
        if self.fit.tracks.agree(first.tracks.at):
            growth = self._propagation.since_frame.Q_parts
            window.inflate_process_noise(np.einsum("k,kij->ij", missing, growth))
            again = self.fit.fit(window, first.tracks, first.pixels, predicted.innovation)
            return _Fitted(*again, first.pixels, True)
        if not self._has_imu:
            return first
        doubted = self.fit.tracks.drop_unpredicted(predicted.tracks, predicted.covariance)
        pixels = Views(first.pixels.z, np.zeros_like(first.pixels.weight))
        return _Fitted(*self.fit.fit_again(window, pixels), pixels, not doubted)

    @property
    def _is_measured(self) -> bool:
        """Whether a sensor has measured the motion since the last frame."""
        propagation = self._propagation
        return propagation.source is not None and not propagation.since_frame.bridged

    @property
    def _has_imu(self) -> bool:
        """Whether an IMU has measured the motion since the last frame."""
        return self._propagation.source == "imu" and self._is_measured

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

    def _step_errors(
        self,
        window: Window,
        tracks: LinearTracks,
        predicted: FloatArray | None,
        fitted: Fit,
        expected: FloatArray,
    ) -> StepErrors | None:
        """The predicted and the corrected motion since the last frame, and what its fit leaves of
        their errors; None with too few tracks.
        """
        if predicted is None or len(tracks.rows) < MIN_TRACKS_FOR_NOISE:
            return None
        remaining = move_covariance(window, len(window.clones) - 2, fitted)
        return self._propagation.step_errors(window, predicted, expected, remaining)

    def _gate_landmarks(self, window: Window, pixels: Views, fitted: Fit) -> tuple[Views, IntArray]:
        """Test the landmarks' pixels after a fit; drop the landmarks that keep failing.

        Returns:
            The pixels of the landmarks left, without weight where rejected, and the ids (R,) of
            those rejected.
        """
        if not len(pixels.z):
            return pixels, window.landmark_ids
        used, dropped = self._landmark_gate.test(self.fit, window, pixels, fitted)
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
        table = self.fit.tracks.table
        newest = len(window.clones) - 1
        full = len(window.clones) > self._settings.clones
        seen = table.seen(tracks.rows)
        lost = ~seen[:, newest]
        leaving = seen[:, 0] & full
        ending = lost | leaving
        ended = (ending & good).nonzero()[0]
        joint = self.fit.joint_columns(window, tracks)
        columns = tracks.stereo if joint is None else joint
        if len(ended):
            directions = tracks.directions(ended)
            scored = self.fit.tracks.drift_scores(tracks, ended)
            self.fit.overdispersion.add(table.ids(tracks.rows[ended]), directions, *scored)
        # Errors that last stay in one place of the image, too, and the field takes them in with
        # every frame.
        repeated = self.fit.overdispersion.factor
        A, b, considered = self.fit.information(window, tracks, ending & good, pixels, joint)
        window.absorb(A, b, repeated=repeated, considered=considered)
        depth_sigma = np.sqrt(self.fit.tracks.variance) * tracks.information.relative_depth_sigma()
        candidates = leaving & good & seen[:, newest]
        promoted = self._new_landmarks.promote(
            window, tracks, columns, candidates, depth_sigma, stereo
        )

        A, b, considered = self.fit.information(window, tracks, good & ~ending, None, joint)
        if columns is not None and not good.all():
            # the points of tracks that are left out move, too
            self.fit.eliminate(tracks, ~good, columns)
        size = window.state.clones.stop
        # without landmarks
        P = self.fit.move_to_optimum(window, tracks, columns, A, b, size).covariance()
        fitted = float((A[:size, :size] * P).sum())
        V = window.prior.error_D_constants[:size, 1:]
        if considered is not None:
            V = V - P @ (A[:size, :size] @ V + considered[:size])
        reported = P + self._rig.reported_uncertainty(window, V)
        # biases and calibration have priors of their own, which errors of pixels do not widen
        constants = slice(window.motion.biases.start, window.state.own.stop)
        reported += (self.fit.overdispersion.outlasting - 1.0) * given(P, constants)
        self._propagation.posterior = FramePosterior.of(window, P)
        self._propagation.reported = FramePosterior.of(window, reported)
        self.smoothed = WindowPosterior.of(window, P, reported)

        done = (ending & good & (depth_sigma < _MAP_DEPTH_SIGMA)).nonzero()[0]
        covariance = self.fit.variance * tracks.information.point_covariance(done)
        if joint is not None:
            of_points = tracks.information.point_D_clones(done) @ V[window.state.clones]
            of_points += joint.point_D_stereo(tracks.information, done)[..., -CONSIDERED:]
            covariance = covariance + self._rig.uncertainty(window, of_points)
        self._points.store(
            window, table.ids(tracks.rows[done]), table.points[tracks.rows[done]], covariance
        )
        spent = leaving & ~lost
        spent[promoted] = False
        self.fit.tracks.end_frame(
            spent=tracks.rows[spent], promoted=tracks.rows[promoted], newest=newest
        )
        if full:
            window.drop_oldest_clone()
            table.shift()
        return len(promoted), fitted
