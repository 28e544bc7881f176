"""Loops as machine code: compiled by numba, ahead of time or at the first call.

For loops over small matrices and patches, where NumPy spends its time on calls and temporary
arrays. Inside a compiled function, write out assignments of whole rows and sums of arrays as loops:
numba's own forms of these take seconds to compile, and `reshape`, or `np.zeros` in place of
`np.empty`, a tenth of a second. A whole number that is written out as an argument of a compiled
function makes numba compile that function anew, for this number alone: pass `int(np.int64(1))`.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from vio.numerics import compiling, prebuilt
from vio.numerics.arrays import FloatArray

log = logging.getLogger(__name__)

Function = TypeVar("Function", bound=Callable[..., Any])

# Without the entry for callers in C, which nothing here uses, a function compiles in a tenth less
# time.
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}
# numba counts references to each array that a function is given, or cuts out of one, by atomic
# additions. A function needs that only if it allocates an array, by one of these names; one that
# does by another name does not compile.
_ALLOCATE = {"empty", "zeros", "copy", "reshape", "searchsorted"}
LOOPS: list[Loop] = []
_FUNCTIONS: set[Callable[..., Any]] = set()  # of the loops


class Loop:
    """A function as machine code: from the extension module, or as numba compiles it for the
    types of a call.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        """Prepare; the first call looks for the code."""
        functools.update_wrapper(self, function)
        self.function = function
        self.options = options
        _FUNCTIONS.add(function)
        self.is_called = False  # from Python
        # of the extension module, each for arguments of other types
        self._codes: list[Callable[..., Any]] = []
        self._last: Callable[..., Any] = _not_found  # the code of the last call

    def __call__(self, *arguments: Any) -> Any:
        """Call it."""
        try:
            return self._last(*arguments)
        except TypeError:  # nothing is computed yet: the arguments are of other types
            return self._call_another(*arguments)

    def _call_another(self, *arguments: Any) -> Any:
        """Find the code for the types of a call, and call it."""
        if not self.is_called:
            self._find()
        for code in self._codes:
            try:
                found = code(*arguments)
            except TypeError:
                continue
            self._last = code
            return found
        return self.by_numba(*arguments)

    def _find(self) -> None:
        """Look for its code in the extension module."""
        self._codes = prebuilt.code_of(self.function, lambda: self.fingerprint)
        if not self._codes:
            if compiling.before_first_call is not None:
                compiling.before_first_call(self.function.__module__)
            self._last = self.by_numba
        self.is_called = True

    @functools.cached_property
    def fingerprint(self) -> str:
        """What its machine code depends on."""
        return prebuilt.fingerprint(self.function, self.options)

    @functools.cached_property
    def by_numba(self) -> Any:
        """The function as numba has it; its code is compiled at the first call, or loaded from
        the cache.
        """
        import numba

        compiling.watch(_FUNCTIONS.__contains__)
        try:
            return numba.njit(self.function, cache=True, **self.options)
        except RuntimeError:  # numba found no folder that it may write to
            log.debug(
                "no folder for numba's cache is writable: %s is compiled in each process",
                self.function.__name__,
            )
            return numba.njit(self.function, **self.options)

    @property
    def _numba_type_(self) -> Any:
        """What numba sees where a function that it compiles calls this one."""
        return self.by_numba._numba_type_

    @property
    def is_compiled_anew(self) -> bool:
        """Whether this process has compiled it, rather than loaded it."""
        stats = getattr(self.__dict__.get("by_numba"), "stats", None)  # none with NUMBA_DISABLE_JIT
        return stats is not None and bool(stats.cache_misses)


def _not_found(*_: Any) -> Any:
    """Stand for the code of a loop that was not called yet."""
    raise TypeError


def compiled(function: Function) -> Function:
    """Use a function as machine code, which is looked for, or compiled for the types of the call,
    at its first call.

    Divisions follow IEEE 754 as NumPy's do, and sums keep their order. numba's cache is beside the
    source file, else in the user's cache folder (NUMBA_CACHE_DIR overrides both); where neither is
    writable, every process compiles anew.
    """
    return _loop(function, {"fastmath": False})


def compiled_sums(function: Function) -> Function:
    """Compile a function like `compiled`, with its sums taken in an order that suits the
    processor's vectors.

    The order is part of the machine code, so results still repeat to the bit on one kind of
    processor. Unlike numba's `fastmath=True`, infinities and NaN keep their meaning.
    """
    return _loop(function, {"fastmath": {"reassoc", "contract", "nsz"}})


def _loop(function: Function, options: dict[str, Any]) -> Function:
    counts = not _ALLOCATE.isdisjoint(function.__code__.co_names)
    LOOPS.append(loop := Loop(function, _OPTIONS | options | {"_nrt": counts}))
    return cast(Function, loop)


def is_cached() -> bool:
    """Whether numba's cache holds loops of an earlier run, or can hold none."""
    stats = getattr(index_of.by_numba, "stats", None)  # type: ignore[attr-defined]
    if stats is None or stats.cache_path is None:
        return True
    return any(Path(stats.cache_path).glob("compiled.*.nbi"))


def has_compiled() -> bool:
    """Return whether this process has compiled any loop, rather than loaded all of them."""
    return any(loop.is_compiled_anew for loop in LOOPS)


@compiled_sums
def dot(a: FloatArray, b: FloatArray) -> float:
    """Sum of the products of two arrays (n,)."""
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@compiled
def invert_positive(A: FloatArray, out: npt.NDArray[np.floating[Any]]) -> None:
    """Write the inverse (n, n) of a symmetric positive definite matrix, whose lower triangle is
    read, by Cholesky.
    """
    n = len(A)
    L = np.empty((n, n))  # first the factor, then its inverse
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(total) if i == j else total / L[j, j]
    for j in range(n):
        L[j, j] = 1.0 / L[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total -= L[i, k] * L[k, j]
            L[i, j] = total / L[i, i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += L[k, i] * L[k, j]
            out[i, j] = out[j, i] = total


@compiled
def solve_positive(A: FloatArray, b: FloatArray) -> None:
    """Solve `A x = b` in place for a symmetric positive definite A (n, n): x replaces b[:n], and
    the factor A.
    """
    n = len(A)
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            A[i, j] = np.sqrt(total) if i == j else total / A[j, j]
        total = b[i]
        for k in range(i):
            total -= A[i, k] * b[k]
        b[i] = total / A[i, i]
    for i in range(n - 1, -1, -1):
        total = b[i]
        for k in range(i + 1, n):
            total -= A[k, i] * b[k]
        b[i] = total / A[i, i]


@compiled
def index_of(value: int, increasing: npt.NDArray[np.int64]) -> int:
    """Index of a number among increasing ones (M,), by bisection; -1: it is not one of them."""
    low = 0
    high = len(increasing)
    while low < high:
        middle = (low + high) // 2
        if increasing[middle] < value:
            low = middle + 1
        else:
            high = middle
    return low if low < len(increasing) and increasing[low] == value else -1


@compiled
def eigenvectors(A: FloatArray, V: FloatArray) -> None:
    """Make a small symmetric A (n, n) diagonal in place, and write its eigenvectors into the
    columns of V (n, n).

    By Jacobi's rotations, each of which clears one entry. Reference: Golub & Van Loan, Matrix
    Computations, 8.5.
    """
    n = len(A)
    for i in range(n):
        for j in range(n):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(12):  # sweeps; convergence is quadratic
        off = 0.0
        own = 0.0
        for i in range(n):
            own += A[i, i] * A[i, i]
            for j in range(i):
                off += A[i, j] * A[i, j]
        if not off > 1e-32 * own:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if A[p, q] == 0.0:
                    continue
                ratio = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
                t = (1.0 if ratio >= 0.0 else -1.0) / (abs(ratio) + np.sqrt(1.0 + ratio * ratio))
                c = 1.0 / np.sqrt(1.0 + t * t)
                s = c * t
                for k in range(n):
                    A[k, p], A[k, q] = c * A[k, p] - s * A[k, q], s * A[k, p] + c * A[k, q]
                for k in range(n):
                    A[p, k], A[q, k] = c * A[p, k] - s * A[q, k], s * A[p, k] + c * A[q, k]
                    V[k, p], V[k, q] = c * V[k, p] - s * V[k, q], s * V[k, p] + c * V[k, q]


@compiled
def move_by_twist(xi: FloatArray, T: FloatArray) -> None:
    """Replace a transform T (4, 4) by `exp(xi) T`, with a twist (6,) `[rho; phi]`: `se3_exp` of
    `vio.geometry.lie`.
    """
    x = xi[3]
    y = xi[4]
    z = xi[5]
    squared = x * x + y * y + z * z
    if squared < 1e-4:  # cancellation in the closed forms
        a = 1.0 - squared / 6.0 * (1.0 - squared / 20.0 * (1.0 - squared / 42.0))
        b = 0.5 - squared / 24.0 * (1.0 - squared / 30.0 * (1.0 - squared / 56.0))
        c = 1.0 / 6.0 - squared / 120.0 * (1.0 - squared / 42.0 * (1.0 - squared / 72.0))
    else:
        angle = np.sqrt(squared)
        a = np.sin(angle) / angle
        b = 2.0 * np.sin(angle / 2.0) ** 2 / squared
        c = (angle - np.sin(angle)) / angle**3
    # phi^ v and phi^ phi^ v are the cross products of phi with v, and with that.
    for j in range(4):
        px = T[0, j]
        py = T[1, j]
        pz = T[2, j]
        cx = y * pz - z * py
        cy = z * px - x * pz
        cz = x * py - y * px
        dx = y * cz - z * cy
        dy = z * cx - x * cz
        dz = x * cy - y * cx
        T[0, j] = px + a * cx + b * dx
        T[1, j] = py + a * cy + b * dy
        T[2, j] = pz + a * cz + b * dz
    px = xi[0]
    py = xi[1]
    pz = xi[2]
    cx = y * pz - z * py
    cy = z * px - x * pz
    cz = x * py - y * px
    dx = y * cz - z * cy
    dy = z * cx - x * cz
    dz = x * cy - y * cx
    T[0, 3] += px + b * cx + c * dx
    T[1, 3] += py + b * cy + c * dy
    T[2, 3] += pz + b * cz + c * dz


@compiled
def move_poses(xi: FloatArray, T: FloatArray) -> None:
    """Replace transforms T (N, 4, 4) by `exp(xi) T`, with twists (N, 6)."""
    for n in range(len(T)):
        move_by_twist(xi[n], T[n])
