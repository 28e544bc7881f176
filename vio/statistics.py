"""Quantiles of chi-square: the bounds of gates and of consistency tests."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincinv

from vio.geometry.lie import FloatArray


def chi_square_quantile(probability: npt.ArrayLike, dof: npt.ArrayLike) -> FloatArray:
    """Value (...) that chi-square with `dof` degrees of freedom (...) stays below with this probability (...).

    Twice the quantile of the gamma distribution of shape `dof / 2`, as `scipy.stats.chi2.ppf` has it; but importing
    `scipy.stats` takes longer than importing all else that a run needs.
    """
    quantile: FloatArray = 2 * np.asarray(gammaincinv(np.asarray(dof) / 2, probability))
    return quantile
