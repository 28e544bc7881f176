"""A finding of an inspection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Part:
    """One part of the report."""

    name: str
    text: str  # one line for people
    facts: Mapping[str, Any]  # the same as plain numbers
    faults: Sequence[str] = ()  # why a run makes no sense, with the remedy; one line each


@dataclass(frozen=True, slots=True)
class Inspection:
    """The whole report."""

    parts: tuple[Part, ...]
    notes: tuple[str, ...]  # of the reader

    @property
    def faults(self) -> tuple[str, ...]:
        """All reasons why a run makes no sense."""
        return tuple(f"{part.name}: {fault}" for part in self.parts for fault in part.faults)
