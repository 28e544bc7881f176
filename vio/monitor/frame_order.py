"""Whether frames come in another order than they were exposed in.

Images named without leading zeros, threads that deliver them as they finish, or a driver's ring of
buffers exchange frames. By images alone the estimate follows them, back and forth: each pose is right
for its image, and wrong for its stamp. Taken in their order along the way, such positions lie on a
smooth path; those of a rig that shakes do not.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from vio.findings import Finding
from vio.geometry.lie import FloatArray, length


class _OrderRules(NamedTuple):
    """When the order of frames is not that of their exposures."""

    frames: int = 8  # the newest, whose positions are put in order
    # Sum of the squared second differences of the positions in order, over that as they came. Frames
    # exchanged in pairs or fours: 0.0003 to 0.001 every few frames; healthy recordings and their
    # variants 0.47 and more. Positions with noise, at random: 0.07 and more; vibrations come to 0.01
    # only where they have the frames' rate and go as far back as the rig goes on.
    limit: float = 0.01
    checks: int = 2  # in which this holds, among as many frames
    clear_frames: int = 20  # in a row in which no step goes back, before it is over


_ORDER = _OrderRules()
_CODE = "frames-out-of-order"


class FrameOrder:
    """Reports that frames are not in the order of their exposures, and when they are again."""

    def __init__(self) -> None:
        self._positions = deque[FloatArray](maxlen=_ORDER.frames)
        self._indices = deque[int](maxlen=_ORDER.frames)  # of the frames
        self._step = np.zeros(3)  # to the last frame
        self._since_back = _ORDER.clear_frames  # frames since a step went back
        # last and first frame of those that are smooth in another order
        self._found = deque[tuple[int, int]](maxlen=_ORDER.checks)
        self._reported = False

    def frame(self, index: int, position: FloatArray) -> list[Finding]:
        """Return what a frame shows, whose position (3,) in the world was estimated."""
        positions = self._positions
        if positions:
            step = position - positions[-1]
            goes_back = float(step @ self._step) < 0.0
            self._since_back = 0 if goes_back else self._since_back + 1
            self._step = step
        positions.append(position.copy())
        self._indices.append(index)
        if self._reported:
            return self._ended(index)
        if self._since_back >= _ORDER.frames or len(positions) < _ORDER.frames:
            return []
        if _smoother(np.array(positions)) > _ORDER.limit:
            return []
        self._found.append((index, self._indices[0]))
        last, since = self._found[0]
        if len(self._found) < _ORDER.checks or last < self._indices[0]:
            return []
        self._reported = True
        message = (
            f"frame {index}: the images go back and forth, and show a smooth motion in another order: "
            f"since frame {since} at the latest, they are not in the order of their exposures; order "
            "them by their stamps or numbers"
        )
        return [Finding(_CODE, message, index, since, lasts=True)]

    def _ended(self, index: int) -> list[Finding]:
        if self._since_back < _ORDER.clear_frames:
            return []
        self._reported = False
        self._found.clear()
        message = f"frame {index}: no step goes back any more: the images are in order again"
        return [Finding(_CODE, message, index, ended=True)]


def _smoother(p: FloatArray) -> float:
    """How rough positions (N, 3) are in their order along the way, over that as they come; infinite
    where that is the same order.
    """
    ahead = p[-2:].sum(axis=0) - p[:2].sum(axis=0)
    if length(ahead) == 0.0:
        return np.inf
    order = np.argsort(p @ ahead, kind="stable")
    if (order[1:] > order[:-1]).all():
        return np.inf
    return _roughness(p[order]) / _roughness(p)


def _roughness(p: FloatArray) -> float:
    """Sum of the squared second differences of positions (N, 3)."""
    return float((np.diff(p, 2, axis=0) ** 2).sum())
