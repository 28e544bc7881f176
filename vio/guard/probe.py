"""Matches between two images that need no front end: corners of one, searched along the rows of the
other.
"""

from __future__ import annotations

import numpy as np

from vio.frontend.detect import detect_corners
from vio.frontend.settings import GridSettings
from vio.frontend.stereo_match import match_rows, shifted_rows
from vio.geometry.lie import FloatArray
from vio.records import Image, IntArray

CORNERS = 80  # that are searched, at most
_MAX_DISPARITY = 0.64  # of the image width: near scenes, too
_USUAL_DISPARITY = 0.16  # enough to compare pairings
_MIN_CORRELATION = 0.8
_GOOD_CORRELATION = 0.9  # of patches whose rows agree
_MIN_MARGIN = 0.03  # lead over the second-best match of a row
_MIN_NEGATIVE_PX = 1.0  # of a disparity that counts as negative
_MAX_ROWS_HALF = 16  # row difference that is searched, pixels at half resolution
_FEW = 0.2  # share of the corners with a match below which other row differences are tried
# row differences of a camera that is pitched a little, pixels at half resolution
_NEAR_ROWS = np.arange(-3.0, 3.1, 0.5)
_CLEARLY = 2  # times as many matches at another row difference


class RowProbe:
    """Counts matches along the rows of two images at half resolution.

    A right camera that was pitched since it was calibrated moves all rows; by how many, is searched
    where hardly anything matches, and kept.
    """

    def __init__(self) -> None:
        self._rows = 0  # right minus left rows, pixels at half resolution
        self._searched = False

    def corners(self, half: Image) -> FloatArray:
        """Return strong corners (K, 2) of an image (H/2, W/2), spread evenly, in pixels of the
        full image.
        """
        return detect_corners(
            half, np.zeros((0, 2)), CORNERS, GridSettings(target_features=CORNERS)
        )

    def positive(self, left: Image, right: Image, points: FloatArray) -> int:
        """Count the pixels (N, 2) of the left image that match with a positive disparity."""
        found = self._count(left, right, points, self._rows, _MIN_CORRELATION)
        if found < _FEW * len(points) and not self._searched:
            self._search(left, right, points)
            found = self._count(left, right, points, self._rows, _MIN_CORRELATION)
        return found

    def negative(self, left: Image, right: Image, points: FloatArray) -> int:
        """Count the pixels (N, 2) of the left image that match with a negative disparity."""
        mirrored = [np.ascontiguousarray(image[:, ::-1]) for image in (left, right)]
        flipped = points * [-1.0, 1.0] + [2.0 * (left.shape[1] - 1), 0.0]
        rows = shifted_rows(mirrored[1], self._rows)
        reach = _MAX_DISPARITY * 2 * left.shape[1]
        disparity, good = match_rows(
            mirrored[0], rows, flipped, reach, _MIN_CORRELATION, _MIN_MARGIN
        )
        return int((good & (disparity >= _MIN_NEGATIVE_PX)).sum())

    def on_rows(self, left: Image, right: Image, points: FloatArray) -> int:
        """Count the pixels (N, 2) of the left image that match well on their rows."""
        return self._well_matched(left, shifted_rows(right, self._rows), points)

    def near_rows(self, left: Image, right: Image, points: FloatArray) -> IntArray:
        """Count (K,) the pixels (N, 2) of the left image that match well on their rows, and on rows
        a little above and below.
        """
        counts = [
            self._well_matched(left, _between_rows(right, self._rows + rows), points)
            for rows in _NEAR_ROWS
        ]
        return np.array(counts, dtype=np.int64)

    def _well_matched(self, left: Image, right: Image, points: FloatArray) -> int:
        reach = _USUAL_DISPARITY * 2 * left.shape[1]
        return int(match_rows(left, right, points, reach, _GOOD_CORRELATION, _MIN_MARGIN)[1].sum())

    def _count(
        self, left: Image, right: Image, points: FloatArray, rows: int, correlation: float
    ) -> int:
        reach = _MAX_DISPARITY * 2 * left.shape[1]
        other = shifted_rows(right, rows)
        return int(match_rows(left, other, points, reach, correlation, _MIN_MARGIN)[1].sum())

    def _search(self, left: Image, right: Image, points: FloatArray) -> None:
        """Take the row difference at which most pixels match well, where it is a clear one."""
        self._searched = True
        tried = range(-_MAX_ROWS_HALF, _MAX_ROWS_HALF + 1)
        counts = [self._count(left, right, points, rows, _GOOD_CORRELATION) for rows in tried]
        best = int(np.argmax(counts))
        present = counts[self._rows + _MAX_ROWS_HALF]
        if counts[best] >= max(_FEW * len(points), _CLEARLY * present):
            self._rows = tried[best]


def _between_rows(image: Image, rows: float) -> Image:
    """The image (H, W) moved up by a number of rows, interpolated between two of them."""
    whole = int(np.floor(rows))
    moved = shifted_rows(image, whole)
    if rows == whole:
        return moved
    further = shifted_rows(image, whole + 1)
    share = round(256 * (rows - whole))
    mixed = (256 - share) * moved.astype(np.uint32) + share * further.astype(np.uint32)
    return np.asarray((mixed + 128) >> 8, dtype=np.uint8)
