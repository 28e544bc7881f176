"""The window's covariance and means: invariants that hold whatever the motion and the landmarks
are.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from vio.filters.navigation import DIM, Measurement, NavState, TwistMotion
from vio.filters.prior import factor, fit, posterior
from vio.filters.settings import MsckfSettings
from vio.filters.window import Window
from vio.filters.window_posterior import move_covariance
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, transform_points

STEP_NS = 50_000_000
LANDMARKS = np.array([[4.0, 1.0, 0.5], [6.0, -2.0, 1.0]])


def _window(clones: int = 4) -> Window:
    """A turning body with clones, two landmarks, and correlations between all of them."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(DIM, DIM)) * 0.05
    nav = NavState(
        se3_exp([1.0, -2, 0.5, 0.3, -0.2, 0.8]),
        np.array([8.0, 0.2, -0.1]),
        np.full(3, 0.4),
        *np.zeros((2, 3)),
    )
    window = Window(TwistMotion(MsckfSettings()), nav, root @ root.T)
    for k in range(clones):
        window.add_clone(k, k * STEP_NS)
        if k == clones - 2:
            A = rng.normal(size=(6, len(window.prior.P))) * 0.3
            window.add_landmarks(np.array([3, 8]), LANDMARKS, A, np.array([np.eye(3) * 1e-3] * 2))
        if k < clones - 1:
            window.propagate(window.motion.advance(window.nav, k * STEP_NS, (k + 1) * STEP_NS))
    return window


def _symmetric_and_positive(P: FloatArray) -> bool:
    return bool(np.abs(P - P.T).max() < 1e-12 and np.linalg.eigvalsh(P).min() > -1e-9)


def test_every_change_keeps_the_covariance_symmetric_and_positive() -> None:
    window, rng = _window(), np.random.default_rng(1)
    assert _symmetric_and_positive(window.prior.P)
    H = rng.normal(size=(20, len(window.prior.P)))
    window.absorb(H.T @ H, H.T @ rng.normal(size=20))
    assert _symmetric_and_positive(window.prior.P)
    window.inflate_process_noise(np.eye(DIM) * 1e-4)
    assert _symmetric_and_positive(window.prior.P)
    window.keep_landmarks(np.array([False, True]))
    window.drop_oldest_clone()
    assert _symmetric_and_positive(window.prior.P)
    assert len(window.prior.P) == DIM + 18 + 3 == len(window.prior.delta)


def test_a_landmark_whose_error_is_its_anchors_moves_with_it() -> None:
    """Both errors are of one kind: the newest camera sees the landmark where it did, also after
    a large move.
    """
    window = _window()
    before = transform_points(se3_inverse(window.clones[-1].T_world_imu), LANDMARKS)
    error = np.zeros(len(window.prior.P))
    move = np.array([0.7, -0.4, 0.2, 0.5, -0.3, 0.9])
    error[window.state.clone(3)] = move
    error[window.state.landmarks.start :] = np.tile(move[:3], 2)
    window.relinearise(error)
    np.testing.assert_allclose(
        window.clones[3].T_world_imu, se3_exp(move) @ _window().clones[3].T_world_imu
    )
    after = transform_points(se3_inverse(window.clones[-1].T_world_imu), window.landmarks)
    np.testing.assert_allclose(after, before, atol=1e-12)


def test_widening_the_last_step_is_the_same_as_having_known_it_less() -> None:
    early, late = _window(), _window()
    extra = np.diag(np.linspace(1e-4, 2e-3, DIM))
    step = early.motion.advance(early.nav, 3 * STEP_NS, 4 * STEP_NS)
    early.propagate(replace(step, Q=step.Q + extra))
    early.add_clone(4, 4 * STEP_NS)
    late.propagate(step)
    late.add_clone(4, 4 * STEP_NS)
    late.inflate_process_noise(extra)
    np.testing.assert_allclose(late.prior.P, early.prior.P, atol=1e-13)


def test_covariance_of_the_last_move_counts_what_both_poses_share() -> None:
    window = _window()
    J = np.zeros((6, len(window.prior.P)))
    J[:, window.state.clone(3)], J[:, window.state.clone(2)] = np.eye(6), -np.eye(6)
    prior = fit(factor(window.prior.P), np.zeros_like(window.prior.P))
    np.testing.assert_allclose(
        move_covariance(window, 2, prior), J @ window.prior.P @ J.T, atol=1e-12
    )
    for index in (2, -2):
        move = window.camera_move_since(index)
        np.testing.assert_allclose(
            window.clones[2].T_world_imu @ move, window.clones[3].T_world_imu, atol=1e-12
        )
    assert not move_covariance(window, 3, prior).any()
    np.testing.assert_allclose(window.camera_move_since(3), np.eye(4), atol=1e-12)


def test_new_landmarks_are_correlated_with_what_made_them() -> None:
    window = _window()
    D = len(window.prior.P)
    A, noise = np.random.default_rng(2).normal(size=(3, D)), np.diag([1e-3, 2e-3, 3e-3])
    J = np.concatenate([np.eye(D), A])
    expected = J @ window.prior.P @ J.T
    expected[D:, D:] += noise
    window.prior.delta = np.linspace(-1, 1, D)
    window.add_landmarks(np.array([9]), np.array([[1.0, 2.0, 3.0]]), A, noise[None])
    np.testing.assert_allclose(window.prior.P, expected, atol=1e-12)
    np.testing.assert_allclose(window.prior.delta, J @ np.linspace(-1, 1, D), atol=1e-12)
    assert window.landmark_ids.tolist() == [3, 8, 9]


def test_what_is_forgotten_leaves_the_rest_as_it_was() -> None:
    window, whole = _window(), _window()
    window.drop_oldest_clone()
    window.keep_landmarks(np.array([False, True]))
    kept = np.r_[0:DIM, DIM + 6 : DIM + 24, DIM + 27 : DIM + 30]
    np.testing.assert_array_equal(window.prior.P, whole.prior.P[np.ix_(kept, kept)])
    assert window.clones.frame_indices.tolist() == [1, 2, 3]
    np.testing.assert_array_equal(window.landmarks, LANDMARKS[1:])
    window.keep_landmarks(np.array([True]))
    assert window.landmark_ids.tolist() == [8]


def test_a_measurement_is_a_kalman_update_of_all_that_is_correlated() -> None:
    window, rng = _window(), np.random.default_rng(3)
    told = Measurement(rng.normal(size=(4, DIM)), rng.normal(size=4), np.diag([0.1, 0.2, 0.3, 0.4]))
    H = np.zeros((4, len(window.prior.P)))
    H[:, :DIM] = told.H
    K = window.prior.P @ H.T @ np.linalg.inv(H @ window.prior.P @ H.T + told.R)
    expected, shift = (np.eye(len(window.prior.P)) - K @ H) @ window.prior.P, K @ told.residual
    moved = copy.deepcopy(window)
    moved.measure(told)
    np.testing.assert_allclose(moved.prior.P, expected, atol=1e-9)
    np.testing.assert_allclose(moved.prior.delta, 0.0, atol=1e-12)
    np.testing.assert_allclose(
        moved.clones[0].T_world_imu, se3_exp(shift[DIM : DIM + 6]) @ window.clones[0].T_world_imu
    )
    window.absorb_measurement(told)
    np.testing.assert_allclose(window.prior.delta, -shift, atol=1e-9)
    np.testing.assert_array_equal(window.clones[0].T_world_imu, _window().clones[0].T_world_imu)


def test_posterior_of_a_prior_with_a_negative_eigenvalue_by_rounding_is_still_one() -> None:
    """Cholesky's factors do not exist then; what is known for sure stays known."""
    known = np.diag([1.0, 4.0, 0.0])
    known[2, 2] = -1e-20
    P, shift = posterior(known, np.diag([1.0, 0.0, 1e6]), np.array([1.0, 1.0, 1e6]))
    np.testing.assert_allclose(P, np.diag([0.5, 4.0, 0.0]), atol=1e-12)
    np.testing.assert_allclose(shift, [0.5, 4.0, 0.0], atol=1e-12)


def test_fit_by_factors_equals_the_dense_covariance() -> None:
    rng = np.random.default_rng(2)
    root, J, b = rng.normal(size=(9, 9)), rng.normal(size=(2, 3, 9)), rng.normal(size=9)
    H = rng.normal(size=(5, 9))
    # the second one is no covariance
    for prior in (root @ root.T, root[:, :6] @ root[:, :6].T - 1e-9 * np.eye(9)):
        fitted = fit(factor(prior), H.T @ H)
        P_new, shift = posterior(prior, H.T @ H, b)
        np.testing.assert_allclose(fitted.covariance(), P_new, atol=1e-12)
        np.testing.assert_allclose(fitted.move(b), shift, atol=1e-9)
        S = fitted.whitened(J @ fitted.prior.L)
        np.testing.assert_allclose(
            S @ np.swapaxes(S, 1, 2), J @ P_new @ np.swapaxes(J, 1, 2), atol=1e-9
        )


@pytest.mark.parametrize("about_all", [False, True])
def test_a_fit_of_some_errors_equals_the_one_of_all(about_all: bool) -> None:
    """Of pixels, which navigation state and calibration follow by their correlation, and of
    everything.
    """
    window, rng = _window(), np.random.default_rng(5)
    D = len(window.prior.P)
    root = rng.normal(size=(D, D))
    window.prior.P, window.prior.delta = root @ root.T, rng.normal(size=D)
    H, r = rng.normal(size=(20, D)), rng.normal(size=20)
    if not about_all:
        H[:, : window.state.clones.start] = 0.0
    for size in (window.state.landmarks.start, D):
        A, b = np.zeros((D, D)), np.zeros(D)
        A[:size, :size], b[:size] = H[:, :size].T @ H[:, :size], H[:, :size].T @ r
        P, shift = posterior(window.prior.P, A, b + A @ window.prior.delta)
        fitted, error = window.optimum(A, b, size)
        assert fitted.prior.first == (0 if about_all else window.state.clones.start)
        np.testing.assert_allclose(error, shift - window.prior.delta, atol=1e-8)
        np.testing.assert_allclose(fitted.covariance(), P[:size, :size], atol=1e-8)
    delta = window.prior.delta
    window.absorb(A, b)
    np.testing.assert_allclose(window.prior.P, P, atol=1e-8)
    np.testing.assert_allclose(window.prior.delta, delta - shift, atol=1e-8)


def test_changes_in_place_are_seen_by_the_next_fit() -> None:
    window = _window()
    for change in (
        lambda: window.propagate(window.motion.advance(window.nav, 3 * STEP_NS, 4 * STEP_NS)),
        lambda: window.add_clone(4, 4 * STEP_NS),
        window.drop_oldest_clone,
    ):
        change()
        nothing = np.zeros_like(window.prior.P)
        fitted, _ = window.optimum(nothing, np.zeros(len(nothing)), len(nothing))
        np.testing.assert_allclose(fitted.covariance(), window.prior.P, atol=1e-11)
