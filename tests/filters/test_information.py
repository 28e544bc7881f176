"""Information of features on a motion, and the greedy choice among them, against independent
derivations.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vio.geometry.lie import FloatArray, se3_exp, transform_points
from vio.geometry.stereo import StereoCamera, p_cam_D_z, project, z_D_p_cam
from vio.records import MotionPrior, observations
from vio.selection.information import (
    MotionInformation,
    lazy_greedy,
    log_det_gain,
    motion_rows,
    prior_information,
    row_weights,
)

CAMERA = StereoCamera(430.0, 440.0, 364.0, 254.0, 0.11, 752, 480)
BROAD = prior_information(None)


def _points(n: int, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1, 20, n)
    return np.stack(
        [rng.uniform(-0.8, 0.8, n) * depth, rng.uniform(-0.5, 0.5, n) * depth, depth], axis=1
    )


def _factors(n: int, motions: int, seed: int) -> FloatArray:
    rng = np.random.default_rng((seed, 1))
    weight = row_weights(rng.integers(0, 6, (n, motions)), rng.random((n, motions)) < 0.8)
    rows = motion_rows(CAMERA, np.repeat(_points(n, seed)[:, None], motions, axis=1))
    return rows * np.sqrt(weight)[..., None] / 0.5


def _gain(prior: FloatArray, L: FloatArray, rows: list[int]) -> float:
    """The same quantity by dense sums of 6 x 6 matrices."""
    total = 0.0
    for k in range(len(prior)):
        after = prior[k] + sum((L[i, k].T @ L[i, k] for i in rows), np.zeros((6, 6)))
        total += 0.5 * (np.linalg.slogdet(after)[1] - np.linalg.slogdet(prior[k])[1])
    return total


def _plain_greedy(prior: FloatArray, L: FloatArray, ids: FloatArray, budget: int) -> list[int]:
    """Evaluate every candidate in every round."""
    chosen: list[int] = []
    while len(chosen) < budget:
        base = _gain(prior, L, chosen)
        gains = {i: _gain(prior, L, [*chosen, i]) - base for i in range(len(L)) if i not in chosen}
        best = max(gains.values(), default=0.0)
        if best <= 1e-12:
            break
        chosen.append(
            min((i for i, g in gains.items() if g >= best * (1 - 1e-9)), key=lambda i: ids[i])
        )
    return chosen


def test_motion_rows_are_the_derivative_of_the_pixels() -> None:
    p, step = _points(20, 0), 1e-6
    numeric = np.zeros((20, 3, 6))
    for j in range(6):
        xi = np.zeros(6)
        xi[j] = step
        z = [project(CAMERA, transform_points(se3_exp(sign * xi), p)) for sign in (1, -1)]
        numeric[..., j] = ((z[0] - z[1]) / (2 * step))[:, :3]
    numeric[:, 1] *= np.sqrt(2)
    np.testing.assert_allclose(motion_rows(CAMERA, p), numeric, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("right", [True, False])
@pytest.mark.parametrize("n", [1, 2, 7])
def test_information_is_that_of_pixels_and_an_uncertain_point(n: int, right: bool) -> None:
    """`H' S^-1 H` in full: S is pixel noise plus the covariance of a point triangulated from n
    stereo sightings.
    """
    sigma2 = 0.25
    for p in _points(10, n):
        J = z_D_p_cam(CAMERA, p)
        triangulation = p_cam_D_z(CAMERA, project(CAMERA, p))
        point = sigma2 * triangulation @ triangulation.T / n
        seen = slice(None) if right else slice(0, 2)
        H = (J @ np.concatenate([np.eye(3), -_hat(p)], axis=1))[seen]
        S = sigma2 * np.eye(len(H)) + J[seen] @ point @ J[seen].T
        rows = motion_rows(CAMERA, p) * np.sqrt(row_weights(n, np.array(right)))[:, None]
        np.testing.assert_allclose(
            rows.T @ rows / sigma2, H.T @ np.linalg.solve(S, H), rtol=1e-9, atol=1e-6
        )


def _hat(p: FloatArray) -> FloatArray:
    return np.array([[0, -p[2], p[1]], [p[2], 0, -p[0]], [-p[1], p[0], 0]])


def test_a_new_point_has_no_information_on_the_last_motion() -> None:
    assert not row_weights(np.zeros(2), np.array([True, False])).any()


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 40),
    budget=st.integers(1, 12),
    motions=st.integers(1, 4),
    seed=st.integers(0, 10**6),
    strength=st.floats(-2, 8),
)
def test_lazy_greedy_is_plain_greedy(
    n: int, budget: int, motions: int, seed: int, strength: float
) -> None:
    L, prior = _factors(n, motions, seed), np.repeat(10.0**strength * BROAD[None], motions, axis=0)
    ids = np.random.default_rng(seed).permutation(n)
    found = lazy_greedy(prior, L, ids, budget)
    assert found.order.tolist() == _plain_greedy(prior, L, ids, budget)
    chosen = found.order.tolist()
    assert np.sum(found.gain[chosen]) == pytest.approx(_gain(prior, L, chosen), rel=1e-8, abs=1e-9)
    assert log_det_gain(prior, L[chosen]) == pytest.approx(
        _gain(prior, L, chosen), rel=1e-8, abs=1e-9
    )
    for left in set(range(n)) - set(chosen):  # the gains of the others are upper bounds
        assert (
            found.gain[left]
            >= (_gain(prior, L, [*chosen, left]) - _gain(prior, L, chosen)) * (1 - 1e-9) - 1e-9
        )


@settings(max_examples=15, deadline=None)
@given(n=st.integers(2, 10), budget=st.integers(1, 4), seed=st.integers(0, 10**6))
def test_greedy_is_close_to_the_best_of_all_subsets(n: int, budget: int, seed: int) -> None:
    L, prior = _factors(n, 2, seed), np.repeat(1e3 * BROAD[None], 2, axis=0)
    order = lazy_greedy(prior, L, np.arange(n), budget).order.tolist()
    best = max(_gain(prior, L, list(rows)) for rows in combinations(range(n), min(budget, n)))
    assert (1 - 1 / np.e) * best <= _gain(prior, L, order) * (1 + 1e-9)
    assert _gain(prior, L, order) <= best * (1 + 1e-9)


def test_ties_go_to_the_smaller_id_in_any_order() -> None:
    L = np.repeat(_factors(1, 2, 3), 30, axis=0)
    prior = np.repeat(BROAD[None], 2, axis=0)
    ids = np.random.default_rng(0).permutation(30)
    found = lazy_greedy(prior, L, ids, 7)
    assert ids[found.order].tolist() == list(range(7))


def test_features_without_information_are_not_chosen() -> None:
    L = _factors(10, 1, 6)
    L[4:] = 0.0
    found = lazy_greedy(BROAD[None], L, np.arange(10), 8)
    assert set(found.order.tolist()) <= {0, 1, 2, 3}


def test_prior_of_a_motion_known_exactly_can_be_inverted() -> None:
    motion = MotionPrior(np.eye(4), np.zeros((6, 6)))
    assert np.isfinite(np.linalg.slogdet(prior_information(motion))[1])


@pytest.mark.parametrize(("sigma_rad", "consistent"), [(1e-4, False), (1e-1, True)])
def test_a_feature_off_the_predicted_motion_has_less_weight(
    sigma_rad: float, consistent: bool
) -> None:
    """A feature ten pixels off its prediction has almost no weight, unless the motion is that
    uncertain.
    """
    z = project(CAMERA, _points(2, 11))
    beside = z + np.array([[0.0, 0.0, 0.0, 0.0], [10.0, 0.0, 10.0, 0.0]])
    model = MotionInformation(CAMERA, 4, 0.5)
    motion = MotionPrior(np.eye(4), np.diag([1e-8] * 3 + [sigma_rad**2] * 3))
    model.add_frame(observations(0, 0, [0, 1], z), motion)
    model.mark_used(observations(0, 0, [0, 1], z), np.ones(2, dtype=np.bool_))
    L = model.add_frame(observations(1, 1, [0, 1], beside), motion)
    strength = np.sum(L[:, 0] ** 2, axis=(1, 2))
    alike = MotionInformation(CAMERA, 4, 0.5)
    alike.add_frame(observations(0, 0, [0, 1], z), None)
    alike.mark_used(observations(0, 0, [0, 1], z), np.ones(2, dtype=np.bool_))
    without = np.sum(
        alike.add_frame(observations(1, 1, [0, 1], beside), None)[:, 0] ** 2, axis=(1, 2)
    )
    ratio = strength / without
    assert ratio[0] == pytest.approx(1.0, abs=1e-9)
    assert ratio[1] > 0.9 if consistent else ratio[1] < 0.1


def test_only_used_observations_count() -> None:
    """A feature that was not used has as little information on the last motion as a new one."""
    z = project(CAMERA, _points(2, 12))
    model = MotionInformation(CAMERA, 4, 0.5)
    for k in range(3):
        L = model.add_frame(observations(k, k, [0, 1], z), None)
        assert not L[1, 0].any()
        assert L[0, 0].any() == (k > 0)
        assert L[:, 1].any(axis=(1, 2)).all()
        model.mark_used(observations(k, k, [0, 1], z), np.array([True, False]))


def test_future_information_is_weighted_by_survival_of_the_age_group() -> None:
    """One feature lives for eight frames; in every frame a new one appears that is not observed
    again.
    """
    z, model = (
        np.repeat(project(CAMERA, _points(1, 13)), 2, axis=0),
        MotionInformation(CAMERA, 3, 0.5),
    )
    for k in range(8):
        L = model.add_frame(observations(k, k, [0, 100 + k], z), None)
    # The prior survival is nine of ten; of the new features, only the first survived, and seven did
    # not.
    old, new = 9 / 10, (9 + 1) / (10 + 1 + 7)
    strength = np.sum(L**2, axis=(2, 3))
    np.testing.assert_allclose(strength[0, 1] / strength[1, 1], old / new)  # the next frame
    np.testing.assert_allclose(strength[0, 2] / strength[1, 2], (old / new) ** 3)  # the horizon
