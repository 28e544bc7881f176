"""The gate of landmarks: predictions without their own pixels, and a running sum for what moves
slowly.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from vio.filters.landmark_gate import LandmarkGate, leave_one_out_nis
from vio.geometry.lie import FloatArray


def _case(seed: int, stereo: bool) -> tuple[FloatArray, FloatArray]:
    """Jacobian (4, 3) of a point's pixels, and the point's covariance (3, 3) by everything else."""
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(4, 3)) * 100
    J[3] = 0.0
    if not stereo:
        J[2] = 0.0
    root = rng.normal(size=(3, 3)) * 0.01
    return J, root @ root.T


@pytest.mark.parametrize("stereo", [True, False])
@pytest.mark.parametrize("weight", [1.0, 0.3])
def test_residuals_after_the_fit_give_the_prediction_without_them(
    stereo: bool, weight: float
) -> None:
    """Predict, then update by Kalman's equations; from what is left, find the innovation and its
    covariance again.
    """
    variance = 0.25
    for seed in range(5):
        J, prior = _case(seed, stereo)
        seen = np.any(J, axis=1)
        innovation = np.random.default_rng(seed + 50).normal(0, 2, 4) * seen
        R = np.eye(4) * variance / weight  # as it entered the fit
        K = prior @ J.T @ np.linalg.inv(J @ prior @ J.T + R)
        r, C = innovation - J @ K @ innovation, (np.eye(3) - K @ J) @ prior
        S = (J @ prior @ J.T + np.eye(4) * variance)[np.ix_(seen, seen)]
        expected = innovation[seen] @ np.linalg.solve(S, innovation[seen])
        nis = leave_one_out_nis(r[None], J[None], C[None], np.array([weight]), variance)
        np.testing.assert_allclose(nis, expected, rtol=1e-6)


def test_a_covariance_that_noise_estimated_since_contradicts_stays_finite() -> None:
    J, prior = _case(0, True)
    nis = leave_one_out_nis(np.full((1, 4), 0.5), J[None], 1e3 * prior[None], np.ones(1), 0.25)
    assert np.isfinite(nis).all()
    assert (nis >= 0).all()


def test_single_frames_are_gated_by_their_degrees_of_freedom() -> None:
    gate, ids, dof = LandmarkGate(0.99), np.arange(4), np.array([2, 2, 3, 3])
    limits = chi2.ppf(0.99, dof)
    used, dropped = gate.check(ids, limits * [0.999, 1.001, 0.999, 1.001], dof)
    assert used.tolist() == [True, False, True, False]
    assert not dropped.any()


def test_what_fails_a_little_in_every_frame_is_dropped() -> None:
    """A slow mover passes the test of each frame; its sum does not. One that is right is kept."""
    gate, rng, ids = LandmarkGate(0.99), np.random.default_rng(0), np.array([7, 3])
    gone = None
    for k in range(40):
        used, dropped = gate.check(
            ids, np.array([10.5, min(rng.chisquare(3), 11.0)]), np.array([3, 3])
        )
        assert used[1] == (not dropped[1])
        if dropped[0]:
            assert not used[0]
            gone = k
            break
        assert used[0]
    assert gone <= 8
    assert not dropped[1]


def test_a_right_landmark_is_seldom_dropped() -> None:
    """Squared innovations drawn from chi-square: of 1000 landmarks in 30 frames, fewer than one
    in 2000 tests drops.
    """
    gate, rng, drops = LandmarkGate(0.99), np.random.default_rng(1), 0
    ids, dof = np.arange(1000), np.full(1000, 3)
    for _ in range(30):
        drops += int(gate.check(ids, rng.chisquare(3, 1000), dof)[1].sum())
    assert drops < 15


def test_a_dropped_or_unseen_landmark_is_forgotten() -> None:
    gate, dof = LandmarkGate(0.99), np.array([3])
    assert gate.check(np.array([5]), np.array([100.0]), dof)[1].tolist() == [True]
    # a new one under its id
    assert gate.check(np.array([5]), np.array([3.0]), dof)[1].tolist() == [False]
    gate.check(np.array([6]), np.array([10.0]), dof)
    assert gate._score.keys() == {6}
