"""The state of an unfinished run in a file, from which it goes on to the same bits.

The file is a checksum, a line of JSON (the program that wrote it and the inputs of the run), the
state as a tree in JSON, and the bytes of its arrays. A node of the tree is a plain value or a list
that begins with the name of its kind; lists are numbered in the order in which they begin, and
`["ref", n]` is one that came before. Loading makes objects of this package's classes without
calling their constructors, and sets their attributes; it calls nothing that the file names.
"""

from __future__ import annotations

import importlib
import json
import platform
import types
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import cache, reduce
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, Protocol

import numpy as np

from vio._version import __version__
from vio.errors import DataError
from vio.files.atomic import atomic_write_bytes
from vio.files.inputs import read_input
from vio.numerics.kinds import Capacity
from vio.protocols import Dataset

_FORMAT = "stereo-vio checkpoint 2"
_PACKAGE = __name__.split(".", maxsplit=1)[0]
_MAX_BYTES: Capacity[int] = 4 << 30
_PLAIN = frozenset((type(None), bool, int, float, str))
_SEQUENCES = frozenset((list, tuple, set, frozenset))
# of the classes whose objects are saved, beside this package's own
_BASES = (object, Generic, Protocol)
_DAMAGE = (
    OSError,
    ValueError,
    ArithmeticError,
    AttributeError,
    TypeError,
    LookupError,
    ImportError,
    RecursionError,
)
_MAX_CHANGES = 3  # of the inputs, named in an error


@cache
def _bit_generators() -> Mapping[str, Any]:
    """NumPy's bit generators by name; it loads them when they are asked for, in 7 ms."""
    kinds = (np.random.PCG64, np.random.PCG64DXSM, np.random.SFC64)
    return {kind.__name__: kind for kind in kinds}


class NotSavableError(Exception):
    """A part of the run holds what cannot be saved."""


def save_checkpoint(
    path: Path, state: Any, dataset: Dataset, inputs: Mapping[str, Any] | None = None
) -> None:
    """Write a state atomically; the recording itself, where the state refers to it, is left out.

    A state is made of plain values, arrays, containers and objects of this package's classes.
    `inputs` is what the results depend on, as JSON values by name; they must be the same when the
    run goes on.

    Raises:
        NotSavableError: a part of the state cannot be saved.
        DataError: the file cannot be written.
    """
    writer = _Writer(dataset)
    try:
        tree = json.dumps(writer.node(state), separators=(",", ":"), check_circular=False).encode()
    except RecursionError as error:
        raise NotSavableError("its parts are nested too deeply") from error
    head = json.dumps(
        {"program": _program(), "inputs": dict(inputs or {}), "tree_bytes": len(tree)}
    ).encode()
    # The arrays are written from where they are: copies would double what a run needs.
    parts: tuple[bytes | memoryview, ...] = (head, b"\n", tree, *writer.blobs)
    checksum = reduce(lambda crc, part: zlib.crc32(part, crc), parts, 0)
    atomic_write_bytes(path, b"%08x" % checksum, *parts)


def checkpoint_id(path: Path) -> int:
    """Return the checksum of a checkpoint, which tells it from others; 0: there is none."""
    try:
        with path.open("rb") as stream:
            return int(stream.read(8), 16)
    except (OSError, ValueError):
        return 0


def load_checkpoint(
    path: Path, dataset: Dataset | None, inputs: Mapping[str, Any] | None = None
) -> Any:
    """Read a state; what referred to the recording refers to `dataset` then.

    Raises:
        DataError: the file is damaged, another program wrote it, or the run had other inputs.
    """
    try:
        data = read_input(path, _MAX_BYTES)
        if data[:8] != b"%08x" % zlib.crc32(memoryview(data)[8:]):
            raise ValueError(
                "its checksum does not agree with its content; or an earlier version wrote it"
            )
        end = data.index(b"\n")
        head = json.loads(data[8:end])
        if program := _changes(head["program"], _program()):
            raise DataError(
                f"{path}: was written by another program ({program}); repeat the run from its start"
            )
        if changed := _changes(head["inputs"], json.loads(json.dumps(dict(inputs or {})))):
            raise DataError(
                f"{path}: what the run depends on has changed ({changed}); undo that, or repeat "
                "the run"
            )
        body = memoryview(data)[end + 1 :]
        tree = json.loads(bytes(body[: head["tree_bytes"]]))
        return _Reader(dataset, body[head["tree_bytes"] :]).node(tree)
    except _DAMAGE as error:
        raise DataError(f"{path}: is damaged ({error}); repeat the run from its start") from error


def _program() -> dict[str, str]:
    """What must be equal for equal bits."""
    from importlib import metadata  # slow, and short runs flush nothing

    import cv2

    return {
        "format": _FORMAT,
        "version": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "numba": metadata.version("numba"),
    }


def _changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Name the values that are not what they were; empty: all are."""
    names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    texts = [f"{name} was {before.get(name)}, now {now.get(name)}" for name in names[:_MAX_CHANGES]]
    return "; ".join(
        texts + [f"and {len(names) - _MAX_CHANGES} more"] * (len(names) > _MAX_CHANGES)
    )


@cache
def _slots(cls: type) -> dict[str, types.MemberDescriptorType]:
    """Return the slots of one of this package's classes by name."""
    for base in cls.__mro__:
        if base not in _BASES and base.__module__.split(".")[0] != _PACKAGE:
            raise TypeError(
                f"{base.__module__}.{base.__qualname__} does not belong into a checkpoint"
            )
    members = {name: own for base in cls.__mro__ for name, own in vars(base).items()}
    return {
        name: own for name, own in members.items() if isinstance(own, types.MemberDescriptorType)
    }


def _own_hook(cls: type, name: str) -> Any:
    """Return `__getstate__` or `__setstate__` where this package's code defines it.

    None: it does not.
    """
    hook = getattr(cls, name, None)
    if str(getattr(hook, "__module__", None)).split(".")[0] == _PACKAGE:
        return hook
    return None


class _Writer:
    """Makes a tree of a state, and collects the bytes of its arrays."""

    def __init__(self, dataset: Dataset) -> None:
        self.blobs: list[memoryview] = []  # of the arrays, most of which share their memory
        self._dataset = dataset
        self._bytes = 0
        # of the objects, by id; -1: a tuple or set that has not ended
        self._numbers: dict[int, int] = {}
        self._kept: list[Any] = []  # so that no id is used twice

    def node(self, value: Any) -> Any:
        """Return the node of a value."""
        if type(value) in _PLAIN:
            return value
        number = self._numbers.get(id(value))
        if number is None:
            number = len(self._kept)
            self._kept.append(value)
            if isinstance(value, (tuple, frozenset)):
                self._numbers[id(value)] = -1
            else:
                self._numbers[id(value)] = number
            made = self._list(value)
            self._numbers[id(value)] = number
            return made
        if number < 0:
            raise NotSavableError(f"a {type(value).__name__} that contains itself")
        return ["ref", number]

    def _list(self, value: Any) -> list[Any]:
        kind = type(value)
        if isinstance(value, np.generic):
            return self._array("scalar", np.array(value))
        if value is self._dataset:
            return ["dataset"]
        if (
            kind is types.MethodType
            and value.__self__ is self._dataset
            and value.__name__ == "observations"
        ):
            return ["observations"]
        writes = self._WRITERS.get(kind)
        if writes is None:
            return self._object(value, kind)
        return writes(self, value)

    def _sequence(self, value: Iterable[Any]) -> list[Any]:
        return [type(value).__name__, *map(self.node, value)]

    def _dict(self, value: dict[Any, Any]) -> list[Any]:
        return ["dict", *(self.node(part) for pair in value.items() for part in pair)]

    def _deque(self, value: deque[Any]) -> list[Any]:
        return ["deque", value.maxlen, *map(self.node, value)]

    def _slice(self, value: slice) -> list[Any]:
        return ["slice", *map(self.node, (value.start, value.stop, value.step))]

    def _complex(self, value: complex) -> list[Any]:
        return ["complex", value.real, value.imag]

    def _byte_string(self, value: bytes) -> list[Any]:
        return self._array("bytes", np.frombuffer(value, dtype=np.uint8))

    def _generator(self, value: np.random.Generator) -> list[Any]:
        bits = value.bit_generator
        return ["generator", type(bits).__name__, self.node(bits.state)]

    _WRITERS: ClassVar[Mapping[type, Callable[[_Writer, Any], list[Any]]]] = {
        **dict.fromkeys(_SEQUENCES, _sequence),
        dict: _dict,
        np.ndarray: lambda self, value: self._array("array", value),
        deque: _deque,
        slice: _slice,
        complex: _complex,
        bytes: _byte_string,
        np.random.Generator: _generator,
    }

    def _array(self, kind: str, value: np.ndarray[Any, Any]) -> list[Any]:
        if value.dtype.hasobject:
            raise NotSavableError("an array of objects does not belong into a checkpoint")
        order: Literal["C", "F"] = "F" if value.flags.fnc else "C"
        self.blobs.append(value.ravel(order).view(np.uint8).data)
        start = self._bytes
        self._bytes = self._bytes + value.nbytes
        if value.dtype.names:
            dtype = np.lib.format.dtype_to_descr(value.dtype)
        else:
            dtype = value.dtype.str
        return [kind, dtype, value.shape, order, start, value.flags.writeable]

    def _object(self, value: Any, kind: type) -> list[Any]:
        name = f"{kind.__module__}:{kind.__qualname__}"
        try:
            slots = _slots(_own_class(name))
        except (TypeError, ValueError, LookupError, ImportError) as error:
            raise NotSavableError(str(error)) from error
        hook = _own_hook(kind, "__getstate__")
        if hook is not None:
            state = hook(value)
        else:
            state = {key: getattr(value, key) for key in slots if hasattr(value, key)} | getattr(
                value, "__dict__", {}
            )
        return ["object", name, {key: self.node(own) for key, own in state.items()}]


class _Reader:
    """Makes a state of its tree and the bytes of its arrays; what does not fit raises a built-in
    exception.
    """

    def __init__(self, dataset: Dataset | None, blobs: memoryview) -> None:
        self._dataset = dataset
        self._blobs = blobs
        self._made: list[Any] = []  # by number; None: not yet

    def node(self, node: Any) -> Any:
        """Return the value of a node."""
        if type(node) in _PLAIN:
            return node
        kind, *parts = node
        if kind == "ref":
            if parts[0] < 0 or (made := self._made[parts[0]]) is None:
                raise ValueError("a part refers to one that is not complete")
            return made
        self._made.append(None)
        number = len(self._made) - 1
        if kind in ("list", "dict", "set", "deque"):
            return self._container(number, kind, parts)
        if kind == "object":
            return self._object(number, *parts)
        self._made[number] = made = self._value(kind, parts)
        return made

    def _container(self, number: int, kind: str, parts: list[Any]) -> Any:
        """Make a container, which its parts may refer to."""
        made: Any = (
            deque(maxlen=parts.pop(0))
            if kind == "deque"
            else {"list": list, "dict": dict, "set": set}[kind]()
        )
        self._made[number] = made
        values = map(self.node, parts)
        if kind == "dict":
            made.update(zip(values, values, strict=True))  # one iterator: keys and values in turns
        elif kind == "set":
            made.update(values)
        else:
            made.extend(values)
        return made

    def _object(self, number: int, name: str, state: dict[str, Any]) -> Any:
        cls = _own_class(name)
        slots = _slots(cls)
        restore = _own_hook(cls, "__setstate__")
        made: Any = object.__new__(cls)
        self._made[number] = made
        values = {key: self.node(node) for key, node in state.items()}
        if restore is not None:
            restore(made, values)
            return made
        for key, value in values.items():
            if key in slots:
                slots[key].__set__(made, value)
            else:
                vars(made)[key] = value
        return made

    def _value(self, kind: str, parts: list[Any]) -> Any:
        if kind in ("array", "scalar", "bytes"):
            array = self._array(*parts)
            if kind == "array":
                return array
            if kind == "scalar":
                return array[()]
            return array.tobytes()
        if kind in ("dataset", "observations"):
            if self._dataset is None:
                raise ValueError("its state refers to a recording")
            return self._dataset if kind == "dataset" else self._dataset.observations
        if kind == "generator":
            generator = np.random.Generator(_bit_generators()[parts[0]]())
            generator.bit_generator.state = self.node(parts[1])
            return generator
        kinds: dict[str, Any] = {"tuple": tuple, "frozenset": frozenset}
        values = [self.node(part) for part in parts]
        return (
            kinds[kind](values)
            if kind in kinds
            else {"slice": slice, "complex": complex}[kind](*values)
        )

    def _array(
        self, dtype: Any, shape: list[int], order: Literal["C", "F"], start: int, writeable: bool
    ) -> np.ndarray[Any, Any]:
        if min(start, *shape, 0) < 0:
            raise ValueError("the place of an array is negative")
        kind = np.dtype(
            [(name, of, *map(tuple, rest)) for name, of, *rest in dtype]
            if type(dtype) is list
            else dtype
        )
        if kind.hasobject:  # NumPy would take bytes for addresses
            raise ValueError("an array of objects does not belong into a checkpoint")
        made: np.ndarray[Any, Any] = np.ndarray(shape, kind, self._blobs, start, order=order).copy(
            order="K"
        )
        made.flags.writeable = writeable
        return made


@cache
def _own_class(name: str) -> type:
    """Return a class of this package by `module:qualified name`, without a call of anything but
    its module's import.
    """
    module, _, path = name.partition(":")
    parents = module.split(".")
    if parents[0] != _PACKAGE or parents[-1] == "__main__":
        raise ValueError(f"{name} does not belong into a checkpoint")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = vars(found)[part]
    if not isinstance(found, type) or (found.__module__, found.__qualname__) != (module, path):
        raise ValueError(f"{name} is no class of its module")
    return found
