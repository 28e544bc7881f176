"""SciPy's extension modules loaded alone: the same functions, and SciPy whole beside them afterwards."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
from scipy.linalg import blas, lapack
from scipy.special import gammaincinv

from vio.numerics import scipy_parts

_AFTERWARDS = """
import numpy as np
from vio.numerics.compiled import compiled, solve_positive
solve_positive(np.eye(2), np.ones(2))
import numba, scipy.linalg, scipy.optimize, scipy.stats
product = numba.njit(lambda a, b: a @ b)
assert np.array_equal(product(np.eye(2), np.full((2, 2), 3.0)), np.full((2, 2), 3.0))
assert scipy.linalg.lapack.dpotrf(4 * np.eye(2))[0][0, 0] == 2.0
assert abs(scipy.stats.chi2.ppf(0.5, 2) - 1.3862943611198906) < 1e-12
"""


def test_functions_are_those_of_scipy() -> None:
    A = np.array([[4.0, 2.0], [2.0, 3.0]])
    assert np.array_equal(scipy_parts.lapack.dpotrf(A)[0], lapack.dpotrf(A)[0])
    assert np.array_equal(scipy_parts.blas.dtrsm(1.0, A, A), blas.dtrsm(1.0, A, A))
    assert scipy_parts.special.gammaincinv(1.5, 0.9) == gammaincinv(1.5, 0.9)


def test_scipy_and_numba_are_whole_afterwards() -> None:
    subprocess.run([sys.executable, "-c", _AFTERWARDS], check=True)


def test_an_extension_that_scipy_does_not_have_is_its_public_module() -> None:
    assert scipy_parts._extension("scipy.linalg._none", (), "scipy.linalg.blas") is blas
    assert scipy_parts._extension("scipy.linalg._flapack", ("none",), "scipy.linalg.lapack") is lapack
