"""The window after a frame: smoothed estimates, and when its motion counts as none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from vio.filters.navigation import DIM, ImuMotion, NavState, TwistMotion
from vio.filters.settings import MsckfSettings
from vio.filters.window import Window
from vio.filters.window_posterior import WindowPosterior, given
from vio.geometry.lie import FloatArray, se3_adjoint, se3_exp, se3_from_parts, se3_inverse

_START = se3_exp([3.0, -2.0, 1.0, 0.4, -0.8, 1.1])
_LIMITS = 0.02, 0.01  # m/s, rad/s


def _window(xi: FloatArray, n: int = 5, motion: str = "twist") -> Window:
    """Clones 0.1 s apart that move by xi (6,) altogether, on the body's side."""
    model = ImuMotion(MsckfSettings()) if motion == "imu" else TwistMotion(MsckfSettings())
    window = Window(model, NavState(_START, *np.zeros((4, 3))), np.eye(DIM) * 1e-4)
    for k in range(n):
        T = _START @ se3_exp(xi * k / (n - 1))
        window.nav = replace(window.nav, T_world_imu=T, velocity=np.array([k, 2.0 * k, 0.5]))
        window.add_clone(10 + k, k * 100_000_000)
    return window


def _posterior(xi: FloatArray, sigma: FloatArray) -> WindowPosterior:
    """The window's posterior whose motion from first to last has standard deviations (6,) on the
    first body.
    """
    window, A = _window(xi), se3_adjoint(_START)
    P = np.zeros((len(window.prior.P), len(window.prior.P)))
    newest = window.state.clone(4)
    P[newest, newest] = A @ np.diag(sigma**2) @ A.T
    return WindowPosterior.of(window, P)


@pytest.mark.parametrize("axis", range(6))
def test_stationary_is_a_chi_square_test_of_the_motion_over_the_window(axis: int) -> None:
    sigma = np.array([1e-3, 2e-3, 3e-3, 5e-4, 1e-3, 2e-3])
    limit = sigma[axis] * np.sqrt(chi2.ppf(0.95, 6))
    for factor, expected in ((0.99, True), (1.01, False)):
        assert (
            _posterior(np.eye(6)[axis] * limit * factor, sigma).is_stationary(*_LIMITS) is expected
        )


@pytest.mark.parametrize(("part", "limit"), [(slice(0, 3), 0.02), (slice(3, 6), 0.01)])
def test_a_window_that_knows_its_motion_badly_is_never_stationary(
    part: slice, limit: float
) -> None:
    """The mean velocity and rate over 0.4 s must be known to the standard deviations of the
    measurement.
    """
    for factor, expected in ((0.99, True), (1.01, False)):
        sigma = np.full(6, 1e-4)
        sigma[part.start] = limit * 0.4 * factor
        assert _posterior(np.zeros(6), sigma).is_stationary(*_LIMITS) is expected


def test_displacement_is_no_longer_than_the_translation_of_the_twist() -> None:
    """`|J_l(phi) rho| <= |rho|`: a displacement that alone is too long for a standstill decides."""
    rho, phi = np.random.default_rng(0).normal(size=(2, 200, 3))
    for twist in np.concatenate([rho, phi * np.linspace(0.0, 1.5, 200)[:, None]], axis=1):
        assert np.linalg.norm(se3_exp(twist)[:3, 3]) <= np.linalg.norm(twist[:3]) * (1 + 1e-12)


def test_a_single_clone_tells_no_standstill() -> None:
    window = _window(np.zeros(6), n=2)
    window.drop_oldest_clone()
    assert not WindowPosterior.of(window, window.prior.P).is_stationary(*_LIMITS)


def test_what_both_poses_share_does_not_blur_their_motion() -> None:
    """A position known to a metre, the same for all clones, leaves the motion known."""
    window = _window(np.zeros(6))
    P = np.zeros((len(window.prior.P), len(window.prior.P)))
    rows = slice(window.state.clones.start, window.state.landmarks.start)
    P[rows, rows] = np.tile(np.eye(6), (5, 5))
    P[window.state.clone(4), window.state.clone(4)] += np.eye(6) * 1e-8
    assert WindowPosterior.of(window, P).is_stationary(*_LIMITS)
    P[window.state.clone(0), window.state.clone(4)] = P[
        window.state.clone(4), window.state.clone(0)
    ] = 0.0
    assert not WindowPosterior.of(window, P).is_stationary(*_LIMITS)


def test_each_clone_is_told_with_its_own_covariance_on_the_bodys_side() -> None:
    window = _window(np.array([0.4, 0.2, 0.0, 0.0, 0.1, 0.3]), motion="imu")
    root = np.random.default_rng(0).normal(size=(len(window.prior.P), len(window.prior.P)))
    P = root @ root.T
    posterior = WindowPosterior.of(window, P)
    for k in range(len(window.clones)):
        clone = window.clones[k]
        estimate = posterior.estimate(10 + k)
        A = se3_adjoint(se3_inverse(clone.T_world_imu))
        rows = window.state.clone(k)
        np.testing.assert_allclose(estimate.covariance, A @ P[rows, rows] @ A.T, rtol=1e-9)
        np.testing.assert_array_equal(estimate.T_world_imu, clone.T_world_imu)
        np.testing.assert_array_equal(estimate.velocity_world, clone.velocity)
        assert estimate.time_ns == k * 100_000_000
    assert posterior.estimate(9) is None
    assert posterior.estimate(15) is None


def test_without_imu_the_velocity_is_that_of_the_poses_around() -> None:
    """Positions of second order in time: exact inside, from the neighbour alone at the ends."""
    window = _window(np.zeros(6))
    t = np.arange(5) * 0.1
    p = np.column_stack([3 * t**2, 1 - 2 * t, 0 * t])
    window.clones = replace(
        window.clones, T_world_imu=se3_from_parts(window.clones.T_world_imu[:, :3, :3], p)
    )
    posterior = WindowPosterior.of(window, window.prior.P)
    smoothed = [posterior.estimate(index) for index in posterior.clones.frame_indices.tolist()]
    velocities = np.array(
        [estimate.velocity_world for estimate in smoothed if estimate is not None]
    )
    exact = np.column_stack([6 * t, np.full(5, -2.0), 0 * t])
    np.testing.assert_allclose(velocities[1:-1], exact[1:-1], atol=1e-12)
    np.testing.assert_allclose(
        velocities[[0, -1]], exact[[0, -1]] + [[0.3, 0, 0], [-0.3, 0, 0]], atol=1e-12
    )


def test_what_is_left_of_a_covariance_where_errors_are_known() -> None:
    half = np.random.default_rng(3).normal(0, 1, (9, 9))
    P = half @ half.T
    known = slice(4, 6)
    others = np.delete(np.arange(9), [4, 5])
    left = given(P, known)
    by_information = np.linalg.inv(np.linalg.inv(P)[np.ix_(others, others)])
    np.testing.assert_allclose(left[np.ix_(others, others)], by_information, atol=1e-9)
    np.testing.assert_allclose(left[known], 0.0, atol=1e-9)
    np.testing.assert_array_equal(given(P, slice(4, 4)), P)
