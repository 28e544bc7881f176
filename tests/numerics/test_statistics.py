"""Chi-square quantiles against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from vio.numerics.statistics import chi_square_quantile, squared_distance


@pytest.mark.parametrize("probability", [1e-6, 0.025, 0.5, 0.95, 0.9999])
def test_quantiles_are_those_of_scipy(probability: float) -> None:
    dof = np.arange(1, 400)
    assert np.allclose(
        chi_square_quantile(probability, dof), stats.chi2.ppf(probability, dof), rtol=1e-12
    )


def test_the_quantile_of_two_degrees_is_closed() -> None:
    probability = np.array([0.1, 0.5, 0.99])
    assert np.allclose(chi_square_quantile(probability, 2), -2 * np.log1p(-probability), rtol=1e-12)


def test_a_squared_distance_is_that_over_the_covariance_with_its_least_variance() -> None:
    A = np.random.default_rng(0).normal(size=(6, 6))
    error = np.arange(1.0, 7.0)
    covariance = A @ A.T
    expected = error @ np.linalg.solve(covariance + 1e-3 * np.eye(6), error)
    before = covariance.copy(), error.copy()
    assert squared_distance(error, covariance, 1e-3) == pytest.approx(expected, rel=1e-9)
    np.testing.assert_array_equal(covariance, before[0])
    np.testing.assert_array_equal(error, before[1])
    assert np.isnan(squared_distance(error, -covariance, 0.0))
