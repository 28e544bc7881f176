"""Poses of the left camera from points, covariances of its positions, and the distance of two trajectories."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vio.evaluation.alignment import align_poses, apply_alignment
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, so3_hat, transform_points
from vio.geometry.stereo import StereoCamera, project, z_D_p_cam
from vio.offline.keyframes import TrackedPath
from vio.offline.points import MIN_DEPTH_M, PointTracks
from vio.records import BoolArray, Estimate, IntArray, Trajectory

_POSE_STEPS = 12
_LEAST_ROWS = 6
_LEAST_SIGMA_M = 1e-4  # of a prior: the first pose of a filter has no uncertainty by definition


def align_to_points(
    camera: StereoCamera,
    T_world_cam0: FloatArray,
    p_world: FloatArray,
    z: FloatArray,
    has_right: BoolArray,
) -> FloatArray | None:
    """Estimate one frame's pose (4, 4) from known points (P, 3) and pixels (P, 4); None: too few of them fit.

    Robust Gauss-Newton from `T_world_cam0`.
    """
    T_cam0_world = se3_inverse(T_world_cam0)
    weight = np.zeros(len(z))
    for step in range(_POSE_STEPS):
        q = transform_points(T_cam0_world, p_world)
        ahead = q[:, 2] > MIN_DEPTH_M
        q = np.where(ahead[:, None], q, [0.0, 0.0, 1.0])
        r = z - project(camera, q)
        z_D_p = z_D_p_cam(camera, q)
        H = np.concatenate([z_D_p, -z_D_p @ so3_hat(q)], axis=2)
        r[~has_right, 2:] = 0
        H[~has_right, 2:] = 0
        width = 2.0 ** max(4 - step, 0)
        weight = ahead / (1 + np.sum(r**2, axis=1) / width**2) ** 2
        if (weight > 0.25).sum() < _LEAST_ROWS:
            return None
        weighted = H * weight[:, None, None]
        normal = np.einsum("nki,nkj->ij", weighted, H)
        if np.linalg.cond(normal) > 1e12:
            return None
        xi = np.linalg.solve(normal, np.einsum("nki,nk->i", weighted, r))
        T_cam0_world = se3_exp(xi) @ T_cam0_world
        if step > 5 and np.abs(xi).max() < 1e-7:
            break
    return se3_inverse(T_cam0_world)


def fill_between(
    run: TrackedPath, keyframes: IntArray, T_world_keyframes: FloatArray, tracks: PointTracks
) -> tuple[FloatArray, int]:
    """Return poses (N, 4, 4) of all frames after the keyframes were adjusted, and how many come from points.

    A frame between keyframes is aligned to the refined points that it observes; with too few of them it keeps its
    motion relative to the previous keyframe.
    """
    old = run.trajectory.T_world_body
    before = np.clip(np.searchsorted(keyframes, np.arange(len(old)), side="right") - 1, 0, None)
    out = T_world_keyframes[before] @ se3_inverse(old[keyframes[before]]) @ old
    aligned = 0
    for k in np.setdiff1d(np.arange(len(old)), keyframes):
        seen = run.fresh(int(k))
        place = np.clip(np.searchsorted(tracks.ids, seen.ids), 0, len(tracks.ids) - 1)
        known = tracks.ids[place] == seen.ids
        pose = align_to_points(run.camera, out[k], tracks.p_world[place[known]], seen.z[known], seen.has_right[known])
        if pose is not None:
            out[k] = pose
            aligned += 1
    return out, aligned


def position_covariances(estimates: Sequence[Estimate], T_cam0_imu: FloatArray) -> FloatArray:
    """Return covariances (K, 3, 3) of the left camera's position in the world, from `xi` (docs/conventions.md).

    `T_imu_world = exp(xi) T_hat` moves a point c fixed in the body by `R_world_imu (-rho + c x phi)`.
    """
    c = se3_inverse(T_cam0_imu)[:3, 3]
    p_D_xi = np.concatenate([-np.eye(3), so3_hat(c)], axis=1)
    R = np.array([e.T_world_imu[:3, :3] for e in estimates])
    P = np.array([e.covariance for e in estimates])
    J = R @ p_D_xi
    out: FloatArray = J @ P @ np.swapaxes(J, 1, 2) + _LEAST_SIGMA_M**2 * np.eye(3)
    return out


def position_difference_m(one: Trajectory, other: Trajectory) -> float:
    """Return the root mean square distance of paired positions after SE(3) alignment."""
    alignment = align_poses(one.T_world_body, other.T_world_body, "se3")
    aligned = apply_alignment(alignment, one.T_world_body)
    return float(np.sqrt(np.mean(np.sum((aligned[:, :3, 3] - other.positions) ** 2, axis=1))))
