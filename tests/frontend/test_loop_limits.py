"""Limits inside the compiled loops of the front end, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA
from tests.frontend.test_motion_limits import _fit
from vio.cameras.projection import camera_args
from vio.frontend import anchor_fit, prediction, stereo_fit, stereo_match
from vio.frontend.align import on_peak
from vio.frontend.keypoints import Keypoints, MutualNearest
from vio.frontend.outliers import pixel_errors
from vio.frontend.stereo_match import EpipolarRowModel
from vio.guard.probe import RowProbe

Says = Callable[[float], bool]
STILL = np.eye(4)


def _row_after_a_frame() -> float:
    """The row difference that is learned of 100 matches with one of a pixel, almost half of which are
    further off.
    """
    model = EpipolarRowModel(640, 480)
    left = np.random.default_rng(0).uniform([0.0, 0.0], [640.0, 480.0], (100, 2))
    right = left + np.array([-10.0, 1.0])
    right[:45, 1] += 0.8
    model.update(left, right)
    return model.offset_px


def _has_point(disparity_px: float) -> bool:
    """Whether a match gives a point whose disparity is so small after the right camera's turn."""
    columns = stereo_fit._RightColumns(
        np.zeros((1, 2)),
        np.zeros(1, np.bool_),
        np.zeros((1, 2, 2)),
        np.zeros((1, 3)),
        np.zeros(1, np.bool_),
    )
    matches = stereo_fit._Matches(
        np.array([[100.0 - disparity_px, 50.0]]), np.zeros((1, 2, 2)), np.ones(1, np.bool_)
    )
    left = np.array([[100.0, 50.0]])
    stereo_fit._match(camera_args(CAMERA), 40.0, left, np.array([0]), matches, columns)
    return bool(columns.has_point[0])


def _is_match(
    row_px: float = 0.0, skew: float = 0.0, disparity_px: float = 20.0, score: float = 1.0
) -> bool:
    """Whether an aligned anchor is a match in the right image, whose row and shape are off."""
    before = np.zeros((1, 2, 3))
    before[0, :, :2] = np.eye(2)
    left = np.array([[100.0, 50.0]])
    start = before.copy()
    start[0, :, 2] = [100.0 - disparity_px, 50.0]
    warp = start.copy()
    warp[0, 1, 2] += row_px
    warp[0, 0, 1] += skew
    fits = stereo_fit._Fits(left, start, warp, np.array([score]))
    out = stereo_fit._Matches(np.zeros((1, 2)), np.zeros((1, 2, 2)), np.zeros(1, np.bool_))
    stereo_fit._judge(before, np.zeros(1, np.int64), fits, 200.0, out)
    return bool(out.good[0])


def _is_nearest(ratio: float) -> bool:
    """Whether a descriptor is matched whose second-nearest is further by this ratio."""
    angles = 2.0 * np.arcsin(0.4 * np.array([0.0, ratio, -1.0]))
    units = np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)
    one = Keypoints(np.zeros((1, 2)), units[:1])
    other = Keypoints(np.zeros((2, 2)), units[1:])
    return len(MutualNearest()(one, other, np.ones((1, 2), np.bool_))) > 0


def _has_error(depth_m: float) -> bool:
    errors = pixel_errors(CAMERA, STILL, np.array([[0.0, 0.0, depth_m]]), np.zeros((1, 2)))
    return bool(np.isfinite(errors[0]))


def _is_moved(depth_m: float) -> bool:
    """Whether a pixel is predicted whose point is so near after a motion."""
    T = np.eye(4)
    T[2, 3] = -5.0
    left = np.array([[7.0, 7.0]])
    point = np.array([[0.0, 0.0, 5.0 + depth_m]])
    return bool(prediction.moved_pixels(CAMERA, T, point, left)[0, 0] != 7.0)


def _borrows_depth(neighbours: int) -> bool:
    """Whether a feature without a point moves sideways as its neighbours do."""
    T = np.eye(4)
    T[0, 3] = 0.5
    count = neighbours + 1
    left = np.column_stack([100.0 + np.arange(count), np.full(count, 100.0)])
    point = np.column_stack([np.zeros((count, 2)), np.full(count, 5.0)])
    pixels = left.copy()
    prediction._move_all(camera_args(CAMERA), T, point, np.arange(count) < neighbours, left, pixels)
    return bool(abs(pixels[-1, 0] - left[-1, 0]) > 5.0)


def _scales(depth_m: float) -> bool:
    """Whether an anchor's scale is predicted of a point that comes so near."""
    before = np.array([[0.0, 0.0, 5.0]])
    after = np.array([[0.0, 0.0, depth_m]])
    points = anchor_fit._Moved(camera_args(CAMERA), STILL, before, after, np.ones(1, np.bool_))
    out = anchor_fit._Starts(np.zeros(1, np.int64), np.zeros((1, 2)), np.ones(1))
    pixels = np.array([[100.0, 100.0]])
    found = anchor_fit._Found(pixels, np.ones(1, np.bool_))
    anchor_fit._begin(points, True, (480, 300), pixels, found, out)
    return bool(out.scale[0] != 1.0)


def _is_flat(ones: int, twos: int = 0) -> bool:
    """Whether a patch of 81 pixels has no correlation of which so many are one, or two, gray levels
    off.
    """
    patch = np.zeros(81)
    patch[:ones] = np.where(np.arange(ones) % 2, 1.0, -1.0)
    patch[ones : ones + twos] = np.where(np.arange(twos) % 2, 2.0, -2.0)
    image = np.full((9, 40), 128.0)
    image[:, 10:19] += np.random.default_rng(0).permutation(patch).reshape(9, 9)
    gray = image.astype(np.uint8)
    score = np.zeros((1, 1), np.float32)
    stereo_match.correlate(gray, gray, np.array([[14, 4]]), np.array([14]), 4, score)
    return bool(score[0, 0] == -1.0)


def _model(*frames: tuple[int, int, float]) -> EpipolarRowModel:
    """Rows learned in frames: their number, their matches in the middle of the image, and by how
    much their rows differ, px.
    """
    rows = EpipolarRowModel(480, 300)
    for count, matches, off_px in frames:
        left = np.tile([240.0, 150.0], (matches, 1))
        for _ in range(count):
            rows.update(left, left + np.array([0.0, off_px]))
    return rows


def _outlier_px() -> float:
    """Row difference of 80 exact matches and 20 that are off by two pixels."""
    rows = EpipolarRowModel(480, 300)
    left = np.tile([240.0, 150.0], (100, 1))
    off = np.where(np.arange(100) < 20, 2.0, 0.0)
    for _ in range(30):
        rows.update(left, left + np.column_stack([np.zeros(100), off]))
    return rows.offset_px


def _finds_rows(rows: int) -> bool:
    """Whether a row difference is found, in pixels at half resolution."""
    fit = _fit()
    fit.count_on_rows = lambda left, right, points: 100 * (right == rows)
    nothing: Any = None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stereo_fit, "shifted_rows", lambda image, k: k)
        return bool(fit._best_offset(nothing, nothing, np.zeros((100, 2)), 0) == rows)


def _well_matched(shift: int) -> bool:
    """Whether corners match well on their rows in images of 320 pixels that are shifted by some."""
    texture = np.random.default_rng(0).integers(0, 255, (120, 500)).astype(np.uint8)
    left = texture[:, :320].copy()
    right = texture[:, shift : shift + 320].copy()
    points = np.random.default_rng(1).uniform([300.0, 40.0], [600.0, 200.0], (60, 2)).round()
    return RowProbe().on_rows(left, right, points) > 30


def _moved(px: float) -> bool:
    return bool(on_peak(np.array([[px, 0.0]]), np.zeros((1, 2)))[0])


LIMITS: dict[str, tuple[Says, float, float]] = {
    "match: row": (lambda x: not _is_match(row_px=x), 0.87, 1.13),
    "match: skew": (lambda x: not _is_match(skew=x), 0.7, 0.9),
    "rows: weights": (lambda x: _row_after_a_frame() < x, 1.055, 1.08),
    "match: depth": (_has_point, 0.09, 0.11),
    "match: disparity": (lambda x: _is_match(disparity_px=x), 0.26, 0.34),
    "match: correlation": (lambda x: _is_match(score=x), 0.74, 0.86),
    "match: peak": (lambda x: not _moved(x), 2.2, 2.8),
    "key points: ratio": (lambda x: not _is_nearest(x), 0.7, 0.9),
    "errors: depth": (_has_error, 0.043, 0.057),
    "predicted: depth": (_is_moved, 0.087, 0.113),
    "predicted: neighbours": (lambda n: _borrows_depth(int(n)), 2, 3),
    "anchor: depth": (_scales, 0.087, 0.113),
    "flat": (lambda n: not _is_flat(int(n), 9 if n == 72 else 0), 58, 72),
    "rows: memory": (
        lambda n: _model((100, 200, 0.0), (int(n), 200, 0.1)).offset_px > 0.05,
        11,
        17,
    ),
    "rows: prior": (lambda n: _model((1, int(n), 0.001)).offset_px > 0.0005, 3, 5),
    "rows: outliers": (lambda x: _outlier_px() < x, 0.02, 0.045),
    "rows: search": (lambda n: not _finds_rows(int(n)), 16, 17),
    "rows: usual disparity": (lambda n: not _well_matched(int(n)), 46, 57),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_in_loops(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
