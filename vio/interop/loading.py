"""Import of the other systems' packages, when they are needed."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from vio.errors import DataError, MissingDependencyError, extra_text
from vio.geometry.lie import FloatArray


def package(module: str, to_install: str) -> Any:
    """Import a module of another system.

    Args:
        module: its dotted name.
        to_install: what pip installs to have it; `.[NAME]` is an extra of this package.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        how = f"install it with: pip install '{to_install}'"
        if to_install.startswith(".["):
            how = extra_text(to_install[2:-1])
        raise MissingDependencyError(f"vio.interop needs {module} ({error}); {how}") from error


def checked_covariance(covariance: FloatArray) -> FloatArray:
    """Return a covariance (6, 6) in float64.

    Raises:
        DataError: it has another shape, or values that are not finite.
    """
    given = np.asarray(covariance, dtype=np.float64)
    if given.shape != (6, 6) or not np.isfinite(given).all():
        raise DataError(
            f"a covariance of a pose is a finite 6x6 matrix, got shape {given.shape}; give that of "
            "[rho; phi]"
        )
    return given


def exchanged_blocks(covariance: FloatArray) -> FloatArray:
    """Return a covariance (6, 6) with translation and rotation exchanged."""
    order = [3, 4, 5, 0, 1, 2]
    return checked_covariance(covariance)[np.ix_(order, order)]
