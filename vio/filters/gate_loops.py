"""The compiled loops behind the tests of corrections and landmarks: small symmetric matrices, many
at a time.

Each loop writes into the arrays that come last. `tests/numpy_twins.py` holds the same in NumPy.
"""

from __future__ import annotations

import numpy as np

from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled, eigenvectors


@compiled
def _inverse_factor(B: FloatArray, first: int, scale: float, V: FloatArray) -> bool:
    """Write the inverse (3, 3) of the Cholesky factor of three rows of a covariance of a scale.

    Returns:
        Whether they are positive.
    """
    L = np.empty((3, 3))
    for i in range(3):  # L L' = B
        for j in range(i + 1):
            total = B[first + i, first + j] + (1e-12 * scale if i == j else 0.0)
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j and not total > 0.0:
                return False
            L[i, j] = np.sqrt(total) if i == j else total / L[j, j]
    _invert_factor(L, V)
    return True


@compiled
def _invert_factor(L: FloatArray, V: FloatArray) -> None:
    """Write the inverse of a lower triangle (3, 3)."""
    for i in range(3):
        for j in range(3):
            total = 1.0 if i == j else 0.0
            for k in range(i):
                total -= L[i, k] * V[k, j]
            V[i, j] = total / L[i, i]


@compiled
def _whiten_removed(
    expected: FloatArray, remaining: FloatArray, first: int, V: FloatArray, M: FloatArray
) -> None:
    """Write the covariance that a correction removed of three rows, in the units of the expected
    one, whose inverse factor (3, 3) is given.
    """
    for i in range(3):
        for j in range(3):
            M[i, j] = 0.0
            for k in range(3):
                for m in range(3):
                    removed = expected[first + k, first + m] - remaining[first + k, first + m]
                    M[i, j] += V[i, k] * removed * V[j, m]


@compiled
def whiten_correction(
    correction: FloatArray,
    expected: FloatArray,
    process: FloatArray,
    remaining: FloatArray,
    first: int,
    informed: float,
) -> tuple[float, int, float]:
    """Return the fields of `WhitenedCorrection` for three rows of a step's errors, from the `first`
    one on.

    Not a number where the predicted covariance is not positive.
    """
    scale = expected[first, first] + expected[first + 1, first + 1] + expected[first + 2, first + 2]
    if not scale > 0.0:
        return 0.0, 0, 0.0
    M = np.empty((3, 3))
    V = np.empty((3, 3))
    if not _inverse_factor(expected, first, scale, V):
        return np.nan, 0, 0.0
    _whiten_removed(expected, remaining, first, V, M)
    U = np.empty((3, 3))
    row = np.empty(3)
    eigenvectors(M, U)
    squared = 0.0
    dof = 0
    share = 0.0
    for e in range(3):
        if not M[e, e] > informed:
            continue
        dof += 1
        y = 0.0
        for i in range(3):
            row[i] = U[0, e] * V[0, i] + U[1, e] * V[1, i] + U[2, e] * V[2, i]
            y += row[i] * correction[first + i]
        squared += y * y / M[e, e]
        for i in range(3):
            for j in range(3):
                share += row[i] * process[first + i, first + j] * row[j]
    return squared, dof, min(share / max(dof, 1), 1.0)


@compiled
def leave_out(
    r: FloatArray,
    J: FloatArray,
    covariance: FloatArray,
    weight: FloatArray,
    variance: float,
    nis: FloatArray,
) -> None:
    """Write the normalised innovations squared (K,) of `leave_one_out_nis`."""
    n = J.shape[2]
    JC = np.empty((4, n))
    inner = np.empty((4, 4))
    U = np.empty((4, 4))
    for k in range(len(r)):
        R = variance / max(weight[k], 1e-6)
        for a in range(4):
            for j in range(n):
                JC[a, j] = 0.0
                for i in range(n):
                    JC[a, j] += J[k, a, i] * covariance[k, i, j]
            for b in range(a + 1):
                total = R if a == b else 0.0
                for j in range(n):
                    total -= JC[a, j] * J[k, b, j]
                inner[a, b] = inner[b, a] = total
        eigenvectors(inner, U)
        nis[k] = 0.0
        for e in range(4):
            # Rounding, and noise that was re-estimated since, must not make a variance negative.
            value = max(inner[e, e], 1e-3 * R)
            y = 0.0
            for a in range(4):
                y += U[a, e] * r[k, a]
            nis[k] += (R / value * y) ** 2 / (R * R / value - R + variance)
