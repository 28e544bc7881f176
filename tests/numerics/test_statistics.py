"""Chi-square quantiles against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from vio.numerics.statistics import chi_square_quantile


@pytest.mark.parametrize("probability", [1e-6, 0.025, 0.5, 0.95, 0.9999])
def test_quantiles_are_those_of_scipy(probability: float) -> None:
    dof = np.arange(1, 400)
    assert np.allclose(
        chi_square_quantile(probability, dof), stats.chi2.ppf(probability, dof), rtol=1e-12
    )


def test_the_quantile_of_two_degrees_is_closed() -> None:
    probability = np.array([0.1, 0.5, 0.99])
    assert np.allclose(chi_square_quantile(probability, 2), -2 * np.log1p(-probability), rtol=1e-12)
