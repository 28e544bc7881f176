"""Splines against finite differences and their samples; simulated IMU data integrates back to
the trajectory.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vio.datasets.tables import read_imu_table
from vio.errors import DataError
from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp, so3_log
from vio.sim.imu import (
    GRAVITY_MPS2,
    GRAVITY_WORLD,
    NO_IMU_NOISE,
    ImuNoise,
    VelocityNoise,
    simulate_imu,
    simulate_velocity,
)
from vio.sim.motion import (
    MotionSpline,
    car_loop,
    fit_spline,
    hand_held,
    motion_at,
    recorded_motion,
    rotate_body_axes,
    spline_from_waypoints,
)
from vio.sim.rigs import R_FLU_EUROC_IMU


def _waypoints(n: int = 12, seed: int = 0) -> FloatArray:
    rng = np.random.default_rng(seed)
    R = so3_exp(np.cumsum(rng.normal(0, 0.25, (n, 3)), axis=0))
    return se3_from_parts(R, np.cumsum(rng.normal(0, 0.5, (n, 3)), axis=0))


MOTIONS: dict[str, MotionSpline] = {
    "waypoints": spline_from_waypoints(_waypoints(seed=1), 0.3, start_ns=1_403_715_524_907_140_000),
    "car": car_loop(duration_s=8.0),
    "hand": hand_held(duration_s=6.0, still_s=1.0),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_derivatives_match_central_differences(name: str) -> None:
    spline = MOTIONS[name]
    h_ns = 50_000
    times = np.linspace(spline.start_ns + h_ns, spline.end_ns - h_ns, 97).astype(np.int64)
    before, at, after = (motion_at(spline, times + step) for step in (-h_ns, 0, h_ns))
    span = 2 * h_ns * 1e-9

    def slope(values: str) -> FloatArray:
        out: FloatArray = (getattr(after, values) - getattr(before, values)) / span
        return out

    np.testing.assert_allclose(at.velocity_world, slope("T_world_imu")[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(at.acceleration_world, slope("velocity_world"), atol=2e-3)
    turn = np.swapaxes(before.T_world_imu[:, :3, :3], 1, 2) @ after.T_world_imu[:, :3, :3]
    np.testing.assert_allclose(at.angular_velocity, so3_log(turn) / span, atol=1e-5)


def test_spline_passes_through_waypoints() -> None:
    T = _waypoints(9, seed=4)
    spline = spline_from_waypoints(T, 0.5)
    times = np.minimum((np.arange(9) * 500_000_000), spline.end_ns)
    met = motion_at(spline, times).T_world_imu
    np.testing.assert_allclose(met[:, :3, 3], T[:, :3, 3], atol=1e-3)
    assert np.abs(so3_log(np.swapaxes(met[:, :3, :3], 1, 2) @ T[:, :3, :3])).max() < 1e-3


def test_a_constant_twist_is_reproduced() -> None:
    t = np.arange(0, 3_000_000_000, 20_000_000)
    omega = np.array([0.0, 0.0, 0.7])
    T = se3_from_parts(
        so3_exp(omega * t[:, None] * 1e-9), np.array([2.0, -1.0, 0.5]) * t[:, None] * 1e-9
    )
    spline, report = fit_spline(t, T, knot_s=0.1)
    state = motion_at(spline, t[5:-5])
    assert report.position_max_m < 1e-8
    assert report.rotation_max_rad < 1e-9
    np.testing.assert_allclose(
        state.angular_velocity, np.broadcast_to(omega, (len(t) - 10, 3)), atol=1e-6
    )
    np.testing.assert_allclose(state.acceleration_world, 0, atol=1e-5)


def test_robust_fit_rejects_jumps() -> None:
    source = MOTIONS["hand"]
    t = np.arange(source.start_ns, source.end_ns, 10_000_000)
    T = motion_at(source, t).T_world_imu
    rng = np.random.default_rng(0)
    T[:, :3, 3] += rng.normal(0, 3e-4, (len(t), 3))
    corrupted = T.copy()
    corrupted[100:104, :3, 3] += 0.3
    corrupted[300, :3, :3] = corrupted[300, :3, :3] @ so3_exp([0.4, 0, 0])
    spline, report = fit_spline(t, corrupted, knot_s=0.1, robust=True)
    assert report.rejected == 5
    error = motion_at(spline, t).T_world_imu[:, :3, 3] - motion_at(source, t).T_world_imu[:, :3, 3]
    assert np.abs(error).max() < 2e-3


def test_rotate_body_axes_changes_the_axes_only() -> None:
    spline = MOTIONS["hand"]
    other = rotate_body_axes(spline, R_FLU_EUROC_IMU)
    t = np.linspace(spline.start_ns, spline.end_ns, 7).astype(np.int64)
    a, b = motion_at(spline, t), motion_at(other, t)
    np.testing.assert_allclose(b.angular_velocity, a.angular_velocity @ R_FLU_EUROC_IMU, atol=1e-9)
    np.testing.assert_allclose(
        b.T_world_imu[:, :3, :3], a.T_world_imu[:, :3, :3] @ R_FLU_EUROC_IMU, atol=1e-9
    )


def test_hand_held_starts_stationary_and_car_moves_like_kitti() -> None:
    still = motion_at(MOTIONS["hand"], np.arange(0, 900_000_000, 50_000_000))
    assert np.linalg.norm(still.velocity_world, axis=1).max() < 1e-3
    assert np.abs(still.angular_velocity).max() < 1e-3
    car = car_loop()
    state = motion_at(car, np.arange(car.start_ns, car.end_ns, 100_000_000))
    speed = np.linalg.norm(state.velocity_world, axis=1)
    assert speed.max() == pytest.approx(10.0, abs=0.3)
    assert 3 < speed.min() < 6  # in the corners
    path = speed.sum() * 0.1
    assert 330 < path < 360
    forward = np.einsum("nji,nj->ni", state.T_world_imu[:, :3, :3], state.velocity_world)
    assert np.abs(forward[:, 1]).max() < 0.1 * speed.max()  # no sideslip
    # a closed loop
    assert np.linalg.norm(state.T_world_imu[-1, :3, 3] - state.T_world_imu[0, :3, 3]) < 1.5


def test_rejects_bad_trajectories(tmp_path: Path) -> None:
    T = np.broadcast_to(np.eye(4), (3, 4, 4))
    with pytest.raises(DataError, match="pose 2 of the trajectory: the clock repeats"):
        fit_spline([0, 10, 10], T)
    path = tmp_path / "gt.txt"
    path.write_text("# t\n1.0 0 0 0 0 0 0 1\n0.9 0 0 0 0 0 0 1\n")
    with pytest.raises(DataError, match=r"gt\.txt, line 3: the clock runs backwards"):
        recorded_motion(path)
    path.write_text("1.0 0 0 0 0 0 0 1\n")
    with pytest.raises(
        DataError, match=r"gt\.txt: describes 1 poses of imu; give two or more of the IMU"
    ):
        recorded_motion(path)
    path.write_text("# body: cam0\n1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    with pytest.raises(DataError, match=r"gt\.txt: describes 2 poses of cam0"):
        recorded_motion(path)


def _integrate(spline: MotionSpline, rate_hz: float) -> tuple[float, float]:
    """Final errors (m, rad) of integrating exact IMU readings with the mid-point rule."""
    imu = simulate_imu(spline, rate_hz=rate_hz, noise=NO_IMU_NOISE)
    state = motion_at(spline, imu.times_ns)
    R, p = state.T_world_imu[0, :3, :3], state.T_world_imu[0, :3, 3]
    v = state.velocity_world[0]
    for i in range(len(imu.times_ns) - 1):
        dt = (imu.times_ns[i + 1] - imu.times_ns[i]) * 1e-9
        R_next = R @ so3_exp(0.5 * (imu.gyro[i] + imu.gyro[i + 1]) * dt)
        a = 0.5 * (R @ imu.accel[i] + R_next @ imu.accel[i + 1]) + GRAVITY_WORLD
        p, v, R = p + v * dt + 0.5 * a * dt * dt, v + a * dt, R_next
    last = state.T_world_imu[-1]
    return float(np.linalg.norm(p - last[:3, 3])), float(
        np.linalg.norm(so3_log(R.T @ last[:3, :3]))
    )


def test_imu_integrates_back_to_the_trajectory() -> None:
    errors = np.array([_integrate(MOTIONS["hand"], rate) for rate in (50.0, 100.0, 200.0, 400.0)])
    ratios = errors[:-1] / errors[1:]
    # second order: halving the step quarters the error
    assert np.all((ratios > 3.3) & (ratios < 4.7)), ratios
    assert errors[-1, 0] < 2e-4
    assert errors[-1, 1] < 2e-5


def test_stationary_imu_measures_gravity() -> None:
    spline = spline_from_waypoints(np.broadcast_to(np.eye(4), (6, 4, 4)), 0.5)
    imu = simulate_imu(spline, noise=NO_IMU_NOISE)
    np.testing.assert_allclose(
        imu.accel, np.broadcast_to([0, 0, GRAVITY_MPS2], imu.accel.shape), atol=1e-9
    )
    np.testing.assert_allclose(imu.gyro, 0, atol=1e-12)


def test_imu_noise_has_the_specified_densities() -> None:
    spline = spline_from_waypoints(np.broadcast_to(np.eye(4), (61, 4, 4)), 1.0)
    noise = ImuNoise()
    imu = simulate_imu(spline, rate_hz=200.0, noise=noise, seed=3)
    white = imu.gyro - imu.gyro_bias
    assert white.std() == pytest.approx(noise.densities.gyro * np.sqrt(200), rel=0.03)
    white = imu.accel - imu.accel_bias - [0, 0, GRAVITY_MPS2]
    assert white.std() == pytest.approx(noise.densities.accel * np.sqrt(200), rel=0.03)
    steps = np.diff(imu.accel_bias, axis=0)
    assert steps.std() == pytest.approx(noise.densities.accel_walk / np.sqrt(200), rel=0.03)
    steps = np.diff(imu.gyro_bias, axis=0)
    assert steps.std() == pytest.approx(noise.densities.gyro_walk / np.sqrt(200), rel=0.03)
    same, other = (simulate_imu(spline, noise=noise, seed=s) for s in (3, 4))
    assert np.array_equal(same.gyro, imu.gyro)
    assert not np.array_equal(other.gyro, imu.gyro)


def test_imu_saturates() -> None:
    imu = simulate_imu(MOTIONS["hand"], noise=ImuNoise(gyro_limit=0.2, accel_limit=9.9))
    assert np.abs(imu.gyro).max() == pytest.approx(0.2)
    assert np.abs(imu.accel).max() == pytest.approx(9.9)


def test_velocity_sensor_has_the_noise_of_the_paper() -> None:
    spline = MOTIONS["car"]
    clean = simulate_velocity(spline, rate_hz=100, noise=VelocityNoise(0.0, 0.0))
    noisy = simulate_velocity(spline, rate_hz=100, seed=1)
    linear = np.array([a.linear - b.linear for a, b in zip(noisy, clean, strict=True)])
    angular = np.array([a.angular - b.angular for a, b in zip(noisy, clean, strict=True)])
    assert linear.std() == pytest.approx(0.5, rel=0.05)
    assert angular.std() == pytest.approx(0.05, rel=0.05)
    assert clean[0].linear[0] == pytest.approx(10.0, abs=0.1)


@pytest.mark.parametrize("flight", ["V1_02"])
def test_spline_fits_a_real_flight_within_its_noise(data_dir: Path, flight: str) -> None:
    folder = data_dir / "euroc_real_imu" / flight
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    spline, report = recorded_motion(folder / "groundtruth_tum.txt")
    assert report.position_rms_m < 5e-4
    assert report.rotation_rms_rad < 2e-3
    assert report.rejected < 0.02 * report.samples
    imu = read_imu_table(folder / "imu0.csv", whole_ns=True)[0]
    inside = (imu.times_ns >= spline.start_ns) & (imu.times_ns <= spline.end_ns)
    state = motion_at(spline, imu.times_ns[inside])
    # The real sensors agree with the spline but for bias and vibration.
    gyro = imu.gyro[inside] - state.angular_velocity
    assert np.all((gyro - np.median(gyro, axis=0)).std(axis=0) < 0.1)
    gravity = np.einsum(
        "nji,nj->ni", state.T_world_imu[:, :3, :3], state.acceleration_world - GRAVITY_WORLD
    )
    assert np.all(np.abs(np.median(imu.accel[inside] - gravity, axis=0)) < 0.3)
