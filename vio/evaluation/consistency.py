"""Whether errors are as large as a filter states: NEES."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from vio.errors import EvaluationError
from vio.geometry.lie import FloatArray
from vio.numerics.statistics import chi_square_quantile


def nees(errors: npt.ArrayLike, covariances: npt.ArrayLike) -> FloatArray:
    """Normalised estimation error squared `e^T P^-1 e` (N,) of errors (N, d) and covariances (N, d,
    d).

    Raises:
        EvaluationError: a covariance is not positive definite.

    Reference: Bar-Shalom, Li & Kirubarajan, Estimation with Applications to Tracking and Navigation
    (2001), 5.4.
    """
    e = np.asarray(errors, dtype=np.float64)
    P = np.asarray(covariances, dtype=np.float64)
    if e.ndim != 2 or P.shape != (*e.shape, e.shape[1]):
        raise EvaluationError(
            f"NEES needs errors (N, d) and covariances (N, d, d), got {e.shape} and {P.shape}"
        )
    if not (np.isfinite(e).all() and np.isfinite(P).all()):
        raise EvaluationError(
            "NEES of errors or covariances that are not finite; the filter has diverged"
        )
    try:
        L = np.linalg.cholesky(P)
    except np.linalg.LinAlgError as error:
        worst = int(np.argmin(np.linalg.eigvalsh(P)[:, 0]))
        raise EvaluationError(
            f"covariance {worst} is not positive definite; the filter is inconsistent"
        ) from error
    whitened = np.linalg.solve(L, e[..., None])[..., 0]
    out: FloatArray = np.sum(whitened * whitened, axis=1)
    return out


def nees_bounds(d: int, runs: int) -> tuple[float, float]:
    """Two-sided 95 % bounds of the NEES of a consistent d-dimensional estimate, averaged over
    independent runs.
    """
    low, high = chi_square_quantile([0.025, 0.975], d * runs) / runs
    return float(low), float(high)
