"""Normal equations that are sparse, symmetric and positive definite: their factors, and blocks of their inverse."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.linalg import SuperLU, splu

from vio.geometry.lie import FloatArray

_AT_ONCE = 32  # blocks: right-hand sides are dense


def factors(H: csc_matrix) -> SuperLU:
    """Factors of a symmetric positive definite matrix (n, n)."""
    # Ordered and pivoted as a symmetric matrix, its factors have a tenth of the entries.
    return splu(H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def marginals(H: csc_matrix, D: csr_matrix, size: int, scores: csr_matrix | None = None) -> FloatArray:
    """Covariances (C, d, d) of `D_c x`, each alone, where x has the information matrix H (n, n).

    Args:
        H: sum of `J' W J`, symmetric and positive definite.
        D: (C d, n) rows of D_c, one after the other.
        size: d.
        scores: (S, n) rows whose squares are together the covariance of the gradient; None: that is H.
    """
    solver, out = factors(H), np.zeros((D.shape[0] // size, size, size))
    for first in range(0, len(out), _AT_ONCE):
        rows = D[size * first : size * (first + _AT_ONCE)]
        x = solver.solve(rows.T.toarray())
        y = None if scores is None else scores @ x
        P = np.asarray(rows @ x if y is None else y.T @ y)
        here = np.arange(len(P) // size)
        out[first : first + len(here)] = P.reshape(len(here), size, len(here), size)[here, :, here, :]
    return 0.5 * (out + np.swapaxes(out, 1, 2))
