"""How a configuration section declares one setting: default, unit and meaning in one place."""

from __future__ import annotations

from dataclasses import field
from typing import TypeVar

T = TypeVar("T")


def setting(default: T, doc: str, *, unit: str = "") -> T:
    """Declare a dataclass field with a default, a one-line meaning and a unit, shown by `vio config --show`."""
    return field(default=default, metadata={"doc": doc, "unit": unit})
