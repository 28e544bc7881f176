"""`dataclass` of the standard library at a tenth of its cost when a module is imported.

The standard one writes six functions for each class as text and compiles them, which took a third
of the time of all imports. Here classes share their methods, and `__init__`, whose speed counts,
is compiled when it is first looked up. Fields, equality, hash, text and pickle are the same;
`dataclasses.replace`, `fields` and `asdict` take the class. Fields have no options but default,
factory, `compare`, `hash`, `repr` and metadata; a class that inherits from another dataclass, or
writes one of the methods itself, is a standard one.
"""

from __future__ import annotations

import dataclasses
import reprlib
from collections.abc import Callable
from dataclasses import MISSING, FrozenInstanceError, fields
from operator import attrgetter
from typing import TYPE_CHECKING, Any

# What a class must leave to the decorator, or the standard one does it all.
_SHARED = ("__init__", "__repr__", "__eq__", "__hash__", "__setattr__", "__delattr__")


def _dataclass(*, slots: bool = False, frozen: bool = False) -> Callable[[type[Any]], type[Any]]:
    """Return the decorator of a class with slots."""

    def decorate(cls: type[Any]) -> type[Any]:
        if not slots or _needs_standard(cls):
            return dataclasses.dataclass(frozen=frozen, slots=slots)(cls)
        made: Any = dataclasses.dataclass(init=False, repr=False, eq=False, slots=True)(cls)
        own = fields(made)
        if any(f.kw_only or not f.init for f in own):
            raise TypeError(f"{cls.__name__}: take dataclasses.dataclass for such fields")
        stated = made.__dataclass_params__
        stated.init = stated.repr = stated.eq = True
        stated.frozen = frozen
        made.__init__ = _LateInit(made, frozen=frozen)
        made.__repr__ = _repr
        made.__eq__ = _equals([f.name for f in own if f.compare])
        made.__hash__ = None
        if frozen:
            _freeze(made)
        return made

    return decorate


def _needs_standard(cls: type[Any]) -> bool:
    """Tell whether a class inherits from a dataclass or writes something itself that is shared."""
    if any(hasattr(base, "__dataclass_fields__") for base in cls.__bases__):
        return True
    return not cls.__doc__ or any(name in vars(cls) for name in _SHARED)


def _freeze(made: Any) -> None:
    """Give a class the methods of one whose instances cannot change."""
    hashed = [f.name for f in fields(made) if (f.compare if f.hash is None else f.hash)]
    made.__hash__ = _hash_of(hashed)
    made.__setattr__ = _refusing_to_set(made)
    made.__delattr__ = _refusing_to_delete(made)
    made.__getstate__ = dataclasses._dataclass_getstate  # type: ignore[attr-defined]
    made.__setstate__ = dataclasses._dataclass_setstate  # type: ignore[attr-defined]


class _LateInit:
    """Makes the `__init__` of a class when it is looked up, and puts it in its own place."""

    def __init__(self, cls: type[Any], *, frozen: bool) -> None:
        self._cls = cls
        self._frozen = frozen

    def __get__(self, instance: object, owner: type[Any] | None = None) -> Any:
        init = self._cls.__init__ = _init_of(self._cls, frozen=self._frozen)
        return init if instance is None else init.__get__(instance, owner)


class _Factory:
    """The default of an argument for which a field's factory is called."""

    def __repr__(self) -> str:
        return "<factory>"


def _init_of(cls: type[Any], *, frozen: bool) -> Callable[..., None]:
    """Write and compile `__init__` as the standard library does."""
    known: dict[str, Any] = {"_set": object.__setattr__, "_factory": _Factory()}
    arguments = ["self"]
    lines = []
    for f in fields(cls):
        value = f.name
        argument = f.name
        if f.default is not MISSING:
            known[f"_default_{f.name}"] = f.default
            argument = f"{f.name}=_default_{f.name}"
        elif f.default_factory is not MISSING:
            known[f"_make_{f.name}"] = f.default_factory
            argument = f"{f.name}=_factory"
            value = f"_make_{f.name}() if {f.name} is _factory else {f.name}"
        arguments.append(argument)
        lines.append(f"_set(self, {f.name!r}, {value})" if frozen else f"self.{f.name} = {value}")
    if hasattr(cls, "__post_init__"):
        lines.append("self.__post_init__()")
    text = f"def __init__({', '.join(arguments)}):\n " + "\n ".join(lines or ["pass"])
    exec(text, known)
    init: Callable[..., None] = known["__init__"]
    init.__qualname__ = f"{cls.__qualname__}.__init__"
    init.__module__ = cls.__module__
    init.__annotations__ = {f.name: f.type for f in fields(cls)} | {"return": None}
    return init


@reprlib.recursive_repr()
def _repr(self: Any) -> str:
    values = (f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if f.repr)
    return f"{type(self).__qualname__}({', '.join(values)})"


def _values(names: list[str]) -> Callable[[Any], tuple[Any, ...]]:
    """Return what returns the values of some fields of an instance."""
    if len(names) > 1:
        return attrgetter(*names)
    return lambda self: tuple(getattr(self, name) for name in names)


def _equals(names: list[str]) -> Callable[[Any, object], bool]:
    values = _values(names)

    def equals(self: Any, other: object) -> bool:
        if other.__class__ is not self.__class__:
            return NotImplemented
        return values(self) == values(other)

    return equals


def _hash_of(names: list[str]) -> Callable[[Any], int]:
    values = _values(names)
    return lambda self: hash(values(self))


def _refusing_to_set(cls: type[Any]) -> Callable[[Any, str, Any], None]:
    def refuse(self: Any, name: str, value: Any) -> None:
        if type(self) is cls or name in cls.__dataclass_fields__:
            raise FrozenInstanceError(f"cannot assign to field {name!r}")
        super(cls, self).__setattr__(name, value)

    return refuse


def _refusing_to_delete(cls: type[Any]) -> Callable[[Any, str], None]:
    def refuse(self: Any, name: str) -> None:
        if type(self) is cls or name in cls.__dataclass_fields__:
            raise FrozenInstanceError(f"cannot delete field {name!r}")
        super(cls, self).__delattr__(name)

    return refuse


if TYPE_CHECKING:
    from dataclasses import dataclass
else:
    dataclass = _dataclass

__all__ = ["dataclass"]
