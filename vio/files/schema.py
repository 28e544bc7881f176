"""What a JSON file of another hand must look like, before anything is taken from it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import field
from typing import Any

from vio.dataclass import dataclass

_LARGEST = 2**63 - 1  # of whole numbers: they end in arrays of 64 bits
_SHOWN = 40  # characters of a wrong value


@dataclass(frozen=True, slots=True)
class Shape:
    """What one value of a JSON file may be."""

    words: str  # "a text", for the message
    kinds: tuple[type, ...]
    or_null: bool = False
    members: Mapping[str, Shape] = field(default_factory=dict)  # of an object, where they are there
    needed: frozenset[str] = frozenset()  # members that must be there
    each: Shape | None = None  # of a list's members, or of an object's others

    def fault(self, value: Any, name: str) -> str | None:
        """Return what is wrong with a value, in words; None: nothing."""
        if value is None and self.or_null:
            return None
        if type(value) not in self.kinds or not _is_usable(value):
            null = " or null" if self.or_null else ""
            return f"{name or 'the file'} must be {self.words}{null}, got {_shown(value)}"
        return next(self._faults_inside(value, f"{name}." if name else ""), None)

    def _faults_inside(self, value: Any, inner: str) -> Iterator[str]:
        """Yield what is wrong with the members of a value, whose names begin with `inner`."""
        if isinstance(value, dict):
            for key in sorted(self.needed - value.keys()):
                yield f"{inner}{key} is missing"
        for key, part, shape in self._shaped_parts(value):
            fault = shape.fault(part, f"{inner}{key}")
            if fault is not None:
                yield fault

    def _shaped_parts(self, value: Any) -> Iterator[tuple[Any, Any, Shape]]:
        """Yield key, value and shape of the members whose shape is known."""
        if isinstance(value, dict):
            for key, part in value.items():
                shape = self.members.get(str(key), self.each)
                if shape is not None:
                    yield key, part, shape
        elif isinstance(value, list) and self.each is not None:
            for k, part in enumerate(value):
                yield k, part, self.each


def _is_usable(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return not isinstance(value, int) or abs(value) <= _LARGEST


def _shown(value: Any) -> str:
    text = repr(value)
    if len(text) <= _SHOWN:
        return text
    return f"{text[:_SHOWN]}…"


def an_object(
    members: Mapping[str, Shape],
    *needed: str,
    each: Shape | None = None,
    or_null: bool = False,
) -> Shape:
    """Return the shape of an object; members that it does not name are `each`, or anything."""
    return Shape("an object", (dict,), or_null, members, frozenset(needed), each)


def a_list(each: Shape, *, or_null: bool = False) -> Shape:
    """Return the shape of a list."""
    return Shape("a list", (list,), or_null, each=each)


TEXT = Shape("a text", (str,))
TEXT_OR_NULL = Shape("a text", (str,), or_null=True)
NUMBER = Shape("a finite number", (int, float))
NUMBER_OR_NULL = Shape("a finite number", (int, float), or_null=True)
WHOLE = Shape("a whole number", (int,))
WHOLE_OR_NULL = Shape("a whole number", (int,), or_null=True)
TRUTH = Shape("true or false", (bool,))
