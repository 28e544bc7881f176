"""When a filter that worked has lost its state for good: whether to begin it anew, and from where.

An estimate that no working rig can have does not come back by itself: what is wrong is in the state.
A filter that never worked is not begun anew, as its sensors or their calibration are wrong.
"""

from __future__ import annotations

from vio.records import NS_PER_S, Estimate

_WORKED_NS = 2 * NS_PER_S  # of estimates that could be used, after which a filter is said to work
_CERTAIN_NS = NS_PER_S  # for which the state has been impossible
_MAX_WAIT_NS = 60 * NS_PER_S  # between two tries; each wait is twice the one before
IMPOSSIBLE = "estimate-implausible"


class Recovery:
    """Follows the estimates of a run."""

    def __init__(self) -> None:
        self._good: Estimate | None = (
            None  # the last one that could be used, of a filter that worked
        )
        self._usable_since_ns: int | None = None
        self._impossible_since_ns: int | None = None
        self._wait_ns = _CERTAIN_NS

    def take(self, estimate: Estimate) -> Estimate | None:
        """Take the estimate of a frame, with its integrity.

        Return the estimate to go on from, where the filter is to be begun anew now; else None.
        """
        now_ns = estimate.time_ns
        if IMPOSSIBLE not in estimate.findings:
            self._impossible_since_ns = None
            self._usable(estimate)
            return None
        self._usable_since_ns = None
        if self._impossible_since_ns is None:
            self._impossible_since_ns = now_ns
        if self._good is None or now_ns - self._impossible_since_ns < self._wait_ns:
            return None
        self._impossible_since_ns = now_ns
        self._wait_ns = min(2 * self._wait_ns, _MAX_WAIT_NS)
        return self._good

    def _usable(self, estimate: Estimate) -> None:
        if estimate.integrity == "unusable":
            self._usable_since_ns = None
            return
        if self._usable_since_ns is None:
            self._usable_since_ns = estimate.time_ns
        if estimate.time_ns - self._usable_since_ns >= _WORKED_NS:
            self._good = estimate
            self._wait_ns = _CERTAIN_NS
