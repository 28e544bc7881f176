"""What checks of right matches have in common: they see the columns of `Observations` alone.

So they serve features of another program and a front end of the caller's own as well as the
built-in ones. They remove right pixels that cannot be true, or put them back in order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vio.findings import Finder
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, IntArray, Observations, shared_rows


@dataclass(frozen=True, slots=True)
class SharedMatches:
    """The features of a frame that had a right pixel in the frame before as well."""

    rows: IntArray  # (K,) of those that have one in both, in the frame
    before: FloatArray  # (K, 4) pixels [ul vl ur vr] in the frame before
    now: FloatArray  # (K, 4) likewise in the frame
    seconds: float  # between the frames

    def __len__(self) -> int:
        return len(self.rows)


def shared_matches(before: Observations | None, now: Observations) -> SharedMatches:
    """Return the right matches that two frames share, by the features' ids."""
    if before is None:
        nothing = np.zeros((0, 4))
        return SharedMatches(np.zeros(0, dtype=np.int64), nothing, nothing, 0.0)
    old, new = shared_rows(before.ids, now.ids)
    both = before.has_right[old] & now.has_right[new]
    return SharedMatches(
        new[both],
        before.z[old[both]],
        now.z[new[both]],
        (now.time_ns - before.time_ns) * 1e-9,
    )


class MatchCheck(Finder):
    """Base of the checks: sees the features of all frames in order of time, and reports each
    event once.
    """

    def inspect(self, seen: Observations, shared: SharedMatches) -> Observations:
        """Return the features to use, without right pixels or with others where necessary.

        Args:
            seen: of this frame, as the check before left them.
            shared: with the frame before, as both came.

        Raises:
            DataError: the recording cannot be used.
        """
        return seen


class Hysteresis:
    """A state that begins with the first frame that shows it, and ends after some frames that
    show the contrary.

    Frames that show neither leave it as it is, but for so many in a row it is given up.
    """

    def __init__(self, *, to_report: int, to_end: int, blind: int) -> None:
        """Take the numbers of frames in a row: until it is to be reported, until it ends, and
        without a sign until it is given up.
        """
        self._to_report = to_report
        self._to_end = to_end
        self._blind = blind
        self._contrary = 0
        self._unsigned = 0
        self.frames = 0  # that showed it
        self.since: int | None = None  # first frame that showed it; None: it is not so
        self._reported = False

    def show(self, index: int, sign: bool | None) -> None:
        """Take what a frame shows: the state, the contrary, or (None) neither."""
        if sign is None:
            self._unsigned += 1
        elif sign:
            self._contrary = 0
            self._unsigned = 0
            self.frames += 1
            self.since = index if self.since is None else self.since
        else:
            self._unsigned = 0
            self._contrary += 1

    def to_report(self) -> bool:
        """Return whether the state has lasted for long enough and was not reported yet; it then
        counts as reported.
        """
        if self.since is None or self._reported or self.frames < self._to_report:
            return False
        self._reported = True
        return True

    def ends(self) -> bool:
        """Return whether the state ends with this frame and was reported; it is then forgotten."""
        over = self._contrary >= self._to_end or self._unsigned >= self._blind
        if self.since is None or not over:
            return False
        reported = self._reported
        self.since = None
        self._reported = False
        self.frames = 0
        return reported


def without_right(seen: Observations, dropped: BoolArray | None = None) -> Observations:
    """Return features without the right pixels of some rows (N,), of all without a mask; the
    record itself where none has one.
    """
    if dropped is None:
        has_right = np.zeros(len(seen), dtype=np.bool_)
    else:
        has_right = ~dropped
    has_right &= seen.has_right
    if has_right.sum() == seen.has_right.sum():
        return seen
    return replace(seen, has_right=has_right)
