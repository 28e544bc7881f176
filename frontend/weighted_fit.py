"""Robustly weighted normal equations of a linear model, for what is learned from the rows of
matches.
"""

from __future__ import annotations

from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled

ROW_SIGMA_PX = 0.5  # of right rows minus left ones: a match that is further off counts less


@compiled
def add_equations(
    terms: FloatArray,
    values: FloatArray,
    model: FloatArray,
    sigma: float,
    normal: FloatArray,
    moment: FloatArray,
) -> tuple[float, float]:
    """Add the equations `terms @ x = values`, each with Cauchy's weight of its residual under a
    model x.

    Args:
        terms: (N, K).
        values: (N,).
        model: (K,) that the weights are computed with.
        sigma: residual at which the weight is a half; infinite: all weigh one.
        normal: (K, K), to which the weighted products of the terms are added.
        moment: (K,), to which their weighted products with the values are added.

    Returns:
        The sum of the weights, and the weighted sum of the squared values.
    """
    count = squares = 0.0
    for n in range(len(values)):
        fitted = 0.0
        for i in range(terms.shape[1]):
            fitted += terms[n, i] * model[i]
        weight = 1.0 / (1.0 + ((values[n] - fitted) / sigma) ** 2)
        count += weight
        squares += weight * values[n] * values[n]
        for i in range(terms.shape[1]):
            part = weight * terms[n, i]
            moment[i] += part * values[n]
            for j in range(terms.shape[1]):
                normal[i, j] += part * terms[n, j]
    return count, squares
