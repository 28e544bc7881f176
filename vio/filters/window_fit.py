"""The Gauss-Newton fit of a window to its tracks and landmarks: residuals, information, steps.

The prior stays where it is linearised; `frame_update` decides what is absorbed into it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.cameras.rectification_error import CONSIDERED, ErrorColumns
from vio.filters import track_loops
from vio.filters.multiview import MIN_DEPTH, landmark_residuals, unweighted
from vio.filters.overdispersion import Overdispersion
from vio.filters.prior import Fit
from vio.filters.rig_calibration import RigCalibration
from vio.filters.settings import MsckfSettings
from vio.filters.stereo_calibration import (
    StereoColumns,
    StereoCorrection,
    eliminate_points,
    stereo_columns,
)
from vio.filters.track_records import ErrorRows, Information, LandmarkResiduals, Views
from vio.filters.window import Window
from vio.filters.window_tracks import LinearTracks, WindowTracks
from vio.geometry.lie import FloatArray, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, project
from vio.records import FIELD_TERMS, BoolArray, IntArray, MotionPrior, TrackPrior


class _FitRules(NamedTuple):
    """How many steps a frame's fit takes."""

    point_steps: int = 1  # Gauss-Newton steps on each point, after the poses moved
    # pixels by which the predicted pose may be off before one step over the window is too few
    one_step_px: float = 0.5
    min_progress: float = 1.25  # by which factor a step must have come nearer for another one
    # over the window in a frame: one is the rule, two bring in a start in motion, a third is an
    # exception
    max_steps: int = 4


_FIT = _FitRules()


class WindowFit:
    """Fits the means of a window, and the points of its tracks, to their pixels."""

    def __init__(self, rig: RigCalibration, settings: MsckfSettings) -> None:
        """Begin without tracks."""
        self._rig = rig
        self._settings = settings
        self.tracks = WindowTracks(rig.camera, settings)
        self.overdispersion = Overdispersion()

    def forget(self) -> None:
        """Forget all tracks."""
        self.tracks = WindowTracks(self._rig.camera, self._settings)

    @property
    def camera(self) -> StereoCamera:
        """The rectified pair."""
        return self._rig.camera

    @property
    def variance(self) -> float:
        """Variance of one pixel coordinate in this frame that counts as if all of them were
        independent, px^2.
        """
        return self.tracks.variance * self.tracks.common_noise * self.overdispersion.factor

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

    def views(self, window: Window, rows: IntArray) -> Views:
        """Return what tracks showed in the clones, without the rectification error."""
        return self.tracks.views(rows, len(window.clones), self._rig.field(window))

    def linearise(self, window: Window, rows: IntArray, steps: int = 0) -> LinearTracks:
        """Linearise tracks at the window's present means, after some Gauss-Newton steps on each
        point.
        """
        return self.tracks.linearise(window.T_cam0_world(), rows, steps, self._rig.field(window))

    def fit(
        self, window: Window, tracks: LinearTracks, pixels: Views, innovation: float | None
    ) -> tuple[LinearTracks, Fit]:
        """Gauss-Newton over the window; returns the tracks linearised at the estimate, and the
        last fit.
        """
        for _ in range(_FIT.max_steps):
            everything = np.ones(len(tracks.rows), dtype=np.bool_)
            A, b, _ = self.information(window, tracks, everything, pixels)
            fitted = self.move_to_optimum(window, tracks, tracks.stereo, A, b, len(A))
            tracks = self.linearise(window, tracks.rows, _FIT.point_steps)
            residual = tracks.newest_innovation()
            # Another step pays only where this one had far to go, and came nearer.
            if (
                innovation is None
                or residual is None
                or innovation < max(_FIT.one_step_px, _FIT.min_progress * residual)
            ):
                break
            innovation = residual
        return tracks, fitted

    def fit_again(self, window: Window, pixels: Views) -> tuple[LinearTracks, Fit]:
        """Fit to what is left of views that contradict the IMU and one another: a person in the
        view, not a shock.
        """
        tracks = self.linearise(window, self.tracks.choose(len(window.clones)), _FIT.point_steps)
        return self.fit(window, tracks, pixels, tracks.newest_innovation())

    def move_to_optimum(
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

    def information(
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
        A, b, by_considered = state.information(A, b, self.variance, considered)
        if pixels is not None and len(pixels.z):
            at = self.landmark_residuals(window, pixels)
            H = np.empty((len(pixels.z), 4, 0))
            if field is not None or considered:
                z = _unweighted(pixels, at)
                H = self.error_columns(field, considered).jacobian(z)
            # In their anchor, the newest clone: dp = xi_f - xi_rho.
            rows = ErrorRows(state.clone(-1).start, state.landmarks.start, state.stereo.start)
            weighted = at._replace(weight=at.weight / self.variance)
            track_loops.add_landmarks(weighted, H, rows, Information(A, b, by_considered))
        return A, b, None if joint is None else by_considered

    def eliminate(
        self, tracks: LinearTracks, chosen: BoolArray, columns: StereoColumns | None
    ) -> None:
        """Prepare the points of chosen tracks (F,) for a move of the means, without their
        information.
        """
        eliminate_points(tracks.information, chosen, columns)

    def joint_columns(self, window: Window, tracks: LinearTracks) -> StereoColumns | None:
        """The tracks' columns of the coefficients estimated and of those considered.

        None: none is considered.
        """
        if not self._rig.considered_sigmas(window).any():
            return None
        return stereo_columns(
            self.error_columns(tracks.field, CONSIDERED), tracks.at, tracks.z, tracks.weight
        )

    def error_columns(self, field: StereoCorrection | None, considered: int) -> ErrorColumns:
        """Columns of the coefficients that are estimated, and of the C considered."""
        if field is None:
            return ErrorColumns(self._rig.camera, np.arange(FIELD_TERMS, FIELD_TERMS + considered))
        return field.columns(considered)

    def landmark_jacobian(self, window: Window, pixels: Views, at: LandmarkResiduals) -> FloatArray:
        """Jacobian (M, 4, 3 + S) of the landmarks' pixels by the points and the coefficients of
        the stereo calibration.
        """
        field = self._rig.field(window)
        if field is None:
            return at.J
        z = _unweighted(pixels, at)
        H = field.columns().jacobian(z) * (at.precision * np.any(at.J, axis=2))[..., None]
        return np.concatenate([at.J, H], axis=2)

    def landmark_residuals(self, window: Window, pixels: Views) -> LandmarkResiduals:
        """Residuals of the landmarks' pixels in the newest exposure."""
        T = window.T_cam0_world(-1)[0]
        seen = self.corrected(window, pixels)
        return landmark_residuals(self._rig.camera, T, window.landmarks, seen, self.tracks.variance)

    def corrected(self, window: Window, pixels: Views) -> Views:
        """Return the landmarks' pixels without the rectification error."""
        field = self._rig.field(window)
        return pixels if field is None else field.corrected(pixels)


def _unweighted(pixels: Views, at: LandmarkResiduals) -> FloatArray:
    """Pixels (K, 4) that are expected where landmarks were seen."""
    return unweighted(pixels.z[None], at.r[None], at.precision[None])[0]
