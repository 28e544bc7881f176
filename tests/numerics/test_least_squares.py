"""The damping of Levenberg and Marquardt."""

from __future__ import annotations

import numpy as np
import pytest

from vio.geometry.lie import FloatArray
from vio.numerics.least_squares import Damping


def _residuals(x: FloatArray) -> FloatArray:
    """Rosenbrock's valley, whose least is at (1, 1)."""
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


def _cost(x: FloatArray) -> float:
    return float(np.sum(_residuals(x) ** 2))


def _moved(x: FloatArray, damping: float) -> FloatArray:
    J = np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])
    H = J.T @ J
    step = np.linalg.solve(H + damping * np.diag(np.diag(H)), J.T @ _residuals(x))
    return np.asarray(x - step)


def test_steps_never_raise_the_cost_and_reach_the_optimum() -> None:
    """The first undamped step leads from 24 to 2000."""
    x = np.array([-1.2, 1.0])
    assert _cost(_moved(x, 0.0)) > 1000.0
    damping = Damping(1e8, value=1e-4)
    costs = [_cost(x)]
    for _ in range(100):
        found = damping.step(lambda value, x=x: _moved(x, value), _cost, costs[-1])
        if found is None:
            break
        x, after = found
        costs.append(after)
    assert costs == sorted(costs, reverse=True)
    np.testing.assert_allclose(x, 1.0, atol=1e-9)


@pytest.mark.parametrize(("largest", "tried"), [(1e2, [1.0, 10.0, 100.0]), (5.0, [1.0])])
def test_ends_where_no_damping_helps(largest: float, tried: list[float]) -> None:
    asked = list[float]()

    def moved(value: float) -> float:
        asked.append(value)
        return value

    assert Damping(largest, value=1.0).step(moved, lambda _: np.inf, 3.0) is None
    assert asked == tried


def test_grows_and_shrinks_tenfold_down_to_its_least() -> None:
    damping = Damping(1e8, smallest=1e-4, value=1e-3)
    # too long a step, with less damping than 0.05
    assert damping.step(lambda value: value, lambda value: float(value < 0.05), 0.5) == (0.1, 0.0)
    assert damping.value == pytest.approx(0.01)
    for _ in range(5):
        assert damping.step(lambda value: value, lambda _: 0.5, 0.5) is not None  # as good
    assert damping.value == 1e-4
