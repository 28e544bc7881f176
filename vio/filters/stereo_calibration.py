"""What a stereo calibration got wrong, as states of the filter: a low-order field of disparities over the image.

A right camera that is turned, shifted or distorted against its calibration moves the right pixels by a smooth field.
Its rows show in `vl - vr` at once and are not used here. Its columns look like depth: only motion, which gives the same
points a second depth, separates them. The field has six terms in normalised coordinates (x, y) of the right image,

    du = f (a1 (1 + x^2) + a2 x + a3 y + a4 x y + a5 x^2 + a6 y^2)      (R1)

The first is a right camera turned about its vertical axis, to first order; the others are a focal ratio, a roll, a
pitch, and what tangential and radial distortion leave over. Equation numbers are those of docs/math.md.
References: Dang, Hoffmann & Stiller, Continuous stereo self-calibration by camera parameter tracking, IEEE TIP (2009);
Cvisic, Markovic & Petrovic, Recalibrating the KITTI dataset camera setup for improved odometry accuracy, ECMR (2021).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.filters.multiview import LandmarkResiduals, Residuals, TrackInformation, Views
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import BoolArray

TERMS = 6


def disparity_basis(camera: StereoCamera, z: FloatArray) -> FloatArray:
    """Evaluate the terms of (R1), times f, at stereo pixels (..., 4): what each coefficient moves `ur` by, (..., 6)."""
    x, y = (z[..., 2] - camera.cu) / camera.fu, (z[..., 1] - camera.cv) / camera.fv
    terms = np.stack([1 + x * x, x, y, x * y, x * x, y * y], axis=-1)
    out: FloatArray = camera.fu * terms
    return out


def corrected_views(camera: StereoCamera, views: Views, coefficients: FloatArray) -> Views:
    """Return views with the field of given coefficients (6,) taken out of their right pixels."""
    if not coefficients.any():
        return views
    z = views.z.copy()
    z[..., 2] -= np.where(views.weight[..., 2] > 0, disparity_basis(camera, views.z) @ coefficients, 0.0)
    return Views(z, views.weight)


@dataclass(frozen=True, slots=True)
class StereoColumns:
    """The part of the tracks' normal equations that concerns the field's S coefficients; pixel noise is one pixel."""

    G: FloatArray  # (F, S, 3) cross information of coefficients and point
    D: FloatArray  # (F, S, S) information of the coefficients before the point is eliminated
    cross: FloatArray  # (F, N, 6, S) cross information of clones and coefficients
    gradient: FloatArray  # (F, S)


def stereo_columns(at: Residuals, basis: FloatArray, point_D_pose: FloatArray, weight: FloatArray) -> StereoColumns:
    """Collect the normal equations of `r = J (B xi_i + dp) + H s`, where H is the basis in the row of `ur`.

    Args:
        at: residuals and Jacobians of F tracks in N clones.
        basis: what the coefficients move the right pixel of each view by (F, N, S).
        point_D_pose: `B` (F, 3, 6).
        weight: robust weights (F, N).
    """
    J, r = at.z_D_p[:, :, 2], at.r[:, :, 2]  # (F, N, 3), (F, N)
    H = basis * np.any(J, axis=2)[..., None]
    WH = H * weight[..., None]
    HJ = np.swapaxes(WH, 1, 2) @ J  # (F, S, 3)
    JB = J @ point_D_pose  # (F, N, 6)
    cross = JB[..., :, None] * WH[..., None, :]
    return StereoColumns(HJ, np.swapaxes(WH, 1, 2) @ H, cross, (np.swapaxes(WH, 1, 2) @ r[..., None])[..., 0])


@dataclass(frozen=True, slots=True)
class StereoInformation:
    """Information about the field's coefficients, beside that about poses and landmarks (n)."""

    A: FloatArray  # (S, S)
    cross: FloatArray  # (S, n) with poses and landmarks
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


def landmark_columns(at: LandmarkResiduals, basis: FloatArray, clones: int) -> StereoInformation:
    """Collect what the landmarks' pixels in the newest exposure say of the coefficients, `dp = xi_f - xi_rho`.

    Args:
        at: residuals of all M landmarks.
        basis: what the coefficients move the right pixel of each by (M, S).
        clones: N, how many exposures there are.
    """
    M, S = basis.shape
    J = at.J[:, 2]
    H = basis * np.any(J, axis=1)[:, None]
    WH = H * at.weight[:, None]
    by_point = WH[:, :, None] * J[:, None, :]  # (M, S, 3)
    cross = np.zeros((S, 6 * clones + 3 * M))
    cross[:, 6 * clones :] = np.swapaxes(by_point, 0, 1).reshape(S, 3 * M)
    cross[:, 6 * clones - 6 : 6 * clones - 3] = -by_point.sum(axis=0)
    return StereoInformation(WH.T @ H, cross, WH.T @ at.r[:, 2])


def eliminate_points_from_columns(
    columns: StereoColumns, info: TrackInformation, chosen: BoolArray
) -> StereoInformation:
    """Take the points of the chosen tracks out of the coefficients' part of the normal equations, as (M4) does."""
    G = columns.G[chosen]
    GC = np.linalg.solve(info.C[chosen], np.swapaxes(G, 1, 2))  # (F, 3, S)
    A = columns.D[chosen].sum(axis=0) - np.einsum("fsk,fkt->st", G, GC)
    N, S = columns.cross.shape[1], G.shape[1]
    cross = columns.cross[chosen].sum(axis=0).reshape(6 * N, S) - np.einsum("fik,fks->is", info.G[chosen], GC)
    b = columns.gradient[chosen].sum(axis=0) - np.einsum("fks,fk->s", GC, info.point_gradient[chosen])
    return StereoInformation(A, cross.T, b)
