"""Marginals of sparse normal equations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csc_matrix, csr_matrix, eye, kron, random

from vio.geometry.lie import se3_exp, se3_inverse, se3_log
from vio.geometry.relative_pose import RelativePose
from vio.mapping.pose_graph import Edges, UpDirections, marginals, optimise
from vio.numerics import sparse


def test_marginals_are_blocks_of_the_inverse() -> None:
    rng = np.random.default_rng(0)
    J, D = rng.normal(size=(400, 210)), rng.normal(size=(3 * 70, 210))
    H = J.T @ J
    expected = D @ np.linalg.inv(H) @ D.T
    found = sparse.marginals(csc_matrix(H), csr_matrix(D), 3)
    assert found.shape == (70, 3, 3)
    for k in range(70):
        np.testing.assert_allclose(
            found[k], expected[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], rtol=1e-8, atol=1e-10
        )


def test_a_large_matrix_that_is_ordered_by_its_blocks_has_the_same_solution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(2)
    J = kron(random(80, 40, 0.05, rng=rng) + eye(80, 40), np.ones((6, 6))).tocsr()
    J.data *= rng.normal(size=len(J.data))
    # the last block is a part of one
    H, b = (J.T @ J + eye(240)).tocsc()[:239, :239], rng.normal(size=(239, 3))
    plain = sparse.factors(H, 6)(b)
    monkeypatch.setattr("vio.numerics.sparse._LARGE", 200)
    np.testing.assert_allclose(sparse.factors(H, 6)(b), plain, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(H @ sparse.factors(H, 6)(b[:, 0]), b[:, 0], atol=1e-9)


def test_errors_of_a_graph_are_as_large_as_its_covariance_says() -> None:
    rng = np.random.default_rng(1)
    truth = [np.eye(4)]
    for _ in range(11):
        truth.append(truth[-1] @ se3_exp(np.array([0.5, 0.0, 0.1, 0.0, 0.3, 0.1])))
    T, pairs = np.array(truth), [*((k, k + 1) for k in range(11)), (0, 9), (2, 11)]
    sigma = np.repeat([0.02, 0.01], 3)
    none = UpDirections(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros(0))
    fixed, values = np.arange(12) == 0, []
    for _ in range(60):
        rows = [
            (
                i,
                j,
                RelativePose(
                    se3_inverse(T[i]) @ T[j] @ se3_exp(sigma * rng.normal(size=6)),
                    np.diag(sigma**2),
                ),
            )
            for i, j in pairs
        ]
        edges = Edges.of(rows[:11]), Edges.of(rows[11:])
        best = optimise(T, *edges, none, fixed).T_map_cam
        chosen = np.array([6, 11])
        P = marginals(best, *edges, none, fixed, chosen)
        e = se3_log(se3_inverse(T[chosen]) @ best[chosen])
        values.append(np.einsum("ki,ki->k", e, np.linalg.solve(P, e[:, :, None])[:, :, 0]))
    # of 60 chi-squares: 6 ± 0.45
    np.testing.assert_allclose(np.mean(values, axis=0), 6.0, atol=1.5)
