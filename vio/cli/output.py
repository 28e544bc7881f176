"""Output of the commands: one JSON object, or a table, and a progress bar meanwhile."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterable, Mapping
from typing import Any

from vio.files.printable import json_text, printable


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


class ProgressBar(contextlib.AbstractContextManager["ProgressBar"]):
    """A tqdm bar on stderr for work whose total may become known only during it; silent where
    stderr is no terminal.
    """

    def __init__(self, label: str, total: int | None = None, *, unit: str = "steps") -> None:
        from tqdm import tqdm

        hidden = not sys.stderr.isatty()
        self._bar = tqdm(
            desc=label,
            total=total,
            unit=f" {unit}",
            dynamic_ncols=True,
            file=sys.stderr,
            disable=hidden,
        )

    def update(self, done: int, total: int | None = None) -> None:
        """Set the number of steps done, and optionally the total."""
        self._bar.total = self._bar.total if total is None else total
        self._bar.update(done - self._bar.n)

    def advance(self) -> None:
        """Advance by one step."""
        self._bar.update()

    def close(self) -> None:
        """Keep the bar as it is, and move the cursor below it."""
        self._bar.close()

    def __exit__(self, *_: object) -> None:
        self.close()
