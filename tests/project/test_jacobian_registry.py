"""Every public Jacobian is held against central differences, and the list that says so is
honest.
"""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np

from tests.conftest import ROOT
from tests.jacobians import (
    TESTED_JACOBIANS,
    left_local,
    left_retract,
    numeric_jacobian,
    right_local,
    right_retract,
)
from vio.geometry.lie import se3_adjoint, se3_exp


def _public_jacobians() -> set[str]:
    """Names 'module.function' of all public `*_D_*`, read from the sources without importing
    them.
    """
    found = set()
    for package in ("vio", "vio/frontend"):
        for path in (ROOT / package).rglob("*.py"):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(
                ".__init__"
            )
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if (
                    isinstance(node, ast.FunctionDef)
                    and "_D_" in node.name
                    and not node.name.startswith("_")
                ):
                    found.add(f"{module}.{node.name}")
    return found


def _names_used(path: Path) -> set[str]:
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    return {n.id for n in nodes if isinstance(n, ast.Name)} | {
        n.attr for n in nodes if isinstance(n, ast.Attribute)
    }


def test_every_public_jacobian_is_registered() -> None:
    missing = _public_jacobians() - TESTED_JACOBIANS
    assert not missing, (
        f"test these against numeric_jacobian and add them to tests/jacobians.py: {sorted(missing)}"
    )


def test_every_registered_jacobian_exists() -> None:
    gone = TESTED_JACOBIANS - _public_jacobians()
    assert not gone, f"remove these from TESTED_JACOBIANS in tests/jacobians.py: {sorted(gone)}"


def test_every_registered_jacobian_is_used_beside_numeric_jacobian() -> None:
    used: set[str] = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        names = _names_used(path)
        if "numeric_jacobian" in names:
            used |= names
    idle = {name for name in TESTED_JACOBIANS if name.rsplit(".", 1)[1] not in used}
    assert not idle, f"no test compares these with numeric_jacobian: {sorted(idle)}"


def test_numeric_jacobian_of_a_linear_map_is_its_matrix() -> None:
    A = np.random.default_rng(1).normal(size=(3, 4))
    np.testing.assert_allclose(numeric_jacobian(lambda x: A @ x, np.arange(4.0)), A, atol=1e-9)


def test_numeric_jacobian_flattens_matrices_row_by_row() -> None:
    X = np.arange(6.0).reshape(2, 3)
    np.testing.assert_allclose(
        numeric_jacobian(lambda m: m.T, X) @ X.ravel(), X.T.ravel(), atol=1e-8
    )


def test_numeric_jacobian_on_poses_finds_the_adjoint() -> None:
    T = se3_exp([1.0, -2.0, 0.5, 0.3, -0.9, 1.2])
    # T exp(xi) seen as exp(Ad(T) xi) T, and the other way round.
    np.testing.assert_allclose(
        numeric_jacobian(lambda X: X, T, right_retract, left_local), se3_adjoint(T), atol=1e-8
    )
    inverse = np.linalg.inv(se3_adjoint(T))
    np.testing.assert_allclose(
        numeric_jacobian(lambda X: X, T, left_retract, right_local), inverse, atol=1e-8
    )
