"""Matches between two images that need no front end: corners of one, searched along the rows of the
other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.frontend.detect import detect_corners
from vio.frontend.settings import GridSettings
from vio.frontend.stereo_match import ROW_SEARCH, match_rows, mirrored, shifted_rows
from vio.geometry.lie import FloatArray
from vio.records import Image, IntArray

CORNERS = 80  # that are searched, at most


@dataclass(frozen=True, slots=True)
class _ProbeRules:
    """How corners are searched along rows, and when the rows are."""

    usual_disparity: float = 0.16  # enough to compare pairings
    min_correlation: float = 0.8
    clear_ratio: int = 2  # times as many matches at another row difference


_PROBE = _ProbeRules()
# of a disparity that has a sign: next to zero, the search to the wrong side matches as well
MIN_SIGNED_PX = 1.0
# row differences of a camera that is pitched a little, pixels at half resolution
_NEAR_ROWS = np.arange(-3.0, 3.1, 0.5)


class RowProbe:
    """Counts matches along the rows of two images at half resolution.

    A right camera that was pitched since it was calibrated moves all rows; by how many, is searched
    where hardly anything matches, and kept.
    """

    def __init__(self) -> None:
        self._rows = 0  # right minus left rows, pixels at half resolution
        self._searched = False

    @property
    def rows_px(self) -> int:
        """By how many rows the right image was found to be moved, pixels of the full image."""
        return 2 * self._rows

    def corners(self, half: Image) -> FloatArray:
        """Return strong corners (K, 2) of an image (H/2, W/2), spread evenly, in pixels of the
        full image.
        """
        return detect_corners(
            half, np.zeros((0, 2)), CORNERS, GridSettings(target_features=CORNERS)
        )

    def positive(self, left: Image, right: Image, points: FloatArray) -> int:
        """Count the pixels (N, 2) of the left image that match with a positive disparity."""
        found = self._positive(left, right, points)
        if found < ROW_SEARCH.few_share * len(points) and not self._searched:
            self._search(left, right, points)
            found = self._positive(left, right, points)
        return found

    def _positive(self, left: Image, right: Image, points: FloatArray) -> int:
        return _signed(left, shifted_rows(right, self._rows), points)

    def negative(self, left: Image, right: Image, points: FloatArray) -> int:
        """Count the pixels (N, 2) of the left image that match with a negative disparity."""
        return _signed(*mirrored(left, shifted_rows(right, self._rows), points))

    def on_rows(self, left: Image, right: Image, points: FloatArray) -> int:
        """Count the pixels (N, 2) of the left image that match well on their rows.

        Those of images of two times may have been matched best at rows that are no camera's, and
        other pairings of the same images are not to pay for it: rows as calibrated count as well.
        """
        return max(
            _well_matched(left, shifted_rows(right, rows), points) for rows in {0, self._rows}
        )

    def near_rows(self, left: Image, right: Image, points: FloatArray) -> IntArray:
        """Count (K,) the pixels (N, 2) of the left image that match well on their rows, and on rows
        a little above and below; see `on_rows`.
        """
        counts = {
            rows: [
                _well_matched(left, _between_rows(right, rows + near), points)
                for near in _NEAR_ROWS
            ]
            for rows in {0, self._rows}
        }
        return np.array(counts[0] + counts[self._rows], dtype=np.int64)

    def _search(self, left: Image, right: Image, points: FloatArray) -> None:
        """Take the row difference at which most pixels match well, where it is a clear one."""
        self._searched = True
        tried = range(-ROW_SEARCH.max_rows_half, ROW_SEARCH.max_rows_half + 1)
        reach = ROW_SEARCH.max_disparity
        counts = [_well_matched(left, shifted_rows(right, k), points, reach) for k in tried]
        best = int(np.argmax(counts))
        present = counts[self._rows + ROW_SEARCH.max_rows_half]
        if counts[best] >= max(ROW_SEARCH.few_share * len(points), _PROBE.clear_ratio * present):
            self._rows = tried[best]


def _well_matched(
    left: Image, right: Image, points: FloatArray, reach: float = _PROBE.usual_disparity
) -> int:
    """Count the pixels (N, 2) of the left image that match well, by disparities up to a share of
    the width.
    """
    found = match_rows(
        left,
        right,
        points,
        reach * 2 * left.shape[1],
        ROW_SEARCH.good_correlation,
        ROW_SEARCH.min_margin,
    )
    return int(found[1].sum())


def _signed(left: Image, right: Image, points: FloatArray) -> int:
    """Count the pixels (N, 2) of the left image that match clearly left of themselves."""
    reach = ROW_SEARCH.max_disparity * 2 * left.shape[1]
    disparity, good = match_rows(
        left, right, points, reach, _PROBE.min_correlation, ROW_SEARCH.min_margin
    )
    return int((good & (disparity >= MIN_SIGNED_PX)).sum())


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
