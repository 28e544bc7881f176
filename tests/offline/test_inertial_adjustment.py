"""Bundle adjustment with an IMU: derivatives by finite differences, a blind stretch, a rig that
is off.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vio.evaluation.alignment import align_poses, apply_alignment
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, se3_log, so3_exp, so3_log
from vio.geometry.stereo import StereoCamera, project
from vio.imu.preintegration import BodyStates, Readings
from vio.offline.inertial_adjustment import Fit, InertialAdjustment, RigPrior
from vio.offline.inertial_refinement import inertial_keyframes
from vio.offline.keyframes import TrackedPath
from vio.offline.points import PointTracks, keep_rows
from vio.records import ImuDensities, LoopEvent, Trajectory

_CAMERA = StereoCamera(300.0, 300.0, 240.0, 150.0, 0.11, 480, 300)
_T_CAM0_IMU = se3_exp(np.array([0.02, -0.01, 0.03, 0.1, -0.2, 1.5]))
_DENSITIES = ImuDensities(gyro=2e-4, gyro_walk=2e-5, accel=4e-3, accel_walk=1e-3)
_BIAS = np.array([0.003, -0.005, 0.002, 0.05, -0.03, 0.08])
_G = 9.81
_PRIOR = RigPrior(
    field=1e-3 * np.eye(15),
    field_at_start=np.zeros(15),
    metric=np.array([5e-3, 3e-3, 1e-3, 1e-3]),
    extrinsics=np.repeat([0.01, 0.01], 3),
    time_s=2e-3,
    accel_scale=0.01,
)


def _pose(t: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) of the body at times (N,) on a path with changing accelerations."""
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, 3] = np.stack([np.sin(1.3 * t), np.cos(1.1 * t), 0.5 * np.sin(0.9 * t)], axis=1)
    T[:, :3, :3] = so3_exp(
        np.stack([0.3 * np.sin(1.1 * t), 0.3 * np.sin(0.7 * t), 0.4 * np.sin(0.5 * t)], axis=1)
    )
    return T


def _flight(blind: range, longer: float) -> tuple[InertialAdjustment, Fit, FloatArray]:
    """A problem of 6 s with the true baseline longer by a share, no tracks across the blind
    keyframes, and its truth.

    Returns the problem, what it begins with, and the true poses of the left camera.
    """
    rng, h = np.random.default_rng(0), 1e-4
    seconds, t = np.arange(25) * 0.25, np.arange(-20, 1240) * 5e-3
    R = _pose(t)[:, :3, :3]
    a = (_pose(t + h)[:, :3, 3] - 2 * _pose(t)[:, :3, 3] + _pose(t - h)[:, :3, 3]) / h**2
    rate = so3_log(np.swapaxes(_pose(t - h)[:, :3, :3], 1, 2) @ _pose(t + h)[:, :3, :3]) / (2 * h)
    values = (
        np.concatenate([rate, np.einsum("nji,nj->ni", R, a + np.array([0, 0, _G]))], axis=1) + _BIAS
    )
    values += rng.normal(0, np.sqrt(200.0), values.shape) * np.repeat(
        [_DENSITIES.gyro, _DENSITIES.accel], 3
    )
    T_world_imu, K = _pose(seconds), len(seconds)
    cameras = T_world_imu @ se3_inverse(_T_CAM0_IMU)
    # Each point is ahead of one keyframe, and of those near it that see it.
    born = np.repeat(np.arange(K), 25)
    near = rng.uniform([-2, -1.2, 2], [2, 1.2, 6], (len(born), 3))
    p = np.einsum("mij,mj->mi", cameras[born, :3, :3], near) + cameras[born, :3, 3]
    rows = []
    true = replace(_CAMERA, baseline_m=_CAMERA.baseline_m * (1 + longer))
    for k in range(K):
        T = se3_inverse(cameras[k])
        q = p @ T[:3, :3].T + T[:3, 3]
        z = project(true, np.where(q[:, 2:] > 0.5, q, [0, 0, 1.0]))
        seen = (q[:, 2] > 0.5) & (z[:, 2] > 0) & (z[:, 0] < 480) & (z[:, 1] > 0) & (z[:, 1] < 300)
        seen &= (
            (np.abs(born - k) <= 3) & (k not in blind) & ((born < blind.start) == (k < blind.start))
        )
        rows += [(m, k, *z[m]) for m in np.flatnonzero(seen)]
    point, keyframe = np.array([r[:2] for r in rows], dtype=np.int64).T
    z = np.array([r[2:] for r in rows]) + rng.normal(0, 0.15, (len(rows), 4))
    z[rng.random(len(z)) < 0.03, :2] += 20.0  # outliers
    names, point = np.unique(point, return_inverse=True)
    has_right = rng.random(len(point)) < 0.8
    moved = rng.normal(0, 0.02, (len(names), 3))
    tracks = PointTracks(names, p[names] + moved, point, keyframe, z, has_right)
    readings = Readings(t, values[:, :3], values[:, 3:], _DENSITIES)
    problem = InertialAdjustment(
        _CAMERA,
        tracks,
        seconds,
        readings,
        _T_CAM0_IMU,
        _PRIOR,
        np.full(len(z), 0.15),
        np.repeat([0.1, 0.3], 3),
        _G,
    )
    off = rng.normal(0, [0.02] * 3 + [0.01] * 3, (K, 6))
    off[0] = 0
    velocity = (_pose(seconds + h)[:, :3, 3] - _pose(seconds - h)[:, :3, 3]) / (2 * h)
    body = BodyStates(
        T_world_imu @ se3_exp(off), velocity + rng.normal(0, 0.03, (K, 3)), np.zeros((K, 6))
    )
    return problem, Fit(body, tracks.p_world, np.zeros(27)), cameras


def test_derivatives_match_finite_differences() -> None:
    problem, at, _ = _flight(
        range(12, 12), 0.0
    )  # what the rig is off by is zero: its part in other derivatives is left out
    steps = problem._preintegrated(at.body)
    system = problem._system(at, steps, 1e6)
    K, h = len(problem.seconds), 1e-5
    rng = np.random.default_rng(2)
    x, p, s = rng.normal(0, 1, (K, 15)), rng.normal(0, 1, at.p_world.shape), rng.normal(0, 1, 27)

    def residuals(sign: float) -> tuple[FloatArray, FloatArray]:
        new = problem._moved(at, sign * h * x, sign * h * p, sign * h * s)
        return problem._pixels(new)[0] / 0.15, problem._other_rows(new, steps, 15 * K + 27)[1]

    (e1, o1), (e0, o0) = residuals(1.0), residuals(-1.0)
    tracks = problem.tracks
    by_pixels = np.einsum("rij,rj->ri", system.own, x[tracks.keyframe, :6]) + np.einsum(
        "rij,rj->ri", system.points, p[tracks.point]
    )
    by_pixels += system.rig @ s
    np.testing.assert_allclose(by_pixels, (e1 - e0) / (2 * h), rtol=1e-5, atol=1e-2)
    by_others = system.others @ np.concatenate([x.ravel(), s])
    gauge = len(by_others) - 4
    np.testing.assert_allclose(
        by_others[:gauge], ((o1 - o0) / (2 * h))[:gauge], rtol=1e-4, atol=2e-2
    )


def test_covariance_counts_all_that_is_unknown_and_errors_that_pixels_share() -> None:
    problem, at, _ = _flight(range(12, 12), 0.0)
    tracks = keep_rows(problem.tracks, problem.tracks.point % 3 == 0)
    problem = replace(problem, tracks=tracks, sigma_px=np.full(len(tracks.point), 0.15))
    at = replace(at, p_world=tracks.p_world)
    system = problem._system(at, problem._preintegrated(at.body), 3.0)
    K, M, (R, n) = len(problem.seconds), len(at.p_world), system.e.shape
    J = np.zeros((R, n, 15 * K + 27 + 3 * M))
    for r, (k, m) in enumerate(zip(tracks.keyframe, tracks.point, strict=True)):
        J[r, :, 15 * k : 15 * k + 6], J[r, :, 15 * K : 15 * K + 27] = system.own[r], system.rig[r]
        J[r, :, 15 * K + 27 + 3 * m :][:, :3] = system.points[r]
    N = J.reshape(R * n, -1).T @ J.reshape(R * n, -1)
    others = np.pad(system.others.toarray(), ((0, 0), (0, 3 * M)))
    N += others.T @ others
    scale = 1 / np.sqrt(np.diag(N))
    P = np.linalg.inv(N * scale * scale[:, None]) * scale * scale[:, None]
    clusters = problem._clusters()
    assert 0.2 * M < clusters.max() + 1 < 0.8 * M
    of_clusters = [clusters[tracks.point] == c for c in range(clusters.max() + 1)]
    y = np.array([P @ np.einsum("rai,ra->i", J[rows], system.e[rows]) for rows in of_clusters])
    P = y.T @ y + (others @ P).T @ (others @ P)
    D = problem._cameras_by_states(at, np.array([3, 20]))
    found = system.covariance(D, clusters)
    of_states = P[: 15 * K + 27, : 15 * K + 27]
    for c, own in enumerate(found):
        rows = D[6 * c : 6 * c + 6].toarray()
        np.testing.assert_allclose(own, rows @ of_states @ rows.T, rtol=1e-3, atol=1e-9)


def test_cameras_follow_from_body_extrinsics_and_clock_as_their_derivatives_say() -> None:
    problem, at, _ = _flight(range(12, 12), 0.0)
    K, h, rng = len(problem.seconds), 1e-4, np.random.default_rng(4)
    x, s = rng.normal(0, 1, (K, 15)), rng.normal(0, 1, 27)
    x[:, 6:] = 0  # velocity and bias act by the twist alone, to second order
    none, before = np.zeros(at.p_world.shape), problem.cameras(at)
    moved = (
        se3_log(se3_inverse(before) @ problem.cameras(problem._moved(at, h * x, none, h * s))) / h
    )
    chosen = np.array([2, 9, 24])
    by_states = problem._cameras_by_states(at, chosen) @ np.concatenate([x.ravel(), s])
    np.testing.assert_allclose(by_states.reshape(-1, 6), moved[chosen], atol=2e-3)


@pytest.mark.parametrize("longer", [0.0, 0.008])
def test_finds_poses_across_a_blind_stretch_and_the_baseline(longer: float) -> None:
    problem, start, truth = _flight(range(11, 14), longer)
    best = problem.solve(start.body)
    fit, pixels, inertial = best.at, best.pixels, best.inertial
    assert best.converged
    assert 0.6 < pixels < 1.1
    assert 0.1 < inertial < 1.1
    found = problem.cameras(fit)
    found = apply_alignment(align_poses(found, truth, "se3"), found)
    error = np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.008, error
    assert fit.rig[15] * _PRIOR.metric[0] == pytest.approx(longer, abs=0.003)
    np.testing.assert_allclose(fit.body.bias[-1, :3], _BIAS[:3], atol=1e-3)


def test_noise_of_the_pixels_makes_no_longer_baseline() -> None:
    """Derivatives at the noisy pixels would: a longer baseline would pass for less noise in the
    disparity.
    """
    problem, start, _ = _flight(range(12, 12), 0.0)
    rng = np.random.default_rng(3)
    noisy = problem.tracks.z + rng.normal(0, 1.0, problem.tracks.z.shape)
    weak = replace(
        problem, tracks=replace(problem.tracks, z=noisy), sigma_px=np.full(len(noisy), 1.0)
    )
    fit = weak.solve(start.body).at
    assert abs(fit.rig[15]) < 1.5


def test_keyframes_at_loops_do_not_exceed_the_number_that_was_asked_for() -> None:
    frames = np.arange(60)
    trajectory = Trajectory(np.tile(np.eye(4), (60, 1, 1)), 100_000_000 * frames, "cam0", frames)
    loops = tuple(LoopEvent(31 + 2 * k, 0, k, 0, 50, 0.0, False, k) for k in range(14))
    path = TrackedPath(Path("run"), _CAMERA, trajectory, None, loops)
    assert len(inertial_keyframes(path, 12)) <= 12
    assert len(inertial_keyframes(path, None)) > 12
