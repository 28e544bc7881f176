"""Output of the commands: one JSON object, or a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from vio.files.printable import json_text, printable

NOTE = 25  # level of a log line that says what was found or assumed, and asks for nothing: between info and warning


def print_result(
    facts: Mapping[str, Any], rows: Iterable[tuple[str, str]], *, as_json: bool, name_width: int = 10
) -> int:
    """Print all results as JSON, or rows of names and values as a table, names of files escaped; return the status."""
    if as_json:
        print(json_text(facts))
    else:
        for name, value in rows:
            print(f"{name:<{name_width}} {printable(value)}")
    return 0
