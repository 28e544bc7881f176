"""Output of the commands: one JSON object, or a table, and a progress bar meanwhile."""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NoReturn

from vio.cli.waiting import line_due, silent_since, working
from vio.errors import NOTE
from vio.files.printable import json_text, printable

if TYPE_CHECKING:
    from tqdm import tqdm

log = logging.getLogger(__name__)


def print_result(
    facts: Mapping[str, Any],
    rows: Iterable[tuple[str, str]],
    *,
    as_json: bool,
    name_width: int = 10,
) -> int:
    """Print all results as JSON, or rows of names and values as a table, names of files escaped;
    return the status.
    """
    if as_json:
        print(json_text(facts))
    else:
        for name, value in rows:
            print(f"{name:<{name_width}} {printable(value)}")
    return 0


def _shown(label: str, total: int | None, unit: str) -> tqdm[NoReturn]:
    """Show a bar on the terminal."""
    from tqdm import tqdm

    return tqdm(desc=label, total=total, unit=f" {unit}", dynamic_ncols=True, file=sys.stderr)


class ProgressBar(contextlib.AbstractContextManager["ProgressBar"]):
    """A tqdm bar on stderr for work whose total may become known only during it.

    Where stderr is no terminal, a line every few seconds says how far the work is, and where it is
    `announced`, one that it begins; short work is silent otherwise.
    """

    def __init__(
        self,
        label: str,
        total: int | None = None,
        *,
        unit: str = "steps",
        announced: bool = False,
    ) -> None:
        hidden = not sys.stderr.isatty()
        self._label = label
        self._unit = unit
        self._done = 0
        self._total = total
        self._begun_s = self._said_s = time.monotonic()
        self._work = contextlib.ExitStack()
        self._work.enter_context(working(self._line))
        if hidden and announced:
            log.log(NOTE, "%s%s", label, "" if total is None else f": {total} {unit}")
        self._bar = None if hidden else _shown(label, total, unit)

    def update(self, done: int, total: int | None = None) -> None:
        """Set the number of steps done, and optionally the total."""
        if self._bar is not None:
            if total is not None:
                self._bar.total = total
            self._bar.update(done - self._bar.n)
        self._total = self._total if total is None else total
        self._advance_to(done)

    def begin(self, part: str) -> None:
        """Go on with another part of the work, whose steps are not known yet."""
        self._label = part
        self._done = 0
        self._total = None
        if self._bar is not None:
            self._bar.reset()
            self._bar.total = None
            self._bar.set_description(part)

    def advance(self) -> None:
        """Advance by one step."""
        if self._bar is not None:
            self._bar.update()
        self._advance_to(self._done + 1)

    def _advance_to(self, done: int) -> None:
        self._done = done
        now_s = time.monotonic()
        if self._bar is None and line_due(
            now_s - self._begun_s, now_s - silent_since(self._said_s)
        ):
            self._said_s = now_s
            log.log(NOTE, "%s", self._line())

    def _line(self) -> str | None:
        """Return how far the work is; None: the bar shows it, whose clock goes on though no step is
        done.
        """
        if self._bar is not None:
            self._bar.refresh()
            return None
        if not self._done and self._total is None:
            return self._label
        of = "" if self._total is None else f" of {self._total}"
        return f"{self._label}: {self._done}{of} {self._unit}"

    def close(self) -> None:
        """Keep the bar as it is, and move the cursor below it."""
        self._work.close()
        if self._bar is not None:
            self._bar.close()

    def __exit__(self, *_: object) -> None:
        self.close()
