"""What a command says while it works, so that no wait is without a line."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from vio.errors import NOTE
from vio.numerics.compiling import PROGRESS

log = logging.getLogger(__name__)


class _LineRules(NamedTuple):
    """When a line says how far the work is: soon at first, more rarely where it takes long."""

    least_s: float = 5.0
    share: float = 0.2  # of the time so far
    most_s: float = 30.0


_LINES = _LineRules()
_said_s = time.monotonic()  # when the log said something last, while a `SilenceBroken` listens


def silent_since(begun_s: float) -> float:
    """Return since when work that began at a time, or the log after it, has said nothing."""
    return max(begun_s, _said_s)


# What goes on, the innermost last; each returns its line, or None where a bar shows it.
_WORK: list[Callable[[], str | None]] = []


def line_due(so_far_s: float, silent_s: float) -> bool:
    """Tell whether work that began, and said nothing, so long ago is to say how far it is."""
    usual_s = min(_LINES.share * so_far_s, _LINES.most_s)
    return silent_s >= max(_LINES.least_s, usual_s)


@contextlib.contextmanager
def working(line: Callable[[], str | None]) -> Iterator[None]:
    """Have a silent wait inside the block described by a function."""
    _WORK.append(line)
    try:
        yield
    finally:
        _WORK.remove(line)


@contextlib.contextmanager
def stage(text: str) -> Iterator[None]:
    """Describe silent waits inside the block."""
    with working(lambda: text):
        yield


class SilenceBroken(logging.Handler):
    """Says what goes on where the log said nothing for some seconds, inside the block."""

    def __init__(self, command: str) -> None:
        super().__init__()
        self._command = command
        self._begun_s = time.monotonic()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def emit(self, record: logging.LogRecord) -> None:
        """Note that something was said."""
        global _said_s
        _said_s = time.monotonic()

    def _watch(self) -> None:
        while not self._ended.wait(_LINES.least_s / 5):
            now_s = time.monotonic()
            if line_due(now_s - self._begun_s, now_s - silent_since(self._begun_s)):
                self._say()

    def _say(self) -> None:
        line = _WORK[-1]() if _WORK else self._command
        if line is None:
            return  # a bar moves
        if PROGRESS.is_compiling:
            line = PROGRESS.line()
        log.log(NOTE, "%s, %.0f s so far", line, time.monotonic() - self._begun_s)

    def __enter__(self) -> SilenceBroken:
        logging.getLogger().addHandler(self)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        logging.getLogger().removeHandler(self)
