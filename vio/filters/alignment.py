"""Visual-inertial alignment: gyro bias, velocity and gravity from the bearings of tracks and the
IMU, without a scale.

Equations (V1) to (V5) of docs/math.md. Everything is in the body frame of the first of K views
("first"), whose attitude is not known yet. The results are a start for a nonlinear estimate
(`vio.filters.mono_start`), and come without a covariance.
References: Kneip & Lynen, Direct optimization of frame-to-frame rotation, ICCV (2013), for the
rotations alone; Martinelli, Closed-form solution of visual-inertial structure from motion, IJCV
(2014); Dong-Si & Mourikis, Estimator initialization in vision-aided inertial navigation with
unknown camera-IMU calibration, IROS (2012), for the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Tolerance
from vio.records import BoolArray


class _AlignmentRules(NamedTuple):
    """The fit of gyro bias, velocity and gravity to bearings."""

    steps: Tolerance[int] = 6
    bearing_sigma_rad: float = 2e-3  # rad, a pixel of a usual lens; larger residuals lose weight
    min_shared_tracks: int = 8  # tracks that two views share, for their rotation to be used
    tiny: Tolerance[float] = 1e-12
    min_depth_m: Tolerance[float] = 0.1  # of a point in a weight: a nearer one is noise


_ALIGNMENT = _AlignmentRules()


@dataclass(frozen=True, slots=True)
class Bearings:
    """What K views show of F tracks."""

    # (F, K, 3) of unit length in the body's axes at each view; arbitrary where not seen
    rays: FloatArray
    seen: BoolArray  # (F, K)
    camera_imu: FloatArray  # (3,) position of the camera in the body's frame, metres


@dataclass(frozen=True, slots=True)
class FreeMotion:
    """The body's motion at K views by its IMU, without gravity and start velocity."""

    times_s: FloatArray  # (K,) since the first view
    R_first_body: FloatArray  # (K, 3, 3)
    moves: FloatArray  # (K, 3) double integral of the turned specific force, metres
    phi_D_bias: FloatArray  # (K, 3, 3) how a gyro bias (rad/s) turns R_first_body, on its left


@dataclass(frozen=True, slots=True)
class VisualInertialAlignment:
    """Velocity and gravity in the first body frame."""

    velocity: FloatArray  # (3,) m/s
    gravity: FloatArray  # (3,) m/s^2, of the given length


def gyro_bias(bearings: Bearings, motion: FreeMotion, sigma_radps: float) -> FloatArray:
    """Gyro bias (3,) rad/s, less the one in `motion`, by which successive views fulfil the epipolar
    constraint best.

    `t' (u_j x u_k) = 0` of each shared track, with directions u in the first frame and the unknown
    direction t of the translation, which is eliminated for every pair of views.

    Args:
        bearings: of the tracks.
        motion: by the gyro.
        sigma_radps: standard deviation of the bias.
    """
    bias = np.zeros(3)
    K = len(motion.times_s)
    u = np.einsum("kij,fkj->fki", motion.R_first_body, bearings.rays)
    pairs = [(j, k) for j in range(K) for k in (j + 1, j + 2) if k < K]
    for _ in range(_ALIGNMENT.steps):
        turns = motion.phi_D_bias @ bias
        now = u + np.cross(turns, u)
        A = np.eye(3) / sigma_radps**2
        b = -bias / sigma_radps**2
        for j, k in pairs:
            shared = bearings.seen[:, j] & bearings.seen[:, k]
            if shared.sum() >= _ALIGNMENT.min_shared_tracks:
                parts = _rotation_information(
                    now[shared, j], now[shared, k], motion.phi_D_bias[[j, k]]
                )
                A = A + parts[0]
                b = b + parts[1]
        bias = bias + np.linalg.solve(A, b)
    return bias


def _rotation_information(
    u: FloatArray, v: FloatArray, phi_D_bias: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Information (3, 3) and vector (3,) about a gyro bias from directions (N, 3) of the same
    points in two views.
    """
    n = np.cross(u, v)
    t = np.linalg.eigh(n.T @ n)[1][:, 0]
    for _ in range(2):  # once more, with the weights of the residuals
        r = n @ t
        w = 1.0 / (1.0 + (r / _ALIGNMENT.bearing_sigma_rad) ** 2) / _ALIGNMENT.bearing_sigma_rad**2
        t = np.linalg.eigh((n * w[:, None]).T @ n)[1][:, 0]
    across = np.linalg.svd(t[None])[2][1:].T  # (3, 2) directions in which t may move
    dot = np.sum(u * v, axis=1)[:, None]
    ut = (u @ t)[:, None]
    vt = (v @ t)[:, None]
    r_D_phi_u = ut * v - dot * t
    r_D_phi_v = dot * t - vt * u
    r_D_bias = r_D_phi_u @ phi_D_bias[0] + r_D_phi_v @ phi_D_bias[1]
    J = np.concatenate([r_D_bias, n @ across], axis=1)
    A = (J * w[:, None]).T @ J
    b = -(J * w[:, None]).T @ (n @ t)
    lost = A[:3, 3:] @ np.linalg.inv(A[3:, 3:] + _ALIGNMENT.tiny * np.eye(2))
    information = A[:3, :3] - lost @ A[3:, :3]
    pull = b[:3] - lost @ b[3:]
    return information, pull


def align_visual_inertial(
    bearings: Bearings, motion: FreeMotion, gravity_mps2: float
) -> VisualInertialAlignment | None:
    """Velocity and gravity that, with the points on their rays, explain the bearings; None where
    nothing does.

    With camera positions `c_k = v t_k + g t_k^2 / 2 + s_k`, point `c_a + d m` of the first view's
    ray m must lie on the ray n of each other view: `(I - n n') (d m + c_a - c_k) = 0`, linear in v,
    g and the distances d, which are eliminated. Weights bring the residuals from metres to angles.
    Gravity has the given length.

    Args:
        bearings: of the tracks, each seen in two views or more.
        motion: by the IMU, its gyro bias taken out.
        gravity_mps2: length of gravity.
    """
    t = motion.times_s
    seen = bearings.seen
    n = np.einsum("kij,fkj->fki", motion.R_first_body, bearings.rays)
    first = np.argmax(seen, axis=1)
    rows = np.arange(len(seen))
    m = n[rows, first]
    fixed = motion.moves + motion.R_first_body @ bearings.camera_imu
    across = np.eye(3) - n[..., :, None] * n[..., None, :]
    by_v = t[first, None] - t
    by_g = 0.5 * (t[first, None] ** 2 - t**2)
    # (F, K, 3, 6)
    A_x = np.concatenate([by_v[..., None, None] * across, by_g[..., None, None] * across], axis=3)
    A_d = np.einsum("fkij,fj->fki", across, m)
    b = -np.einsum("fkij,fkj->fki", across, fixed[first][:, None] - fixed)
    weight = seen.astype(np.float64)
    x = np.zeros(6)
    for _ in range(_ALIGNMENT.steps):
        H_xx = np.einsum("fk,fkai,fkaj->ij", weight, A_x, A_x)
        H_xd = np.einsum("fk,fkai,fka->fi", weight, A_x, A_d)
        H_dd = np.einsum("fk,fka,fka->f", weight, A_d, A_d) + _ALIGNMENT.tiny
        g_x = np.einsum("fk,fkai,fka->i", weight, A_x, b)
        g_d = np.einsum("fk,fka,fka->f", weight, A_d, b)
        S = H_xx - np.einsum("fi,fj,f->ij", H_xd, H_xd, 1 / H_dd)
        x_or_none = _with_length(S, g_x - H_xd.T @ (g_d / H_dd), gravity_mps2)
        if x_or_none is None:
            return None
        x = x_or_none
        d = (g_d - H_xd @ x) / H_dd
        centres = (
            by_v[..., None] * x[:3] + by_g[..., None] * x[3:] + (fixed[first][:, None] - fixed)
        )
        depth = np.maximum(
            np.linalg.norm(centres + d[:, None, None] * m[:, None], axis=2), _ALIGNMENT.min_depth_m
        )
        residual = A_x @ x + A_d * d[:, None, None] - b
        off = np.linalg.norm(residual, axis=2) / depth
        weight = (
            seen * (d > 0)[:, None] / depth**2 / (1 + (off / _ALIGNMENT.bearing_sigma_rad) ** 2)
        )
        if np.count_nonzero(d > 0) < _ALIGNMENT.min_shared_tracks:
            return None
    return VisualInertialAlignment(x[:3], x[3:])


def _with_length(S: FloatArray, r: FloatArray, length: float) -> FloatArray | None:
    """Minimise `x' S x / 2 - r' x` over `x = [v; g]` (6,) with a given length of g; None: S does
    not determine v.

    With v eliminated, `(A + lambda I) g = b`, where |g| falls in lambda: bisection beyond the
    smallest eigenvalue.
    Reference: Golub & Van Loan, Matrix computations, section 6.2.1 (least squares over a sphere).
    """
    of_rotation = S[:3, :3]
    smallest = np.linalg.eigvalsh(of_rotation)[0]
    if smallest <= 1e-9 * np.trace(of_rotation) or not np.isfinite(S).all():
        return None
    v_D_g = -np.linalg.solve(S[:3, :3], S[:3, 3:])
    v_0 = np.linalg.solve(S[:3, :3], r[:3])
    values, vectors = np.linalg.eigh(S[3:, 3:] + S[3:, :3] @ v_D_g)
    b = vectors.T @ (r[3:] - S[3:, :3] @ v_0)
    scale = float(np.linalg.norm(b)) + float(np.abs(values).max()) * length
    low = -float(values[0])
    high = -float(values[0]) + 2 * scale / length
    for _ in range(100):
        middle = 0.5 * (low + high)
        longer = float(np.sum((b / (values + middle + 1e-300)) ** 2)) > length**2
        low, high = (middle, high) if longer else (low, middle)
    g = vectors @ (b / (values + high))
    return np.concatenate([v_0 + v_D_g @ g, g])
