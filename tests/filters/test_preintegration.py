"""The IMU's motions between keyframes, against finite differences and a motion that is known."""

from dataclasses import replace

import numpy as np
import pytest

from vio.geometry.lie import se3_exp, so3_exp, so3_log
from vio.imu.preintegration import BodyStates, Readings, preintegrate
from vio.records import ImuDensities

_DENSITIES = ImuDensities(gyro=2e-4, gyro_walk=2e-5, accel=2e-3, accel_walk=3e-3)


def _readings(rng: np.random.Generator, seconds: float = 1.0) -> Readings:
    t = np.sort(rng.uniform(0, seconds, 200))
    return Readings(t, rng.normal(0, 1.0, (200, 3)), rng.normal(0, 3.0, (200, 3)), _DENSITIES)


def test_rotation_at_a_constant_rate_and_fall_are_exact() -> None:
    t = np.linspace(0.0, 2.0, 401)
    rate, bias = np.array([0.3, -0.5, 0.9]), np.array([0.01, 0.02, -0.03, 0.1, -0.2, 0.05])
    # Falls freely while it rotates: no force but the bias.
    seen = Readings(t, np.tile(rate + bias[:3], (401, 1)), np.tile(bias[3:], (401, 1)), _DENSITIES)
    start, end = np.array([0.1234, 1.0]), np.array([0.9, 1.7321])
    done = preintegrate(seen, start, end, np.tile(bias, (2, 1)))
    np.testing.assert_allclose(so3_log(done.R), rate * (end - start)[:, None], atol=1e-12)
    np.testing.assert_allclose(done.v, 0, atol=1e-12)
    T = np.tile(np.eye(4), (2, 1, 1))
    at_end = T.copy()
    v0, dt = np.array([1.0, 2.0, 3.0]), (end - start)[:, None]
    at_end[:, :3, :3] = so3_exp(rate * dt)
    at_end[:, :3, 3] = v0 * dt - 0.5 * 9.81 * np.array([0, 0, 1]) * dt**2
    i = BodyStates(T, np.tile(v0, (2, 1)), np.tile(bias, (2, 1)))
    j = BodyStates(at_end, v0 - 9.81 * np.array([0, 0, 1]) * dt, i.bias)
    np.testing.assert_allclose(done.residual(i, j, 9.81), 0, atol=1e-12)


def test_integration_is_of_second_order() -> None:
    """A turn on the spot about a level axis, where gravity hides errors of first order the least."""
    errors = []
    for hz in (100, 200):
        t = np.arange(hz + 1) / hz
        rate = np.array([np.radians(90), 0.0, 0.0])
        force = np.array([so3_exp(rate * s).T @ [0.0, 0.0, 9.81] for s in t])
        seen = Readings(t, np.tile(rate, (hz + 1, 1)), force, _DENSITIES)
        done = preintegrate(seen, np.array([0.0]), np.array([1.0]), np.zeros((1, 6)))
        errors.append(np.linalg.norm(done.v[0] - [0.0, 0.0, 9.81]))
    assert errors[0] < 1e-3  # m/s; one of first order has 0.077
    np.testing.assert_allclose(errors[0] / errors[1], 4, rtol=0.01)


def test_derivatives_match_finite_differences() -> None:
    rng = np.random.default_rng(0)
    seen, start, end = _readings(rng), np.array([0.05, 0.4]), np.array([0.35, 0.9])
    bias = rng.normal(0, 0.01, (2, 6))
    done = preintegrate(seen, start, end, bias)
    i, j = (
        BodyStates(
            se3_exp(rng.normal(0, 0.8, (2, 6))),
            rng.normal(0, 1, (2, 3)),
            bias + rng.normal(0, 0.03, (2, 6)),
        )
        for _ in range(2)
    )
    r, A, B = done.linearised(i, j, 9.81)
    np.testing.assert_array_equal(r, done.residual(i, j, 9.81))
    h = 1e-6
    for k in range(15):
        x = np.zeros((2, 15))
        x[:, k] = h
        by_i = (done.residual(i.moved(x), j, 9.81) - done.residual(i.moved(-x), j, 9.81)) / (2 * h)
        by_j = (done.residual(i, j.moved(x), 9.81) - done.residual(i, j.moved(-x), 9.81)) / (2 * h)
        np.testing.assert_allclose(A[:, :, k], by_i, atol=1e-7)
        np.testing.assert_allclose(B[:, :, k], by_j, atol=1e-7)


def test_derivatives_by_the_bias_are_those_of_integrating_again() -> None:
    rng = np.random.default_rng(1)
    seen, start, end = _readings(rng), np.array([0.05]), np.array([0.85])
    bias = rng.normal(0, 0.01, (1, 6))
    done, h = preintegrate(seen, start, end, bias), 1e-5
    for k in range(6):
        plus, minus = (preintegrate(seen, start, end, bias + s * h * np.eye(6)[k]) for s in (1, -1))
        np.testing.assert_allclose(
            done.D_bias[0, :3, k],
            so3_log(np.swapaxes(minus.R, 1, 2) @ plus.R)[0] / (2 * h),
            atol=1e-8,
        )
        np.testing.assert_allclose(
            done.D_bias[0, 3:6, k], (plus.v - minus.v)[0] / (2 * h), atol=1e-8
        )
        np.testing.assert_allclose(
            done.D_bias[0, 6:, k], (plus.p - minus.p)[0] / (2 * h), atol=1e-8
        )


def test_covariance_is_that_of_many_draws() -> None:
    rng, draws, samples, rate = np.random.default_rng(2), 1000, 100, 200.0
    t = np.arange(draws * samples + 1) / rate
    phase = 2 * np.pi * t * rate / samples
    clean = np.stack([np.sin(phase + k) for k in range(6)], axis=1) * np.repeat([1.0, 5.0], 3)
    white = rng.normal(0, np.sqrt(rate), clean.shape) * np.repeat(
        [_DENSITIES.gyro, _DENSITIES.accel], 3
    )
    start = np.arange(draws) * samples / rate
    truth, drawn = (
        preintegrate(
            Readings(t, x[:, :3], x[:, 3:], _DENSITIES),
            start,
            start + samples / rate,
            np.zeros((draws, 6)),
        )
        for x in (clean, clean + white)
    )
    phi = so3_log(np.swapaxes(truth.R, 1, 2) @ drawn.R)
    e = np.concatenate([phi, drawn.v - truth.v, drawn.p - truth.p], axis=1)
    nees = np.einsum("di,dij,dj->d", e, np.linalg.inv(truth.covariance), e)
    assert abs(nees.mean() / 9 - 1) < 0.05


def test_missing_samples_leave_the_motion_open() -> None:
    seen, ends = _readings(np.random.default_rng(3)), (np.array([0.2, 0.6]), np.array([0.3, 1.2]))
    t = np.linspace(0.0, 1.0, 201)
    whole = preintegrate(replace(seen, seconds=t[:200]), *ends, np.zeros((2, 6))).covariance
    kept = (t[:200] < 0.22) | (t[:200] > 0.28)
    cut = Readings(t[:200][kept], seen.gyro[kept], seen.accel[kept], _DENSITIES)
    sigma = np.sqrt(
        np.diagonal(preintegrate(cut, *ends, np.zeros((2, 6))).covariance, axis1=1, axis2=2)
    )
    assert sigma[0, 0] == pytest.approx(0.06, rel=0.3), "1 rad/s for 0.06 s"
    assert np.sqrt(whole[0, 0, 0]) < 1e-3
    assert sigma[1, 0] == pytest.approx(0.2, rel=0.3), "and 0.2 s after the last sample"
