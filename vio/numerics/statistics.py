"""Chi-square quantiles and probabilities for gates and consistency tests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray

_NUMPY_TOOLS = {"f2py", "testing", "test"}  # to build and to test packages


@contextmanager
def _without_numpy_tools() -> Iterator[None]:
    """Hide NumPy's tools, which SciPy would load as it copies NumPy's names: a third of its time and memory."""
    names, listed = np.__all__, np.__dir__
    np.__all__ = [name for name in names if name not in _NUMPY_TOOLS]
    np.__dir__ = lambda: [name for name in listed() if name not in _NUMPY_TOOLS]  # type: ignore[method-assign]
    try:
        yield
    finally:
        np.__all__, np.__dir__ = names, listed  # type: ignore[method-assign]


with _without_numpy_tools():
    from scipy.special import gammainc, gammaincinv


def chi_square_quantile(probability: npt.ArrayLike, dof: npt.ArrayLike) -> FloatArray:
    """Compute the chi-square quantile (...) at a probability (...) for `dof` degrees of freedom (...).

    Twice the quantile of the gamma distribution of shape `dof / 2`, equal to `scipy.stats.chi2.ppf`, without the slow
    import of `scipy.stats`.
    """
    quantile: FloatArray = 2 * np.asarray(gammaincinv(np.asarray(dof) / 2, probability))
    return quantile


def chi_square_cdf(x: float, dof: int) -> float:
    """Probability that a chi-square variable of `dof` degrees of freedom is below x."""
    return float(gammainc(0.5 * dof, 0.5 * x))
