"""A progress bar on stderr, silent where stderr is no terminal."""

from __future__ import annotations

import sys
from types import TracebackType

from tqdm import tqdm


class ProgressBar:
    """A tqdm bar for work whose total may become known only during it."""

    def __init__(self, label: str, total: int | None = None, *, unit: str = "steps") -> None:
        """Start at zero."""
        hidden = not sys.stderr.isatty()
        self._bar = tqdm(desc=label, total=total, unit=f" {unit}", dynamic_ncols=True, file=sys.stderr, disable=hidden)

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

    def __enter__(self) -> ProgressBar:
        """Return the bar."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bar, whatever happened."""
        self.close()
