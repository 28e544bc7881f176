"""Normal equations that are sparse, symmetric and positive definite: their factors, and blocks
of their inverse.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu

from vio.numerics.arrays import FloatArray
from vio.numerics.kinds import Capacity

_LARGE: Capacity[int] = 10_000  # unknowns
_AT_ONCE: Capacity[int] = 32  # blocks: right-hand sides are dense


def factors(H: csc_matrix, block: int = 1) -> Callable[[FloatArray], FloatArray]:
    """Return what solves `H x = b` for b (n,) or (n, m), H (n, n) being symmetric and positive
    definite.

    Args:
        H: the matrix.
        block: unknowns from the first on, of which all or none depend on another unknown. A large
            matrix is ordered by its blocks, as scipy holds the interpreter while it orders; a
            smaller one as it is.
    """
    # Ordered and pivoted as a symmetric matrix, its factors have a tenth of the entries.
    options: dict[str, Any] = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    if block == 1 or H.shape[0] < _LARGE:
        solve: Callable[[FloatArray], FloatArray] = splu(
            H, permc_spec="MMD_AT_PLUS_A", **options
        ).solve
        return solve
    links = H[::block, ::block].tocsc()
    links.data[:] = -1.0
    links = (links + diags(np.diff(links.indptr) + 1.0)).tocsc()
    order = np.argsort(splu(links, permc_spec="MMD_AT_PLUS_A", **options).perm_c)
    unknowns = (block * order[:, None] + np.arange(block)).ravel()
    unknowns = unknowns[unknowns < H.shape[0]]
    ordered = splu(H[unknowns][:, unknowns].tocsc(), permc_spec="NATURAL", **options)

    def solve_ordered(b: FloatArray) -> FloatArray:
        x = np.empty_like(b)
        x[unknowns] = ordered.solve(b[unknowns])
        return x

    return solve_ordered


def marginals(
    H: csc_matrix, D: csr_matrix, size: int, scores: csr_matrix | None = None, block: int = 1
) -> FloatArray:
    """Covariances (C, d, d) of `D_c x`, each alone, where x has the information matrix H (n, n).

    Args:
        H: sum of `J' W J`, symmetric and positive definite.
        D: (C d, n) rows of D_c, one after the other.
        size: d.
        scores: (S, n) rows whose squares are together the covariance of the gradient; None: that is
            H.
        block: that of `factors`.
    """
    solve = factors(H, block)
    out = np.zeros((D.shape[0] // size, size, size))
    for first in range(0, len(out), _AT_ONCE):
        rows = D[size * first : size * (first + _AT_ONCE)]
        x = solve(rows.T.toarray())
        y = None if scores is None else scores @ x
        P = np.asarray(rows @ x if y is None else y.T @ y)
        here = np.arange(len(P) // size)
        out[first : first + len(here)] = P.reshape(len(here), size, len(here), size)[
            here, :, here, :
        ]
    return 0.5 * (out + np.swapaxes(out, 1, 2))
