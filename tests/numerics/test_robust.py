"""Robust standard deviation and jackknife against known values."""

from __future__ import annotations

import numpy as np
import pytest

from vio.numerics.robust import (
    cauchy_equations,
    cauchy_fit,
    fits_without_blocks,
    jackknife,
    median,
    quantile,
    robust_sigma,
    robust_sigmas,
)


@pytest.mark.parametrize("count", [1, 2, 3, 100, 101])
def test_the_median_is_numpys_to_the_bit(count: int) -> None:
    rng = np.random.default_rng(count)
    for values in (
        rng.standard_normal(count),
        np.round(rng.standard_normal(count)),
        rng.standard_normal((count, 2)),
    ):
        assert median(values) == np.median(values)
        values.flat[0] = np.nan
        assert np.isnan(median(values))
    assert np.isnan(median([]))
    assert median([3, 1, 2]) == 2.0


def test_the_jackknife_of_a_mean_is_its_standard_error() -> None:
    values = np.random.default_rng(0).standard_normal((40, 3)) * [1.0, 2.0, 5.0]
    again = [np.delete(values, k, axis=0).mean(axis=0) for k in range(40)]
    np.testing.assert_allclose(
        jackknife(again), values.std(axis=0, ddof=1) / np.sqrt(40), rtol=1e-12
    )
    assert float(jackknife([a[0] for a in again])) == pytest.approx(
        float(jackknife(again)[0]), rel=1e-12
    )


def test_jackknife_accounts_for_correlation_within_blocks() -> None:
    rng = np.random.default_rng(1)
    lasting = np.repeat(rng.standard_normal(200), 10)  # 200 independent values, each seen ten times
    single = [np.delete(lasting, k).mean() for k in range(0, 2000, 10)]
    blocks = [np.setdiff1d(np.arange(2000), block) for block in np.array_split(np.arange(2000), 20)]
    by_blocks = float(jackknife([lasting[kept].mean() for kept in blocks]))
    assert by_blocks == pytest.approx(1 / np.sqrt(200), rel=0.5)
    assert float(jackknife(single)) < 0.5 * by_blocks


def test_robust_sigma_ignores_outliers() -> None:
    values = 3 * np.random.default_rng(2).standard_normal(20_000)
    assert robust_sigma(values) == pytest.approx(3.0, rel=0.03)
    values[:3000] = 1e6
    assert robust_sigma(values) == pytest.approx(3.0, rel=0.3)


@pytest.mark.parametrize("count", [1, 2, 3, 10, 101])
def test_quantiles_are_numpys_to_the_bit(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    for share in (0.0, 0.02, 0.37, 0.5, 0.7, 0.95, 1.0):
        assert quantile(values, share) == np.quantile(values, share)


@pytest.mark.parametrize("count", [1, 2, 7, 200])
def test_sigmas_of_columns_are_those_of_each(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, 6))
    values[0, 1] = np.nan
    expected = [robust_sigma(column) for column in values.T]
    assert np.array_equal(robust_sigmas(values), expected, equal_nan=True)


def test_equations_with_cauchys_weights_are_those_of_weighted_least_squares() -> None:
    rng = np.random.default_rng(4)
    r = rng.normal(0.0, 0.5, (40, 3))
    J = rng.normal(0.0, 1.0, (40, 3, 5))
    squared = (r**2).sum(axis=1)
    W = np.diag((1.0 / (1.0 + squared / np.median(squared))).repeat(3))
    equations = cauchy_equations(r, J, 0.1)
    np.testing.assert_allclose(equations.matrix, J.reshape(-1, 5).T @ W @ J.reshape(-1, 5))
    np.testing.assert_allclose(equations.vector, J.reshape(-1, 5).T @ W @ r.reshape(-1))
    np.testing.assert_allclose(
        equations.variance, np.sum(W.diagonal() * r.reshape(-1) ** 2) / W.trace()
    )


def test_equations_with_cauchys_weights_nearly_leave_out_what_is_far_off() -> None:
    rng = np.random.default_rng(5)
    J = rng.normal(0.0, 1.0, (200, 2, 3))
    true = np.array([1.0, -2.0, 0.5])
    x = np.zeros(3)
    values = J @ true + rng.normal(0.0, 0.01, (200, 2))
    values[:40] += 30.0
    for _ in range(20):
        A, b, variance = cauchy_equations(values - J @ x, J, 0.01)
        x = x + np.linalg.solve(A, b)
    np.testing.assert_allclose(x, true, atol=0.005)
    assert 0.005 < np.sqrt(variance) < 0.02


def test_cauchys_weights_are_no_narrower_than_stated() -> None:
    r = np.full((10, 1), 1e-6)
    r[0] = 0.3
    J = np.ones((10, 1, 1))
    np.testing.assert_allclose(cauchy_equations(r, J, 0.3).vector[0], 0.3 / 2 + 9e-6, rtol=1e-6)


def test_fits_without_blocks_are_those_to_the_other_values() -> None:
    rng = np.random.default_rng(4)
    terms = rng.normal(size=(60, 3))
    values = terms @ [1.0, -2.0, 0.5] + 0.1 * rng.normal(size=60)
    values[:5] += 3.0
    block = rng.integers(3, 7, 60)
    least = 0.2  # wider than the median, so that the widths are the same
    whole = cauchy_fit(terms, values, np.zeros(3), least, 20)
    found = fits_without_blocks(terms, values, whole, block, least, 20)
    for coefficients, left_out in zip(found, np.unique(block), strict=True):
        rest = block != left_out
        expected = cauchy_fit(terms[rest], values[rest], whole, least, 20)
        assert coefficients == pytest.approx(expected, abs=1e-7)
