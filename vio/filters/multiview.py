"""Many tracks over many clones at once: triangulation, residuals, and the information they hold about the poses.

Shapes: F tracks, N clones. A track's landmark is a point of the world; its error is taken out of the problem exactly
(Schur complement, the same as projecting onto the left null space of its Jacobian, a test shows), so tracks need no
place in the state. Equation numbers (M1) … are those of docs/math.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.geometry.lie import FloatArray, so3_hat, transform_points
from vio.geometry.stereo import StereoCamera, project, triangulate, z_D_p_cam
from vio.records import BoolArray

MIN_DEPTH = 0.5  # baselines; nearer points are mismatches
CAUCHY = 3.0  # residuals beyond this many sigmas lose most of their weight
_MEDIAN = 2.37  # of chi-square with 3 degrees of freedom, those of a stereo view


@dataclass(frozen=True, slots=True)
class Views:
    """What F tracks showed in N clones."""

    z: FloatArray  # (F, N, 4) pixels [ul vl ur vr]; arbitrary where unseen
    weight: FloatArray  # (F, N, 4) 1 for a pixel coordinate that was measured, 0 else

    def take(self, index: BoolArray) -> Views:
        """Return the tracks of a mask (F,)."""
        return Views(self.z[index], self.weight[index])


@dataclass(frozen=True, slots=True)
class Residuals:
    """Residuals of tracks at given poses and points, and their Jacobians."""

    r: FloatArray  # (F, N, 4) pixels, zero where unseen
    z_D_p: FloatArray  # (F, N, 4, 3) with respect to the point in the world frame, zero where unseen
    ahead: BoolArray  # (F,) the point lies in front of every camera that saw it

    def take(self, index: BoolArray) -> Residuals:
        """Return the tracks of a mask (F,)."""
        return Residuals(self.r[index], self.z_D_p[index], self.ahead[index])


def residuals(camera: StereoCamera, T_cam0_world: FloatArray, p_world: FloatArray, views: Views) -> Residuals:
    """Compare predicted with seen pixels, equation (M1).

    Args:
        camera: rectified pair.
        T_cam0_world: (N, 4, 4).
        p_world: (F, 3).
        views: what was seen.
    """
    R, t = T_cam0_world[:, :3, :3], T_cam0_world[:, :3, 3]
    F, N = len(p_world), len(T_cam0_world)
    p_cam = (p_world @ R.reshape(-1, 3).T).reshape(F, N, 3) + t
    seen = views.weight[..., 0] > 0
    ok = p_cam[..., 2] > MIN_DEPTH * camera.baseline_m
    safe = np.where((ok & seen)[..., None], p_cam, [0.0, 0.0, 1.0])
    usable = views.weight * ok[..., None]
    r = (np.where(usable > 0, views.z, 0.0) - project(camera, safe)) * usable
    J = (z_D_p_cam(camera, safe) * usable[..., None]) @ R
    ahead: BoolArray = np.all(ok | ~seen, axis=1)
    return Residuals(r, J, ahead)


def first_points(camera: StereoCamera, T_cam0_world: FloatArray, views: Views) -> tuple[FloatArray, BoolArray]:
    """Points (F, 3) in the world from each track's stereo view of largest disparity; False (F,) where there is none.

    The newest clone's view counts only where it is the only one, as its pose has yet to be corrected.
    """
    disparity = np.where(views.weight[..., 2] > 0, views.z[..., 0] - views.z[..., 2], -np.inf)
    disparity[:, -1] = np.where(np.isfinite(disparity[:, :-1]).any(axis=1), -np.inf, disparity[:, -1])
    best = np.argmax(disparity, axis=1)
    rows = np.arange(len(best))
    usable = disparity[rows, best] > 0
    z = views.z[rows, best][:, [0, 1, 2, 1]]  # the right row is no measurement, so the left one stands for both
    p_cam, valid = triangulate(camera, np.where(usable[:, None], z, 0.0))
    T = T_cam0_world[best]
    p = ((p_cam - T[:, :3, 3])[:, None, :] @ T[:, :3, :3])[:, 0]
    return p, usable & valid


def refine_points(
    camera: StereoCamera, T_cam0_world: FloatArray, p_world: FloatArray, views: Views, steps: int, scale_px: float
) -> FloatArray:
    """Move points (F, 3) by damped Gauss-Newton steps on all their pixels, with Cauchy weights of a scale in pixels.

    A step is cut to half the distance from the nearest camera that saw the point, so that a bad start cannot throw it
    behind the cameras.
    """
    p = p_world
    centre = -np.einsum("nji,nj->ni", T_cam0_world[:, :3, :3], T_cam0_world[:, :3, 3]).mean(axis=0)
    for _ in range(steps):
        at = residuals(camera, T_cam0_world, p, views)
        weight = 1 / (1 + np.sum(at.r**2, axis=2) / (4 * scale_px**2))
        J = at.z_D_p.reshape(len(p), 4 * len(T_cam0_world), 3)
        Jt = np.swapaxes((at.z_D_p * weight[..., None, None]).reshape(J.shape), 1, 2)
        C = Jt @ J
        C += (1e-9 + 1e-6 * np.trace(C, axis1=1, axis2=2))[:, None, None] * np.eye(3)
        step = np.linalg.solve(C, Jt @ at.r.reshape(len(p), 4 * len(T_cam0_world), 1))[..., 0]
        reach = np.linalg.norm(step, axis=1) / (0.5 * np.maximum(np.linalg.norm(p - centre, axis=1), 1e-6))
        p = p + step / np.maximum(reach, 1.0)[:, None]
    return p


def within(camera: StereoCamera, T_cam0_world: FloatArray, p_world: FloatArray, max_distance_m: float) -> BoolArray:
    """Which points (F,) lie ahead of the newest clone's camera plane by no more than a distance, and are finite."""
    depth = p_world @ T_cam0_world[-1, 2, :3] + T_cam0_world[-1, 2, 3]
    return np.isfinite(p_world).all(axis=1) & (np.abs(depth) < max_distance_m)


def robust_weights(at: Residuals, sigma2: float) -> FloatArray:
    """Cauchy weights (F, N) of all views; the scale is each clone's own, as a predicted pose is off as a whole.

    Args:
        at: residuals and Jacobians.
        sigma2: the pixel noise's variance, the smallest scale.
    """
    squares = np.sum(at.r**2, axis=2)
    used: BoolArray = np.any(at.z_D_p[:, :, 1, :], axis=2)  # the row of vl is measured in every view
    weights = np.zeros(squares.shape)
    for n in range(squares.shape[1]):
        of_clone = squares[used[:, n], n]
        if len(of_clone):
            scale2 = max(sigma2, float(np.median(of_clone)) / _MEDIAN)
            weights[:, n] = used[:, n] / (1 + squares[:, n] / (4 * scale2 * CAUCHY**2))
    return weights


@dataclass(frozen=True, slots=True)
class LandmarkResiduals:
    """Residuals of landmarks in one camera, their Jacobians `dz = J dp`, and the weights that they enter a fit with."""

    r: FloatArray  # (K, 4) pixels, zero where not measured
    J: FloatArray  # (K, 4, 3) with respect to the point in the world frame, zero where not measured
    weight: FloatArray  # (K,) robust weights

    def information(self) -> tuple[FloatArray, FloatArray]:
        """Information (K, 3, 3) and vector (K, 3) about `dp`, for one pixel of noise."""
        J, w = self.J, self.weight
        return np.einsum("k,kai,kaj->kij", w, J, J), np.einsum("k,kai,ka->ki", w, J, self.r)


def landmark_residuals(
    camera: StereoCamera, T_cam0_world: FloatArray, p_world: FloatArray, views: Views, sigma2: float
) -> LandmarkResiduals:
    """Compare landmarks' predicted pixels in one camera with what was seen.

    Args:
        camera: rectified pair.
        T_cam0_world: (4, 4).
        p_world: (K, 3).
        views: what was seen, (K, 4) each.
        sigma2: the pixel noise's variance, for the robust weights.
    """
    p_cam = transform_points(T_cam0_world, p_world)
    ahead = p_cam[:, 2] > MIN_DEPTH * camera.baseline_m
    p_cam = np.where(ahead[:, None], p_cam, [0.0, 0.0, 1.0])
    usable = views.weight * ahead[:, None]
    r = np.where(usable > 0, views.z - project(camera, p_cam), 0.0)
    J = (z_D_p_cam(camera, p_cam) @ T_cam0_world[:3, :3]) * usable[..., None]
    squares, seen = np.sum(r**2, axis=1), usable[:, 1] > 0
    scale2 = max(sigma2, float(np.median(squares[seen])) / _MEDIAN) if seen.any() else sigma2
    return LandmarkResiduals(r, J, seen / (1 + squares / (4 * scale2 * CAUCHY**2)))


@dataclass(frozen=True, slots=True)
class TrackInformation:
    """What tracks say of the clones once their points are eliminated; pixel noise is one pixel here."""

    G: FloatArray  # (F, 6N, 3) cross information of clones and point
    C: FloatArray  # (F, 3, 3) information of the point
    diagonal: FloatArray  # (F, N, 6, 6) information of each clone before the point is eliminated
    gradient: FloatArray  # (F, 6N) before the point is eliminated
    point_gradient: FloatArray  # (F, 3)


def track_information(at: Residuals, p_world: FloatArray, weight: FloatArray) -> TrackInformation:
    """Collect the normal equations of tracks, equations (M2) and (M3).

    With the right-invariant error of clone i, `dz_i = J_i B xi_i + J_i dp`, where `B = [-I, p^]` is the same for all
    clones: the error of the point is measured from the rotated estimate, so a common rotation of all clones about
    the world's axes leaves every residual alone, whatever the estimates.

    Args:
        at: residuals and Jacobians.
        p_world: points (F, 3).
        weight: (F, N) robust weight of each view.
    """
    J = at.z_D_p
    F, N = J.shape[:2]
    Jt = np.swapaxes(J * weight[..., None, None], 2, 3)
    C_i = Jt @ J
    g_i = (Jt @ at.r[..., None])[..., 0]
    B = point_D_pose(p_world)
    Bt = np.swapaxes(B, 1, 2)
    G_i = Bt[:, None] @ C_i
    diagonal = G_i @ B[:, None]
    gradient = (Bt[:, None] @ g_i[..., None]).reshape(F, 6 * N)
    return TrackInformation(G_i.reshape(F, 6 * N, 3), C_i.sum(axis=1), diagonal, gradient, g_i.sum(axis=1))


def eliminate_points(info: TrackInformation, chosen: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Information matrix (6N, 6N) and vector (6N,) about the clones of the chosen tracks, equation (M4).

    `sum_f blkdiag(D_f) - G_f C_f^-1 G_f'`: exact elimination of each point.
    """
    N = info.diagonal.shape[1]
    C = info.C[chosen]
    L = np.linalg.cholesky(np.linalg.inv(C))
    V = info.G[chosen] @ L  # (F, 6N, 3)
    flat = np.swapaxes(V, 1, 2).reshape(-1, 6 * N)
    A = -flat.T @ flat
    blocks = info.diagonal[chosen].sum(axis=0)
    for i in range(N):
        A[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += blocks[i]
    b = info.gradient[chosen].sum(axis=0)
    b -= flat.T @ (np.swapaxes(L, 1, 2) @ info.point_gradient[chosen][..., None]).reshape(-1)
    return A, b


def point_D_pose(p_world: FloatArray) -> FloatArray:
    """`B = [-I, p^]` (F, 3, 6): how a clone's error `[rho; phi]` moves a point as that clone sees it."""
    B = np.zeros((len(p_world), 3, 6))
    B[:, :, :3] = -np.eye(3)
    B[:, :, 3:] = so3_hat(p_world)
    return B
