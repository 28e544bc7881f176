"""The package's `dataclass` against the standard library's."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import pickle
from collections.abc import Callable
from typing import Any, ClassVar

import pytest

from vio.dataclass import dataclass


def _point(decorate: Callable[..., Any]) -> Any:
    """Return a class with fields of all kinds that the decorator takes."""

    @decorate(frozen=True, slots=True)
    class Point:
        """A point."""

        DIMENSIONS: ClassVar[int] = 2
        x: float
        y: float = 2.0
        names: list[str] = dataclasses.field(default_factory=list, compare=False)
        hidden: int = dataclasses.field(default=0, repr=False)

        def __post_init__(self) -> None:
            if self.x < 0:
                raise ValueError("negative")

    return Point


STANDARD = _point(dataclasses.dataclass)
OURS = _point(dataclass)


@dataclass(frozen=True, slots=True)
class Frozen:
    """At the top of a module, as pickle needs it."""

    value: int
    more: tuple[int, ...] = ()


@dataclass(slots=True)
class Open:
    """With fields that may change."""

    value: int = 0


@dataclass(frozen=True, slots=True)
class Derived(Frozen):
    """Of another dataclass: made by the standard library."""

    last: int = 3


def test_is_the_standard_one_but_for_its_cost() -> None:
    assert str(inspect.signature(OURS)) == str(inspect.signature(STANDARD))
    assert OURS.__match_args__ == STANDARD.__match_args__
    assert OURS.__slots__ == STANDARD.__slots__
    assert repr(OURS.__dataclass_params__) == repr(STANDARD.__dataclass_params__)
    a, b, c = (OURS(1.0, names=["a"]), OURS(1.0, names=["b"]), OURS(1.0, 3.0))
    assert repr(a) == repr(STANDARD(1.0, names=["a"]))
    assert (a == b, a == c, a == STANDARD(1.0)) == (True, False, False)
    assert hash(a) == hash(b) == hash(STANDARD(1.0))
    assert dataclasses.asdict(a) == dataclasses.asdict(STANDARD(1.0, names=["a"]))
    assert dataclasses.replace(a, y=3.0) == c
    assert a.names is not OURS(1.0).names
    assert OURS(1.0).names is not OURS(1.0).names


def test_checks_are_made() -> None:
    with pytest.raises(ValueError, match="negative"):
        OURS(-1.0)
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'x'"):
        OURS()


@pytest.mark.parametrize("name", ["value", "other"])
def test_frozen_fields_do_not_change(name: str) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(Frozen(1), name, 2)
    with pytest.raises(dataclasses.FrozenInstanceError):
        delattr(Frozen(1), name)


def test_open_fields_change_and_have_no_hash() -> None:
    own = Open()
    own.value = 5
    assert own == Open(5)
    with pytest.raises(TypeError, match="unhashable"):
        hash(own)


@pytest.mark.parametrize("own", [Frozen(1, (2,)), Open(4), Derived(1, (2,), 3)])
def test_copies_are_equal(own: object) -> None:
    assert pickle.loads(pickle.dumps(own)) == own
    assert copy.deepcopy(own) == own


def test_a_record_inside_itself_is_written_once() -> None:
    own = Open()
    own.value = own  # type: ignore[assignment]
    assert repr(own) == "Open(value=...)"


def test_fields_of_other_kinds_are_refused() -> None:
    with pytest.raises(TypeError, match=r"take dataclasses\.dataclass"):

        @dataclass(frozen=True, slots=True)
        class Named:
            """A field that is given by name alone."""

            value: int = dataclasses.field(default=0, kw_only=True)
