"""Left-right matching on a rectified pair: normalised correlation along the row over all
disparities.

The search compares zero-mean, unit-norm patches, so that exposure and gain may differ between the
cameras. It runs at half resolution, left to right and back; `frontend.align` then finds the
sub-pixel position in the full image.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.frontend.align import FLAT_RMS
from vio.frontend.weighted_fit import add_equations
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled, solve_positive
from vio.records import BoolArray, Image, IntArray

MIN_MATCH_DISPARITY_PX = 0.3  # smallest disparity of a stereo match
_RADIUS = 4  # pixels of the half-resolution image
_PEAK_HALF_WIDTH = 2  # neighbours of the best candidate that count as the same peak
_FIELD_MEMORY = 0.95  # forgetting factor of previous frames, per frame
_FIELD_PRIOR = 4.0  # weight of the prior of zero row difference, in matches
_FIELD_SIGMA_PX = 0.5
_FIELD_ITERATIONS = 3
# root mean square of the row differences: from here on the run reports the calibration, too
_ROWS_OFF_PX = 0.2
# the third of three like angles over the root mean square of two, at most, at 99 %
_THIRD_ANGLE = 7.0


class _RowSearch(NamedTuple):
    """How features are searched along rows, and when other rows are tried."""

    # of the image width: largest disparity that is searched where the scene is near
    max_disparity: float = 0.64
    min_margin: float = 0.03  # lead in correlation over the second-best match in the row
    good_correlation: float = 0.9  # of patches whose rows agree
    # share of features with a right match below which other row differences are tried
    few_share: float = 0.2
    max_rows_half: int = 16  # row difference, pixels at half resolution


ROW_SEARCH = _RowSearch()
Scores = npt.NDArray[np.float32]  # correlations, and what they are computed from


class EpipolarRowModel:
    """Row differences of matches over the image, estimated from the matches: the residual error of
    the rectification.

    A small error of the relative rotation or principal point moves rows by a low polynomial in the
    pixel: 1, x, y, x y and y^2 of equation (R2) of docs/math.md. At a slanted edge it causes an
    error of the disparity.
    """

    def __init__(self, width: int, height: int) -> None:
        self._centre = np.array([width / 2, height / 2])
        self._normal = _FIELD_PRIOR * np.eye(5)
        self._moment = np.zeros(5)
        self._field: FloatArray = np.zeros(5)
        self.rms_px = 0.0  # of the field over the matches of the last frame

    def _terms(self, pixels: FloatArray) -> FloatArray:
        terms = np.empty((len(pixels), 5))
        _write_terms(pixels, self._centre, terms)
        return terms

    @property
    def offset_px(self) -> float:
        """Row difference at the image's centre, pixels."""
        return float(self._field[0])

    @property
    def are_off(self) -> bool:
        """Whether the rows of the matches differ by a smooth field: the calibration is off, and
        so are the depths.
        """
        return self.rms_px >= _ROWS_OFF_PX

    def disparity_error_px(self, focal_px: float) -> float:
        """Bound of the error of disparities that the rows suggest, pixels; 0: they agree.

        Of three like angles of a mount, two shift rows: the third is of their size, and Student's t
        with two degrees of freedom bounds it. What it does to the rows itself is added.
        """
        if not self.are_off:
            return 0.0
        return _THIRD_ANGLE * self.rms_px + self.disparity_px(focal_px)

    def disparity_px(self, focal_px: float) -> float:
        """Size of the common error of disparities, pixels, of the yaw that the rows show.

        A yaw shifts rows by u v / f for what it shifts disparities by f, (R1): the term in x y.
        """
        return abs(float(self._field[3])) * (focal_px / self._centre[0]) ** 2

    def restart(self, offset_px: float) -> None:
        """Begin again with the same row difference over the whole image."""
        self._normal = _FIELD_PRIOR * np.eye(5)
        self._moment = np.zeros(5)
        self._field = np.array([offset_px, 0.0, 0.0, 0.0, 0.0])
        self._moment[0] = _FIELD_PRIOR * offset_px

    def rows(self, left: FloatArray) -> FloatArray:
        """Expected rows (N,) in the right image of left pixels (N, 2)."""
        return left[:, 1] + self._terms(left) @ self._field

    def update(self, left: FloatArray, right: FloatArray) -> None:
        """Update the estimate with the matches (N, 2) and (N, 2) of one frame; outliers have
        little weight.
        """
        terms = self._terms(left)
        off = right[:, 1] - left[:, 1]
        _learn(terms, off, self._normal, self._moment, self._field)
        if len(terms):
            fitted = terms @ self._field
            self.rms_px = math.sqrt(float(fitted @ fitted) / len(fitted))


@compiled
def _write_terms(pixels: FloatArray, centre: FloatArray, terms: FloatArray) -> None:
    """Write the terms (N, 5) of the row differences at pixels (N, 2)."""
    for n in range(len(pixels)):
        x = (pixels[n, 0] - centre[0]) / centre[0]
        y = (pixels[n, 1] - centre[1]) / centre[0]
        terms[n, 0] = 1.0
        terms[n, 1] = x
        terms[n, 2] = y
        terms[n, 3] = x * y
        terms[n, 4] = y * y


@compiled
def _learn(
    terms: FloatArray, off: FloatArray, normal: FloatArray, moment: FloatArray, field: FloatArray
) -> None:
    """Add the row differences (N,) of a frame's matches to the normal equations, and solve these
    for the field.
    """
    size = len(field)
    for i in range(size):
        for j in range(size):
            normal[i, j] *= _FIELD_MEMORY
        normal[i, i] += (1 - _FIELD_MEMORY) * _FIELD_PRIOR
        moment[i] *= _FIELD_MEMORY
    kept = normal.copy()
    kept_moment = moment.copy()
    for _ in range(_FIELD_ITERATIONS):
        for i in range(size):
            for j in range(size):
                normal[i, j] = kept[i, j]
            moment[i] = kept_moment[i]
        add_equations(terms, off, field, _FIELD_SIGMA_PX, normal, moment)
        for i in range(size):
            field[i] = moment[i]
        solve_positive(normal.copy(), field)


def shifted_rows(image: Image, rows: int) -> Image:
    """The image (H, W) moved up by a number of rows; the last one is repeated."""
    if rows == 0:
        return image
    chosen = np.clip(np.arange(len(image)) + rows, 0, len(image) - 1)
    return np.ascontiguousarray(image[chosen])


def mirrored(
    left_half: Image, right_half: Image, points: FloatArray
) -> tuple[Image, Image, FloatArray]:
    """Return images (H/2, W/2) and left pixels (N, 2) of the full image with the columns in reverse
    order, in which negative disparities are positive ones.
    """
    left, right = (np.ascontiguousarray(image[:, ::-1]) for image in (left_half, right_half))
    return left, right, points * [-1.0, 1.0] + [2.0 * (left_half.shape[1] - 1), 0.0]


@compiled
def correlate(
    source: Image,
    target: Image,
    centres: IntArray,
    first_column: IntArray,
    radius: int,
    out: Scores,
) -> None:
    """Write the normalised correlations (N, count) of source patches with the target patches of the
    same row.

    Candidate k of point n is centred at column `first_column[n] + k`. Candidates whose patch leaves
    the image, and patches without contrast, score -1. The source patches must lie inside the source
    image. Sums of products of 81 pairs of gray levels are exact in 32 bits of float.
    """
    width = target.shape[1]
    count = out.shape[1]
    side = 2 * radius + 1
    size = side * side
    flat = FLAT_RMS**2 * side * side
    strip = np.empty(count + side - 1, np.float32)
    product = np.empty(count, np.float32)
    total = np.empty(len(strip), np.float32)
    squares = np.empty(len(strip), np.float32)
    windows = np.empty(count, np.float32)
    square_windows = np.empty(count, np.float32)
    for n in range(len(centres)):
        column = centres[n, 0] - radius
        row = centres[n, 1]
        first = first_column[n]
        own_total = 0
        own_squares = 0
        for k in range(len(strip)):
            total[k] = squares[k] = 0.0
        for k in range(count):
            product[k] = 0.0
        for y in range(row - radius, row + radius + 1):
            _cut_row(target, y, first - radius, strip)
            for k in range(len(strip)):
                total[k] += strip[k]
                squares[k] += strip[k] * strip[k]
            for x in range(side):
                gray = int(source[y, column + x])
                own_total += gray
                own_squares += gray * gray
            own = source[y, column:]
            # three at once: to read and write the sums takes longer than to add
            for x in range(0, side - 2, 3):
                a = np.float32(own[x])
                b = np.float32(own[x + 1])
                c = np.float32(own[x + 2])
                one = strip[x:]
                two = strip[x + 1 :]
                three = strip[x + 2 :]
                for k in range(count):
                    product[k] += a * one[k] + b * two[k] + c * three[k]
            for x in range(side - side % 3, side):
                a = np.float32(own[x])
                one = strip[x:]
                for k in range(count):
                    product[k] += a * one[k]
        energy = own_squares - own_total**2 / size
        _sum_windows(total, side, windows)
        _sum_windows(squares, side, square_windows)
        for k in range(count):
            level_sum = np.float64(windows[k])
            other = square_windows[k] - level_sum**2 / size
            score = (product[k] - own_total * level_sum / size) / np.sqrt(energy * other)
            inside = radius <= first + k < width - radius
            out[n, k] = score if inside and energy > flat and other > flat else -1.0


@compiled
def _cut_row(image: Image, y: int, first: int, strip: Scores) -> None:
    """Write the gray levels of a row from a column on into `strip`; outside the image (H, W) its
    border is repeated.
    """
    last = image.shape[1] - 1
    if first >= 0 and first + len(strip) <= image.shape[1]:
        for k in range(len(strip)):
            strip[k] = image[y, np.uint64(first + k)]
    else:
        for k in range(len(strip)):
            strip[k] = image[y, min(max(first + k, 0), last)]


@compiled
def _sum_windows(values: Scores, side: int, out: Scores) -> None:
    """Write the sums (N,) of `side` numbers in a row, of (N + side - 1,)."""
    for k in range(len(out)):
        out[k] = 0.0
    for x in range(side):
        rest = values[x:]
        for k in range(len(out)):
            out[k] += rest[k]


@compiled
def _search(
    source: Image,
    target: Image,
    points: FloatArray,
    low: int,
    high: int,
    shift: FloatArray,
    top: FloatArray,
) -> None:
    """Search shifts `low..high` along the row for points (N, 2).

    Writes the best shift (N,), sub-pixel, and into `top` (2, N) its score, -1 too close to the
    border, and the best score outside its peak.
    """
    height, width = source.shape
    centres = np.empty((len(points), 2), np.int64)
    first = np.empty(len(points), np.int64)
    for n in range(len(points)):
        centres[n, 0] = min(max(int(np.rint(points[n, 0])), _RADIUS), width - _RADIUS - 1)
        centres[n, 1] = min(max(int(np.rint(points[n, 1])), _RADIUS), height - _RADIUS - 1)
        first[n] = centres[n, 0] + low
    score = np.empty((len(points), high - low + 1), np.float32)
    correlate(source, target, centres, first, _RADIUS, score)
    _peaks(score, shift, top[0], top[1])
    farthest = low if -low > high else high
    for n in range(len(points)):
        # The patches were cut at whole pixels; the shift carries over to the sub-pixel point.
        shift[n] += low
        if shift[n] == farthest:  # no peak, as the next candidate may be better
            top[0, n] = -1.0
        if centres[n, 0] != np.rint(points[n, 0]) or centres[n, 1] != np.rint(points[n, 1]):
            top[0, n] = -1.0


@compiled
def _peaks(score: Scores, offset: FloatArray, top: FloatArray, second: FloatArray) -> None:
    """Write each row's best candidate (N,), sub-pixel by a parabola, its score, and the best
    score outside its peak.
    """
    last = score.shape[1] - 1
    for n in range(len(score)):
        best = 0
        for k in range(1, last + 1):
            if score[n, k] > score[n, best]:
                best = k
        second[n] = -1.0
        for k in range(last + 1):
            if abs(k - best) > _PEAK_HALF_WIDTH:
                second[n] = max(second[n], score[n, k])
        offset[n] = best
        top[n] = score[n, best]
        if 0 < best < last:
            before = float(score[n, best - 1])
            after = float(score[n, best + 1])
            bend = before - 2.0 * top[n] + after
            if bend < 0.0:
                offset[n] += min(max((before - after) / (2.0 * bend), -0.5), 0.5)


def match_rows(
    left_half: Image,
    right_half: Image,
    points: FloatArray,
    max_disparity: float,
    min_correlation: float,
    margin: float,
) -> tuple[FloatArray, BoolArray]:
    """Match points of the left image into the right one, to about half a pixel.

    Args:
        left_half: left image at half resolution.
        right_half: right image at half resolution.
        points: left pixels (N, 2) of the full image.
        max_disparity: largest disparity, pixels of the full image.
        min_correlation: smallest normalised correlation.
        margin: smallest lead over the second-best match in the row.

    Returns:
        Disparities (N,) in pixels of the full image, and a mask (N,) of those with sufficient
        correlation, unique, and confirmed by the reverse search.
    """
    disparity = np.empty(len(points))
    valid = np.empty(len(points), dtype=np.bool_)
    images = np.ascontiguousarray(left_half), np.ascontiguousarray(right_half)
    _match(
        images, points / 2, math.ceil(max_disparity / 2), min_correlation, margin, disparity, valid
    )
    return disparity, valid


@compiled
def _match(
    images: tuple[Image, Image],
    points: FloatArray,
    reach: int,
    min_correlation: float,
    margin: float,
    disparity: FloatArray,
    valid: BoolArray,
) -> None:
    """Write what `match_rows` returns, for points (N, 2) in pixels of the half image."""
    left, right = images
    count = 0
    shift = np.empty(len(points))
    top = np.empty((2, len(points)))
    there = np.empty((len(points), 2))
    backward = -reach  # no literals: see `vio.numerics.compiled`
    low = int(np.int64(-1))
    high = int(np.int64(1))
    _search(left, right, points, backward, high, shift, top)
    for n in range(len(points)):
        disparity[n] = -2.0 * shift[n]
        valid[n] = top[0, n] >= min_correlation and top[0, n] - top[1, n] >= margin
        if valid[n]:
            there[count, 0] = points[n, 0] + shift[n]
            there[count, 1] = points[n, 1]
            count += 1
    _search(right, left, there[:count], low, reach, shift, top)
    count = 0
    for n in range(len(points)):
        if valid[n]:
            valid[n] = abs(0.5 * disparity[n] - shift[count]) <= 1.0
            count += 1
