"""Each limit of readers, selectors and records, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from vio.datasets.image_times import _slow_note
from vio.datasets.tracks import mark_repeats, moving_frames, resolve_repeats
from vio.geometry.lie import FloatArray, so3_exp
from vio.geometry.stereo import StereoCamera
from vio.geometry.upright import upright_axes
from vio.records import FeatureTracks, RotationComparison
from vio.selection.selectors import SelectorSettings, _budget

Says = Callable[[float], bool]


def _moves(
    speed_mps: float = 0.0, rate_radps: float = 0.0, noise: float = 0.0, frame: int = 50
) -> bool:
    """Whether a vehicle is said to move in a frame, by velocities that begin at frame 50."""
    noisy = noise * np.where(np.arange(100) % 2, 1.0, -1.0)
    linear = np.zeros((100, 3))
    linear[:, 0] = speed_mps + noisy
    angular = np.zeros((100, 3))
    angular[:, 1] = rate_radps
    return bool(moving_frames(linear, angular)[frame])


def _tracks(jump_steps: float, features: int) -> FeatureTracks:
    """Features that move by 2 px a frame, repeat their pixels in frame 3, and then move by so many
    steps.
    """
    moved = np.cumsum([0.0, 2.0, 2.0, 0.0, 2.0 * jump_steps, 2.0])
    z = np.zeros((6, features, 4))
    z[:] = 100.0 + 10.0 * np.arange(features)[:, None]
    z[:, :, [0, 2]] += moved[:, None, None]
    return FeatureTracks(
        features * np.arange(7),
        np.tile(np.arange(features), 6),
        z.reshape(-1, 4),
        np.ones(6 * features, np.bool_),
        np.zeros(6 * features, np.bool_),
    )


def _is_split(jump_steps: float) -> bool:
    tracks = _tracks(jump_steps, 40)
    return resolve_repeats(tracks, np.ones(6, np.bool_), "auto")[0].ids.max() >= 40


def _knows_jump(features: int) -> bool:
    return mark_repeats(_tracks(1.0, features), np.ones(6, np.bool_))[1].jump is not None


def _ahead(level: float) -> FloatArray:
    """The direction ahead of a camera that looks up but for a level part, and moves to the right."""
    T = np.tile(np.eye(4), (2, 1, 1))
    pitch = np.arccos(level)
    T[:, :3, :3] = so3_exp([pitch, 0.0, 0.0])
    T[1, 0, 3] = 5.0
    return upright_axes(T, np.array([0.0, -1.0, 0.0]))[1]


def _pair(baseline_m: float) -> StereoCamera:
    return StereoCamera(400.0, 400.0, 320.0, 240.0, baseline_m, 640, 480)


LIMITS: dict[str, tuple[Says, float, float]] = {
    "moving: speed": (lambda x: _moves(x), 0.045, 0.055),
    "moving: rate": (lambda x: _moves(0.0, x), 0.09, 0.11),
    "moving: significance": (lambda x: _moves(x, noise=1.0), 1.0, 1.4),
    "repeats: another point": (lambda x: not _is_split(x), 1.4, 1.6),
    "repeats: rows": (lambda n: _knows_jump(int(n)), 19, 20),
    "times: slow": (
        lambda x: _slow_note(Path("t"), (1e9 * x * np.arange(5)).astype(np.int64)) != (),
        4.5,
        5.5,
    ),
    "upright: looks up": (lambda x: bool(abs(_ahead(x)[0]) < 0.5), 0.09, 0.11),
    "turns: differ": (lambda x: RotationComparison(x, 1e-4, False).differ, 0.027, 0.033),
    "turns: sigmas": (lambda x: RotationComparison(x, 0.009, False).differ, 0.041, 0.049),
    "turns: known": (lambda x: not RotationComparison(0.5, x, False).differ, 0.009, 0.011),
    "baseline: short": (lambda x: _pair(x).baseline_fault is None, 0.0045, 0.0055),
    "baseline: long": (lambda x: _pair(x).baseline_fault is not None, 4.5, 5.5),
    "selector: kept": (lambda n: _budget(SelectorSettings(), 40) < n, 12, 13),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_readers(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
