"""Each limit of which corners become features, and what predictions are used, from both sides."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA
from vio.frontend.columns import changed
from vio.frontend.detect import detect_corners, grid_shape, min_distance_px
from vio.frontend.frames import usable_prior
from vio.frontend.new_features import NewFeatures
from vio.frontend.outliers import Consensus
from vio.frontend.settings import GridSettings
from vio.frontend.tracks import AnchorBank, Tracks, new_tracks
from vio.geometry.lie import se3_exp
from vio.records import Image, IntArray, TrackPrior

Says = Callable[[float], bool]
GRID = GridSettings(target_features=100)


class _Right:
    """Right images that may be used and are needed."""

    usable = True
    needed = True
    delayed = False


def _new() -> NewFeatures:
    bank = AnchorBank(300, 9)
    return NewFeatures(CAMERA, GRID, bank, _Right())  # type: ignore[arg-type]


def _tracks(count: int, matched: int = 0, age: int = 0, left_only: int = 0) -> Tracks:
    pixels = np.random.default_rng(0).uniform(30.0, 100.0, (count, 2))
    return changed(
        new_tracks(pixels, np.arange(count)),
        has_right=np.arange(count) < matched,
        age=np.full(count, age),
        left_only_frames=np.full(count, left_only),
    )


def _wanted(active: int) -> tuple[int, int]:
    """Corners to detect in two frames in a row, beside so many features."""
    new = _new()
    return new._wanted_corners(active), new._wanted_corners(active)


def _chosen(active: int, matched: int, unique: bool, stays: bool, corners: int = 200) -> IntArray:
    return _new()._select_corners(
        _tracks(active, matched), np.full(corners, unique), np.full(corners, stays), False
    )[0]


def _stays(ahead_m: float) -> bool:
    """Whether a point near the border stays visible where the camera goes ahead by so much a frame."""
    motion = Consensus(se3_exp([0.0, 0.0, -ahead_m, 0.0, 0.0, 0.0]), np.ones(1, np.bool_))
    image = np.zeros((CAMERA.height or 0, CAMERA.width or 0), np.uint8)
    corner = np.array([[0.25 * (CAMERA.width or 0), CAMERA.cv]])
    disparity = np.array([CAMERA.fu * CAMERA.baseline_m / 10.0])
    return bool(_new()._stay_visible(corner, disparity, motion, image)[0])  # type: ignore[arg-type]


def _output(count: int, age: int, proven: int) -> int:
    """Features that are output, of which some are matched."""
    return int(_new().output(_tracks(count, proven, age)).shown.sum())


def _output_of_new(age: int) -> bool:
    """Whether matched features of an age are output beside as many old ones."""
    tracks = _tracks(100, 100, 5)
    tracks = changed(tracks, age=np.where(np.arange(100) < 50, 5, age))
    return int(_new().output(tracks).shown.sum()) == 100


def _kept(left_only: int) -> bool:
    return len(_new()._without_old_left_only(_tracks(3, 0, 5, left_only)).ids) > 0


def _is_rotation(off: float) -> bool:
    R = np.eye(3)
    R[0, 0] += off / 2
    prior = usable_prior(TrackPrior(np.array([1]), np.zeros((1, 4)), R))
    return prior is not None and prior.R_cam_prev is not None


LIMITS: dict[str, tuple[Says, float, float]] = {
    "corners: few missing": (lambda n: _wanted(int(100 - n))[0] > 0, 10, 11),
    "corners: spare": (lambda n: _wanted(20)[0] < n, 195, 205),
    "corners: tried": (lambda n: len(_chosen(60, 60, True, True)) < n, 58, 62),
    "corners: leave soon": (lambda n: len(_chosen(90, int(90 - n), True, False)) > 0, 18, 22),
    "corners: no depth": (lambda n: len(_chosen(60, int(n), False, True)) == 0, 33, 37),
    "corners: stay": (lambda x: not _stays(x), 0.68, 0.83),
    "left alone": (lambda n: not _kept(int(n)), 9, 10),
    "output: probation": (lambda n: _output_of_new(int(n)), 0, 1),
    "output: few": (lambda n: _output(100, 3, int(n)) < 100, 22, 28),
    "grid: cells": (lambda n: grid_shape(640, 480, GRID)[1] < n, 6, 7),
    "grid: distance": (lambda n: min_distance_px(640, 480, GRID) < n, 7, 9),
    "prediction: rotation": (lambda x: not _is_rotation(x), 0.9e-3, 1.1e-3),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_new_features(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


# Corners of an image


def _half(contrasts: dict[tuple[int, int], float], noise: float = 0.0) -> Image:
    """An image (120, 160) with squares of 8 pixels at (x, y), brighter by their contrasts."""
    image = np.full((120, 160), 100.0)
    for (x, y), contrast in contrasts.items():
        image[y : y + 8, x : x + 8] += contrast
    image += noise * np.random.default_rng(0).normal(size=image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def _found(image: Image, x: int, y: int, wanted: int = 60, features: int = 12) -> bool:
    """Whether a corner is found at the square at (x, y)."""
    grid = GridSettings(target_features=features)
    corners = detect_corners(image, np.zeros((0, 2)), wanted, grid) / 2
    return bool(len(corners)) and bool((np.abs(corners - [x + 4, y + 4]).max(axis=1) < 7).any())


CORNERS: dict[str, tuple[Says, float, float]] = {
    "beside a stronger one": (
        lambda x: _found(_half({(60, 14): 150.0, (60, 36): x}), 60, 36),
        19.0,
        27.0,
    ),
    "in little noise": (
        lambda x: _found(_half({(60, 40): x}, 0.5), 60, 40, features=100),
        3.7,
        5.0,
    ),
    "in noise": (lambda x: _found(_half({(60, 40): x}, 2.0), 60, 40, features=100), 3.5, 4.6),
}


@pytest.mark.parametrize(("says", "below", "above"), CORNERS.values(), ids=CORNERS)
def test_limits_of_corners(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
