"""The tracks of the window: which of them enter an update, what they say there, and how far they are believed.

Everything here is about pixels and points; poses come in as camera poses and go out as information about them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from vio.filters.multiview import (
    CAUCHY,
    Residuals,
    TrackInformation,
    first_points,
    has_parallax,
    refine_points,
    residuals,
    robust_weights,
    track_information,
)
from vio.filters.settings import MsckfSettings
from vio.filters.tracks import TrackTable
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, IntArray
from vio.statistics import chi_square_quantile

MIN_TRACKS_FOR_NOISE = 15  # fewer tracks say nothing of how noisy pixels, or the motion model, are
_MIN_TRACKS_TO_STAND = 15
_NOISE_GAIN = 0.05  # how fast the pixel noise follows the residuals
_MEDIAN = 0.85  # of chi-square over its degrees of freedom, right for 4 to 8 of them
_VIEW_LIMIT = 23.5  # chi-square with 4 degrees of freedom, probability 0.9999
_AGREEMENT = 0.8
_MOST_DOF = 199


@dataclass(frozen=True, slots=True)
class LinearTracks:
    """Tracks linearised at one estimate of the window."""

    T_cam0_world: FloatArray  # (N, 4, 4) camera poses
    rows: IntArray  # (F,) in the table
    p_world: FloatArray  # (F, 3)
    at: Residuals
    information: TrackInformation

    def newest_innovation(self) -> float | None:
        """Median absolute residual in the newest clone, pixels; None where nothing is seen in it."""
        r, used = self.at.r[:, -1], np.any(self.at.z_D_p[:, -1] != 0, axis=2)
        return float(np.median(np.abs(r[used]))) if used.any() else None


class WindowTracks:
    """The living tracks, and the pixel noise as their residuals tell it."""

    def __init__(self, camera: StereoCamera, settings: MsckfSettings) -> None:
        self._camera, self._settings = camera, settings
        self.table = TrackTable(settings.clones + 1)
        self.variance = settings.pixel_sigma_px**2  # of one pixel coordinate, px^2; follows the residuals

    def is_stationary(self, clones: int) -> bool:
        """Whether the image stands still: the median track, and nine tenths of all within twice its limit."""
        limit = self._settings.still_px
        moved = self.table.moved_px(clones - 1) if clones > 1 and limit > 0 else np.zeros(0)
        if len(moved) < _MIN_TRACKS_TO_STAND:
            return False
        return bool(np.median(moved) < limit and np.quantile(moved, 0.9) < 2 * limit)

    def choose(self, clones: int) -> IntArray:
        """Rows of the tracks that say something of the poses: two views or more, the most telling first if too many."""
        rows = self.table.rows()
        seen = self.table.seen(rows)
        length = seen.sum(axis=1)
        rows, seen, length = rows[length >= 2], seen[length >= 2], length[length >= 2]
        if len(rows) > self._settings.max_features:
            # What ends now has its last chance; then the longest.
            ends = ~seen[:, clones - 1] | seen[:, 0]
            best = np.lexsort((self.table.ids(rows), -length, ~ends))[: self._settings.max_features]
            rows = rows[np.sort(best)]
        return rows

    def linearise(self, T_cam0_world: FloatArray, rows: IntArray, steps: int) -> LinearTracks:
        """Triangulate tracks, from where their points were last, and linearise them.

        Args:
            T_cam0_world: camera poses (N, 4, 4) at the clones.
            rows: tracks; those without a usable point are left out.
            steps: Gauss-Newton steps on each point.
        """
        camera, table, T, clones = self._camera, self.table, T_cam0_world, len(T_cam0_world)
        views = table.views(rows, clones)
        fresh = ~table.has_point[rows]
        if fresh.any():
            start, known = first_points(camera, T, views.take(fresh))
            table.points[rows[fresh]], table.has_point[rows[fresh]] = start, known
            rows = rows[table.has_point[rows]]
            views = table.views(rows, clones)
        p = refine_points(camera, T, table.points[rows], views, steps, CAUCHY * float(np.sqrt(self.variance)))
        at = residuals(camera, T, p, views)
        keep = at.ahead & np.isfinite(p).all(axis=1)
        keep[keep] = has_parallax(camera, T, p[keep], views.take(keep), at.take(keep))
        table.points[rows], table.has_point[rows] = p, keep
        return self._linear(T, rows[keep], p[keep], at.take(keep))

    def without_wrong_views(self, tracks: LinearTracks) -> LinearTracks:
        """Drop single views that contradict the rest of their track, for good, and linearise what is left."""
        wrong: BoolArray = np.sum(tracks.at.r**2, axis=2) / self.variance > _VIEW_LIMIT
        if not wrong.any():
            return tracks
        self.table.drop_views(tracks.rows, wrong)
        kept = ~wrong
        at = Residuals(
            tracks.at.r * kept[..., None], tracks.at.z_D_p * kept[..., None, None], np.ones(len(wrong), dtype=np.bool_)
        )
        enough = np.any(at.z_D_p[:, :, 1, :], axis=2).sum(axis=1) >= 2
        T = tracks.T_cam0_world
        return self._linear(T, tracks.rows[enough], tracks.p_world[enough], at.take(enough))

    def _linear(self, T_cam0_world: FloatArray, rows: IntArray, p_world: FloatArray, at: Residuals) -> LinearTracks:
        weight = robust_weights(at, self.variance)
        information = track_information(self._camera, T_cam0_world, at, p_world, weight)
        return LinearTracks(T_cam0_world, rows, p_world, at, information)

    def move_points(self, tracks: LinearTracks, exposure_errors: FloatArray) -> None:
        """Move each point as its own normal equations say once the clones have moved (6N,): back-substitution."""
        self.table.points[tracks.rows] = tracks.information.moved_points(exposure_errors)

    def agree(self, at: Residuals) -> bool:
        """Whether nearly all views of the newest clone fit: only then may they contradict the motion model."""
        squares, used = np.sum(at.r[:, -1] ** 2, axis=1), np.any(at.z_D_p[:, -1] != 0, axis=(1, 2))
        return bool(used.any() and np.mean(squares[used] < _VIEW_LIMIT * self.variance) > _AGREEMENT)

    def gate(self, at: Residuals) -> tuple[BoolArray, FloatArray]:
        """Which tracks (F,) pass the chi-square gate, and their squared residual over its degrees of freedom (F,)."""
        pairs: BoolArray = np.any(at.z_D_p[:, :, 1::2, :], axis=3)  # (F, N, 2): seen left, seen right
        dof = np.maximum(2 * pairs.sum(axis=(1, 2)) - 3, 1)
        squares = np.sum(at.r**2, axis=(1, 2)) / self.variance
        limit = _chi2_table(self._settings.gate_probability)[np.minimum(dof, _MOST_DOF)]
        passed: BoolArray = squares <= limit
        return passed, squares / dof

    def update_pixel_noise(self, nis_per_dof: FloatArray) -> None:
        """Let the pixel noise follow the median of the squared residuals (F,), robustly and slowly."""
        if len(nis_per_dof) < MIN_TRACKS_FOR_NOISE:
            return
        s = self._settings
        ratio = float(np.clip(np.median(nis_per_dof) / _MEDIAN, 0.25, 4.0))
        self.variance = float(
            np.clip(self.variance * ratio**_NOISE_GAIN, s.pixel_sigma_min_px**2, s.pixel_sigma_max_px**2)
        )

    def end_frame(self, *, spent: IntArray, promoted: IntArray, newest: int) -> None:
        """Forget what has been committed and what has ended.

        Args:
            spent: rows whose views have had their say; the tracks go on without them.
            promoted: rows that have become landmarks.
            newest: column of the newest clone; tracks that were not seen in it have ended.
        """
        self.table.remove(promoted)
        rows = self.table.rows()
        ended = rows[~self.table.seen(rows)[:, newest]]
        self.table.forget_views(spent)
        self.table.remove(ended)


@lru_cache(maxsize=8)
def _chi2_table(probability: float) -> FloatArray:
    """Quantiles of chi-square for 0 to 199 degrees of freedom."""
    return np.concatenate([[0.0], chi_square_quantile(probability, np.arange(1, _MOST_DOF + 1))])
