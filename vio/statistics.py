"""Chi-square quantiles for gates and consistency tests."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincinv

from vio.geometry.lie import FloatArray


def chi_square_quantile(probability: npt.ArrayLike, dof: npt.ArrayLike) -> FloatArray:
    """Compute the chi-square quantile (...) at a probability (...) for `dof` degrees of freedom (...).

    Twice the quantile of the gamma distribution of shape `dof / 2`, equal to `scipy.stats.chi2.ppf`, without the slow
    import of `scipy.stats`.
    """
    quantile: FloatArray = 2 * np.asarray(gammaincinv(np.asarray(dof) / 2, probability))
    return quantile
