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


@pytest.mark.parametrize("block", [(1, 0), (2, 1, 0, 3), (0, 2, 1), (3, 2, 1, 0)])
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


def _shaken(low_hz: float, high_hz: float, seed: int) -> FloatArray:
    """Positions (N, 3) at 20 Hz of a rig that is shaken by 4 cm at random, mostly along one axis."""
    rng = np.random.default_rng(seed)
    frames = 400
    hz = np.fft.rfftfreq(frames, 1.0 / 20.0)
    within = (hz > low_hz) & (hz < high_hz)
    spectrum = np.where(
        within, rng.normal(size=(3, len(hz))) + 1j * rng.normal(size=(3, len(hz))), 0.0
    )
    motion = np.fft.irfft(spectrum, frames).T
    noise = rng.normal(0.0, 0.0005, (frames, 3))
    return 0.04 * motion / motion.std(axis=0) * np.array([1.0, 0.05, 0.05]) + noise


@pytest.mark.parametrize("band", [(3.5, 6.0), (4.0, 5.0), (5.0, 7.0), (7.0, 8.0)])
def test_a_rig_that_is_shaken_at_random_is_not_named(band: tuple[float, float]) -> None:
    assert [finding for seed in range(8) for finding in _found(_shaken(*band, seed))] == []


def test_it_ends_at_rest_though_noise_goes_back_and_forth() -> None:
    path = _in_blocks((1, 0), 12, FRAMES)
    rng = np.random.default_rng(1)
    begun, ended = _found(np.vstack([path, path[-1] + rng.normal(0.0, 5e-4, (60, 3))]))
    assert begun.lasts
    assert ended.ended
    assert ended.frame == pytest.approx(FRAMES + 20, abs=2)


def test_it_ends_once_the_path_is_smooth_in_no_other_order() -> None:
    """A rig that is shaken after the fault goes back and forth as well."""
    path = _in_blocks((1, 0), 12, FRAMES)
    begun, ended = _found(np.vstack([path, path[-1] + _shaken(4.0, 5.0, 0)[:100]]))
    assert begun.lasts
    assert ended.ended
    assert ended.frame is not None
    assert ended.frame <= FRAMES + 60


@pytest.mark.parametrize(("innovation", "named"), [(1.9, False), (2.1, True), (None, True)])
def test_nothing_is_said_where_a_motion_sensor_agrees(
    innovation: float | None, named: bool
) -> None:
    check = FrameOrder()
    positions = _in_blocks((1, 0), 12, 48)
    found = [f for k, p in enumerate(positions) for f in check.frame(k, p, innovation)]
    assert bool(found) == named
