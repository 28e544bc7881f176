"""Each limit of the rules of maps, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.test_map_places import CAMERA, T_I_J
from vio.geometry.lie import FloatArray, se3_inverse, so3_exp, transform_points
from vio.geometry.stereo import project
from vio.mapping.builder import _is_alike
from vio.mapping.density import spread
from vio.mapping.features import KeyframeFeatures
from vio.mapping.loop_geometry import Verified, match, verify
from vio.mapping.overlap import is_visible
from vio.mapping.place_index import PlaceIndex
from vio.records import BoolArray

Says = Callable[[float], bool]


def _views(
    count: int, wrong: int = 0, sigma_px: float = 0.5, off_px: float = 0.0, stated_px: float = 0.5
) -> tuple[KeyframeFeatures, KeyframeFeatures]:
    """Two views of so many points, some of them where no motion explains; the first points of the
    second view are off in their columns.
    """
    rng = np.random.default_rng(3)
    p = rng.uniform([-3.0, -1.5, 3.0], [3.0, 1.5, 9.0], (count, 3))
    bits = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    views = []
    for points in (p, transform_points(se3_inverse(T_I_J), p)):
        z = project(CAMERA, points) + sigma_px * rng.standard_normal((count, 4))
        views.append(KeyframeFeatures(z, np.ones(count, np.bool_), np.full(count, stated_px), bits))
    z = views[1].z.copy()
    z[:wrong] = rng.uniform([100.0, 50.0, 80.0, 50.0], [600.0, 300.0, 100.0, 300.0], (wrong, 4))
    z[wrong : wrong + 10, [0, 2]] += off_px
    return views[0], replace(views[1], z=z)


def _verified(count: int, wrong: int = 0, **more: float) -> Verified | None:
    i, j = _views(count, wrong, **more)
    return verify(CAMERA, i, CAMERA, j)


def _sigmas(sigma_px: float, count: int = 120) -> tuple[float, float]:
    """Stated standard deviations of a motion: metres and degrees."""
    seen = _verified(count, sigma_px=sigma_px)
    assert seen is not None
    C = seen.pose.covariance
    return float(np.sqrt(C[0, 0])), float(np.degrees(np.sqrt(C[4, 4])))


def _inliers(off_px: float) -> int:
    """How many of a hundred pairs agree, of which ten are off."""
    seen = _verified(100, sigma_px=0.05, off_px=off_px, stated_px=1.0)
    assert seen is not None
    return seen.inliers


def _paired(second_best_bits: int) -> bool:
    """Whether features pair whose descriptors differ in 40 bits, beside those of others."""
    none = np.zeros((2, 32), dtype=np.uint8)
    one = np.zeros(256, dtype=np.uint8)
    one[:40] = 1
    other = np.zeros(256, dtype=np.uint8)
    other[:second_best_bits] = 1
    far = np.full((1, 32), 255, dtype=np.uint8)
    i = KeyframeFeatures(
        np.zeros((2, 4)), np.ones(2, np.bool_), np.ones(2), np.vstack([none[:1], far])
    )
    bits = np.packbits(np.stack([one, other]), axis=1)
    j = KeyframeFeatures(np.zeros((2, 4)), np.ones(2, np.bool_), np.ones(2), bits)
    return [0, 0] in match(i, j).tolist()


def _pairs_used(count: int) -> int:
    seen = _verified(count)
    assert seen is not None
    return seen.pairs


def _kept(turn_rad: float) -> BoolArray:
    """Which of three keyframes of a cubic metre are kept: the second is 0.5 m from the first, and
    the third turned against the first.
    """
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, 3] = [[0.1, 0.5, 0.5], [0.6, 0.5, 0.5], [0.1, 0.5, 0.5]]
    T[2, :3, :3] = so3_exp([0.0, turn_rad, 0.0])
    return spread(T, np.zeros(3, np.int64), np.array([5, 1, 1]), 2)


def _visible(nearer: float, depth_m: float = 3.0) -> bool:
    """Whether a point is, from where it is so many times nearer than it was seen from."""
    p: FloatArray = np.array([[0.0, 0.0, depth_m]])
    there = np.array([[0.0, 0.0, depth_m * (1.0 - nearer)]])
    return bool(is_visible(p, there, p, np.zeros(3))[0])


def _candidate(alone: int, beside: int) -> int:
    """The best candidate among a keyframe that shares `alone` features with a view, and three in a
    row that share `beside` each.
    """
    rng = np.random.default_rng(0)
    view = rng.integers(0, 256, (100, 32), dtype=np.uint8)
    index = PlaceIndex()
    shares = [0, 0, 0, alone, 0, 0, 0, 0, beside, beside, beside, 0, 0, 0, 0]
    for share in shares:
        other = rng.integers(0, 256, (100, 32), dtype=np.uint8)
        other[:share] = view[:share]
        index.add(other)
    found = index.candidates(view, np.ones(len(shares), np.bool_), 1)
    return int(found[0])


LIMITS: dict[str, tuple[Says, float, float]] = {
    "loop: pairs": (lambda n: _verified(int(n), sigma_px=0.05) is not None, 19, 20),
    "loop: share": (lambda n: _verified(120, int(120 - n), sigma_px=0.1) is not None, 25, 36),
    "loop: second best": (lambda n: _paired(int(n)), 45, 50),
    "loop: pairs that are used": (lambda n: _pairs_used(int(n)) < n, 190, 210),
    "loop: off": (lambda x: _inliers(x) < 95, 13.0, 15.7),
    "loop: sigma": (lambda x: _sigmas(1.0)[0] < x, 0.0215, 0.0285),
    "loop: floor": (lambda x: _sigmas(0.01)[0] < x, 0.0098, 0.0135),
    "loop: floor of angles": (lambda x: _sigmas(0.01)[1] < x, 0.052, 0.066),
    "density: turns": (lambda x: bool(_kept(x)[2]) and not _kept(x)[1], 0.22, 0.28),
    "overlap: scale": (lambda x: not _visible(x), 2.25, 2.75),
    "overlap: depth": (lambda x: _visible(1.0, x), 0.09, 0.11),
    "index: neighbours": (lambda n: _candidate(30, int(n)) > 5, 13, 16),
    "rig: length": (
        lambda x: not _is_alike(replace(CAMERA, baseline_m=CAMERA.baseline_m * (1 + x)), CAMERA),
        0.026,
        0.034,
    ),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_maps(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
