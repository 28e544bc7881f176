"""The pixels of all living tracks over the window, in arrays: rows are tracks, columns are
clones.
"""

from __future__ import annotations

import numpy as np

from vio.filters import track_loops as loops
from vio.filters.track_records import Views
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, IntArray, Observations

# Of a pixel, over the frame's median: a residual can be small, or a patch fit badly, by chance.
_MAX_SIGMA = 10.0
_MAX_PRECISION = 3.0


class TrackTable:
    """Grows by doubling; a track keeps its row until it is removed."""

    def __init__(self, columns: int) -> None:
        self._columns = columns
        self._rows: IntArray = np.zeros(0, dtype=np.int64)  # of all tracks, in order of their ids
        # rows without a track; the last one is used next
        self._free: IntArray = np.zeros(0, dtype=np.int64)
        self._ids = np.zeros(0, dtype=np.int64)
        self._z = np.zeros((0, columns, 4))
        self._weight = np.zeros((0, columns, 4))  # as in `Views`
        # world; the last triangulation of each row, a start for the next
        self.points = np.zeros((0, 3))
        self.has_point: BoolArray = np.zeros(0, dtype=np.bool_)
        self._grow(256)

    def add_frame(self, column: int, seen: Observations) -> None:
        """Write the observations of one frame into a column; unknown ids become new tracks."""
        rows: IntArray = np.empty(len(seen), dtype=np.int64)
        new = loops.find_rows(seen.ids, self._ids[self._rows], self._rows, rows)
        if new:
            unknown = (rows < 0).nonzero()[0]
            while new > len(self._free):
                self._grow(2 * len(self._ids))
            rows[unknown] = self._free[-1 : -new - 1 : -1]
            self._free = self._free[:-new]
            self._ids[rows[unknown]] = seen.ids[unknown]
            together = np.concatenate([self._rows, rows[unknown]])
            self._rows = together[self._ids[together].argsort()]
        loops.write_column(rows, column, seen.z, precision(seen), self._z, self._weight)

    def rows(self) -> IntArray:
        """Rows (F,) of all tracks, in order of their ids, so that no result depends on the
        table's history.
        """
        return self._rows

    def ids(self, rows: IntArray) -> IntArray:
        """Ids (F,) of rows."""
        return self._ids[rows]

    def views(self, rows: IntArray, columns: int) -> Views:
        """What rows showed in the first `columns` clones."""
        return Views(self._z[rows, :columns], self._weight[rows, :columns])

    def seen(self, rows: IntArray) -> BoolArray:
        """Which columns (F, N) rows were seen in."""
        return self.lengths(rows)[0]

    def lengths(self, rows: IntArray) -> tuple[BoolArray, IntArray]:
        """Which columns (F, N) rows were seen in, and how many they are (F,)."""
        seen: BoolArray = np.empty((len(rows), self._columns), dtype=np.bool_)
        length: IntArray = np.empty(len(rows), dtype=np.int64)
        loops.count_views(rows, self._weight, seen, length)
        return seen, length

    def shift(self) -> None:
        """Forget the oldest column; tracks that were seen there alone are removed."""
        loops.shift_columns(self._rows, self._z, self._weight)
        self.remove(self._rows[self.lengths(self._rows)[1] == 0])

    def forget_views(self, rows: IntArray) -> None:
        """Forget all views of rows but keep the tracks; their pixels have been used."""
        self._weight[rows] = 0.0
        self.has_point[rows] = False

    def drop_views(self, rows: IntArray, views: BoolArray) -> None:
        """Remove single views (F, N) of rows permanently."""
        self._weight[rows, : views.shape[1]] *= ~views[..., None]

    def remove(self, rows: IntArray) -> None:
        """Remove tracks."""
        if not len(rows):
            return
        gone = np.zeros(len(self._ids), dtype=np.bool_)
        gone[rows] = True
        self._rows = self._rows[~gone[self._rows]]
        self._free = np.concatenate([self._free, rows])
        self.forget_views(rows)

    def _grow(self, size: int) -> None:
        old = len(self._ids)
        extra = size - old
        self._ids = np.concatenate([self._ids, np.zeros(extra, dtype=np.int64)])
        self._z = np.concatenate([self._z, np.zeros((extra, self._columns, 4))])
        self._weight = np.concatenate([self._weight, np.zeros((extra, self._columns, 4))])
        self.points = np.concatenate([self.points, np.zeros((extra, 3))])
        self.has_point = np.concatenate([self.has_point, np.zeros(extra, dtype=np.bool_)])
        self._free = np.concatenate([self._free, np.arange(size - 1, old - 1, -1)])


def measured(has_right: BoolArray) -> FloatArray:
    """Weights (N, 4) of `[ul vl ur vr]`: 1 for what is a measurement of its own, 0 else.

    The right row is none. It is fitted near the row that the left pixel and the learned rows of the
    pair predict, so its error is that of `vl` and of the pair's calibration; as a fourth pixel it
    would make the filter overconfident.
    """
    weight = np.zeros((len(has_right), 4))
    weight[:, :2] = 1.0
    weight[:, 2] = has_right
    return weight


def precision(seen: Observations) -> FloatArray:
    """One over the standard deviations (N, 4) of `[ul vl ur vr]`, in those of the frame's median;
    0: not measured.

    What patches state of a whole frame, such as its blur, is learned instead: errors that last
    along tracks exceed it.
    """
    weight = measured(seen.has_right)
    if seen.sigma is None:
        return weight
    loops.weigh_by_sigma(seen.sigma, 1.0 / _MAX_SIGMA, _MAX_PRECISION, weight)
    return weight


def rows_of(seen: Observations, ids: IntArray) -> tuple[IntArray, BoolArray]:
    """Return the rows (K,) of given ids (M,) in one frame, in their order, and a mask (M,) of
    those that are there.
    """
    if not len(seen) or not len(ids):
        return np.zeros(0, dtype=np.int64), np.zeros(len(ids), dtype=np.bool_)
    order = seen.ids.argsort()
    at = np.minimum(np.searchsorted(seen.ids, ids, sorter=order), len(order) - 1)
    rows = order[at]
    found = seen.ids[rows] == ids
    return rows[found], found
