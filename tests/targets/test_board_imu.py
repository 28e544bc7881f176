"""A camera and an IMU before a board: corners without rendering, records as a hand makes them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.board_views import GRID, LEFT
from tests.calibration.test_camera_imu import (
    DENSITIES,
    OFFSET_S,
    T_CAM_IMU,
    _errors,
    hand_imu,
    hand_pose,
)
from vio.errors import DataError
from vio.filters.imu_terms import CHOSEN, ImuTerms, term_sigmas
from vio.geometry.distortion import project_point
from vio.geometry.lie import (
    FloatArray,
    se3_from_parts,
    se3_inverse,
    so3_exp,
    transform_points,
)
from vio.targets.bundle import RigFit, layout_of, lens_moved
from vio.targets.corners import Corners
from vio.targets.inertial import BoardPoses, CameraImu, calibrate_imu
from vio.targets.rendering import board_points
from vio.targets.start import pose_only
from vio.targets.views import View, sightings

NOISE_PX = 0.1
VIEW_STEP_S = 0.2


def _poses(seed: int, seconds: float, size: float = 1.0, lens_sigma_px: float = 0.0) -> BoardPoses:
    """Poses by corners of a board that is `size` times as large as its file says, and by a lens
    whose focal lengths and centre were calibrated with errors.
    """
    rng = np.random.default_rng(1000 + seed)
    shots = np.arange(VIEW_STEP_S, seconds - VIEW_STEP_S, VIEW_STEP_S)
    points = size * board_points(GRID)
    centre = 0.5 * size * np.array(GRID.extent_m)
    T_cam_board = se3_from_parts(so3_exp([0.3, 0.2, 0.1]), [*-centre, 0.9])
    T_world_board = se3_inverse(T_CAM_IMU) @ T_cam_board
    T_world_cam = hand_pose(shots, seed, 1.0) @ se3_inverse(T_CAM_IMU)
    views: list[View] = []
    for second, T in zip(shots.tolist(), se3_inverse(T_world_cam) @ T_world_board, strict=True):
        uv, seen = project_point(LEFT, transform_points(T, points))
        inside = seen & (uv > 4).all(axis=1) & (uv < [747, 475]).all(axis=1)
        ids = np.flatnonzero(inside)
        if len(ids) >= 12:
            noisy = uv[ids] + NOISE_PX * rng.normal(size=(len(ids), 2))
            views.append(View(round(1e9 * (second - OFFSET_S)), (Corners(ids, noisy),)))
    seen_all = sightings(views, GRID.points_m)
    sigma = np.zeros(layout_of((LEFT,)).size)
    sigma[:4] = lens_sigma_px
    lens = lens_moved(LEFT, (sigma * rng.normal(size=len(sigma)))[:8])
    fit = RigFit((lens,), np.eye(4)[None], np.zeros((1, 4, 4)), np.zeros(2))
    problem, found = pose_only(fit, seen_all)
    good = np.bincount(seen_all.view[found.used], minlength=len(views)) >= 12
    times = np.array([view.time_ns for view in views], dtype=np.int64)
    information, xi_D_lens = problem.pose_information(found)
    T = found.at.T_cam0_board[good]
    return BoardPoses(times[good], T, information[good], xi_D_lens[good], np.diag(sigma**2))


def _found(
    seed: int, seconds: float, *, size: float = 1.0, terms: ImuTerms = "off", wrong: float = 0.0
) -> tuple[CameraImu, FloatArray]:
    """The calibration, and the terms that are true; `wrong`: standard deviations they are off by."""
    true = wrong * term_sigmas() * np.random.default_rng(seed).normal(size=15)
    record = hand_imu(seed, seconds, true)
    return calibrate_imu(_poses(seed, seconds, size), record, DENSITIES, terms=terms), true


def _check(seeds: range, seconds: float, low: float, high: float) -> None:
    nees: list[float] = []
    for seed in seeds:
        found, _ = _found(seed, seconds)
        error = _errors(found)
        assert np.linalg.norm(error[:3]) < 1e-3
        assert np.degrees(np.linalg.norm(error[3:6])) < 0.02
        assert abs(error[6]) < 5e-5
        assert found.weak == ()
        assert 0.7 < found.chi < 1.25
        assert found.board_scale == pytest.approx(1, abs=5 * found.board_scale_sigma)
        nees.append(float(error @ np.linalg.solve(found.covariance, error)))
    # Bounds of chi-square with 7 degrees of freedom a seed.
    assert low < np.sum(nees) < high


def test_errors_are_those_of_the_covariance() -> None:
    _check(range(2), 15.0, 5.6, 26.1)  # 95 % of 14 degrees of freedom


def test_the_covariance_holds_the_errors_of_the_lens() -> None:
    """They are common to all poses, so that no number of views averages them out."""
    nees = []
    nees_of_known_lens = []
    for seed in range(3):
        record = hand_imu(seed, 15.0, np.zeros(15))
        poses = _poses(seed, 15.0, lens_sigma_px=0.3)
        found = calibrate_imu(poses, record, DENSITIES)
        error = _errors(found)
        nees.append(float(error @ np.linalg.solve(found.covariance, error)))
        known = replace(poses, lens_covariance=np.zeros_like(poses.lens_covariance))
        P = calibrate_imu(known, record, DENSITIES).covariance
        nees_of_known_lens.append(float(error @ np.linalg.solve(P, error)))
    assert 8 < sum(nees) < 41  # 99 % of chi-square with 21 degrees of freedom
    assert sum(nees_of_known_lens) > 80


@pytest.mark.slow
def test_errors_of_a_minute_are_those_of_the_covariance() -> None:
    _check(range(8), 60.0, 37.2, 78.6)  # 95 % of 56 degrees of freedom


def test_finds_scale_and_misalignment_of_the_imu() -> None:
    found, true = _found(3, 20.0, terms="full", wrong=1.0)
    sigma = found.term_sigmas
    assert (sigma[CHOSEN["full"]] < 0.5 * term_sigmas()).sum() > 10
    assert np.sqrt(np.mean(((found.terms - true) / sigma) ** 2)) < 1.8
    error = _errors(found)
    assert np.linalg.norm(error[:3]) < 1e-3
    assert np.degrees(np.linalg.norm(error[3:6])) < 0.05


@pytest.mark.parametrize(("size", "words"), [(1.05, "larger"), (0.95, "smaller")])
def test_names_a_board_of_another_size(size: float, words: str) -> None:
    found, _ = _found(2, 15.0, size=size)
    assert found.board_scale == pytest.approx(size, abs=0.01)
    finding = next(text for text in found.weak if "by the IMU the board is" in text)
    assert words in finding
    assert "--size" in finding
    assert "\n" not in finding


@pytest.mark.parametrize(("rate", "words"), [(1.0005, "slower"), (0.9995, "faster")])
def test_names_clocks_that_drift_against_each_other(rate: float, words: str) -> None:
    record = hand_imu(2, 15.0, np.zeros(15))
    stretched = replace(record, times_ns=np.rint(rate * record.times_ns).astype(np.int64))
    found = calibrate_imu(_poses(2, 15.0), stretched, DENSITIES)
    finding = next(text for text in found.weak if "ppm" in text)
    assert f"ppm {words} than the IMU's" in finding
    assert float(finding.split()[4]) == pytest.approx(500, rel=0.1)
    assert "\n" not in finding


def test_refuses_an_imu_with_a_dead_axis() -> None:
    record = hand_imu(2, 15.0, np.zeros(15))
    dead = replace(record, gyro=record.gyro * [1, 1, 0])
    with pytest.raises(DataError, match=r"an axis may be dead|the gyro may be dead") as caught:
        calibrate_imu(_poses(2, 15.0), dead, DENSITIES)
    assert "\n" not in str(caught.value)


def test_names_an_imu_whose_noise_is_larger_than_stated() -> None:
    densities = replace(DENSITIES, gyro=0.1 * DENSITIES.gyro, accel=0.1 * DENSITIES.accel)
    found = calibrate_imu(_poses(1, 15.0), hand_imu(1, 15.0, np.zeros(15)), densities)
    finding = next(text for text in found.weak if "camera and IMU differ" in text)
    assert "--imu-noise" in finding
    assert "\n" not in finding


def test_a_short_record_leaves_the_terms_at_their_priors() -> None:
    found, _ = _found(1, 10.0, terms="scale")
    assert (found.term_sigmas[np.setdiff1d(CHOSEN["full"], CHOSEN["scale"])] == 0).all()
    assert (found.term_sigmas[CHOSEN["scale"]] > 0).all()
    assert (found.term_sigmas <= 1.01 * term_sigmas()).all()
