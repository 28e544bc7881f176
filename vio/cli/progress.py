"""A progress bar on stderr, silent where stderr is no terminal."""

from __future__ import annotations

import sys
from types import TracebackType

from tqdm import tqdm


class ProgressBar:
    """tqdm's bar for work that says how far it is, and perhaps only then how far it has to go."""

    def __init__(self, label: str, total: int | None = None, *, unit: str = "steps") -> None:
        """Start at nothing done.

        Args:
            label: what is being done.
            total: how many steps there are, where that is known already.
            unit: what a step is.
        """
        hidden = not sys.stderr.isatty()
        self._bar = tqdm(desc=label, total=total, unit=f" {unit}", dynamic_ncols=True, file=sys.stderr, disable=hidden)

    def update(self, done: int, total: int | None = None) -> None:
        """Say how many steps are done, and of how many if that is news."""
        self._bar.total = self._bar.total if total is None else total
        self._bar.update(done - self._bar.n)

    def advance(self) -> None:
        """Say that one more step is done."""
        self._bar.update()

    def close(self) -> None:
        """Leave the bar as it stands, and the cursor below it."""
        self._bar.close()

    def __enter__(self) -> ProgressBar:
        """Return the bar."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bar, whatever happened."""
        self.close()
