"""Declaration of a setting: default, unit, range and description in one place."""

from __future__ import annotations

import math
from dataclasses import field, fields
from functools import cache
from numbers import Integral, Real
from types import UnionType
from typing import Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from vio.dataclass import dataclass
from vio.errors import ConfigError

T = TypeVar("T")
_hints = cache(get_type_hints)

# No setting means anything beyond these sizes, in its unit; their squares would overflow, vanish or
# fill the memory.
_LARGEST = 10**6
_SMALLEST = 1e-9


@dataclass(frozen=True, slots=True)
class Range:
    """Allowed range of a number; None: no bound on that side."""

    at_least: float | None = None
    above: float | None = None
    at_most: float | None = None
    below: float | None = None

    def holds(self, value: float) -> bool:
        """Return whether a finite number is in the range."""
        return (
            (self.at_least is None or value >= self.at_least)
            and (self.above is None or value > self.above)
            and (self.at_most is None or value <= self.at_most)
            and (self.below is None or value < self.below)
        )

    def __str__(self) -> str:
        """Return `at least 3`, `above 0 and below 1`, …; empty without bounds."""
        bounds = ((f.name.replace("_", " "), getattr(self, f.name)) for f in fields(self))
        return " and ".join(
            f"{name} {bound}" if isinstance(bound, int) else f"{name} {bound:g}"
            for name, bound in bounds
            if bound is not None
        )


def setting(
    default: T,
    doc: str,
    *,
    unit: str = "",
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
) -> T:
    """Declare a dataclass field with default, one-line description, unit and range, as shown by
    `vio config --show`.

    A `Section` rejects numbers out of their range and numbers that are not finite.
    """
    allowed = Range(at_least, above, at_most, below)
    return field(default=default, metadata={"doc": doc, "unit": unit, "range": allowed})


class Section:
    """Base of the configuration's sections: frozen dataclasses whose settings are checked at
    construction.
    """

    __slots__ = ()
    section: ClassVar[str] = ""  # its path in the configuration, as used by --set

    def __post_init__(self) -> None:
        """Check the type of every value, and the range of every number.

        Raises:
            ConfigError: a value has the wrong type or is out of range.
        """
        hints = _hints(type(self))  # type: ignore[arg-type] # a dataclass is hashable
        for f in fields(self):  # type: ignore[arg-type]
            if not _fits(value := getattr(self, f.name), hints[f.name]):
                key = f"{self.section}.{f.name}".lstrip(".")
                raise ConfigError(
                    f"{key} does not take {repr(value)[:100]}; it takes {_wanted(hints[f.name])}"
                )
            _check(
                f"{self.section}.{f.name}".lstrip("."),
                getattr(self, f.name),
                f.metadata.get("range", Range()),
            )


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value is of a setting's type; a whole number is a number, and NumPy's
    numbers are.
    """
    if get_origin(hint) in (Union, UnionType):
        return any(_fits(value, member) for member in get_args(hint))
    if get_origin(hint) is Literal:
        return isinstance(value, str) and value in get_args(hint)
    if hint in (int, float):
        return isinstance(value, Integral if hint is int else Real) and not isinstance(value, bool)
    return isinstance(value, hint)


def _wanted(hint: Any) -> str:
    if get_origin(hint) in (Union, UnionType):
        return " or ".join(_wanted(member) for member in get_args(hint))
    if get_origin(hint) is Literal:
        return f"one of {', '.join(get_args(hint))}"
    names = {int: "a whole number", float: "a number", bool: "True or False", type(None): "None"}
    return names.get(hint, hint.__name__)


def _check(key: str, value: Any, allowed: Range) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{key} must be finite, got {value:g}")
    if not allowed.holds(value):
        raise ConfigError(f"{key} must be {allowed}, got {_number(value)}")
    if allowed.at_most is None and abs(value) > _LARGEST:
        raise ConfigError(f"{key} must be at most {_LARGEST} in size, got {_number(value)}")
    if 0 < abs(value) < _SMALLEST:
        raise ConfigError(
            f"{key} must be at least {_SMALLEST:g} in size, or 0 where that is allowed, got "
            f"{value:g}"
        )


def _number(value: float) -> str:
    if isinstance(value, float) or abs(value) < 2**1000:
        return f"{value:g}"
    return "a larger number"
