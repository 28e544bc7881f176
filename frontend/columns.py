"""Records of equally long columns, such as the features of a frame: select rows, concatenate records."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

import numpy as np

from vio.records import BoolArray, IntArray

Record = TypeVar("Record")

_names: dict[type, tuple[str, ...]] = {}  # of the columns of each kind: to find them takes as long as to index them


def take(record: Record, index: BoolArray | IntArray) -> Record:
    """Select rows of a record by a mask (N,) or indices (K,); the record itself where the mask selects all."""
    if index.dtype == np.bool_:
        if index.all():
            return record
        index = index.nonzero()[0]
    columns = _columns(record)
    return type(record)(*[c.take(index, axis=0) if isinstance(c, np.ndarray) else take(c, index) for c in columns])


def share_of(mask: BoolArray) -> float:
    """Return the share of a mask (N,), N > 0, that is set, as its mean is, in a tenth of the time."""
    return int(np.count_nonzero(mask)) / len(mask)


def joined(first: Record, second: Record) -> Record:
    """Concatenate the rows of two records."""
    pairs = zip(_columns(first), _columns(second), strict=True)
    return type(first)(*[np.concatenate([a, b]) if isinstance(a, np.ndarray) else joined(a, b) for a, b in pairs])


def _columns(record: Any) -> list[Any]:
    kind = type(record)
    if kind not in _names:
        _names[kind] = tuple(column.name for column in fields(kind))
    return [getattr(record, name) for name in _names[kind]]
