"""Flights by which consistency is measured: what is called the truth is one, and the filter is consistent with it."""

from __future__ import annotations

import numpy as np
import pytest

from tools.consistency import Flight, Job, Motion, Scenario, fly
from vio.evaluation.consistency import nees_bounds
from vio.filters.navigation import ImuMotion, NavState
from vio.filters.settings import MsckfSettings


def test_flight_and_its_imu_agree() -> None:
    """Integrating the exact rates gives the exact states: what the Monte-Carlo calls the truth is one."""
    flight = Flight()
    t = np.arange(0.0, 2.0, 0.005)
    rng = np.random.default_rng(0)
    quiet = MsckfSettings(
        gyro_noise_density=1e-9, accel_noise_density=1e-9, gyro_bias_sigma_radps=0, accel_bias_sigma_mps2=0,
        gyro_bias_walk=0, accel_bias_walk=0,
    )  # fmt: skip
    motion = ImuMotion(quiet)
    samples, bias = flight.imu(range(401), rng, quiet)
    assert not bias.any()
    for sample in samples:
        motion.take(sample)
    R, p, v = flight.state(t[[0, -1]])
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, p
    end = motion.advance(NavState(T[0], v[0], *np.zeros((3, 3))), 0, round(t[-1] * 1e9)).nav
    np.testing.assert_allclose(end.T_world_imu, T[1], atol=2e-4)
    np.testing.assert_allclose(end.velocity, v[1], atol=2e-4)


@pytest.mark.parametrize("motion", ["imu", "none"])
def test_yaw_stays_as_uncertain_as_it_began(motion: Motion) -> None:
    """No image and no IMU observes yaw: one degree of uncertainty at the start must still be there at the end."""
    for seed in range(2):
        sigma = fly(Job(Scenario(seconds=1.0), motion, "uncertain", "right-invariant", seed)).yaw_sigma_deg
        assert sigma[0] == pytest.approx(1.0, rel=1e-4)
        assert sigma.min() > 0.999
        assert sigma.max() < 1.05


def test_navigation_state_is_consistent_with_known_noise() -> None:
    """Mean NEES over 20 flights whose start is drawn from its covariance: two-sided, for all that is estimated."""
    runs = 20
    scenario = Scenario(seconds=0.8, features=30)
    records = [fly(Job(scenario, "imu", "uncertain", "right-invariant", seed)) for seed in range(runs)]
    for measure, d in (("pose", 6), ("position", 3), ("orientation", 3), ("velocity", 3), ("gyro bias", 3)):
        mean = np.mean([r.nees[measure][1:] for r in records], axis=0)
        low, high = nees_bounds(d, runs)
        assert low < mean.mean() < high, f"{measure}: mean NEES {mean.mean():.2f}, bounds {low:.2f} to {high:.2f}"
    nis = np.mean([r.nis[5:] for r in records])
    assert 0.9 < nis < 1.1
