"""What a stereo calibration got wrong, as states of the filter and as a field of rows learned
beside it.

A right camera that is turned, shifted or distorted against its calibration moves the right pixels
by a smooth field. Its rows show in `vl - vr` at once. Its columns look like depth: only motion,
which gives the same points a second depth, separates them. Equations (R1) to (R3) of docs/math.md:
rows give three terms of the columns; four others are states, and so are four terms of distortion
that both lenses have in common. With a metric sensor, so are the length of the baseline and the
focal length, equation (R4).
References: Dang, Hoffmann & Stiller, Continuous stereo self-calibration by camera parameter
tracking, IEEE TIP (2009); Cvisic, Markovic & Petrovic, Recalibrating the KITTI dataset camera setup
for improved odometry accuracy, ECMR (2021).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vio.cameras.projection import camera_args
from vio.cameras.rectification_error import ErrorColumns, corrected_pixels, vertical_disparity_terms
from vio.dataclass import dataclass
from vio.filters import track_loops as loops
from vio.filters.multiview import CAUCHY, TrackInformation
from vio.filters.track_records import Eliminated, Residuals, RowEquations, TermColumns, Views
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera, project
from vio.numerics.compiled import invert_positive, solve_positive
from vio.numerics.robust import median
from vio.records import FIELD_TERMS, RIGHT_TERMS, ROW_TERMS, BoolArray, IntArray, Observations


class _RowRules(NamedTuple):
    """How the rows of matches are learned."""

    min_rows: int = 30  # matches in a frame below which its rows are not learned from
    memory: float = 0.99  # per frame, of the rows' normal equations
    # standard deviation of the rows' coefficients before the first frame, over the noise of a row
    prior_px: float = 10.0


_ROWS = _RowRules()
_ROW_PRIOR: FloatArray = np.eye(ROW_TERMS) / _ROWS.prior_px**2
_SHIFT_FRAMES = 5  # frames together, about half a window, that show whether the rows have moved


class VerticalDisparityModel:
    """Learns how far right rows are off over the image, equation (R2), from the matches of all
    frames.
    """

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        self.forget()

    def forget(self) -> None:
        """Begin anew, as the rig is another one."""
        # medians of the last frames' rows less what was learned before them, px
        self._shifts: deque[float] = deque(maxlen=_SHIFT_FRAMES)
        self._A: FloatArray = _ROW_PRIOR.copy()
        self._b: FloatArray = np.zeros(ROW_TERMS)
        # of A with the prior
        self._inverse: FloatArray = np.asarray(np.linalg.inv(2 * _ROW_PRIOR), dtype=np.float64)
        # Right sides if the rows were those of k1, k2, q1, q2 alone.
        self._common: FloatArray = np.zeros((ROW_TERMS, FIELD_TERMS - RIGHT_TERMS))
        self._squares = self._count = 0.0  # of the rows' residuals, in the same memory
        self._matches = 0  # of the last frame
        self._field_squares = self._field_count = 0.0  # of the field, in the same memory
        self.rms_px = 0.0  # of the field over the last matches
        # of 1, x, y, x y, x^2, y^2, d, in focal lengths
        self.coefficients: FloatArray = np.zeros(ROW_TERMS)

    def update(self, seen: Observations) -> None:
        """Take in the rows of a frame's matches, with Cauchy weights against mismatches."""
        z = seen.z[seen.has_right]
        if len(z) < _ROWS.min_rows:
            return
        camera = self._camera
        basis, common = vertical_disparity_terms(camera, z)
        rows = z[:, 3] - z[:, 1]
        left = rows - camera.fv * (basis @ self.coefficients)
        if self._matches:
            self._shifts.append(median(left))
        # The median is taken out, as in the first frames the field itself is not yet known.
        weight = np.empty(len(z))
        loops.weigh_rows(left, CAUCHY, weight)
        learned = RowEquations(self._A, self._b, self._common)
        loops.add_rows(basis, common, rows, weight, _ROWS.memory, learned)
        solution = self._b.copy()
        solve_positive(self._A + (1 - _ROWS.memory) * _ROW_PRIOR, solution)
        self._inverse = np.empty(self._A.shape)
        invert_positive(self._A + _ROW_PRIOR, self._inverse)
        self.coefficients = solution / camera.fv
        self._matches = len(z)
        misfits, weights, squares = loops.fitted_rows(basis, rows, weight, solution)
        self._squares = _ROWS.memory * self._squares + misfits
        self._count = _ROWS.memory * self._count + weights
        self._field_squares = _ROWS.memory * self._field_squares + squares
        self._field_count = _ROWS.memory * self._field_count + len(z)
        self.rms_px = math.sqrt(squares / len(z))

    def without_common(self, stereo: FloatArray) -> FloatArray:
        """Return the coefficients (7,) without what the distortion of both lenses, in (8,) of (R3),
        does to rows.

        Both lenses bend a near point differently, as it lies at different places in the two images.
        """
        return np.asarray(
            self.coefficients - self._inverse @ (self._common @ stereo[RIGHT_TERMS:FIELD_TERMS])
        )

    @property
    def rows_D_common(self) -> FloatArray:
        """What k1, k2, q1 and q2 of (R3) add to the coefficients (7, 4) of the rows of the
        features seen.
        """
        return np.asarray(self._inverse @ self._common, dtype=np.float64)

    @property
    def covariance(self) -> FloatArray:
        """Covariance (7, 7) of the coefficients, in squared focal lengths."""
        # Rows of one feature share their error from frame to frame, so only the features of one
        # frame count as many.
        shared = max(self._count / max(self._matches, 1), 1.0)
        noise = 1.0
        if self._count:
            noise = self._squares / max(self._count, 1.0)
        return np.asarray(noise * shared / self._camera.fv**2 * self._inverse, dtype=np.float64)

    @property
    def moved_px(self) -> float:
        """By how much the rows of the last frames are off from what was learned before, all of
        them alike.
        """
        full = len(self._shifts) == _SHIFT_FRAMES
        if not full:
            return 0.0
        return abs(sum(self._shifts)) / _SHIFT_FRAMES

    @property
    def stated_px(self) -> float:
        """Root mean square of the field over the matches of all frames: wherever in the image the
        features of the last one lie, that is what is stated.
        """
        if not self._field_count:
            return 0.0
        return math.sqrt(self._field_squares / self._field_count)

    @property
    def offset_px(self) -> float | None:
        """Root mean square of the field over the last matches, less what noise alone makes.

        None before the first.
        """
        if not self._matches:
            return None
        # The features of one frame count, as in the covariance.
        by_noise = ROW_TERMS * self._squares / max(self._count, 1.0) / self._matches
        return float(np.sqrt(max(self.rms_px**2 - by_noise, 0.0)))


@dataclass(frozen=True, slots=True)
class StereoCorrection:
    """The field at the present estimate: what is taken out of the pixels."""

    camera: StereoCamera
    # (7,) of (R2) that are the right camera's own, in focal lengths; zero where they show no fault
    rows: FloatArray
    coefficients: FloatArray  # (10,) of (R3) and (R4)
    terms: IntArray  # (S,) which of them are estimated
    # (7, 4) what k1, k2, q1, q2 have taken off `rows`, which were learned with them; (7, 0):
    # nothing
    rows_D_common: FloatArray = field(default_factory=lambda: np.zeros((ROW_TERMS, 0)))

    def columns(self, considered: int = 0) -> ErrorColumns:
        """Columns of the coefficients that are estimated, then of those considered: none, or four.

        The four are baseline, focal length, principal point.
        """
        return ErrorColumns(
            self.camera,
            _with_considered(tuple(self.terms.tolist()), considered),
            self.rows_D_common,
        )

    def depth_sigma(self, p_cam: FloatArray, P: FloatArray) -> FloatArray:
        """Standard deviations (M,) of stereo depths, over them, by errors of the coefficients of
        covariance P (S, S).

        Args:
            p_cam: points in the left camera (M, 3).
            P: of the coefficients that are estimated.
        """
        z = project(self.camera, p_cam)
        J = self.columns().jacobian(z)
        by_terms = J[:, 0] - J[:, 2]
        out: FloatArray = np.sqrt(np.einsum("ms,st,mt->m", by_terms, P, by_terms)) / (
            z[:, 0] - z[:, 2]
        )
        return out

    def corrected(self, views: Views) -> Views:
        """Return views (..., 4) without the field."""
        out = corrected_pixels(self.camera, self.coefficients, self.rows, views.z, views.weight)
        return Views(out, views.weight)

    def seen(self, z: FloatArray) -> FloatArray:
        """Pixels (M, 4) that the cameras show where the calibration expects z (M, 4): with (R4),
        without (R3).
        """
        baseline, focal = self.coefficients[FIELD_TERMS:]
        centre = np.array([self.camera.cu, self.camera.cv])
        out = z.copy()
        out[:, :2] = centre + (z[:, :2] - centre) * np.exp(focal)
        out[:, 2] = out[:, 0] - (z[:, 0] - z[:, 2]) * np.exp(focal + baseline)
        out[:, 3] = out[:, 1]
        return out


@lru_cache(maxsize=8)
def _with_considered(terms: tuple[int, ...], considered: int) -> IntArray:
    return np.array([*terms, *range(FIELD_TERMS, FIELD_TERMS + considered)], dtype=np.int64)


@dataclass(frozen=True, slots=True)
class StereoColumns:
    """The part of F tracks' normal equations that concerns the field's S coefficients:
    `r = J (B xi_i + dp) + H s`.
    """

    wanted: ErrorColumns  # columns of H
    at: Residuals  # and Jacobians of the tracks in N clones
    z: FloatArray  # (F, N, 4) pixels at which H is taken
    weight: FloatArray  # (F, N) robust weights
    # (F, S, 3) cross information of coefficients and point, of tracks whose points were eliminated
    G: FloatArray

    def point_D_stereo(self, info: TrackInformation, chosen: IntArray) -> FloatArray:
        """How the estimated points of tracks (K,) follow errors of the coefficients (K, 3, S),
        world: `-C^-1 G`.
        """
        out: FloatArray = np.empty((len(chosen), 3, self.G.shape[1]))
        loops.points_by_others(chosen, info.C, info.q.p_D_q, self.G, out)
        return out


def stereo_columns(
    wanted: ErrorColumns, at: Residuals, z: FloatArray, weight: FloatArray
) -> StereoColumns:
    """Return the columns of tracks, see `StereoColumns`, before `eliminate_points` has collected
    them.
    """
    return StereoColumns(wanted, at, z, weight, np.zeros((len(weight), len(wanted.chosen), 3)))


def eliminate_points(
    info: TrackInformation, chosen: BoolArray, columns: StereoColumns | None = None
) -> tuple[FloatArray, FloatArray]:
    """Information matrix (6N + S, 6N + S) and vector about clones and coefficients of the chosen
    tracks, (M4).

    `sum_f M_f - G_f C_f^-1 G_f'`: exact elimination of each point. Without columns, S is zero;
    those given learn the cross information of the chosen tracks.
    """
    rows = chosen.nonzero()[0]
    size = info.G.shape[1]
    if columns is None:
        D = size
    else:
        D = size + len(columns.wanted.chosen)
    out = Eliminated(np.empty((3 * len(rows), D)), np.zeros((D, D)), np.zeros(D))
    loops.eliminate_tracks(rows, info, out)
    A = out.A
    if columns is not None:
        wanted = columns.wanted
        terms = TermColumns(
            camera_args(wanted.camera),
            wanted.chosen,
            wanted.rows_D_common,
            columns.z,
            columns.weight,
            columns.G,
        )
        loops.eliminate_columns(rows, terms, columns.at, info, out)
        A[size:, :size] = A[:size, size:].T
    A -= out.V.T @ out.V
    return A, out.b
