"""Python's search for reference cycles, in a program whose pauses count."""

from __future__ import annotations

import gc
import threading

# Objects more than before until the young ones are searched. Frames make no cycles, so that few are ever found, and
# what lives in a run is some ten thousand objects, through which a search takes a few milliseconds.
_YOUNG = 20_000


class QuietCollector:
    """Keeps what is loaded out of searches for cycles: one through all modules takes 50 to 100 ms.

    The collector belongs to the process: the first user sets it up, and the last one restores it.
    """

    _users = 0
    _before = (0, 0, 0)
    _lock = threading.Lock()

    def __init__(self) -> None:
        self._holds = False

    def hold(self) -> None:
        """Search a last time, and then through newer objects only; calling it again adds what has come since."""
        gc.collect()
        gc.freeze()
        if not self._holds:
            with self._lock:
                if QuietCollector._users == 0:
                    QuietCollector._before = gc.get_threshold()
                    gc.set_threshold(_YOUNG, *QuietCollector._before[1:])
                QuietCollector._users += 1
                self._holds = True

    def release(self) -> None:
        """Let the collector do as before."""
        if not self._holds:
            return
        with self._lock:
            self._holds = False
            QuietCollector._users -= 1
            if QuietCollector._users == 0:
                gc.set_threshold(*QuietCollector._before)
                gc.unfreeze()
