"""Frames in another order than they were exposed in."""

from __future__ import annotations

import numpy as np
import pytest

from vio.findings import Finding
from vio.geometry.lie import FloatArray
from vio.monitor.frame_order import FrameOrder

FRAMES = 60


def _path(frames: int = FRAMES) -> FloatArray:
    """Positions (N, 3) on a curve, along which a rig brakes."""
    t = np.linspace(0.0, 1.0, frames)[:, None]
    return np.hstack([2.0 * t - 0.6 * t**2, np.sin(2.0 * t), 0.1 * t])


def _found(positions: FloatArray) -> list[Finding]:
    check = FrameOrder()
    return [finding for k, position in enumerate(positions) for finding in check.frame(k, position)]


def _in_blocks(block: tuple[int, ...], begin: int, end: int) -> FloatArray:
    """Positions whose blocks are in another order between two frames."""
    order = np.arange(FRAMES)
    for k in range(begin, end, len(block)):
        order[k : k + len(block)] = k + np.array(block)
    return _path()[order]


@pytest.mark.parametrize("block", [(1, 0), (2, 1, 0, 3), (0, 2, 1)])
def test_frames_in_another_order_are_named(block: tuple[int, ...]) -> None:
    begun, ended = _found(_in_blocks(block, 12, 36))
    assert begun.effect == "unusable"
    assert begun.lasts
    assert begun.frame is not None
    assert begun.since is not None
    assert 12 < begun.frame <= 12 + 12
    assert begun.since <= 12
    assert ended.ended
    assert ended.frame == pytest.approx(36 + 20, abs=2)


def test_paths_that_are_rough_in_any_order_are_not_named() -> None:
    """Noise of positions, a rig that shakes, one that turns back, and one that stands still."""
    rng = np.random.default_rng(3)
    path = _path()
    k = np.arange(FRAMES)[:, None]
    assert _found(path) == []
    for sigma_m in (0.01, 0.03, 0.3):
        assert _found(path + rng.normal(0.0, sigma_m, path.shape)) == []
    for rate in (0.4, 1.1, 2.0, 2.9):
        shaken = 0.05 * np.sin(rate * k) * np.array([0.3, 1.0, -0.5])
        assert _found(path + shaken) == []
    assert _found(np.vstack([path, path[::-1]])) == []
    assert _found(np.zeros((FRAMES, 3))) == []
