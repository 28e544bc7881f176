"""A camera and an IMU before a board."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vio.errors import DataError
from vio.geometry.lie import (
    FloatArray,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    se3_log,
    so3_exp,
    so3_log,
)
from vio.records import ImuDensities, ImuRecord, IntArray, imu_matrices
from vio.targets.inertial import BoardPoses, CameraImu, calibrate_imu

DENSITIES = ImuDensities(gyro=2e-4, gyro_walk=1e-5, accel=2e-3, accel_walk=2e-4)
T_CAM_IMU = se3_from_parts(so3_exp([0.3, -1.2, 0.4]), [0.03, -0.05, 0.02])
OFFSET_S = 0.0123
RATE_HZ = 200.0
POSE_SIGMA = np.array([2e-4] * 3 + [2e-4] * 3)  # m and rad


def hand_pose(seconds: FloatArray, rng_seed: int, turning: float) -> FloatArray:
    """Poses (N, 4, 4) of the IMU in the world: a hand's motion."""
    rng = np.random.default_rng(rng_seed)
    f = rng.uniform(0.2, 0.9, size=(6, 3))
    phase = rng.uniform(0, 2 * np.pi, size=(6, 3))
    waves = np.sin(2 * np.pi * f[None] * seconds[:, None, None] + phase).mean(axis=2)
    return se3_from_parts(so3_exp(0.7 * turning * waves[:, 3:]), 0.25 * waves[:, :3])


def hand_imu(seed: int, seconds: float, terms: FloatArray) -> ImuRecord:
    """An IMU on a hand, with white noise and walking biases; scale and misalignment by `terms`."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / RATE_HZ)
    h = 1e-4
    before, now, after = (hand_pose(t + d, seed, 1.0) for d in (-h, 0.0, h))
    R = now[:, :3, :3]
    gyro = so3_log(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]) / (2 * h)
    a = (after[:, :3, 3] - 2 * now[:, :3, 3] + before[:, :3, 3]) / h**2
    accel = np.einsum("nji,nj->ni", R, a + np.array([0, 0, 9.81]))
    root = np.sqrt(RATE_HZ)
    M_accel, M_gyro = imu_matrices(terms)
    out = []
    for values, M, bias, white, walk in (
        (gyro, M_gyro, [0.01, -0.02, 0.005], DENSITIES.gyro, DENSITIES.gyro_walk),
        (accel, M_accel, [0.1, 0.05, -0.08], DENSITIES.accel, DENSITIES.accel_walk),
    ):
        noise = np.cumsum(walk / root * rng.normal(size=values.shape), axis=0)
        noise += white * root * rng.normal(size=values.shape)
        out.append((values + bias + noise) @ np.linalg.inv(M).T)
    return ImuRecord(np.round(1e9 * t).astype(np.int64), out[0], out[1])


def poses_by_known_lens(
    times_ns: IntArray, T_cam0_board: FloatArray, information: FloatArray
) -> BoardPoses:
    """Poses of a board whose lens is known."""
    none = np.zeros((len(times_ns), 6, 0)), np.zeros((0, 0))
    return BoardPoses(times_ns, T_cam0_board, information, *none)


def _record(seed: int, seconds: float = 25.0, turning: float = 1.0) -> tuple[BoardPoses, ImuRecord]:
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / RATE_HZ)
    h = 1e-4
    before, now, after = (hand_pose(t + d, seed, turning) for d in (-h, 0.0, h))
    R = now[:, :3, :3]
    gyro = so3_log(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]) / (2 * h)
    a = (after[:, :3, 3] - 2 * now[:, :3, 3] + before[:, :3, 3]) / h**2
    accel = np.einsum("nji,nj->ni", R, a + np.array([0, 0, 9.81]))
    root = np.sqrt(RATE_HZ)
    gyro = gyro + [0.01, -0.02, 0.005] + DENSITIES.gyro * root * rng.normal(size=gyro.shape)
    accel = accel + [0.1, 0.05, -0.08] + DENSITIES.accel * root * rng.normal(size=accel.shape)
    shots = np.arange(0.2, seconds - 0.2, 0.2)
    T_world_board = se3_from_parts(so3_exp([1.3, 0.2, 0.4]), [0.1, 0.8, 0.2])
    T_world_cam = hand_pose(shots, seed, turning) @ se3_inverse(T_CAM_IMU)
    noise = se3_exp(POSE_SIGMA * rng.normal(size=(len(shots), 6)))
    T_cam_board = noise @ se3_inverse(T_world_cam) @ T_world_board
    stamps = np.round(1e9 * (shots - OFFSET_S)).astype(np.int64)
    information = np.tile(np.diag(1 / POSE_SIGMA**2), (len(shots), 1, 1))
    times = np.round(1e9 * t).astype(np.int64)
    return poses_by_known_lens(stamps, T_cam_board, information), ImuRecord(times, gyro, accel)


def _errors(found: CameraImu) -> FloatArray:
    xi = se3_log(se3_inverse(found.T_cam0_imu) @ T_CAM_IMU)
    return np.append(xi, OFFSET_S - found.time_offset_s)


def test_finds_extrinsics_and_time_without_a_guess() -> None:
    nees = []
    for seed in range(2):
        found = calibrate_imu(*_record(seed), DENSITIES)
        error = _errors(found)
        assert np.linalg.norm(error[:3]) < 1e-3
        assert np.degrees(np.linalg.norm(error[3:6])) < 0.02
        assert abs(error[6]) < 5e-5
        assert np.allclose(found.gyro_bias, [0.01, -0.02, 0.005], atol=2e-3)
        assert np.allclose(found.accel_bias, [0.1, 0.05, -0.08], atol=0.02)
        assert found.weak == ()
        nees.append(error @ np.linalg.solve(found.covariance, error) / 7)
    assert 0.3 < np.mean(nees) < 2.5


def test_names_what_a_motion_does_not_show() -> None:
    found = calibrate_imu(*_record(1, seconds=10, turning=0.03), DENSITIES)
    error = _errors(found)
    assert any("position" in text for text in found.weak)
    assert np.abs(error[:3]).max() < 5 * np.sqrt(np.diag(found.covariance)[:3]).max()


def test_says_what_to_record() -> None:
    poses, imu = _record(1, seconds=10)
    later = replace(poses, times_ns=poses.times_ns + 10**15)
    with pytest.raises(DataError, match="clocks"):
        calibrate_imu(later, imu, DENSITIES)
    with pytest.raises(DataError, match="turn the rig"):
        calibrate_imu(*_record(1, seconds=10, turning=0.0), DENSITIES)
