"""Whether the project refuses what it is given, for tables of limits."""

from __future__ import annotations

from collections.abc import Callable

from vio.errors import VioError


def is_refused(call: Callable[[], object]) -> bool:
    """Whether a call ends by an error of the project's own."""
    try:
        call()
    except VioError:
        return True
    return False
