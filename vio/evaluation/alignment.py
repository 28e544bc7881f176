"""Alignment of a trajectory with a reference: the similarity that minimises the squared
distances of the positions.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from vio.dataclass import dataclass
from vio.errors import EvaluationError
from vio.geometry.lie import (
    FloatArray,
    nearest_rotation,
    se3_from_parts,
    se3_inverse,
    so3_exp,
    so3_hat,
    so3_log,
)
from vio.numerics.kinds import Tolerance

AlignMode: TypeAlias = Literal["se3", "sim3", "first", "none"]
RotationSource: TypeAlias = Literal[
    "positions", "direction and orientations", "orientations", "first pose", "none"
]


@dataclass(frozen=True, slots=True)
class _AlignmentRules:
    """When positions alone, or orientations too, decide an alignment."""

    # ratio of squared extents below which points are collinear, to rounding
    collinear: Tolerance[float] = 1e-13
    # positions determine the rotation about the path if its standard deviation is below 3 degrees
    loose_rad: float = 0.05
    # ratio of standard deviations above which the orientations replace the positions in it
    orientation_gain: float = 10.0
    # standard deviations by which they may differ; more: they do not describe the same body
    contradiction: float = 5.0
    # extent, relative to the size of the coordinates, below which points coincide, to rounding
    stationary: Tolerance[float] = 1e-12


_ALIGNMENT = _AlignmentRules()


@dataclass(frozen=True, slots=True)
class Alignment:
    """Similarity from the estimate's world to the reference's: `p_ref = scale R p_est + t`."""

    R: FloatArray  # (3, 3)
    t: FloatArray  # (3,) metres
    scale: float
    # direction and orientations: of the path, and of the poses about it
    rotation_from: RotationSource = "positions"


def align_poses(T_est: FloatArray, T_ref: FloatArray, mode: AlignMode) -> Alignment:
    """Find the alignment of M >= 1 paired poses (M, 4, 4) that minimises the squared distances of
    their positions.

    Where the positions do not determine the rotation (one point, or a straight line), the
    orientations do. `first` makes the first pair of poses equal instead, `none` is the identity.

    Raises:
        EvaluationError: the scale of `sim3` is undefined, because one of the two does not move.

    Reference: Umeyama, Least-squares estimation of transformation parameters between two point
    patterns, IEEE TPAMI (1991), equations 34 to 43.
    """
    if mode == "none":
        return Alignment(np.eye(3), np.zeros(3), 1.0, "none")
    if mode == "first":
        T = T_ref[0] @ se3_inverse(T_est[0])
        return Alignment(T[:3, :3], T[:3, 3], 1.0, "first pose")
    x = T_est[:, :3, 3]
    y = T_ref[:, :3, 3]
    x_mean = x.mean(axis=0)
    y_mean = y.mean(axis=0)
    x_extent = extent_m(x)
    y_extent = extent_m(y)
    covariance = (y - y_mean).T @ (x - x_mean) / len(x)
    U, d, Vt = np.linalg.svd(covariance)
    sign = np.array([1.0, 1.0, 1.0 if np.linalg.det(U @ Vt) > 0 else -1.0])
    R = (U * sign) @ Vt
    rotation_from: RotationSource = "positions"
    moving = min(x_extent, y_extent) > 0 and d[0] > _ALIGNMENT.collinear * x_extent * y_extent
    if not moving:
        if mode == "sim3":
            raise EvaluationError(
                "sim3 alignment needs two trajectories that move together; align with se3 or none"
            )
        R = nearest_rotation(_orientation_sum(T_est, T_ref))
        rotation_from = "orientations"
    elif d[1] <= _ALIGNMENT.collinear * d[0]:
        R = _rotate_about(U[:, 0], R, _orientation_sum(T_est, T_ref))
        rotation_from = "direction and orientations"
    scale = 1.0
    if mode == "sim3":
        scale = float(d @ sign) / x_extent**2
    return Alignment(R, y_mean - scale * (R @ x_mean), scale, rotation_from)


def settle_rotation(alignment: Alignment, T_est: FloatArray, T_ref: FloatArray) -> Alignment:
    """Return the alignment of paired poses (M, 4, 4), turned about the path where positions leave
    that part open.

    On a nearly straight path the least squares of the positions determine the rotation about the
    path to `sigma_p` only (math.md, E1), which may be tens of degrees. There the orientations
    replace them, if their own errors about the path are far smaller and both agree within
    `sigma_p`. Anywhere else the alignment is returned unchanged.
    """
    if alignment.rotation_from != "positions":
        return alignment
    axis, sigma = deviation_about_path(alignment, T_est, T_ref)
    R = _rotate_about(axis, alignment.R, _orientation_sum(T_est, T_ref))
    R_est_ref = R @ T_est[:, :3, :3] @ np.swapaxes(T_ref[:, :3, :3], 1, 2)
    scatter = so3_log(R_est_ref) @ axis
    angle = np.linalg.norm(so3_log(R @ alignment.R.T))
    precise = sigma > max(
        _ALIGNMENT.loose_rad, _ALIGNMENT.orientation_gain * np.sqrt(np.mean(scatter**2))
    )
    if not precise or angle > _ALIGNMENT.contradiction * sigma:
        return alignment
    centre_ref = T_ref[:, :3, 3].mean(axis=0)
    centre_est = T_est[:, :3, 3].mean(axis=0)
    t = centre_ref - alignment.scale * (R @ centre_est)
    return Alignment(R, t, alignment.scale, "direction and orientations")


def deviation_about_path(
    alignment: Alignment, T_est: FloatArray, T_ref: FloatArray
) -> tuple[FloatArray, float]:
    """Return the direction (3,) of a path and the standard deviation, radians, of an alignment's
    rotation about it.
    """
    x = alignment.scale * T_est[:, :3, 3] @ alignment.R.T
    y = T_ref[:, :3, 3]
    x_mean = x.mean(axis=0)
    y_mean = y.mean(axis=0)
    S = (y - y_mean).T @ (x - x_mean) / len(x)  # symmetric at the least squares
    axis = np.linalg.svd(S)[0][:, 0]
    across = np.eye(3) - np.outer(axis, axis)
    residual = (y - y_mean - x + x_mean) @ across
    variance = 0.5 * float(np.mean(np.sum(residual**2, axis=1)))
    curvature = float(np.trace(across @ S))
    return axis, float(np.sqrt(variance / curvature)) if curvature > 0 else float("inf")


def apply_alignment(alignment: Alignment, T_est: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) in the reference's world; the scale touches positions only."""
    p = alignment.scale * T_est[:, :3, 3] @ alignment.R.T + alignment.t
    return se3_from_parts(alignment.R @ T_est[:, :3, :3], p)


def extent_m(p: FloatArray) -> float:
    """Root mean square distance of positions (N, 3) from their centroid, metres; 0 where it is
    within rounding of the coordinates.
    """
    off_m = p - p.mean(axis=0)
    extent = float(np.sqrt(np.mean(np.sum(off_m**2, axis=1))))
    if extent > _ALIGNMENT.stationary * float(np.abs(p).max()):
        return extent
    return 0.0


def _orientation_sum(T_est: FloatArray, T_ref: FloatArray) -> FloatArray:
    """Return C (3, 3) such that the best fit R of `R_ref = R R_est` maximises trace(R^T C)."""
    out: FloatArray = np.einsum("nij,nkj->ik", T_ref[:, :3, :3], T_est[:, :3, :3])
    return out


def _rotate_about(axis: FloatArray, R: FloatArray, C: FloatArray) -> FloatArray:
    """Return the rotation `exp(angle axis^) R` that maximises trace(rotation^T C)."""
    D = C @ R.T
    sine = -np.trace(so3_hat(axis) @ D)
    cosine = np.trace(D) - axis @ D @ axis
    angle = np.arctan2(sine, cosine)
    out: FloatArray = so3_exp(angle * axis) @ R
    return out
