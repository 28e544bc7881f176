"""A limit on the frames that are used in a second."""

from __future__ import annotations

import numpy as np

from vio.records import NS_PER_S, IntArray

_EARLY = 0.1  # of an interval that a frame may come early: cameras jitter, and 30 frames/s are rarely exactly 30


class FrameRateLimit:
    """Tells which frames of a sequence are used: those that come no sooner than an interval after the last one used.

    A sequence that has passed one limit passes the same limit again whole.
    """

    def __init__(self, most_hz: float | None) -> None:
        """Begin a sequence.

        Args:
            most_hz: frames a second; None: no limit.
        """
        self._least_ns = 0 if most_hz is None else round((1 - _EARLY) * NS_PER_S / most_hz)
        self._last_ns: int | None = None

    def takes(self, time_ns: int) -> bool:
        """Return whether a frame of this time is used; frames come in order of time."""
        if self._last_ns is not None and time_ns - self._last_ns < self._least_ns:
            return False
        self._last_ns = time_ns
        return True


def used_frames(times_ns: IntArray, most_hz: float | None) -> IntArray:
    """Return the numbers (G,) of the frames of a recording that a limit lets through, counted from the first of all.

    Args:
        times_ns: of all frames (F,), increasing.
        most_hz: frames a second; None: no limit.
    """
    limit = FrameRateLimit(most_hz)
    return np.flatnonzero([limit.takes(t) for t in times_ns.tolist()])
