"""What a recording of a board lacks, from both sides of each limit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.board_views import GRID
from vio.records import ImuSample
from vio.targets.corners import Corners
from vio.targets.guidance import Guidance

Says = Callable[[float], bool]
MS = 1_000_000


def _enough(
    views: int = 40,
    *,
    cell_corners: float = 50.0,
    tilted: int = 5,
    scales: float = 2.0,
    turn_radps: float = 1.0,
    seconds: float = 40.0,
    tilt_deg: float = 25.0,
) -> bool:
    """Whether nothing is missing of a recording that has enough, but for one thing."""
    guidance = Guidance(GRID)
    seen = Corners(np.arange(20), np.zeros((20, 2)))
    guidance._views = [(seen,)] * views
    guidance._sizes = [(752, 480)]
    guidance._cells = [np.full(9, cell_corners)]
    tilts = [
        [sign * tilt_deg * (axis == k) for axis in range(2)] for k in range(2) for sign in (1, -1)
    ]
    guidance._tilts_deg = [np.array(tilt) for tilt in tilts for _ in range(tilted)]
    guidance._scales = [100.0, 100.0 * scales]
    for k in range(round(20 * seconds) + 1):
        # of this standard deviation
        turn = turn_radps * np.sqrt(2.0) * np.sin(0.9 * k + np.arange(3))
        guidance.add_sample(ImuSample(50 * MS * k, turn, np.array([0.0, 0.0, 9.8])))
    return not guidance.lacks().wanted


def _is_new(moved_share: float, shared: int = 20) -> bool:
    """Whether a view is new whose corners have moved by a share of the image's width; so many of
    them are those of an earlier view.
    """
    guidance = Guidance(GRID)
    guidance._sizes = [(1000, 600)]
    uv = np.random.default_rng(0).uniform(100.0, 500.0, (20, 2))
    guidance._views = [(Corners(np.arange(20), uv),)]
    moved = Corners(20 - shared + np.arange(20), uv + np.array([1000.0 * moved_share, 0.0]))
    if shared < 20:
        moved = Corners(20 - shared + np.arange(20), np.roll(uv, shared - 20, axis=0))
    return guidance._is_new((moved,))


LIMITS: dict[str, tuple[Says, float, float]] = {
    "views": (lambda n: _enough(int(n)), 29, 30),
    "corners of a part": (lambda n: _enough(cell_corners=n), 11, 12),
    "tilts": (lambda n: _enough(tilted=int(n)), 2, 3),
    "tilted": (lambda x: _enough(tilt_deg=x), 14.5, 15.5),
    "distances": (lambda x: _enough(scales=x), 1.5, 1.7),
    "turns": (lambda x: _enough(turn_radps=x), 0.37, 0.43),
    "time": (lambda x: _enough(seconds=x), 29.0, 31.0),
    "moved": (_is_new, 0.036, 0.044),
    "the same corners": (lambda n: not _is_new(0.0, int(n)), 5, 6),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_guidance(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
