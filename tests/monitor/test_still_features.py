"""Features that stay at the same pixels while the view changes."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from vio.findings import Finding
from vio.monitor.still_features import StillFeatures
from vio.records import Image

HEIGHT = 240
WIDTH = 480
_NOISE = np.random.default_rng(1).normal(0.0, 1.0, (HEIGHT, 3 * WIDTH)).astype(np.float32)
_BLURRED = np.asarray(cv2.GaussianBlur(_NOISE, (0, 0), 12.0), dtype=np.float64)
TEXTURE = 120.0 + 40.0 * _BLURRED / _BLURRED.std()
View = Callable[[int, np.random.Generator], np.ndarray]


def _image(view: np.ndarray, rng: np.random.Generator) -> Image:
    noisy = view + rng.normal(0.0, 3.0, view.shape)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


def _passing(k: int, share: float) -> np.ndarray:
    """A view of which the left part passes by 30 px a frame."""
    view = TEXTURE[:, :WIDTH].copy()
    columns = round(share * WIDTH)
    view[:, :columns] = TEXTURE[:, 30 * k : 30 * k + columns]
    return view


def _rain(k: int, rng: np.random.Generator) -> np.ndarray:
    view = _passing(0, 0.0)
    for u, v in rng.integers(0, (WIDTH, HEIGHT), (200, 2)).tolist():
        cv2.line(view, (u, v), (u + 2, v + 12), 230.0)
    return view


def _flickering(k: int, depth: float) -> np.ndarray:
    """A lamp of 100 Hz, at 30 Hz and a readout of 20 ms."""
    row = np.arange(HEIGHT)[:, None] / HEIGHT
    return _passing(0, 0.0) * (1.0 + depth * np.sin(2.0 * np.pi * 100.0 * (k / 30.0 + 0.02 * row)))


def _bracketed(k: int, gain: float) -> np.ndarray:
    """A bright view whose exposure changes from frame to frame."""
    return np.clip((30.0 + _passing(0, 0.0)) * (gain if k % 2 else 1.0), 0.0, 255.0)


def _found(
    view: View, frames: int = 20, flow_px: float | None = 0.2, moves_from: int = 99
) -> list[Finding]:
    check = StillFeatures()
    rng = np.random.default_rng(2)
    found: list[Finding] = []
    for k in range(frames):
        flow = flow_px if k < moves_from else 3.0
        found += check.frame(k, _image(view(k, rng), rng), flow)
    return found


def test_a_view_that_changes_behind_features_that_stay_is_named() -> None:
    (finding,) = _found(lambda k, rng: _passing(k, 1.0))
    assert finding.code == "rig-in-view"
    assert finding.effect == "unusable"
    assert finding.lasts
    assert finding.since == 0
    assert finding.frame is not None
    assert finding.frame <= 6


def test_features_that_move_end_it() -> None:
    begun, ended = _found(lambda k, rng: _passing(k, 1.0), moves_from=10)
    assert not begun.ended
    assert ended.ended
    assert ended.frame == 14


def test_a_view_that_stays_ends_it() -> None:
    begun, ended = _found(lambda k, rng: _passing(min(k, 12), 1.0), frames=40)
    assert not begun.ended
    assert ended.ended
    assert ended.frame is not None
    assert 12 < ended.frame <= 12 + 15


@pytest.mark.parametrize(
    "view",
    [
        lambda k, rng: _passing(0, 0.0),
        lambda k, rng: _passing(0, 0.0) * (0.6 + 0.4 * (k % 2)) + 10.0 * (k % 3),
        lambda k, rng: _passing(k, 0.4),
        lambda k, rng: _flickering(k, 0.05),
        lambda k, rng: _flickering(k, 0.2),
        lambda k, rng: _bracketed(k, 1.5),
        lambda k, rng: _passing(0, 0.0) + rng.normal(0.0, 20.0, (HEIGHT, WIDTH)),
        _rain,
    ],
    ids=["noise", "exposure", "object", "flicker", "lamp", "bracketed", "night", "rain"],
)
def test_a_rig_at_standstill_is_not_named(view: View) -> None:
    assert _found(view) == []


def test_without_flow_or_images_nothing_is_said() -> None:
    """A motion sensor tells, features move, or there are no images."""
    assert _found(lambda k, rng: _passing(k, 1.0), flow_px=None) == []
    assert _found(lambda k, rng: _passing(k, 1.0), flow_px=0.6) == []
    check = StillFeatures()
    assert [f for k in range(20) for f in check.frame(k, None, 0.0)] == []
    small = np.zeros((60, 80), dtype=np.uint8)
    assert [f for k in range(20) for f in check.frame(k, small + 40 * (k % 2), 0.0)] == []
