"""What numba compiles in this process: that it does so now, and how far it is."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from vio.errors import NOTE

log = logging.getLogger(__name__)

USUAL_S = 60.0  # of CPU time that the loops of a usual run take
USUAL_LOOPS = 170  # of them, in a usual run on what `vio demo` renders
# Packages of the loops of each part of a run.
PACKAGES = {"frontend": "vio.frontend", "filter": "vio.filters"}
_LINE_S = 10.0  # between two lines

# Called with the module of a loop, before numba compiles or loads it.
before_first_call: Callable[[str], None] | None = None
# Called with each loop in place of a line; the process that waits for this one counts it.
counted_by: Callable[[], None] | None = None


def _level() -> int:
    """Return the level of a line: in a program that has no handler for notes, one that shows."""
    return NOTE if logging.getLogger().hasHandlers() else logging.WARNING


class Progress:
    """Counts the loops that this process, and those that it waits for, compile, and says every few
    seconds how many.
    """

    def __init__(self) -> None:
        self.compiled = 0
        self._counting = threading.Lock()
        self._depth = 0  # a loop is compiled while another one that calls it is
        self._said_s = time.monotonic()

    @property
    def is_compiling(self) -> bool:
        """Whether numba compiles a loop now, or another process does for this one."""
        return self._depth > 0

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Wait for another process that compiles, inside the block."""
        self._depth += 1
        try:
            yield
        finally:
            self._depth -= 1

    def begin(self) -> None:
        """Count a loop."""
        self._depth += 1
        self.count()

    def count(self) -> None:
        """Count a loop that this process, or one beside it, begins to compile."""
        with self._counting:
            self.compiled += 1
            now_s = time.monotonic()
            due = now_s - self._said_s >= _LINE_S
            self._said_s = now_s if due else self._said_s
            line = self.line()
        if counted_by is not None:
            counted_by()
        elif due:
            log.log(_level(), "%s", line)

    def line(self) -> str:
        """Return how many loops were compiled, of how many if there are not more than usual."""
        of = f" of about {USUAL_LOOPS}" if self.compiled < USUAL_LOOPS else ""
        return f"compiling loops, once: {self.compiled}{of}"

    def end(self) -> None:
        """End a loop."""
        self._depth -= 1


PROGRESS = Progress()
_watched: list[object] = []  # the listener, once numba is loaded


def watch(is_own: Callable[[Any], bool]) -> None:
    """Count what numba compiles from now on, of functions for which `is_own` holds."""
    if _watched:
        return
    from numba.core import event

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            if is_own(event.data["dispatcher"].py_func):
                PROGRESS.begin()

        def on_end(self, event: Any) -> None:
            if is_own(event.data["dispatcher"].py_func):
                PROGRESS.end()

    _watched.append(Listener())
    event.register("numba:compile", _watched[0])  # type: ignore[no-untyped-call]
