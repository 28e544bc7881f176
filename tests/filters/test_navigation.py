"""The motion models of the sliding-window filter: their noise against closed forms, their
measurements, odd starts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.jacobians import numeric_jacobian
from vio.errors import EstimationError
from vio.filters.imu_start import START_TILT_SIGMA_DEG
from vio.filters.navigation import DIM, ImuMotion, NavState, TwistMotion
from vio.filters.settings import MsckfSettings
from vio.geometry.lie import FloatArray, se3_exp, so3_exp
from vio.imu.settings import DEFAULT_IMU, ImuSettings
from vio.imu.standstill import NOISE_FACTOR, blocks_agree
from vio.records import ImuSample, VelocitySample

SETTINGS = MsckfSettings(calibrate_imu="off")
MOVING = NavState(
    se3_exp([3.0, -2.0, 1.0, 0.4, -0.8, 1.1]),
    np.array([1.0, -0.5, 0.3]),
    np.array([0.2, 0.1, -0.3]),
    np.array([0.01, -0.02, 0.03]),
    np.array([0.1, 0.05, -0.1]),
)
ORIGIN = NavState(np.eye(4), *np.zeros((4, 3)))


def _imu(
    hz: int, seconds: float, imu: ImuSettings = DEFAULT_IMU, *, moving: bool = False
) -> ImuMotion:
    motion = ImuMotion(SETTINGS, imu)
    for k in range(round(hz * seconds) + 1):
        t = k / hz
        gyro = np.array([0.5 * np.sin(3 * t), -0.4, 0.3 * t]) if moving else np.zeros(3)
        accel = np.array([0.3, np.cos(2 * t), 9.81]) if moving else np.array([0.0, 0.0, 9.81])
        motion.take(ImuSample(round(1e9 * t), gyro, accel))
    return motion


@pytest.mark.parametrize("hz", [100, 400])
def test_imu_noise_at_rest_is_that_of_integrated_white_noise(hz: int) -> None:
    """Whatever the rate of the samples: T for angle and velocity, T^3 / 3 for position, T for
    the biases.
    """
    T = 0.5
    Q = _imu(hz, T).advance(ORIGIN, 0, round(1e9 * T)).Q
    s = DEFAULT_IMU
    np.testing.assert_allclose(np.diag(Q)[3:6], s.gyro_noise_density**2 * T, rtol=1e-6)
    # A velocity error of gravity's direction change adds to two of the axes, (g t)^2 integrated.
    tilting = np.array([1, 1, 0]) * s.gyro_noise_density**2 * s.gravity_mps2**2 * T**3 / 3
    np.testing.assert_allclose(np.diag(Q)[6:9], s.accel_noise_density**2 * T + tilting, rtol=2e-3)
    np.testing.assert_allclose(Q[2, 2], s.accel_noise_density**2 * T**3 / 3, rtol=2e-3)
    np.testing.assert_allclose(Q[2, 8], s.accel_noise_density**2 * T**2 / 2, rtol=2e-3)
    np.testing.assert_allclose(
        np.diag(Q)[9:], np.repeat([s.gyro_bias_walk, s.accel_bias_walk], 3) ** 2 * T, rtol=1e-9
    )


def test_a_turn_on_the_spot_about_a_level_axis_gains_no_velocity() -> None:
    """Half a sample of delay between gyro and accelerometer would make it 0.077 m/s."""
    motion = ImuMotion(SETTINGS, DEFAULT_IMU)
    rate = np.array([np.radians(90), 0.0, 0.0])
    for k in range(101):
        force = so3_exp(rate * k / 100).T @ [0.0, 0.0, DEFAULT_IMU.gravity_mps2]
        motion.take(ImuSample(10_000_000 * k, rate, force))
    moved = motion.advance(ORIGIN, 0, 1_000_000_000).nav
    np.testing.assert_allclose(moved.velocity, 0, atol=1e-3)
    np.testing.assert_allclose(moved.T_world_imu[:3, 3], 0, atol=1e-3)


def test_imu_noise_does_not_depend_on_how_the_time_is_cut() -> None:
    motion = _imu(200, 0.2, ImuSettings(gyro_bias_walk=0.0, accel_bias_walk=0.0), moving=True)
    whole = motion.advance(MOVING, 0, 200_000_000)
    first = motion.advance(MOVING, 0, 80_000_000)
    second = motion.advance(first.nav, 80_000_000, 200_000_000)
    np.testing.assert_allclose(second.nav.T_world_imu, whole.nav.T_world_imu, atol=1e-12)
    np.testing.assert_allclose(second.Phi @ first.Phi, whole.Phi, atol=1e-9)
    cut = second.Phi @ first.Q @ second.Phi.T + second.Q
    np.testing.assert_allclose(cut, whole.Q, rtol=1e-6, atol=1e-9 * np.abs(whole.Q).max())


def test_twist_noise_does_not_depend_on_how_the_time_is_cut() -> None:
    motion = TwistMotion(SETTINGS)
    nav = replace(ORIGIN, T_world_imu=MOVING.T_world_imu)
    whole = motion.advance(nav, 0, 200_000_000)
    first, second = motion.advance(nav, 0, 80_000_000), motion.advance(nav, 80_000_000, 200_000_000)
    cut = second.Phi @ first.Q @ second.Phi.T + second.Q
    np.testing.assert_allclose(cut, whole.Q, rtol=1e-9, atol=1e-12 * np.abs(whole.Q).max())
    np.testing.assert_allclose(np.diag(whole.Q)[6:12], 0.2 * np.repeat([1.0, 0.3], 3) ** 2)


def test_twist_noise_over_a_minute_of_turning_is_a_covariance() -> None:
    """Images alone go on through a gap between frames as they moved before it."""
    motion = TwistMotion(SETTINGS)
    turning = replace(ORIGIN, velocity=np.array([2.0, 0.0, 0.0]), rate=np.array([0.0, 0.0, 1.0]))
    whole = motion.advance(turning, 0, 60_000_000_000)
    assert np.linalg.eigvalsh(whole.Q).min() > 0.0
    assert np.sqrt(np.diag(whole.Q)[:3]).max() < 1000.0
    assert np.sqrt(np.diag(whole.Q)[5]) == pytest.approx(0.3 * np.sqrt(60.0**3 / 3.0), rel=0.01)


@pytest.mark.parametrize("kind", ["imu", "twist"])
def test_factors_scale_their_own_part_of_the_noise(kind: str) -> None:
    """The first is the translation's, the second the rotation's; the biases' walk is no part of
    either.
    """
    motion = _imu(200, 0.1, moving=True) if kind == "imu" else TwistMotion(SETTINGS)
    plain = motion.advance(MOVING, 0, 100_000_000)
    scaled = motion.advance(MOVING, 0, 100_000_000, np.array([2.0, 3.0]))
    np.testing.assert_allclose(scaled.Q_parts[0], 4 * plain.Q_parts[0], atol=1e-18)
    np.testing.assert_allclose(scaled.Q_parts[1], 9 * plain.Q_parts[1], atol=1e-18)
    np.testing.assert_allclose(
        scaled.Q - scaled.Q_parts.sum(axis=0), plain.Q - plain.Q_parts.sum(axis=0), atol=1e-18
    )
    if kind == "imu":  # noise of the accelerometer turns nothing
        assert not plain.Q_parts[0][3:6].any()
        assert plain.Q_parts[1][3:6, 3:6].any()


def test_mean_rate_of_a_step_is_what_the_gyro_read_and_the_present_rate_lacks_the_bias() -> None:
    motion, reading = ImuMotion(SETTINGS), np.array([0.3, -0.2, 0.5])
    for k in range(11):
        motion.take(ImuSample(k * 5_000_000, reading, np.array([0.0, 0.0, 9.81])))
    step = motion.advance(MOVING, 0, 50_000_000)
    np.testing.assert_allclose(step.gyro, reading, atol=1e-12)
    np.testing.assert_allclose(step.nav.rate, reading - MOVING.gyro_bias, atol=1e-12)


def test_rest_of_an_imu_is_measured_by_velocity_and_bias() -> None:
    motion, reading = ImuMotion(SETTINGS), MOVING.gyro_bias + np.array([0.02, 0.01, -0.03])
    measurement = motion.zero_velocity(MOVING, reading)

    def seen(error: FloatArray) -> FloatArray:
        moved = motion.corrected(MOVING, error)
        return np.concatenate([moved.velocity, moved.gyro_bias])

    np.testing.assert_allclose(measurement.H, numeric_jacobian(seen, np.zeros(DIM)), atol=1e-8)
    rest = np.concatenate([np.zeros(3), reading])
    np.testing.assert_allclose(measurement.residual, rest - seen(np.zeros(DIM)), atol=1e-12)
    np.testing.assert_allclose(np.diag(measurement.R), np.repeat([0.02, 0.01], 3) ** 2)


def test_rest_is_denied_where_the_gyro_turns_or_is_not_known() -> None:
    motion = ImuMotion(SETTINGS)
    assert motion.zero_velocity(MOVING, MOVING.gyro_bias + np.array([0.0, 0.34, 0.0])) is None
    assert motion.zero_velocity(MOVING, None) is None


def test_velocities_are_measured_by_the_twist_and_the_rates_bias() -> None:
    motion, sample = (
        TwistMotion(SETTINGS),
        VelocitySample(0, np.array([1.2, -0.4, 0.0]), np.array([0.3, 0.2, 0.1])),
    )
    motion.take(sample)
    measurement = motion.measurement(MOVING)

    def seen(error: FloatArray) -> FloatArray:
        moved = motion.corrected(MOVING, error)
        return np.concatenate([moved.velocity, moved.rate + moved.gyro_bias])

    np.testing.assert_allclose(measurement.H, numeric_jacobian(seen, np.zeros(DIM)), atol=1e-8)
    told = np.concatenate([sample.linear, sample.angular])
    np.testing.assert_allclose(measurement.residual, told - seen(np.zeros(DIM)), atol=1e-12)


@pytest.mark.parametrize("up", [[0.0, 0, 1], [0.0, 0, -1], [0.0, 1, 0], [0.6, 0, -0.8]])
def test_start_turns_the_accelerometers_up_to_the_worlds(up: list[float]) -> None:
    motion = ImuMotion(SETTINGS)
    motion.take(ImuSample(0, np.zeros(3), 9.81 * np.array(up)))
    nav, P = motion.start(0)
    R = nav.T_world_imu[:3, :3]
    np.testing.assert_allclose(R @ up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    from_bias = DEFAULT_IMU.accel_bias_sigma_mps2 / DEFAULT_IMU.gravity_mps2
    np.testing.assert_allclose(
        np.diag(P)[3:5], np.radians(START_TILT_SIGMA_DEG) ** 2 + from_bias**2
    )


def test_an_accelerometer_that_reads_nothing_is_named() -> None:
    motion = ImuMotion(SETTINGS)
    motion.take(ImuSample(0, np.full(3, 1e-4), np.full(3, 1e-5)))
    with pytest.raises(EstimationError, match=r"accelerometer reads zero; is it in m/s\^2"):
        motion.start(0)


def test_an_interval_without_any_sample_is_an_error() -> None:
    with pytest.raises(EstimationError, match="no IMU sample before 1000000000 ns"):
        ImuMotion(SETTINGS).advance(ORIGIN, 0, 1_000_000_000)


@pytest.mark.parametrize("times", [[0, 10], [900, 1000], [0, 5, 10, 1000]])
def test_an_interval_with_few_samples_is_bridged(times: list[int]) -> None:
    motion = ImuMotion(SETTINGS)
    for t in times:
        motion.take(ImuSample(t * 1_000_000, np.zeros(3), np.array([0.0, 0.0, 9.81])))
    step = motion.advance(ORIGIN, 0, 1_000_000_000)
    assert step.bridged
    assert step.gyro is None
    assert np.sqrt(step.Q[6, 6]) > 0.3  # m/s


def test_old_samples_are_dropped_but_not_the_one_that_the_next_interval_begins_with() -> None:
    motion = _imu(200, 0.2, moving=True)
    expected = motion.advance(MOVING, 102_000_000, 150_000_000)
    motion.forget_before(102_000_000)
    again = motion.advance(MOVING, 102_000_000, 150_000_000)
    np.testing.assert_array_equal(again.nav.T_world_imu, expected.nav.T_world_imu)
    assert motion.covered(150_000_000) == 150_000_000
    assert motion.covered(210_000_000) == 200_000_000  # a little late: as far as the samples go
    assert motion.covered(300_000_000) == 300_000_000  # for too long


@pytest.mark.parametrize("hz", [100, 200, 1000])
def test_the_noise_of_one_reading_is_that_of_the_imus_own_period(hz: int) -> None:
    """Also where old samples are dropped, and one is left."""
    motion = _imu(hz, 1.0)
    density = DEFAULT_IMU.gyro_noise_density
    assert motion.rate_variance(np.ones(2)) == pytest.approx(density**2 * hz)
    motion.forget_before(motion.samples[-1].time_ns)
    assert len(motion.samples) == 1
    assert motion.rate_variance(np.ones(2)) == pytest.approx(density**2 * hz)


@pytest.mark.parametrize(("share", "agree"), [(0.9, True), (1.1, False)])
def test_means_agree_up_to_what_one_standstill_in_a_thousand_shows(
    share: float, agree: bool
) -> None:
    """Five means of three values have twelve degrees of freedom."""
    limit = 32.9  # of the tables of chi-square
    density = np.sqrt(0.1) / NOISE_FACTOR  # the mean of a tenth of a second has unit variance
    values = np.zeros((5, 3))
    values[2, 0] = np.sqrt(share * limit / (1 - 1 / 5))
    times_s = -np.array([0.45, 0.35, 0.25, 0.15, 0.05])
    assert blocks_agree(times_s, values, density) == agree
