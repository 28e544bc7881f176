"""The prior of the window: one mean and covariance over all errors, and the algebra that changes
them.

The means of the states are the newest estimates, at which everything is linearised; `P` and `delta`
describe what all absorbed measurements say: the true error of the means has mean `-delta` and
covariance `P`.
"""

from __future__ import annotations

import numpy as np

from vio.cameras.rectification_error import CONSIDERED
from vio.dataclass import dataclass
from vio.filters import pose_loops as loops
from vio.filters.scale_test import ScaleTest
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Tolerance
from vio.numerics.scipy_extensions import lapack
from vio.records import IntArray

_SINGULAR: Tolerance[float] = 1e-12  # of the largest eigenvalue of a matrix of correlations


class Prior:
    """Mean and covariance of D errors, and how they depend on constants that are estimated
    beside them.
    """

    def __init__(self, P: FloatArray) -> None:
        self._factors: dict[tuple[int, int], Factor] = {}  # of parts of P, since it changed
        self.P = P
        self.delta: FloatArray = np.zeros(len(P))
        self.scale_test: ScaleTest | None = None
        # How the errors depend on constants that are not estimated: the scale that is tested, then
        # those considered.
        self.error_D_constants: FloatArray = np.zeros((len(P), 1 + CONSIDERED))

    @property
    def P(self) -> FloatArray:
        """Covariance (D, D)."""
        return self._P

    @P.setter
    def P(self, P: FloatArray) -> None:
        self._P = P
        self._factors = {}

    def to_change(self) -> FloatArray:
        """Return the covariance, for changes in place."""
        self._factors = {}
        return self._P

    def transform(self, M: FloatArray) -> None:
        """Turn the errors into `M error`, with M (D, D)."""
        self.P = M @ self._P @ M.T
        self.delta = M @ self.delta
        self.error_D_constants = M @ self.error_D_constants

    def inflate(self, rows: slice, variances: FloatArray) -> None:
        """Add variances (k,) to those of some errors."""
        self.P = self._P.copy()
        self.P[rows, rows] += np.diag(variances)

    def insert(self, first: int, covariance: FloatArray) -> None:
        """Add errors with a covariance (S, S), from the row `first` on, that depend on no other."""
        D = len(self._P)
        S = len(covariance)
        old = np.concatenate([np.arange(first), np.arange(first + S, D + S)])
        P = np.zeros((D + S, D + S))
        delta = np.zeros(D + S)
        P[np.ix_(old, old)] = self._P
        delta[old] = self.delta
        P[first : first + S, first : first + S] = covariance
        self.P = P
        self.delta = delta
        self.error_D_constants = np.insert(self.error_D_constants, [first] * S, 0.0, axis=0)

    def insert_dependent(
        self, at: int, J: FloatArray, noise: FloatArray, of_scale: FloatArray
    ) -> None:
        """Add errors `J error + noise` at a row.

        Args:
            at: the row.
            J: (k, m) of the first m errors.
            noise: covariance (k, k).
            of_scale: how they depend on the scale that is tested (k,).
        """
        D = len(self._P) + len(J)
        own = slice(0, J.shape[1])
        P: FloatArray = np.empty((D, D))
        loops.insert_rows(self._P, at, J, noise, P)
        delta = self.delta
        V = self.error_D_constants
        self.delta = np.concatenate([delta[:at], J @ delta[own], delta[at:]])
        of_new = J @ V[own]
        of_new[:, 0] = of_scale
        self.error_D_constants = np.concatenate([V[:at], of_new, V[at:]])
        self.P = P

    def append(
        self, A: FloatArray, blocks: FloatArray, by_considered: FloatArray | None = None
    ) -> None:
        """Add errors `A error + B constants + noise` of points behind the others.

        Args:
            A: (3K, D).
            blocks: covariances of the noise (K, 3, 3).
            by_considered: B (3K, 4); None: zero.
        """
        D = len(self._P) + len(A)
        P: FloatArray = np.empty((D, D))
        loops.append_rows(self._P, A @ self._P, A, blocks, P)
        self.delta = np.concatenate([self.delta, A @ self.delta])
        V = A @ self.error_D_constants
        if by_considered is not None:
            V[:, 1:] += by_considered
        self.error_D_constants = np.concatenate([self.error_D_constants, V])
        self.P = P

    def keep(self, rows: IntArray) -> None:
        """Marginalise all errors but those of given rows."""
        P = np.empty((len(rows), len(rows)))
        loops.take_rows(self._P, rows, P)
        self.P = P
        self.delta = self.delta[rows]
        self.error_D_constants = self.error_D_constants[rows]

    def optimum(
        self, information: FloatArray, vector: FloatArray, size: int, first: int = 0
    ) -> tuple[Fit, FloatArray]:
        """Where the prior and given information agree best.

        Args:
            information: about the first `size` errors alone; the rest of (D, D) is zero.
            vector: (D,) likewise, at the present means.
            size: `k`.
            first: row before which there is usually no information.

        Returns:
            The fit, with the covariance (k, k) of the first errors there, and the error vector (D,)
            that moves the means there.
        """
        prior = self._factor(information, size, first)
        own = slice(prior.first, size)
        A = information[own, own]
        b = vector[own] + information[own, own] @ self.delta[own]
        fitted = fit(prior, A)
        moved = fitted.move(b)
        # the others follow by their correlation
        shift: FloatArray = self._P[:, own] @ (b - A @ moved)
        shift[own] = moved
        return fitted, shift - self.delta

    def absorb(
        self,
        information: FloatArray,
        vector: FloatArray,
        first: int = 0,
        scaled: FloatArray | None = None,
        repeated: tuple[slice, float] | None = None,
        considered: FloatArray | None = None,
    ) -> None:
        """Absorb measurements.

        Args:
            information: `H' R^-1 H` (D, D) of the residuals at the present means.
            vector: `H' R^-1 r` (D,).
            first: row before which there is usually no information.
            scaled: for measurements in metres, how the errors (D,) move with the logarithm of the
                world's scale.
            repeated: rows of constants, and the factor by which the measurements repeat what was
                said of them: mean and variance of these go that part of the way only, as if the
                noise were larger by the factor, while all others take in the whole, equation
                (R9).
            considered: `H' R^-1 C` (D, 4), C being the derivatives of the residuals by the
                constants considered.
        """
        prior = self._factor(information, len(self._P), first)
        own = slice(prior.first, None)
        P = fit(prior, information[own, own]).covariance()
        delta = self.delta - P @ (vector + information @ self.delta)
        V = self.error_D_constants.copy()
        if scaled is not None:
            V[:, 0] += scaled
        W = information @ V
        if considered is not None:
            W[:, 1:] += considered
        if self.scale_test is not None:
            self.scale_test.absorb(V[:, 0], W[:, 0], vector + information @ delta, P)
        V = self.error_D_constants - P @ W
        if repeated is not None:
            rows = repeated[0]
            kept = 1 - 1 / repeated[1]
            delta[rows] += kept * (self.delta[rows] - delta[rows])
            P[rows, rows] += kept * (self._P[rows, rows] - P[rows, rows])
            V[rows] += kept * (self.error_D_constants[rows] - V[rows])
        self.P = P
        self.delta = delta
        self.error_D_constants = V

    def squared_distance(self, rows: slice) -> tuple[float, int]:
        """Squared distance of the means of some errors from what the prior says, over its
        covariance; its dimensions.

        Directions in which the covariance is singular to rounding have no part: states are copies,
        or known.
        """
        P = self._P[rows, rows]
        delta = self.delta[rows]
        scale = np.sqrt(np.where(P.diagonal() > 0, P.diagonal(), 1.0))
        values, vectors = np.linalg.eigh(P / np.outer(scale, scale))
        free = values > _SINGULAR * values[-1]
        along = vectors[:, free].T @ (delta / scale)
        return float(np.sum(along**2 / values[free])), int(free.sum())

    def _factor(self, information: FloatArray, size: int, first: int) -> Factor:
        """The factor of the present covariance, up to row `size`, of the errors that information
        (D, D) is about.

        It begins at row `first` where there is no information before it, and the part after it is
        not singular beyond rounding. It is computed once for all fits to one covariance.
        """
        if information[:first].any():
            first = 0
        if (first, size) not in self._factors:
            self._factors[first, size] = factor(self._P[:size, :size], first)
        return self._factors[first, size]


@dataclass(frozen=True, slots=True)
class Factor:
    """A covariance, and a factor of that of its last n errors: `P_n = L L'`."""

    P: FloatArray  # (D, D)
    L: FloatArray  # (n, n)
    # by Cholesky; False: by the eigenvectors of a P that is singular beyond rounding
    triangular: bool
    first: int  # row of the first error that is factored, D - n


@dataclass(frozen=True, slots=True)
class Fit:
    """The covariance after a measurement of the last n errors in information form:
    `P_n_new = L (K K')^-1 L'`.
    """

    prior: Factor
    # (n, n) upper triangle, of `K K' = I + L' A L`, in LAPACK's order of columns
    K_transposed: FloatArray

    def move(self, vector: FloatArray) -> FloatArray:
        """Return `P_n_new v` (n,), for the information vector v (n,) the shift of their mean."""
        L = self.prior.L
        out: FloatArray = L @ lapack.dpotrs(self.K_transposed, L.T @ vector, lower=0)[0]
        return out

    def rows(self, rows: slice) -> FloatArray:
        """Return the rows (k, n) of L that belong to rows of P: `J L` for a choice J of the
        errors.
        """
        first = self.prior.first
        return self.prior.L[rows.start - first : rows.stop - first]

    def whitened(self, J_L: FloatArray) -> FloatArray:
        """Return S (..., k, n) with `S S'` the covariance of `J error`, from `J L` (..., k, n)."""
        rows = np.ascontiguousarray(J_L).reshape(-1, J_L.shape[-1])
        S: FloatArray = lapack.dtrtrs(self.K_transposed, rows.T, trans=1)[0].T
        return S.reshape(J_L.shape)

    def covariance(self) -> FloatArray:
        """Return the covariance (D, D) of all errors: symmetric and positive by construction.

        That of the last n is `W' W`. With N the others' covariance with them before, times
        `L'^-1 K'^-1`, the others' covariance with them is `N W`, and their own is `N N'` and what
        it is given the last n.
        """
        P = self.prior.P
        L = self.prior.L
        first = self.prior.first
        W, _ = lapack.dtrtrs(self.K_transposed, L.T, trans=1)
        out: FloatArray = np.empty(P.shape)
        out[first:, first:] = W.T @ W
        if first:
            G: FloatArray = lapack.dtrtrs(L.T, P[:first, first:].T, trans=1)[0].T
            N = self.whitened(G)
            out[:first, first:] = N @ W
            out[first:, :first] = out[:first, first:].T
            out[:first, :first] = P[:first, :first] - G @ G.T + N @ N.T
            _keep_positive(out, P, first)
        return out


def _keep_positive(out: FloatArray, P: FloatArray, count: int) -> None:
    """Add to the first variances of a covariance what keeps it positive to rounding, also where
    P knows one exactly.
    """
    _diagonal(out)[:count] += 1e-14 * P.diagonal()[:count] + 1e-24


def _diagonal(A: FloatArray) -> FloatArray:
    """Return the diagonal of a contiguous matrix (n, n), for changes in place."""
    return A.ravel()[:: A.shape[0] + 1]


def factor(P: FloatArray, first: int = 0) -> Factor:
    """Factor a covariance (D, D) from the row `first` on; the whole where that part is singular
    beyond rounding.
    """
    A = np.array(P[first:, first:], order="C")
    _keep_positive(A, A, len(A))
    upper, failed = lapack.dpotrf(A.T, lower=0, overwrite_a=1)
    if not failed:
        return Factor(P, upper.T, True, first)
    values, vectors = np.linalg.eigh(P)
    root: FloatArray = np.array(
        vectors * np.sqrt(np.maximum(values, 0.0)), dtype=np.float64, order="C"
    )
    return Factor(P, root, False, 0)


def fit(prior: Factor, information: FloatArray) -> Fit:
    """Fit a prior to a measurement in information form (D, D).

    `(P^-1 + A)^-1` without an inverse of P, which is singular where states are copies or known. Of
    `I + L' A L = K K'`, only the triangle of K' is computed, in LAPACK's order of columns, in which
    the transpose of an array is free.

    Raises:
        numpy.linalg.LinAlgError: the information is not positive.
    """
    L = prior.L
    if prior.triangular:
        inner, _ = lapack.dsygst(information.T, L.T, itype=2, lower=0)
    else:
        inner = np.asfortranarray(L.T @ information @ L)
    _diagonal(inner.T)[:] += 1.0
    K_transposed, failed = lapack.dpotrf(inner, lower=0, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("the information is not positive")
    return Fit(prior, K_transposed)


def posterior(
    P: FloatArray, information: FloatArray, vector: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (D, D) and the shift of the mean (D,) after a measurement in
    information form.
    """
    P_new = fit(factor(P), information).covariance()
    return P_new, P_new @ vector
