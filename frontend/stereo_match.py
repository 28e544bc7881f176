"""Left-right matching on a rectified pair: a normalised search along the row, then sub-pixel alignment.

The search compares zero-mean, unit-norm patches, so that exposure and gain may differ between the cameras. New points
are searched over the whole disparity range at half resolution; points with a predicted disparity only near it. In the
alignment a patch may shift, shear and stretch along the row, because the disparity of a slanted surface (the road,
above all) changes across it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from frontend.align import FLAT_RMS, align, cut_patches, shift_warps, templates
from frontend.patches import inside, integer_patches
from frontend.settings import KltSettings
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, Image, IntArray

_COARSE_RADIUS = 4  # pixels of the half-resolution image
_NEAR_PX = 3  # half width of the search around a predicted or coarse disparity
_BACK_PX = 6  # half width of the search back in the left image
_PEAK_HALF_WIDTH = 2  # neighbours of the best candidate that count as the same peak
_ALIGN_ITERATIONS = 6
_MAX_STRETCH = 0.8  # change of disparity per pixel; the road under a car reaches about 0.4
_ALIGN_MAX_PX = 2.0  # a fit that moves further than this has left its peak


@dataclass(frozen=True, slots=True)
class RowPyramid:
    """One image at full and at half resolution; a point (u, v) lies at (u/2, v/2) in the half image."""

    full: Image
    half: Image


@dataclass(frozen=True, slots=True)
class StereoMatch:
    """Right pixels of N left points."""

    right: FloatArray  # (N, 2) [ur vr], arbitrary where not valid
    valid: BoolArray  # (N,)


def row_pyramid(image: Image) -> RowPyramid:
    """Build the two levels that `match_rows` needs."""
    return RowPyramid(image, np.asarray(cv2.pyrDown(image), dtype=np.uint8))


def row_correlation(
    source: Image, target: Image, centres: IntArray, first_column: IntArray, count: int, radius: int
) -> npt.NDArray[np.float32]:
    """Normalised correlation (N, count) of source patches with the target patches of the same row.

    Candidate k of point n is centred at column `first_column[n] + k`. Candidates whose patch leaves the image, and
    patches without contrast, score -1. The source patches must lie inside the source image.
    """
    side = 2 * radius + 1
    template = integer_patches(source, centres - radius, side, side)
    template -= template.mean(axis=(1, 2), keepdims=True)
    norm = np.sqrt(np.einsum("nhw,nhw->n", template, template))
    width = target.shape[1]
    columns = first_column[:, None] + np.arange(count)
    pad_left = max(0, -int(columns.min(initial=0)) + radius)
    pad_right = max(0, int(columns.max(initial=0)) + radius + 1 - width)
    padded = np.asarray(cv2.copyMakeBorder(target, 0, 0, pad_left, pad_right, cv2.BORDER_REPLICATE), dtype=np.uint8)
    corner = np.stack([first_column + pad_left - radius, centres[:, 1] - radius], axis=1)
    strip = integer_patches(padded, corner, side, count + side - 1)
    product = np.zeros((len(centres), count), dtype=np.float32)
    for column in range(side):
        product += np.einsum("nhk,nh->nk", strip[:, :, column : column + count], template[:, :, column])
    total = _window_sums(strip.sum(axis=1), side)
    square = _window_sums(np.einsum("nhk,nhk->nk", strip, strip), side)
    target_norm = np.sqrt(np.maximum(square - total * total / side**2, 0.0))
    flat = FLAT_RMS * side
    good = (norm[:, None] > flat) & (target_norm > flat) & (columns >= radius) & (columns < width - radius)
    score = np.where(good, product / np.where(good, norm[:, None] * target_norm, 1.0), -1.0)
    return score.astype(np.float32)


def _window_sums(values: npt.NDArray[np.float32], side: int) -> FloatArray:
    """Sums (N, K - side + 1) of `side` neighbouring values (N, K); exact for whole numbers."""
    running = np.cumsum(values, axis=1, dtype=np.float64)
    sums = running[:, side - 1 :].copy()
    sums[:, 1:] -= running[:, :-side]
    return sums


def _best(score: npt.NDArray[np.float32]) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the best candidate (N,), its score (N,), and the best score away from its peak (N,)."""
    rows = np.arange(len(score))
    best = np.argmax(score, axis=1)
    near = np.abs(np.arange(score.shape[1]) - best[:, None]) <= _PEAK_HALF_WIDTH
    second = np.where(near, -1.0, score).max(axis=1)
    return best, score[rows, best].astype(np.float64), second.astype(np.float64)


def _search(
    source: Image, target: Image, points: FloatArray, low: FloatArray, high: FloatArray, radius: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Search shifts `low..high` (N,) along the row; return the best shift (N,), its score and the runner-up's."""
    centres = np.rint(points).astype(np.int64)
    start = np.floor(low).astype(np.int64)
    count = int(np.max(np.ceil(high) - start, initial=0)) + 1
    safe = np.clip(centres, radius, np.array([source.shape[1], source.shape[0]]) - radius - 1)
    score = row_correlation(source, target, safe, safe[:, 0] + start, count, radius)
    shifts = start[:, None] + np.arange(count)
    score = np.where(shifts <= np.ceil(high)[:, None], score, np.float32(-1.0))
    best, top, second = _best(score)
    # The patches were cut at whole pixels; the shift carries over to the sub-pixel point.
    return (start + best).astype(np.float64), np.where((safe == centres).all(axis=1), top, -1.0), second


def match_rows(
    left: RowPyramid, right: RowPyramid, points: FloatArray, disparity_guess: FloatArray, settings: KltSettings
) -> StereoMatch:
    """Match left points (N, 2) into the right image of a rectified pair.

    Args:
        left: the image of the points.
        right: the image to search.
        points: left pixels (N, 2).
        disparity_guess: expected `ul - ur` (N,); NaN where nothing is known, which costs a search of the whole range.
        settings: gates and patch size.
    """
    n = len(points)
    radius = settings.stereo_radius_px
    max_disparity = settings.max_disparity * left.full.shape[1]
    guess = np.clip(disparity_guess, 0.0, max_disparity)
    shift, score = np.zeros(n), np.full(n, -1.0)
    known = np.flatnonzero(np.isfinite(guess))
    if len(known):
        shift[known], score[known] = _near(left.full, right.full, points[known], -guess[known], _NEAR_PX, radius)
    lost = np.flatnonzero(score < settings.min_correlation)
    if len(lost):
        coarse, unique = _whole_row(left.half, right.half, points[lost], max_disparity, settings.min_peak_margin)
        shift[lost], score[lost] = _near(left.full, right.full, points[lost], coarse, _NEAR_PX, radius)
        score[lost[~unique]] = -1.0
    found = np.flatnonzero((score > settings.min_correlation - 0.2) & inside(left.full, points, radius + 2))
    place, valid = np.zeros((n, 2)), np.zeros(n, dtype=np.bool_)
    if len(found) == 0:
        return StereoMatch(place, valid)
    start = points[found] + np.stack([shift[found], np.zeros(len(found))], axis=1)
    template = templates(cut_patches(left.full, points[found], radius))
    warp, score[found] = align(template, right.full, shift_warps(start), "row", _ALIGN_ITERATIONS)
    place[found] = warp[:, :2, 2]
    on_peak = (np.abs(place[found] - start).max(axis=1) <= _ALIGN_MAX_PX) & (
        np.abs(warp[:, 0, :2] - [1.0, 0.0]).max(axis=1) <= _MAX_STRETCH
    )
    back, _ = _near(right.full, left.full, place[found], points[found, 0] - place[found, 0], _BACK_PX, radius)
    returns = np.abs(place[found, 0] + back - points[found, 0]) <= 1.5  # whole-pixel search: one pixel plus rounding
    disparity = points[found, 0] - place[found, 0]
    valid[found] = (
        returns
        & on_peak
        & (score[found] >= settings.min_correlation)
        & (np.abs(points[found, 1] - place[found, 1]) <= settings.max_epipolar_px)
        & (disparity >= settings.min_disparity_px)
        & (disparity <= max_disparity)
    )
    return StereoMatch(place, valid)


def _near(
    source: Image, target: Image, points: FloatArray, shift: FloatArray, half_width: int, radius: int
) -> tuple[FloatArray, FloatArray]:
    """Search within `half_width` pixels of a predicted shift (N,); return the best shift and its score."""
    best, score, _ = _search(source, target, points, shift - half_width, shift + half_width, radius)
    return best, score


def _whole_row(
    left: Image, right: Image, points: FloatArray, max_disparity: float, margin: float
) -> tuple[FloatArray, BoolArray]:
    """Search the whole disparity range at half resolution, both ways.

    Returns:
        Shifts (N,) in full-resolution pixels, and a mask (N,) of those that are unique and found again backwards.
    """
    n = len(points)
    reach = np.full(n, max_disparity / 2)
    shift, score, second = _search(left, right, points / 2, -reach, np.zeros(n), _COARSE_RADIUS)
    there = points / 2 + np.stack([shift, np.zeros(n)], axis=1)
    back, _, _ = _search(right, left, there, np.zeros(n), reach, _COARSE_RADIUS)
    return 2 * shift, (np.abs(shift + back) <= 1.0) & (score - second >= margin)


def mirrored(pyramid: RowPyramid) -> RowPyramid:
    """Return the pyramid of the image flipped left to right; negative disparities become positive in it."""
    return row_pyramid(np.ascontiguousarray(pyramid.full[:, ::-1]))
