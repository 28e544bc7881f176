"""The pixels of all living tracks over the window, in arrays: rows are tracks, columns are clones."""

from __future__ import annotations

import numpy as np

from vio.filters import track_loops as loops
from vio.filters.multiview import Views
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, IntArray, Observations

# Of a pixel, over the frame's median: a residual can be small, or a patch fit badly, by chance.
_MOST_SIGMA = 10.0
_MOST_PRECISION = 3.0


class TrackTable:
    """Grows by doubling; a track keeps its row until it is removed."""

    def __init__(self, columns: int) -> None:
        self._columns = columns
        self._row_of: dict[int, int] = {}
        self._rows: IntArray | None = None  # all rows in order of their ids; None: tracks have come
        self._free: list[int] = []
        self._ids = np.zeros(0, dtype=np.int64)
        self._z = np.zeros((0, columns, 4))
        self._weight = np.zeros((0, columns, 4))  # as in `Views`
        self.points = np.zeros((0, 3))  # world; the last triangulation of each row, a start for the next
        self.has_point: BoolArray = np.zeros(0, dtype=np.bool_)
        self._grow(256)

    def add_frame(self, column: int, seen: Observations) -> None:
        """Write the observations of one frame into a column; unknown ids become new tracks."""
        ids, row_of = seen.ids.tolist(), self._row_of
        self._add([track for track in ids if track not in row_of])
        if ids:
            rows = np.array([row_of[track] for track in ids])
            self._z[rows, column] = seen.z
            self._weight[rows, column] = precision(seen)

    def rows(self) -> IntArray:
        """Rows (F,) of all tracks, in order of their ids, so that no result depends on the table's history."""
        if self._rows is None:
            rows = np.fromiter(self._row_of.values(), dtype=np.int64, count=len(self._row_of))
            self._rows = rows[np.argsort(self._ids[rows])]
        return self._rows

    def ids(self, rows: IntArray) -> IntArray:
        """Ids (F,) of rows."""
        return self._ids[rows]

    def views(self, rows: IntArray, columns: int) -> Views:
        """What rows showed in the first `columns` clones."""
        return Views(self._z[rows, :columns], self._weight[rows, :columns])

    def seen(self, rows: IntArray) -> BoolArray:
        """Which columns (F, N) rows were seen in."""
        return self._weight[rows, :, 0] > 0

    def shift(self) -> None:
        """Forget the oldest column; tracks that were seen there alone are removed."""
        self._z[:, :-1], self._weight[:, :-1] = self._z[:, 1:].copy(), self._weight[:, 1:].copy()
        self._weight[:, -1] = 0.0
        rows = self.rows()
        self.remove(rows[~self.seen(rows).any(axis=1)])

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
        ordered = self.rows()
        self._rows = ordered[~gone[ordered]]
        for track in self._ids[rows].tolist():
            del self._row_of[track]
        self._free += rows.tolist()
        self._weight[rows] = 0.0
        self.has_point[rows] = False

    def _add(self, tracks: list[int]) -> None:
        """Give new tracks free rows."""
        if not tracks:
            return
        while len(tracks) > len(self._free):
            self._grow(2 * len(self._ids))
        rows = self._free[: -len(tracks) - 1 : -1]
        del self._free[-len(tracks) :]
        self._row_of.update(zip(tracks, rows, strict=True))
        self._ids[rows], self._rows = tracks, None

    def _grow(self, size: int) -> None:
        old = len(self._ids)
        extra = size - old
        self._ids = np.concatenate([self._ids, np.zeros(extra, dtype=np.int64)])
        self._z = np.concatenate([self._z, np.zeros((extra, self._columns, 4))])
        self._weight = np.concatenate([self._weight, np.zeros((extra, self._columns, 4))])
        self.points = np.concatenate([self.points, np.zeros((extra, 3))])
        self.has_point = np.concatenate([self.has_point, np.zeros(extra, dtype=np.bool_)])
        self._free += range(size - 1, old - 1, -1)


def measured(has_right: BoolArray) -> FloatArray:
    """Weights (N, 4) of `[ul vl ur vr]`: 1 for what is a measurement of its own, 0 else.

    The right row is none. It is fitted near the row that the left pixel and the learned rows of the pair predict, so
    its error is that of `vl` and of the pair's calibration; as a fourth pixel it would make the filter overconfident.
    """
    weight = np.zeros((len(has_right), 4))
    weight[:, :2] = 1.0
    weight[:, 2] = has_right
    return weight


def precision(seen: Observations) -> FloatArray:
    """One over the standard deviations (N, 4) of `[ul vl ur vr]`, in those of the frame's median; 0: not measured.

    What patches state of a whole frame, such as its blur, is learned instead: errors that last along tracks exceed it.
    """
    weight = measured(seen.has_right)
    if seen.sigma is None:
        return weight
    loops.weigh_by_sigma(seen.sigma, 1.0 / _MOST_SIGMA, _MOST_PRECISION, weight)
    return weight


def rows_of(seen: Observations, ids: IntArray) -> tuple[IntArray, BoolArray]:
    """Return the rows (K,) of given ids (M,) in one frame, in their order, and a mask (M,) of those that are there."""
    if not len(seen) or not len(ids):
        return np.zeros(0, dtype=np.int64), np.zeros(len(ids), dtype=np.bool_)
    order = np.argsort(seen.ids)
    at = np.minimum(np.searchsorted(seen.ids, ids, sorter=order), len(order) - 1)
    rows = order[at]
    found = seen.ids[rows] == ids
    return rows[found], found
