"""The start with an IMU: at standstill, turning, and while accelerating; on an exact world with
pixel noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from tests.filters.test_msckf import Flight
from vio.evaluation.consistency import nees_bounds
from vio.filters.imu_start import imu_start
from vio.filters.msckf import Msckf
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import FloatArray, so3_exp
from vio.imu.settings import DEFAULT_IMU
from vio.records import ImuSample

SETTINGS = MsckfSettings()
RATE = 200.0
SEEDS = 20
FRAMES = 21  # 20 Hz: the last one is a second after the first


class Start(Flight):
    """A start with a second of IMU before it: steady acceleration and turn, or standstill up to
    a take-off.
    """

    def __init__(
        self, accel: FloatArray, turn: FloatArray, take_off_s: float | None = None
    ) -> None:
        super().__init__(FRAMES)
        self.accel, self.turn, self.take_off_s = accel, turn, take_off_s

    def state(self, t: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """R, p, v, a, omega (body) at a time; at 0.5 s the velocity is zero, so that the points
        stay in view.
        """
        attitude = so3_exp([0.1, -0.15, 0.0])
        if self.take_off_s is not None:
            s = max(t - self.take_off_s, 0.0)
            moving = float(s > 0)
            R = attitude @ so3_exp(self.turn * s)
            return (
                R,
                0.5 * self.accel * s**2,
                self.accel * s,
                self.accel * moving,
                self.turn * moving,
            )
        s = t - 0.5
        return (
            attitude @ so3_exp(self.turn * t),
            0.5 * self.accel * s**2,
            self.accel * s,
            self.accel,
            self.turn,
        )

    def imu(self, noise: np.random.Generator, bias: FloatArray) -> list[ImuSample]:
        out = []
        for k in range(-round(RATE), FRAMES * 10):
            R, _, _, a, omega = self.state(k / RATE)
            gyro = (
                omega
                + bias[:3]
                + noise.normal(0, DEFAULT_IMU.gyro_noise_density * np.sqrt(RATE), 3)
            )
            force = R.T @ (a + np.array([0, 0, DEFAULT_IMU.gravity_mps2])) + bias[3:]
            force = force + noise.normal(0, DEFAULT_IMU.accel_noise_density * np.sqrt(RATE), 3)
            out.append(ImuSample(k * 5_000_000, gyro, force))
        return out


@dataclass(frozen=True)
class Outcome:
    """What a start has come to after a second, over seeds."""

    tilt_deg: FloatArray  # (S,)
    pose: float  # mean NEES of the pose, 6 degrees of freedom
    tilt: float  # 2
    velocity: float  # 3


def _after_a_second(start: Start, settings: MsckfSettings = SETTINGS) -> Outcome:
    degrees, values = [], []
    for seed in range(SEEDS):
        bias = np.random.default_rng(1000 + seed).normal(0, [0.02] * 3 + [0.05] * 3)
        errors, covariances, filt = start.run(settings, "imu", seed, bias=bias, limit=40)
        pose = errors[-1] @ np.linalg.solve(covariances[-1], errors[-1])
        angle, tilt, velocity = _tilt_and_velocity(start, filt)
        degrees.append(angle)
        values.append([pose, tilt, velocity])
    return Outcome(np.array(degrees), *np.mean(values, axis=0).tolist())


def _tilt_and_velocity(start: Start, filt: Msckf) -> tuple[float, float, float]:
    """Error of the vertical in the body frame (degrees), its NEES, and that of the velocity in
    the body frame.
    """
    R_true, _, v_true, *_ = start.state((FRAMES - 1) * 0.05)
    window = filt._window
    R = window.nav.T_world_imu[:3, :3]
    P = filt._propagation.posterior.own
    up_true, up = R_true[2], R[2]  # R' e_z
    error = R @ np.cross(up, up_true)  # world side; up_true = R' exp(phi)' e_z
    angle = float(np.degrees(np.arccos(np.clip(up @ up_true, -1, 1))))
    tilt = float(error[:2] @ np.linalg.solve(P[3:5, 3:5], error[:2]))
    e_v = R @ (R_true.T @ v_true) - window.nav.velocity
    return angle, tilt, float(e_v @ np.linalg.solve(P[6:9, 6:9], e_v))


def _unit(x: float, y: float, z: float) -> FloatArray:
    return np.array([x, y, z]) / np.linalg.norm([x, y, z])


STARTS = {
    "standstill": Start(np.zeros(3), np.zeros(3)),
    "constant turn": Start(np.zeros(3), np.array([0.0, 0.1, 0.2])),
    "slow constant turn": Start(np.zeros(3), np.array([0.0, 0.0, 0.02])),
    "take-off": Start(np.array([1.0, 0.5, 2.0]), np.array([0.1, 0.2, 0.0]), 0.3),
    "2 m/s^2 ahead": Start(2 * _unit(1, 0, 0), np.array([0.0, 0.0, 0.1])),
    "5 m/s^2 ahead": Start(5 * _unit(1, 0, 0), np.array([0.0, 0.0, 0.1])),
    "5 m/s^2 to the left and up": Start(5 * _unit(0, 1, 1), np.array([0.0, 0.0, 0.1])),
    "5 m/s^2 ahead and down": Start(5 * _unit(1, 0, -1), np.zeros(3)),
    "8 m/s^2 ahead": Start(8 * _unit(1, 0, 0), np.array([0.0, 0.0, 0.1])),
    "8 m/s^2 to the right": Start(8 * _unit(0, -1, 0), np.zeros(3)),
    "8 m/s^2 up": Start(8 * _unit(0, 0, 1), np.zeros(3)),
}


@pytest.mark.parametrize("name", STARTS)
def test_a_start_is_solved_within_a_second(name: str) -> None:
    """Vertical to a degree, and pose, vertical and velocity within what their covariance says, over
    20 seeds.

    Without a turn, an accelerometer bias looks like a tilt: it leaves 1.75 degrees (its prior over
    gravity) open.
    """
    found = _after_a_second(STARTS[name])
    assert np.median(found.tilt_deg) < 1.0, found
    assert np.sqrt(np.mean(found.tilt_deg**2)) < np.degrees(
        DEFAULT_IMU.accel_bias_sigma_mps2 / 9.81
    ), found
    for value, dof in ((found.pose, 6), (found.tilt, 2), (found.velocity, 3)):
        assert value < nees_bounds(dof, SEEDS)[1], found


@pytest.mark.parametrize(
    ("name", "still"), [(n, n in ("standstill", "slow constant turn")) for n in STARTS]
)
def test_the_first_tilt_is_covered_by_its_standard_deviation(name: str, still: bool) -> None:
    """Within three sigma in all directions; a standstill is told from what the readings show to
    be motion.
    """
    start = STARTS[name]
    bias = np.array([0.02, -0.01, 0.03, 0.05, -0.05, 0.05])
    samples = [x for x in start.imu(np.random.default_rng(0), bias) if x.time_ns <= 0]
    found = imu_start(samples, 0, DEFAULT_IMU)
    R = start.state(0.0)[0]
    horizontal = np.linalg.norm(np.cross(R @ found.force, [0, 0, 1])) * DEFAULT_IMU.gravity_mps2
    horizontal /= np.linalg.norm(found.force)
    assert horizontal < 3 * np.hypot(found.accel_sigma_mps2, DEFAULT_IMU.accel_bias_sigma_mps2)
    assert np.all(np.abs(found.gyro_bias - bias[:3]) < 3 * found.gyro_bias_sigma_radps)
    if still or name == "take-off":
        assert found.still
        assert found.accel_sigma_mps2 < 1.0
        np.testing.assert_allclose(found.gyro_bias, bias[:3] + start.turn * still, atol=2e-3)
    if name.startswith(("5", "8")):
        assert not found.still


def test_vibration_is_no_standstill_and_neither_is_a_start_without_samples() -> None:
    rng = np.random.default_rng(0)
    gravity = np.array([0, 0, DEFAULT_IMU.gravity_mps2])
    swaying = [
        ImuSample(
            k * 5_000_000,
            np.zeros(3),
            gravity + np.array([np.sin(0.1 * k), 0, 0]) + rng.normal(0, 0.1, 3),
        )
        for k in range(100)
    ]
    assert not imu_start(swaying, 10**9, DEFAULT_IMU).still
    assert not imu_start(swaying[:10], 10**9, DEFAULT_IMU).still
    assert not imu_start(swaying[:1], 10**9, DEFAULT_IMU).still
