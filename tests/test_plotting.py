"""The picture of a run: which plane the map shows."""

from __future__ import annotations

import numpy as np
import pytest

from vio.plotting import _plane

RNG = np.random.default_rng(0)
STREET = RNG.uniform([-12, -4, 0], [12, 2, 60], size=(400, 3))  # x right, y down, z forward, metres


@pytest.mark.parametrize(
    ("across_m", "up_m", "points", "expected"),
    [
        (0.1, 1.0, STREET, (0, 2)),  # a straight road uphill: the street is wider than high
        (0.1, 1.0, STREET[:0], (1, 2)),  # nothing else is known
        (1.0, 15.0, STREET, (1, 2)),  # a climb
        (9.0, 1.0, STREET, (0, 2)),  # a bend
    ],
)
def test_map_shows_the_plane_of_the_motion(
    across_m: float, up_m: float, points: np.ndarray, expected: tuple[int, int]
) -> None:
    s = np.linspace(0, 1, 50)
    assert _plane(np.stack([across_m * s, up_m * s, 40 * s], axis=1), points) == expected
