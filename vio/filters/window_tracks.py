"""The tracks of the window: which of them enter an update, their linearisation, their gates, and
the pixel noise.

Everything here is about pixels and points; poses come in as camera poses and go out as information
about them.
"""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np

from vio.dataclass import dataclass
from vio.filters import track_loops as loops
from vio.filters.multiview import (
    CAUCHY,
    TrackInformation,
    first_points,
    linearised_points,
    robust_weights,
    squared_residuals,
    track_information,
    unweighted,
)
from vio.filters.settings import MsckfSettings
from vio.filters.stereo_calibration import (
    StereoColumns,
    StereoCorrection,
    eliminate_points,
    stereo_columns,
)
from vio.filters.track_records import Residuals, Views
from vio.filters.tracks import TrackTable
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import median
from vio.numerics.scipy_extensions import lapack
from vio.numerics.statistics import chi_square_quantile
from vio.records import BoolArray, IntArray

MIN_TRACKS_FOR_NOISE = 15  # with fewer, neither the pixel noise nor the process noise is adapted
MIN_PIXEL_SIGMA_PX = 0.03  # lower bound of the estimated noise of one pixel coordinate


@dataclass(frozen=True, slots=True)
class _TrackRules:
    """Which tracks the filter uses, and which views of them."""

    # Pixels of a track share errors that its residuals do not show, and no right image bounds
    # what they make of the scale (docs/notes/design_decisions.md, pixel noise of one camera).
    min_mono_px: float = 0.1
    noise_gain: float = 0.05  # how fast the pixel noise follows the residuals in the end
    # the noise at the start may be off by a factor of four, that of frames differs by one and a
    # half
    prior_frames: float = 0.1
    max_change: float = 4.0  # of the variance from frame to frame that is believed in the end
    # Degrees of freedom: 2 for the mean of an inverse chi-square, over the efficiency of a median,
    # 0.64.
    spent_on_noise: float = 3.0
    # of the tracks used, at least, that the newest frame shows and that stay in the window
    going_on: float = 0.1
    max_dof: int = 199
    # left of a pose's own, at most: directions that pixels alone do not tell, as where the world
    # is
    no_information: Tolerance[float] = 1e-8
    # of a frame over the learned variance: beyond twice the noise it is no blur
    max_common_noise: float = 4.0


_TRACKS = _TrackRules()
VIEW_PROBABILITY = 0.9999  # chi-square limit of a single view
_AGREEMENT = 0.8


@dataclass(frozen=True)
class LinearTracks:
    """Tracks linearised at one estimate of the window; their normal equations are collected
    where they are used.
    """

    camera: StereoCamera
    variance: float  # of one pixel coordinate, px^2
    T_cam0_world: FloatArray  # (N, 4, 4) camera poses
    rows: IntArray  # (F,) in the table
    p_world: FloatArray  # (F, 3)
    at: Residuals
    # (F, N, 4) pixels as they are predicted: those seen share their noise with the residuals, which
    # biases coefficients
    z: FloatArray
    # what was taken out of the pixels; None: the rectification error is not estimated
    field: StereoCorrection | None

    @cached_property
    def weight(self) -> FloatArray:
        """Robust weight (F, N) of each view."""
        return robust_weights(self.at, self.variance)

    @cached_property
    def information(self) -> TrackInformation:
        """What the tracks say of the clones and of their points."""
        return track_information(self.camera, self.T_cam0_world, self.at, self.p_world, self.weight)

    @cached_property
    def stereo(self) -> StereoColumns | None:
        """Columns of the coefficients that are estimated; None: there are none."""
        if self.field is None:
            return None
        return stereo_columns(self.field.columns(), self.at, self.z, self.weight)

    def directions(self, chosen: IntArray) -> FloatArray:
        """Return where chosen points (K,) are in the newest image: x / z, y / z (K, 2)."""
        out = np.empty((len(chosen), 2))
        loops.write_directions(chosen, self.T_cam0_world[-1], self.p_world, out)
        return out

    def newest_innovation(self) -> float | None:
        """Median absolute residual in the newest clone, pixels.

        None where nothing is seen in it.
        """
        return loops.newest_residual(self.at.r, self.at.z_D_p)


class WindowTracks:
    """The tracks in the window, and the pixel noise estimated from their residuals."""

    def __init__(self, camera: StereoCamera, settings: MsckfSettings) -> None:
        self._camera = camera
        self._settings = settings
        self.table = TrackTable(settings.clones + 1)
        if camera.kind == "mono":
            self._least_px = _TRACKS.min_mono_px
        else:
            self._least_px = MIN_PIXEL_SIGMA_PX
        self._frames = 0  # from which the noise was learned
        # of one pixel coordinate, px^2; follows the residuals
        self.variance = settings.pixel_sigma_px**2
        # variance of all tracks' pixels over it in the last frame, at least 1
        self.common_noise = 1.0
        self.misfit = 1.0  # the same without its bound

    def choose(self, clones: int) -> IntArray:
        """Rows of the tracks that constrain the poses: two views or more, the most informative
        first if too many.
        """
        rows = self.table.rows()
        seen, length = self.table.lengths(rows)
        enough = length >= 2
        rows = rows[enough]
        if len(rows) > self._settings.max_features:
            # What ends now has its last chance; then the longest. Where nearly all ends at once, as
            # behind a cover, the newest pose needs some that go on: of few views a wrong one
            # decides.
            seen = seen[enough]
            ends = ~seen[:, clones - 1] | seen[:, 0]
            order = np.lexsort((self.table.ids(rows), -length[enough], ~ends))
            count = int(ends.sum())
            most = self._settings.max_features
            going_on = order[count:][: round(_TRACKS.going_on * most)]
            best = np.concatenate([going_on, order[:count], order[count + len(going_on) :]])[:most]
            best.sort()
            rows = rows[best]
        return rows

    def linearise(
        self,
        T_cam0_world: FloatArray,
        rows: IntArray,
        steps: int,
        field: StereoCorrection | None = None,
    ) -> LinearTracks:
        """Triangulate tracks, from where their points were last, and linearise them.

        Args:
            T_cam0_world: camera poses (N, 4, 4) at the clones.
            rows: tracks; those without a usable point are left out.
            steps: Gauss-Newton steps on each point.
            field: what is taken out of the pixels where the rectification error is estimated.
        """
        camera = self._camera
        table = self.table
        T = T_cam0_world
        clones = len(T_cam0_world)
        views = self.views(rows, clones, field)
        fresh = ~table.has_point[rows]
        if fresh.any():
            start, known = first_points(camera, T, views.take(fresh))
            table.points[rows[fresh]] = start
            table.has_point[rows[fresh]] = known
            started = table.has_point[rows]
            rows = rows[started]
            views = views.take(started)
        scale_px = CAUCHY * float(np.sqrt(self.variance))
        p, at, keep = linearised_points(camera, T, table.points[rows], views, steps, scale_px)
        table.points[rows] = p
        table.has_point[rows] = keep
        if not keep.all():
            kept = keep.nonzero()[0]
            rows = rows[kept]
            p = p[kept]
            at = at.take(kept)
            views = Views(views.z[kept], views.weight[kept])
        return self._linear(T, rows, p, at, field, unweighted(views.z, at.r, at.weight))

    def without_wrong_views(self, tracks: LinearTracks) -> LinearTracks:
        """Drop single views that contradict the rest of their track permanently, and linearise
        what is left.
        """
        at = tracks.at
        limits = chi_square_table(VIEW_PROBABILITY)
        wrong: BoolArray = np.empty(at.r.shape[:2], dtype=np.bool_)
        enough: BoolArray = np.empty(len(wrong), dtype=np.bool_)
        if not loops.mark_wrong_views(at.r, at.z_D_p, self.variance, limits, wrong, enough):
            return tracks
        self.table.drop_views(tracks.rows, wrong)
        r = at.r.copy()
        z_D_p = at.z_D_p.copy()
        r[wrong] = 0.0
        z_D_p[wrong] = 0.0
        at = Residuals(r, z_D_p, np.ones(len(wrong), dtype=np.bool_), at.weight)
        rows = tracks.rows[enough]
        p = tracks.p_world[enough]
        z = tracks.z[enough]
        return self._linear(tracks.T_cam0_world, rows, p, at.take(enough), tracks.field, z)

    def innovations(
        self, predicted: LinearTracks, moved: FloatArray
    ) -> tuple[FloatArray, IntArray]:
        """Squared innovations (F,) in the newest clone over their covariance, and how many pixels
        (F,) each has.

        Args:
            predicted: tracks linearised where the motion model has the newest clone.
            moved: covariance (6, 6) of its motion since the clone before, `[rho; phi]` on the
                world's side.
        """
        at = predicted.at
        squared = np.empty(len(predicted.rows))
        pixels = np.empty(len(predicted.rows), np.int64)
        loops.innovations(at.r, at.z_D_p, predicted.p_world, moved, self.variance, squared, pixels)
        return squared, pixels

    def innovation_ratio(self, predicted: LinearTracks, moved: FloatArray) -> float | None:
        """Median innovation in the newest clone over its standard deviation.

        None where nothing is seen in it.
        """
        squared, pixels = self.innovations(predicted, moved)
        used = pixels > 0
        if not used.any():
            return None
        return float(np.sqrt(median(squared[used] / chi_square_table(0.5)[pixels[used]])))

    def drop_unpredicted(self, predicted: LinearTracks, moved: FloatArray) -> bool:
        """Drop views of the newest clone that contradict the predicted motion permanently.

        Args:
            predicted: tracks linearised where the motion model has the newest clone.
            moved: covariance (6, 6) of its motion since the clone before, `[rho; phi]` on the
                world's side.

        Returns:
            Whether there were any.
        """
        squared, pixels = self.innovations(predicted, moved)
        wrong: BoolArray = squared > chi_square_table(VIEW_PROBABILITY)[pixels]
        views = np.zeros(predicted.at.r.shape[:2], dtype=np.bool_)
        views[:, -1] = wrong
        self.table.drop_views(predicted.rows, views)
        return bool(wrong.any())

    def _linear(
        self,
        T_cam0_world: FloatArray,
        rows: IntArray,
        p_world: FloatArray,
        at: Residuals,
        field: StereoCorrection | None,
        z: FloatArray,
    ) -> LinearTracks:
        return LinearTracks(self._camera, self.variance, T_cam0_world, rows, p_world, at, z, field)

    def drift_scores(self, tracks: LinearTracks, chosen: IntArray) -> tuple[FloatArray, FloatArray]:
        """Scores and information (K, 6) of tracks (K,) by a drift of the poses about the newest
        one, points eliminated.

        In the believed noise, where the expected square of a score is its information.
        """
        info = tracks.information
        T = tracks.T_cam0_world[-1]
        scores, information = np.empty((2, len(chosen), 6))
        loops.score_drifts(
            chosen, info, -T[:3, :3].T @ T[:3, 3], self.variance, scores, information
        )
        return scores, information

    def views(self, rows: IntArray, clones: int, field: StereoCorrection | None) -> Views:
        """Return what rows showed in the clones, without the rectification error."""
        views = self.table.views(rows, clones)
        return views if field is None else field.corrected(views)

    def move_points(
        self,
        tracks: LinearTracks,
        columns: StereoColumns | None,
        exposure_errors: FloatArray,
        stereo_errors: FloatArray,
    ) -> None:
        """Move each point as its own normal equations say once the clones (6N,) and the field
        (S,) have moved.
        """
        other: FloatArray | float = 0.0
        if columns is not None:
            other = stereo_errors @ columns.G[:, : len(stereo_errors)]
        self.table.points[tracks.rows] = tracks.information.moved_points(exposure_errors, other)

    def agree(self, at: Residuals) -> bool:
        """Whether nearly all views of the newest clone fit: only then may they contradict the
        motion model.
        """
        of_views, counts = squared_residuals(at)
        squares = of_views[:, -1]
        pixels = counts[:, -1]
        used = pixels > 0
        limits = chi_square_table(VIEW_PROBABILITY)[pixels]
        return bool(
            used.any() and np.mean(squares[used] < self.variance * limits[used]) > _AGREEMENT
        )

    def gate(self, at: Residuals) -> tuple[BoolArray, FloatArray, IntArray]:
        """Test the tracks against the chi-square quantile of the settings, relative to how well all
        of them fit.

        How well they fit, `common_noise`, is kept: it divides the information of this frame's
        pixels, too, less what `leave_motion_out` takes out of it.

        Returns:
            Mask (F,) of those that pass, their normalised squared residuals (F,), and the degrees
            of freedom (F,).
        """
        squares = np.empty(len(at.r))
        dof = np.empty(len(at.r), dtype=np.int64)
        loops.square_tracks(at.r, at.z_D_p, self.variance, _TRACKS.max_dof, squares, dof)
        self._take_misfit(_misfit(squares, dof))
        limits = chi_square_table(self._settings.gate_probability)[dof] * self.common_noise
        passed: BoolArray = squares <= limits
        return passed, squares, dof

    def leave_motion_out(self, tracks: LinearTracks, nis: FloatArray, dof: IntArray) -> None:
        """Leave out of the common noise what other poses would explain: it is an error of the
        prior, not of the pixels.

        With nothing but pixels to hold the poses, the weighted squares fall by `b' A^+ b`.

        Args:
            tracks: linearised at the estimate, all of them.
            nis: (F,) their normalised squared residuals, as `gate` returns them.
            dof: (F,) their degrees of freedom, the poses known.
        """
        if self.common_noise == 1.0:
            return
        A, b = eliminate_points(tracks.information, np.ones(len(dof), dtype=np.bool_))
        scale = np.sqrt(np.where(A.diagonal() > 0, A.diagonal(), 1.0))
        # `b' A^+ b` by Cholesky with pivots, in the directions that A determines: b has no part in
        # the others.
        U, order, spent, _ = lapack.dpstrf(
            A / np.outer(scale, scale), tol=_TRACKS.no_information, lower=0
        )
        determined = order[:spent] - 1
        y, _ = lapack.dtrtrs(U[:spent, :spent], (b / scale)[determined], trans=1)
        squares = float(np.sum(tracks.weight * squared_residuals(tracks.at)[0]))
        total = int(dof.sum())
        if total > spent:
            left = (1 - float(y @ y) / squares) / (1 - spent / total)
            self._take_misfit(max(_misfit(nis, dof) * min(left, 1.0), 1.0))

    def _take_misfit(self, misfit: float) -> None:
        """Take how much larger a frame's variance is than the learned one."""
        self.misfit = misfit
        self.common_noise = min(misfit, _TRACKS.max_common_noise)

    def update_pixel_noise(self, squares: FloatArray, dof: IntArray, fitted: float) -> None:
        """Let the pixel noise follow the median of squared residuals over that of chi-square,
        robustly.

        Its logarithm is the mean over the frames so far, then follows slowly. At the start it is
        hardly known: if half a pixel is believed in place of a tenth, what moves by a pixel passes
        for noise.

        Args:
            squares: (F,) of tracks, over the variance believed.
            dof: (F,) their degrees of freedom, the poses known.
            fitted: degrees of freedom that were spent on the poses and all else that tracks have in
                common.
        """
        if len(squares) < MIN_TRACKS_FOR_NOISE:
            return
        self._frames += 1
        gain = max(1 / (self._frames + _TRACKS.prior_frames), _TRACKS.noise_gain)
        most = _TRACKS.max_change ** (gain / _TRACKS.noise_gain)
        # The mean of 1 / variance is that of the noise itself, where its estimate has about two
        # degrees less.
        total = float(dof.sum())
        left = max(total - fitted - _TRACKS.spent_on_noise, 0.25 * total)
        ratio = min(
            max(total / left * median(squares / chi_square_table(0.5)[dof]), 1 / most), most
        )
        variance = max(self.variance * ratio**gain, self._least_px**2)
        self.variance = min(variance, self._settings.pixel_sigma_max_px**2)

    def end_frame(self, *, spent: IntArray, promoted: IntArray, newest: int) -> None:
        """Remove what has been absorbed and what has ended.

        Args:
            spent: rows whose views have been used; the tracks go on without them.
            promoted: rows that have become landmarks.
            newest: column of the newest clone; tracks that were not seen in it have ended.
        """
        self.table.remove(promoted)
        rows = self.table.rows()
        ended = rows[~self.table.seen(rows)[:, newest]]
        self.table.forget_views(spent)
        self.table.remove(ended)


def _misfit(squares: FloatArray, dof: IntArray) -> float:
    """Variance of all tracks' pixels over what is assumed, where their squared residuals (F,) show
    more; else 1.

    Blur comes and goes faster than the noise is learned, and then what fails the gate is the whole
    frame. The best quarter decides: tracks on what moves are in the others.
    """
    if len(squares) < MIN_TRACKS_FOR_NOISE:
        return 1.0
    k = len(squares) // 4
    ratios = squares / chi_square_table(0.25)[dof]
    ratios.partition(k)
    return max(float(ratios[k]), 1.0)


@lru_cache(maxsize=8)
def chi_square_table(probability: float) -> FloatArray:
    """Quantiles of chi-square for 0 to 199 degrees of freedom."""
    return np.concatenate(
        [[0.0], chi_square_quantile(probability, np.arange(1, _TRACKS.max_dof + 1))]
    )
