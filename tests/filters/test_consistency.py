"""Flights by which consistency is measured: what is called the truth is one, and the filter is
consistent with it.

Equation numbers are those of docs/notes/consistency.md.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.jacobians import numeric_jacobian
from tools.consistency import Job, Motion, Scenario, fly
from vio.evaluation.consistency import nees_bounds
from vio.filters.navigation import DIM, ImuMotion, NavState, TwistMotion
from vio.filters.settings import MsckfSettings
from vio.filters.window import Window
from vio.geometry.lie import FloatArray, se3_exp, so3_hat, so3_log


def _window(motion: str) -> Window:
    """Three clones on a moving body and two landmarks."""
    rng = np.random.default_rng(0)
    nav = NavState(np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    settings = MsckfSettings(calibrate_imu="off")
    model = ImuMotion(settings) if motion == "imu" else TwistMotion(settings)
    window = Window(model, nav, np.eye(DIM) * 1e-3)
    for k in range(3):
        move = se3_exp(rng.normal(0, [0.5, 0.5, 0.5, 0.2, 0.2, 0.2]))
        window.nav = NavState(
            move @ window.nav.T_world_imu, rng.normal(size=3), np.zeros(3), np.zeros(3), np.zeros(3)
        )
        window.add_clone(k, k)
    A = rng.normal(size=(6, len(window.prior.P))) * 0.3
    points = np.array([[4.0, 1.0, 0.5], [6.0, -2.0, 1.0]])
    window.add_landmarks(np.array([3, 8]), points, A, np.array([np.eye(3) * 1e-3] * 2))
    return window


def _usual_D_error(window: Window) -> FloatArray:
    """M (D, D) of (E1): the usual errors by the window's right-invariant ones."""
    M = np.eye(len(window.prior.P))
    M[0:3, 3:6] = -so3_hat(window.nav.T_world_imu[:3, 3])
    if isinstance(window.motion, ImuMotion):
        M[6:9, 3:6] = -so3_hat(window.nav.velocity)
    for k, clone in enumerate(window.clones):
        start = window.state.clone(k).start
        M[start : start + 3, start + 3 : start + 6] = -so3_hat(clone.T_world_imu[:3, 3])
    M[window.state.landmarks.start :, start + 3 : start + 6] = -so3_hat(window.landmarks).reshape(
        -1, 3
    )
    return M


def _usual_difference(a: Window, b: Window) -> FloatArray:
    """Means of a minus means of b, in the usual errors."""
    poses = [(a.nav.T_world_imu, b.nav.T_world_imu)]
    poses += [(x, y) for x, y in zip(a.clones.T_world_imu, b.clones.T_world_imu, strict=True)]
    changes = [
        np.concatenate([x[:3, 3] - y[:3, 3], so3_log(x[:3, :3] @ y[:3, :3].T)]) for x, y in poses
    ]
    names = (
        "velocity",
        *(
            ("gyro_bias", "accel_bias")
            if isinstance(a.motion, ImuMotion)
            else ("rate", "gyro_bias")
        ),
    )
    rest = [getattr(a.nav, name) - getattr(b.nav, name) for name in names]
    return np.concatenate([changes[0], *rest, *changes[1:], (a.landmarks - b.landmarks).ravel()])


@pytest.mark.parametrize("motion", ["imu", "none"])
def test_jacobian_of_the_usual_errors_equals_central_differences(motion: str) -> None:
    """Move the window by a right-invariant error and look at what that is in the usual ones,
    (E1).
    """
    at = _window(motion)

    def moved(error: FloatArray) -> FloatArray:
        window = _window(motion)
        window.relinearise(error)
        return _usual_difference(window, at)

    numeric = numeric_jacobian(moved, np.zeros(len(at.prior.P)))
    np.testing.assert_allclose(_usual_D_error(at), numeric, atol=1e-7)


def test_a_prior_is_carried_to_other_means_by_the_sum_of_jacobians() -> None:
    """N = M(new)^-1 M(old) = I + M(old) - M(new) keeps the prior in the usual errors, (E2); the
    filter needs none.
    """
    window, P = _window("imu"), _window("imu").prior.P
    old = _usual_D_error(window)
    window.relinearise(np.random.default_rng(1).normal(0, 0.1, len(P)))
    new = _usual_D_error(window)
    N = np.eye(len(P)) + old - new
    np.testing.assert_allclose(new @ N @ P @ N.T @ new.T, old @ P @ old.T, atol=1e-12)
    assert np.abs(N - np.eye(len(P))).max() > 0.1
    np.testing.assert_array_equal(window.prior.P, P)


@pytest.mark.parametrize("motion", ["imu", "none"])
def test_yaw_stays_as_uncertain_as_it_began(motion: Motion) -> None:
    """No image and no IMU observes yaw: one degree of uncertainty at the start must still be
    there at the end.
    """
    for seed in range(2):
        sigma = fly(
            Job(Scenario(seconds=1.0), motion, "uncertain", "right-invariant", seed)
        ).yaw_sigma_deg
        assert sigma[0] == pytest.approx(1.0, rel=1e-4)
        assert sigma.min() > 0.999
        assert sigma.max() < 1.05


def test_navigation_state_is_consistent_with_known_noise() -> None:
    """Mean NEES over 20 flights whose start is drawn from its covariance: two-sided, for all
    that is estimated.
    """
    runs = 20
    scenario = Scenario(seconds=0.8, features=30)
    records = [
        fly(Job(scenario, "imu", "uncertain", "right-invariant", seed)) for seed in range(runs)
    ]
    for measure, d in (
        ("pose", 6),
        ("position", 3),
        ("orientation", 3),
        ("velocity", 3),
        ("gyro bias", 3),
    ):
        mean = np.mean([r.nees[measure][1:] for r in records], axis=0)
        low, high = nees_bounds(d, runs)
        assert low < mean.mean() < high, (
            f"{measure}: mean NEES {mean.mean():.2f}, bounds {low:.2f} to {high:.2f}"
        )
    nis = np.mean([r.nis[5:] for r in records])
    assert 0.9 < nis < 1.1
