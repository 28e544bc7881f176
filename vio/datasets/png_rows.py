"""The compiled loops behind `vio.datasets.png`: the filters of a PNG's rows, undone."""

from __future__ import annotations

import numpy as np

from vio.numerics.compiled import compiled
from vio.numerics.kinds import Capacity
from vio.records import Image

_SIDE_BY_SIDE: Capacity[int] = (
    16  # rows, as many as a vector of the processor holds numbers of 16 bits
)
_PAETH = 4  # number of the filter


@compiled
def unfilter(rows: Image, out: Image) -> None:
    """Write the pixels (H, W) of filtered rows (H, 1 + W), each with the number of its filter in
    front.
    """
    y = int(np.int64(0))  # no literal: see `vio.numerics.compiled`
    while y < len(out):
        if y > 0 and _paeth_rows(rows, y) >= _SIDE_BY_SIDE:
            _side_by_side(rows, out, y)
            y += _SIDE_BY_SIDE
        else:
            _one_row(rows, out, y)
            y += 1


@compiled
def _paeth_rows(rows: Image, y: int) -> int:
    """Number of rows from one on, up to 16, that have Paeth's filter."""
    count = 0
    while count < _SIDE_BY_SIDE and y + count < len(rows) and rows[y + count, 0] == _PAETH:
        count += 1
    return count


@compiled
def _one_row(rows: Image, out: Image, y: int) -> None:
    kind = rows[y, 0]
    left = np.int16(0)
    corner = np.int16(0)
    for x in range(out.shape[1]):
        above = np.int16(out[y - 1, x]) if y > 0 else np.int16(0)
        guess = np.int16(0)
        if kind == 1:
            guess = left
        elif kind == 2:
            guess = above
        elif kind == 3:
            guess = np.int16((left + above) // 2)
        elif kind == _PAETH:
            guess = _paeth(left, above, corner)
        left = np.int16((np.int16(rows[y, x + 1]) + guess) & 255)
        corner = above
        out[y, x] = left


@compiled
def _paeth(left: np.int16, above: np.int16, corner: np.int16) -> np.int16:
    """The neighbour that is nearest to `left + above - corner`; of equals the first."""
    up = np.int16(above - corner)
    across = np.int16(left - corner)
    by_left = np.int16(abs(up))
    by_above = np.int16(abs(across))
    by_corner = np.int16(abs(np.int16(up + across)))
    other = above if by_above <= by_corner else corner
    return left if by_left <= min(by_above, by_corner) else other


@compiled
def _side_by_side(rows: Image, out: Image, y: int) -> None:
    """Write 16 rows from y > 0 on, each one pixel behind the row above it, so that all
    neighbours are there.
    """
    width = out.shape[1]
    last = _SIDE_BY_SIDE - 1
    left = np.empty(_SIDE_BY_SIDE, np.int16)
    above = np.empty(_SIDE_BY_SIDE, np.int16)
    corner = np.empty(_SIDE_BY_SIDE, np.int16)
    change = np.empty(_SIDE_BY_SIDE, np.int16)
    for k in range(_SIDE_BY_SIDE):
        left[k] = corner[k] = 0
    for step in range(width + last):
        whole = last <= step < width  # each row has a pixel in this step
        for k in range(last, 0, -1):
            above[k] = left[k - 1]
        above[0] = out[y - 1, step] if step < width else 0
        if whole:
            for k in range(_SIDE_BY_SIDE):
                change[k] = rows[y + k, step + 1 - k]
        else:
            for k in range(_SIDE_BY_SIDE):
                change[k] = rows[y + k, step + 1 - k] if 0 <= step - k < width else 0
        for k in range(_SIDE_BY_SIDE):  # zero before a row begins, as all neighbours are zero there
            left[k] = (change[k] + _paeth(left[k], above[k], corner[k])) & 255
        for k in range(_SIDE_BY_SIDE):
            corner[k] = above[k]
        if whole:
            for k in range(_SIDE_BY_SIDE):
                out[y + k, step - k] = left[k]
        else:
            for k in range(_SIDE_BY_SIDE):
                if 0 <= step - k < width:
                    out[y + k, step - k] = left[k]
