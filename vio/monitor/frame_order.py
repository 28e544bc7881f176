"""Whether frames come in another order than they were exposed in.

Images named without leading zeros, threads that deliver them as they finish, or a driver's ring of
buffers exchange frames. By images alone the estimate follows them, back and forth: each pose is right
for its image, and wrong for its stamp. Taken in their order along the way, such positions lie on a
smooth path, one step after another, and go on from one block of frames to the next. Those of a rig that
shakes pile up where it turns back, and stay about one place. Where a motion sensor agrees with the
estimate, the rig has moved so.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from vio.findings import Finding, begun, ended
from vio.geometry.lie import FloatArray, length, lengths
from vio.numerics.robust import median


class _OrderRules(NamedTuple):
    """When the order of frames is not that of their exposures."""

    frames: int = 8  # the newest, whose positions are put in order
    # Sum of the squared second differences of the positions in order, over that as they came. Frames
    # exchanged in pairs or fours: 0.0003 to 0.001 every few frames; healthy recordings and their
    # variants 0.47 and more. Positions with noise, at random: 0.07 and more; vibrations come to 0.01
    # only where they have the frames' rate and go as far back as the rig goes on.
    limit: float = 0.01
    checks: int = 2  # in which this holds, among as many frames
    # Least step from one of the positions in order to the next, over the median one.
    even: float = 0.3
    # From the mean of as many positions before these to theirs, over the way from the first one in
    # order to the last one. In blocks of four 0.73 and more at one speed; about one place at most 0.64.
    progress: float = 0.65
    # innovation over its standard deviation, by a motion sensor, up to which it agrees
    agrees: float = 2.0
    clear_frames: int = 20  # in a row in which no step goes back, before it is over …
    # … by more than so much of the median one at which it was found …
    back: float = 0.25
    unseen_frames: int = 40  # … or in which no positions were smooth in another order


_ORDER = _OrderRules()
_CODE = "frames-out-of-order"


class FrameOrder:
    """Reports that frames are not in the order of their exposures, and when they are again."""

    def __init__(self) -> None:
        # the newest ones, and as many before
        self._positions = deque[FloatArray](maxlen=2 * _ORDER.frames)
        self._indices = deque[int](maxlen=2 * _ORDER.frames)  # of the frames
        self._step = np.zeros(3)  # to the last frame
        self._least_m = 0.0  # of a step that goes back
        self._since_back = _ORDER.clear_frames  # frames since a step went back
        self._unseen = 0  # frames since positions were smooth in another order
        # last frames of those that are smooth in another order
        self._found = deque[int](maxlen=_ORDER.checks)
        self._reported = False

    def frame(
        self, index: int, position: FloatArray, innovation: float | None = None
    ) -> list[Finding]:
        """Return what a frame shows.

        Args:
            index: frame number.
            position: (3,) estimated in the world.
            innovation: of a motion sensor over its standard deviation; None: there is none.
        """
        positions = self._positions
        if positions:
            step = position - positions[-1]
            if float(step @ self._step) < 0.0 and length(step) > self._least_m:
                self._since_back = -1
            self._since_back += 1
            self._step = step
        positions.append(position.copy())
        self._indices.append(index)
        self._unseen += 1
        agrees = innovation is not None and innovation <= _ORDER.agrees
        if self._since_back < _ORDER.frames and len(positions) == positions.maxlen and not agrees:
            self._look(index)
        if self._reported:
            return self._ended(index)
        if len(self._found) < _ORDER.checks or self._found[0] < self._indices[_ORDER.frames]:
            return []
        steps = np.diff(np.array(positions), axis=0)
        goes_back = (steps[1:] * steps[:-1]).sum(axis=1) < 0.0
        since = self._indices[int(goes_back.argmax())]
        self._least_m = _ORDER.back * median(lengths(steps))
        self._reported = True
        text = (
            "the images go back and forth, and show a smooth motion in another order: "
            f"since frame {since} at the latest, they are not in the order of their exposures; order "
            "them by their stamps or numbers"
        )
        return [begun(_CODE, index, text, since)]

    def _look(self, index: int) -> None:
        """Look whether the newest positions are those of a smooth path in another order."""
        before, newest = np.split(np.array(self._positions), 2)
        if _is_smooth_in_order(newest, before):
            self._unseen = 0
            self._found.append(index)

    def _ended(self, index: int) -> list[Finding]:
        if self._since_back < _ORDER.clear_frames and self._unseen < _ORDER.unseen_frames:
            return []
        self._reported = False
        self._least_m = 0.0
        self._found.clear()
        text = "no step goes back any more: the images are in order again"
        if self._since_back < _ORDER.clear_frames:
            text = "the path is smooth in no other order any more"
        return [ended(_CODE, index, text)]


def _is_smooth_in_order(p: FloatArray, before: FloatArray) -> bool:
    """Whether positions (N, 3) are smooth in their order along the way, and not as they come, and go
    on from those before them (N, 3).
    """
    ahead = p.mean(axis=0) - before.mean(axis=0)
    way = length(ahead)
    if way == 0.0:
        return False
    along = p @ (ahead / way)
    order = np.argsort(along, kind="stable")
    if (order[1:] > order[:-1]).all():
        return False
    steps = np.diff(along[order])
    if steps.min() < _ORDER.even * median(steps) or way < _ORDER.progress * steps.sum():
        return False
    return _roughness(p[order]) <= _ORDER.limit * _roughness(p)


def _roughness(p: FloatArray) -> float:
    """Sum of the squared second differences of positions (N, 3)."""
    return float((np.diff(p, 2, axis=0) ** 2).sum())
