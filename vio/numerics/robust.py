"""Robust standard deviations and least squares, and standard errors under correlated errors."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.numerics.arrays import FloatArray, distinct

_MEDIAN_TO_SIGMA = 1.4826  # standard deviation over median absolute value of a normal distribution
_RIDGE = 1e-9  # of what the terms of a fit do not show


def median(values: npt.ArrayLike) -> float:
    """Return the median as NumPy does, to the bit (of nothing: NaN), but for few numbers in a
    sixth of the time, and without NumPy's masked arrays, which its own loads.
    """
    ordered = np.array(values, dtype=np.float64)
    if ordered.ndim != 1:
        ordered = ordered.ravel()
    ordered.sort()  # NaN come last
    count = ordered.size
    middle = count // 2
    if not count or ordered[-1] != ordered[-1]:
        return math.nan
    return float(ordered[middle] if count % 2 else 0.5 * (ordered[middle - 1] + ordered[middle]))


def medians(values: FloatArray) -> FloatArray:
    """Return the medians (K,) of columns of values (N, K) as `median` does."""
    ordered = np.sort(values, axis=0)  # NaN come last
    middle = len(ordered) // 2
    out = ordered[middle]
    if len(ordered) % 2 == 0:
        out = 0.5 * (ordered[middle - 1] + out)
    return np.where(np.isnan(ordered[-1]), np.nan, out)


def quantile(values: npt.ArrayLike, share: float) -> float:
    """Return the quantile of some numbers, without NaN, by linear interpolation as NumPy does, to
    the bit.

    NumPy's own loads its masked arrays.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=None)
    place = share * (len(ordered) - 1)
    below = min(int(place), len(ordered) - 2)
    if below < 0:
        return float(ordered[0])
    part = place - below
    lower = float(ordered[below])
    upper = float(ordered[below + 1])
    step = upper - lower
    if part < 0.5:
        return lower + step * part
    return upper - step * (1 - part)


def robust_sigma(values: npt.ArrayLike) -> float:
    """Estimate the standard deviation of zero-mean values from the median of their absolute
    values.
    """
    return _MEDIAN_TO_SIGMA * median(np.abs(values))


def robust_sigmas(values: FloatArray) -> FloatArray:
    """Estimate the standard deviations (K,) of the columns of zero-mean values (N, K) as
    `robust_sigma` does.
    """
    out: FloatArray = _MEDIAN_TO_SIGMA * medians(np.abs(values))
    return out


class NormalEquations(NamedTuple):
    """A Gauss-Newton step of K parameters, `matrix @ step = vector`."""

    matrix: FloatArray  # (K, K)
    vector: FloatArray  # (K,)
    variance: float  # of a residual, by the weighted mean of their squares


def cauchy_equations(r: FloatArray, J: FloatArray, least: float) -> NormalEquations:
    """Weigh measurements by Cauchy's function of their size, whose width is the median one.

    Args:
        r: residuals (N, D); the D of a measurement count alike.
        J: derivatives (N, D, K) of what is fitted to them.
        least: width of a residual, at least.
    """
    squared = (r * r).sum(axis=1)
    weight = 1.0 / (1.0 + squared / max(median(squared), r.shape[1] * least**2))
    columns = J.reshape(r.size, -1)
    weighted = (J * weight[:, None, None]).reshape(columns.shape)
    variance = float((weight * squared).sum() / (r.shape[1] * weight.sum()))
    return NormalEquations(weighted.T @ columns, weighted.T @ r.reshape(-1), variance)


def cauchy_fit(
    terms: FloatArray, values: FloatArray, start: FloatArray, least: float, steps: int
) -> FloatArray:
    """The coefficients (K,) of a linear model that most values (N,) agree with, whatever the others
    are: Gauss-Newton with the weights of `cauchy_equations`.

    Args:
        terms: (N, K); what they do not show stays as it begins.
        values: (N,).
        start: (K,) to begin with.
        least: width of a residual, at least.
        steps: number of them.
    """
    x = start.copy()
    for _ in range(steps):
        residual = (values - terms @ x)[:, None]
        equations = cauchy_equations(residual, terms[:, None, :], least)
        x += np.linalg.solve(equations.matrix + _RIDGE * np.eye(len(x)), equations.vector)
    return x


def fits_without_blocks(
    terms: FloatArray,
    values: FloatArray,
    whole: FloatArray,
    block: npt.NDArray[np.int64],
    least: float,
    steps: int,
) -> FloatArray:
    """The coefficients (B, K) that `cauchy_fit` finds without one block of values, for each of B
    blocks; the width of its weights is that of all values.

    Args:
        terms: (N, K).
        values: (N,).
        whole: those of all values (K,), to begin with.
        block: the block (N,) that each value is in.
        least: width of a residual, at least.
        steps: number of them.
    """
    K = terms.shape[1]
    of_block = distinct(block)[:, None] == block
    columns = np.column_stack([terms, values])
    products = (terms[:, :, None] * columns[:, None, :]).reshape(len(values), -1)
    width = max(median((values - terms @ whole) ** 2), least**2)
    x = np.tile(whole, (len(of_block), 1))
    for _ in range(steps):
        weight = 1.0 / (1.0 + (values - x @ terms.T) ** 2 / width)
        weight[of_block] = 0.0
        sums = (weight @ products).reshape(-1, K, K + 1)
        normal = sums[..., :K] + _RIDGE * np.eye(K)
        gradient = sums[..., K:] - sums[..., :K] @ x[..., None]
        x += np.linalg.solve(normal, gradient)[..., 0]
    return x


def jackknife(values: npt.ArrayLike) -> FloatArray:
    """Compute standard errors (...) of an estimate from its leave-one-block-out values (n, ...).

    With blocks longer than the correlation time of the errors, the result accounts for correlated
    errors.
    Reference: Tukey (1958), after Quenouille.
    """
    estimates = np.asarray(values, dtype=np.float64)
    out: FloatArray = np.sqrt(
        (len(estimates) - 1) * np.mean((estimates - estimates.mean(axis=0)) ** 2, axis=0)
    )
    return out


# Graduated non-convexity: the probability at which a residual is cut off, and what `mu` grows by
# from one step to the next.
CUT_OFF_PROBABILITY = 0.999
MU_GROWTH = 1.6


def truncated_weights(
    squared: FloatArray, mu: FloatArray | float, limit: FloatArray | float
) -> FloatArray:
    """Compute weights (...) of truncated least squares of squared errors (...) by graduated
    non-convexity.

    Reference: Yang et al. (2020), equation (14); `mu` grows from 0 (convex) on, `limit` is the
    largest squared error.
    """
    middle = np.sqrt(limit * mu * (mu + 1) / np.maximum(squared, 1e-12)) - mu
    out: FloatArray = np.where(
        squared >= limit * (mu + 1) / mu,
        0.0,
        np.where(squared <= limit * mu / (mu + 1), 1.0, middle),
    )
    return out
