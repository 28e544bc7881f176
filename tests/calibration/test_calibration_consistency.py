"""The flights by which the calibration's NEES is measured: what is called the truth is one, and
NEES of a few.
"""

from __future__ import annotations

import numpy as np
import pytest

from tools.calibration_consistency import (
    FromStandstill,
    Off,
    _misread,
    _seen,
    calibration_nees,
    fly,
    walked_terms,
)
from tools.consistency import CAMERA, T_CAM0_IMU, Flight
from vio.filters.imu_terms import IMU_TERMS, calibrated
from vio.filters.navigation import ImuMotion, NavState
from vio.filters.settings import MsckfSettings
from vio.filters.stereo_calibration import FIELD_TERMS
from vio.geometry.lie import se3_exp, se3_from_parts, se3_inverse
from vio.geometry.stereo import project
from vio.imu.settings import ImuSettings
from vio.records import Estimate, StereoFieldEstimate, StereoScaleEstimate, observations

QUIET = ImuSettings(
    gyro_noise_density=1e-9, accel_noise_density=1e-9, gyro_bias_sigma_radps=0, accel_bias_sigma_mps2=0,
    gyro_bias_walk=0, accel_bias_walk=0,
)  # fmt: skip


@pytest.mark.parametrize("flight", [Flight(), FromStandstill()])
def test_a_flight_and_its_imu_agree(flight: Flight) -> None:
    """Integrating the exact rates gives the exact states: what the Monte-Carlo calls the truth
    is one.
    """
    motion = ImuMotion(MsckfSettings(), QUIET)
    samples, bias = flight.imu(range(401), np.random.default_rng(0), QUIET)
    assert not bias.any()
    for sample in samples:
        motion.take(sample)
    R, p, v = flight.state(np.array([0.0, 2.0]))
    assert v[0].any() != isinstance(flight, FromStandstill)
    T = se3_from_parts(R, p)
    end = motion.advance(NavState(T[0], v[0], *np.zeros((3, 3))), 0, 2_000_000_000).nav
    np.testing.assert_allclose(end.T_world_imu, T[1], atol=2e-4)
    np.testing.assert_allclose(end.velocity, v[1], atol=2e-4)


def test_samples_are_stamped_by_the_clock_of_the_imu() -> None:
    early, late = (
        Flight().imu(range(20), np.random.default_rng(0), QUIET, clock_s=s)[0] for s in (0.0, 0.003)
    )
    assert {b.time_ns - a.time_ns for a, b in zip(early, late, strict=True)} == {3_000_000}


def test_a_rig_that_is_off_is_off_by_what_its_errors_say() -> None:
    """Estimates equal to the truth have no error: pixels of the true rig, and the signs of all
    parameters.
    """
    xi, turn = np.array([0.01, -0.02, 0.005, 0.004, -0.003, 0.006]), np.array([1e-3, -2e-3, 1.5e-3])
    off = Off(xi, 0.004, turn, 0.01)
    T_believed = T_CAM0_IMU @ se3_inverse(se3_exp(xi))
    right = Estimate(
        0, np.eye(4), np.eye(6), T_cam0_imu=T_believed @ se3_exp(xi), T_cam0_imu_covariance=np.eye(6),
        time_offset_s=0.004, time_offset_sigma_s=1e-3,
        stereo_field=StereoFieldEstimate(turn[1] * np.eye(FIELD_TERMS)[[0, 2]].sum(axis=0), np.eye(FIELD_TERMS)),
        stereo_scale=StereoScaleEstimate(np.array([0.01, 0.0]), np.eye(2)),
    )  # fmt: skip
    assert max(calibration_nees(right, off).values()) < 1e-12
    p = np.random.default_rng(1).uniform([-1, -1, 2], [1, 1, 8], (20, 3))
    z = project(CAMERA, p)
    seen = _seen(observations(0, 0, np.arange(20), z), Off(np.zeros(6), 0.0, np.zeros(3), 0.01)).z
    longer = np.exp(0.01) * CAMERA.baseline_m
    np.testing.assert_allclose(seen[:, 2], z[:, 0] - CAMERA.fu * longer / p[:, 2])


def test_a_misread_sample_is_the_perfect_one_to_the_filter_that_knows_the_terms() -> None:
    off = Off(np.zeros(6), 0.0, np.zeros(3), 0.0, np.linspace(-0.02, 0.02, IMU_TERMS))
    walked = walked_terms(off, 50, QUIET, np.random.default_rng(0))
    # 1 % times 0.005, over the root of a quarter of a second
    assert 0 < np.abs(walked[-1] - off.imu).max() < 1e-4
    perfect = Flight().imu(range(-100, 20), np.random.default_rng(0), QUIET)[0][40]
    read = _misread(perfect, walked[40])
    got = calibrated(np.concatenate([read.gyro, read.accel])[None], walked[40])
    np.testing.assert_allclose(got[0], np.concatenate([perfect.gyro, perfect.accel]), atol=1e-12)
    assert np.abs(read.accel - perfect.accel).max() > 0.05


def test_the_baseline_is_estimated_consistently() -> None:
    """Three seconds of four flights, each with another baseline: a mean NEES above 2.8 of 1 is a
    chance of 2 %.
    """
    found = [
        fly("baseline", "standstill", seed, seconds=3.0)[-1]["baseline (1)"] for seed in range(4)
    ]
    assert np.mean(found) < 2.8
