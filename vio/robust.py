"""Spreads that a few gross errors leave alone, and standard errors that count errors which last."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray

_MEDIAN_TO_SIGMA = 1.4826  # standard deviation of a normal distribution over the median of its sizes


def robust_sigma(values: npt.ArrayLike) -> float:
    """Standard deviation of values around zero, by the median of their sizes."""
    return _MEDIAN_TO_SIGMA * float(np.median(np.abs(values)))


def jackknife(values: npt.ArrayLike) -> FloatArray:
    """Standard errors (...) of an estimate from its values (n, ...) with one block of the data left out of each.

    Blocks that are longer than the errors last make the result count errors that are not independent.
    Reference: Tukey (1958), after Quenouille.
    """
    again = np.asarray(values, dtype=np.float64)
    out: FloatArray = np.sqrt((len(again) - 1) * np.mean((again - again.mean(axis=0)) ** 2, axis=0))
    return out
