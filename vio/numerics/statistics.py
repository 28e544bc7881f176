"""Chi-square quantiles and probabilities for gates and consistency tests."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from vio.numerics.arrays import FloatArray
from vio.numerics.compiled import solve_positive
from vio.numerics.scipy_extensions import special


def chi_square_quantile(probability: npt.ArrayLike, dof: npt.ArrayLike) -> FloatArray:
    """Compute the chi-square quantile (...) at a probability (...) for `dof` degrees of freedom
    (...).

    Twice the quantile of the gamma distribution of shape `dof / 2`, equal to
    `scipy.stats.chi2.ppf`, without the slow import of `scipy.stats`.
    """
    quantile: FloatArray = 2 * np.asarray(special.gammaincinv(np.asarray(dof) / 2, probability))
    return quantile


def chi_square_cdf(x: float, dof: int) -> float:
    """Probability that a chi-square variable of `dof` degrees of freedom is below x."""
    return float(special.gammainc(0.5 * dof, 0.5 * x))


def squared_distance(error: FloatArray, covariance: FloatArray, least: float) -> float:
    """Squared length of an error (n,) over its covariance (n, n): NaN where that is not positive.

    Args:
        error: the error.
        covariance: its covariance.
        least: is added to all variances, for directions in which the error is known exactly.
    """
    A = covariance.copy()
    A.reshape(-1)[:: len(A) + 1] += least
    along = error.copy()
    solve_positive(A, along)
    return float(error @ along)
