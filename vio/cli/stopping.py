"""Ending a long run in order: the first signal asks it to stop after the present frame, the
second one ends it; while loops are compiled the first one does.
"""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

from vio.numerics.compiling import PROGRESS

_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


class StopRequest:
    """Notes the first Ctrl-C, SIGTERM or SIGHUP inside the block; in other threads than the main
    one, none.
    """

    def __init__(self) -> None:
        self.number: int | None = None  # of the signal
        self._before: dict[int, Any] = {}

    def reason(self) -> str | None:
        """Why the run should stop; None: it should not."""
        if self.number is None:
            return None
        return (
            "interrupted"
            if self.number == signal.SIGINT
            else f"ended by {signal.Signals(self.number).name}"
        )

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                before = signal.getsignal(number)
                if before != signal.SIG_IGN:  # as SIGHUP is under nohup
                    self._before[number] = before
                    signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.number = number
        self.__exit__()  # a second signal does what it did before
        if PROGRESS.is_compiling:  # the present frame may take minutes, and has no result yet
            signal.raise_signal(number)
