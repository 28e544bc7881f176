"""What a stereo calibration got wrong, as states of the filter and as a field of rows learned beside it.

A right camera that is turned, shifted or distorted against its calibration moves the right pixels by a smooth field.
Its rows show in `vl - vr` at once. Its columns look like depth: only motion, which gives the same points a second
depth, separates them. Equations (R1) to (R3) of docs/math.md: rows give three of the six terms of the columns; the
other three are states, and so are three terms of distortion that both lenses have in common.
References: Dang, Hoffmann & Stiller, Continuous stereo self-calibration by camera parameter tracking, IEEE TIP (2009);
Cvisic, Markovic & Petrovic, Recalibrating the KITTI dataset camera setup for improved odometry accuracy, ECMR (2021).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.filters.multiview import CAUCHY, LandmarkResiduals, Residuals, TrackInformation, Views
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray, Observations

TERMS = 6  # a0, a1, a2, k, q1, q2 of (R3)
_ROW_TERMS = 6
_MIN_ROWS = 30  # matches in a frame below which its rows are not learned from
_ROW_MEMORY = 0.99  # per frame, of the rows' normal equations
_LEAST_ROWS_PX = 0.05  # root mean square of the field over the matches; smaller ones do no harm
_ROW_DOMINANCE = 4.0  # the field over the variance that it leaves: features that wander calibrate nothing
_ROW_SIGNIFICANCE = 25.0  # squared standard deviations of the field by noise alone
_ROW_PRIOR_PX = 10.0  # standard deviation of the rows' coefficients before the first frame, over the noise of a row


def field_jacobian(camera: StereoCamera, z: FloatArray) -> FloatArray:
    """Derivatives of pixels `[ul vl ur vr]` (..., 4) by the six coefficients of (R3), (..., 4, 6), pixels.

    The row of `vr` is zero: right rows are not measured.
    """
    x, y = (z[..., 0] - camera.cu) / camera.fu, (z[..., 1] - camera.cv) / camera.fv
    xr = (z[..., 2] - camera.cu) / camera.fu
    out = np.zeros((*z.shape[:-1], 4, TERMS))
    for row, u in ((0, x), (2, xr)):
        r2 = u * u + y * y
        out[..., row, 3], out[..., row, 4], out[..., row, 5] = u * r2, 2 * u * y, r2 + 2 * u * u
    r2 = x * x + y * y
    out[..., 1, 3], out[..., 1, 4], out[..., 1, 5] = y * r2, r2 + 2 * y * y, 2 * x * y
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = 1.0, xr, xr * xr + y * y
    return out * np.array([camera.fu, camera.fv, camera.fu, camera.fv])[:, None]


class RowField:
    """Learns how far right rows are off over the image, equation (R2), from the matches of all frames."""

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        self._A: FloatArray = np.eye(_ROW_TERMS) / _ROW_PRIOR_PX**2
        self._b: FloatArray = np.zeros(_ROW_TERMS)
        self._squares = self._count = 0.0  # of the rows' residuals, in the same memory
        self._matches = 0  # of the last frame
        self.rms_px = 0.0  # of the field over the matches
        self.coefficients: FloatArray = np.zeros(_ROW_TERMS)  # of 1, x, y, x y, x^2, y^2, in focal lengths

    def update(self, seen: Observations) -> None:
        """Take in the rows of a frame's matches, with Cauchy weights against mismatches."""
        z = seen.z[seen.has_right]
        if len(z) < _MIN_ROWS:
            return
        camera = self._camera
        x, y = (z[:, 2] - camera.cu) / camera.fu, (z[:, 1] - camera.cv) / camera.fv
        basis = np.stack([np.ones_like(x), x, y, x * y, x * x, y * y], axis=1)
        rows = z[:, 3] - z[:, 1]
        # The median is taken out, as in the first frames the field itself is not yet known.
        residual = _centred(rows - camera.fv * (basis @ self.coefficients))
        scale = max(1.48 * float(np.median(np.abs(residual))), 1e-3)
        weight: FloatArray = 1 / (1 + (residual / (CAUCHY * scale)) ** 2)
        self._A = _ROW_MEMORY * self._A + (basis * weight[:, None]).T @ basis
        self._b = _ROW_MEMORY * self._b + (basis * weight[:, None]).T @ rows
        prior = (1 - _ROW_MEMORY) * np.eye(_ROW_TERMS) / _ROW_PRIOR_PX**2
        solution = np.asarray(np.linalg.solve(self._A + prior, self._b), dtype=np.float64)
        self.coefficients = solution / camera.fv
        field, self._matches = basis @ solution, len(z)
        self._squares = _ROW_MEMORY * self._squares + float(weight @ (rows - field) ** 2)
        self._count = _ROW_MEMORY * self._count + float(weight.sum())
        self.rms_px = float(np.sqrt(np.mean(field**2)))

    @property
    def is_significant(self) -> bool:
        """Whether the rows show that the calibration is off: a field beyond its own uncertainty, and beyond harm."""
        # Rows of one feature share their error from frame to frame, so only the features of one frame count as many.
        uncertainty = _ROW_TERMS * self._squares / max(self._count, 1.0) / max(self._matches, 1)
        noise = self._squares / max(self._count, 1.0)
        return self.rms_px**2 > max(_LEAST_ROWS_PX**2 + _ROW_SIGNIFICANCE * uncertainty, _ROW_DOMINANCE * noise)

    def columns(self, z: FloatArray) -> FloatArray:
        """Return the part of `du` (...) that follows from the rows at stereo pixels (..., 4), pixels."""
        camera, c = self._camera, self.coefficients
        x, y = (z[..., 2] - camera.cu) / camera.fu, (z[..., 1] - camera.cv) / camera.fv
        out: FloatArray = camera.fu * (-c[1] * y + (c[5] - c[4]) * x * y - c[3] * y * y)
        return out


def _centred(values: FloatArray) -> FloatArray:
    return np.asarray(values - np.median(values), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class StereoField:
    """The field at the present estimate: what is taken out of the pixels."""

    camera: StereoCamera
    rows: RowField
    coefficients: FloatArray  # (6,) of (R3)

    def corrected(self, views: Views) -> Views:
        """Return views (..., 4) without the field."""
        z = views.z - field_jacobian(self.camera, views.z) @ self.coefficients
        z[..., 2] -= self.rows.columns(views.z)
        return Views(np.where(views.weight > 0, z, views.z), views.weight)


@dataclass(frozen=True, slots=True)
class StereoColumns:
    """The part of the tracks' normal equations that concerns the field's S coefficients; pixel noise is one pixel."""

    by_point: FloatArray  # (F, N, 3, S) `J' W H` of each view, the point in the coordinates (M5)
    H: FloatArray  # (F, 4N, S) derivatives of the pixels by the coefficients, zero where not measured
    WH: FloatArray  # (F, 4N, S) the same times the robust weights
    r: FloatArray  # (F, 4N) residuals

    @property
    def G(self) -> FloatArray:
        """Cross information (F, 3, S) of point and coefficients."""
        out: FloatArray = self.by_point.sum(axis=1)
        return out

    def point_D_stereo(self, info: TrackInformation) -> FloatArray:
        """How the estimated points follow errors of the coefficients (F, 3, S), world: `-C^-1 G`."""
        out: FloatArray = -info.q.p_D_q @ np.linalg.solve(info.C, self.G)
        return out


def stereo_columns(at: Residuals, H: FloatArray, p_D_q: FloatArray, weight: FloatArray) -> StereoColumns:
    """Collect the normal equations of `r = J (B xi_i + dp) + H s`.

    Args:
        at: residuals and Jacobians of F tracks in N clones.
        H: derivatives of each view's pixels by the coefficients (F, N, 4, S).
        p_D_q: the points' coordinates (F, 3, 3), equation (M5).
        weight: robust weights (F, N).
    """
    F, N, _, S = H.shape
    J = at.z_D_p
    H = H * np.any(J, axis=3)[..., None]
    WH = H * weight[..., None, None]
    by_point = np.asarray(sum(J[:, :, a, :, None] * WH[:, :, a, None, :] for a in range(3)))
    by_q = np.swapaxes(p_D_q, 1, 2) @ np.swapaxes(by_point, 1, 2).reshape(F, 3, N * S)
    flat = (F, 4 * N, S)
    return StereoColumns(
        np.swapaxes(by_q.reshape(F, 3, N, S), 1, 2), H.reshape(flat), WH.reshape(flat), at.r.reshape(F, 4 * N)
    )


@dataclass(frozen=True, slots=True)
class StereoInformation:
    """Information about the field's S coefficients, beside that about n entries of poses and landmarks."""

    A: FloatArray  # (S, S)
    cross: FloatArray  # (S, n)
    b: FloatArray  # (S,)

    @classmethod
    def none(cls, size: int) -> StereoInformation:
        """No information, beside `size` entries of poses and landmarks."""
        return cls(np.zeros((TERMS, TERMS)), np.zeros((TERMS, size)), np.zeros(TERMS))

    def __add__(self, other: StereoInformation) -> StereoInformation:
        """Add information; the other may concern the first of the poses and landmarks only."""
        cross = self.cross.copy()
        cross[:, : other.cross.shape[1]] += other.cross
        return StereoInformation(self.A + other.A, cross, self.b + other.b)

    def scaled(self, factor: float) -> StereoInformation:
        """Return the information times a factor."""
        return StereoInformation(self.A * factor, self.cross * factor, self.b * factor)


def eliminate_points_from_columns(
    columns: StereoColumns, info: TrackInformation, chosen: BoolArray
) -> StereoInformation:
    """Take the points of the chosen tracks out of the coefficients' part of the normal equations, as (M4) does."""
    by_point = columns.by_point[chosen]
    F, N, _, S = by_point.shape
    H, WH, r = (a[chosen] for a in (columns.H, columns.WH, columns.r))
    G = by_point.sum(axis=1)  # (F, 3, S)
    CG = np.linalg.solve(info.C[chosen], G)  # (F, 3, S)
    flat_G, flat_CG = G.reshape(3 * F, S), CG.reshape(3 * F, S)
    A = WH.reshape(-1, S).T @ H.reshape(-1, S) - flat_G.T @ flat_CG
    B = info.q_D_clone[chosen].reshape(3 * F, 6)
    per_view = np.swapaxes(by_point, 1, 2).reshape(3 * F, N * S)
    cross = (B.T @ per_view).reshape(6, N, S).transpose(1, 0, 2).reshape(6 * N, S)
    cross = cross - np.swapaxes(info.G[chosen], 1, 2).reshape(3 * F, 6 * N).T @ flat_CG
    b = WH.reshape(-1, S).T @ r.reshape(-1) - flat_CG.T @ info.point_gradient[chosen].reshape(-1)
    return StereoInformation(A, cross.T, b)


def landmark_columns(at: LandmarkResiduals, H: FloatArray, clones: int) -> StereoInformation:
    """Collect what the landmarks' pixels in the newest exposure say of the coefficients, `dp = xi_f - xi_rho`.

    Args:
        at: residuals of all M landmarks.
        H: derivatives of their pixels by the coefficients (M, 4, S).
        clones: N, how many exposures there are.
    """
    M, _, S = H.shape
    H = H * np.any(at.J, axis=2)[..., None]
    WH = H * at.weight[:, None, None]
    by_point = np.swapaxes(WH, 1, 2) @ at.J  # (M, S, 3)
    cross = np.zeros((S, 6 * clones + 3 * M))
    cross[:, 6 * clones :] = np.swapaxes(by_point, 0, 1).reshape(S, 3 * M)
    cross[:, 6 * clones - 6 : 6 * clones - 3] = -by_point.sum(axis=0)
    return StereoInformation(WH.reshape(-1, S).T @ H.reshape(-1, S), cross, np.einsum("mas,ma->s", WH, at.r))
