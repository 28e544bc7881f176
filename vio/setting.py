"""Declaration of a setting: default, unit, range and description in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, TypeVar

from vio.errors import ConfigError

T = TypeVar("T")


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
        return " and ".join(f"{name} {bound:g}" for name, bound in bounds if bound is not None)


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
    """Declare a dataclass field with default, one-line description, unit and range, as shown by `vio config --show`.

    A `Section` rejects numbers out of their range and numbers that are not finite.
    """
    allowed = Range(at_least, above, at_most, below)
    return field(default=default, metadata={"doc": doc, "unit": unit, "range": allowed})


class Section:
    """Base of the configuration's sections: frozen dataclasses whose settings are checked at construction."""

    __slots__ = ()
    section: ClassVar[str] = ""  # its path in the configuration, as used by --set

    def __post_init__(self) -> None:
        """Check every number.

        Raises:
            ConfigError: a value is out of range.
        """
        for f in fields(self):  # type: ignore[arg-type]
            _check(f"{self.section}.{f.name}".lstrip("."), getattr(self, f.name), f.metadata.get("range", Range()))


def _check(key: str, value: Any, allowed: Range) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return
    if not math.isfinite(value):
        raise ConfigError(f"{key} must be finite, got {value:g}")
    if not allowed.holds(value):
        raise ConfigError(f"{key} must be {allowed}, got {value:g}")
