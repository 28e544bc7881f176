"""A progress bar on stderr, silent where stderr is no terminal."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import TextIO

_BAR_COLUMNS = 30
_REDRAW_S = 0.1


class ProgressBar:
    """One line that is drawn over itself: label, bar, count, rate, time taken and time left."""

    def __init__(
        self,
        label: str,
        total: int | None = None,
        *,
        unit: str = "",
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start at nothing done.

        Args:
            label: what is being done.
            total: how many steps there are, where that is known already.
            unit: what a step is, for the rate; none is shown without.
            stream: where to draw; stderr if not given.
            clock: seconds of a clock that never goes back.
        """
        self._label, self._total, self._unit, self._clock = label, total, unit, clock
        self._stream = sys.stderr if stream is None else stream
        self._shown = self._stream.isatty()
        self._start, self._drawn = clock(), float("-inf")
        self._done, self._width = 0, 0

    def update(self, done: int, total: int | None = None) -> None:
        """Say how many steps are done, and of how many if that is news."""
        self._done, self._total = done, self._total if total is None else total
        if self._shown and (done == self._total or self._clock() - self._drawn >= _REDRAW_S):
            self._draw()

    def advance(self) -> None:
        """Say that one more step is done."""
        self.update(self._done + 1)

    def close(self) -> None:
        """Leave the bar as it stands, and the cursor below it."""
        if self._width:
            self._draw()
            print(file=self._stream, flush=True)
        self._shown = False

    def __enter__(self) -> ProgressBar:
        """Return the bar."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bar, whatever happened."""
        self.close()

    def _draw(self) -> None:
        self._drawn = self._clock()
        columns = shutil.get_terminal_size().columns - 1  # a full line would wrap, and stay
        line = self._line(self._drawn - self._start)[:columns]
        # Blanks over the rest of a longer line: every terminal knows them.
        self._stream.write("\r" + line.ljust(min(self._width, columns)))
        self._stream.flush()
        self._width = len(line)

    def _line(self, seconds: float) -> str:
        parts = [self._label]
        if self._total:
            full = _BAR_COLUMNS * min(self._done, self._total) // self._total
            parts.append("[" + "#" * full + "-" * (_BAR_COLUMNS - full) + "]")
        parts.append(f"{self._done}/{'?' if self._total is None else self._total}")
        if self._unit and seconds > 0:
            parts.append(f"{self._done / seconds:.1f} {self._unit}/s")
        parts.append(_clock_time(seconds))
        if self._total and 0 < self._done < self._total:
            parts.append(f"{_clock_time(seconds * (self._total / self._done - 1))} left")
        return " ".join(parts)


def _clock_time(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"
