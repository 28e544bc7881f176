"""The results of a live odometry as an iterator, in a thread of the caller's own."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator

from vio.records import Estimate

_MOST = 1000  # estimates that wait for the reader; of a slower one, the oldest are forgotten


class EstimateStream(Iterator[Estimate]):
    """Estimates as they come; it ends when the odometry is closed. `trajectory` counts the resets before the last."""

    def __init__(self, raise_failure: Callable[[], None]) -> None:
        """Create an empty stream; `raise_failure` raises what the odometry ended with, if it failed."""
        self.trajectory = self._resets = 0
        self._estimates: deque[tuple[int, Estimate]] = deque(maxlen=_MOST)
        self._changed = threading.Condition()
        self._ended = False
        self._raise_failure = raise_failure

    def put(self, estimate: Estimate) -> None:
        """Add the newest estimate."""
        with self._changed:
            self._estimates.append((self._resets, estimate))
            self._changed.notify()

    def reset(self) -> None:
        """Begin a new trajectory."""
        self._resets += 1

    def end(self) -> None:
        """Nothing more will come."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def __next__(self) -> Estimate:
        """Wait for the next estimate."""
        with self._changed:
            while not self._estimates and not self._ended:
                self._changed.wait()
            if self._estimates:
                self.trajectory, estimate = self._estimates.popleft()
                return estimate
        self._raise_failure()
        raise StopIteration
