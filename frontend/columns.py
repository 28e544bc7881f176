"""Records of equally long columns, such as the features of a frame: select rows, concatenate records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import lru_cache
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np

from vio.records import BoolArray, IntArray

Record = TypeVar("Record")


def take(record: Record, index: BoolArray | IntArray) -> Record:
    """Select rows of a record by a mask (N,) or indices (K,); the record itself where the mask selects all."""
    if index.dtype == np.bool_:
        if index.all():
            return record
        index = np.flatnonzero(index)
    columns = _getter(type(record))(record)
    return type(record)(*[c.take(index, axis=0) if isinstance(c, np.ndarray) else take(c, index) for c in columns])


def joined(first: Record, second: Record) -> Record:
    """Concatenate the rows of two records."""
    columns = _getter(type(first))
    pairs = zip(columns(first), columns(second), strict=True)
    return type(first)(*[np.concatenate([a, b]) if isinstance(a, np.ndarray) else joined(a, b) for a, b in pairs])


@lru_cache(maxsize=16)
def _getter(kind: type) -> Callable[[Any], tuple[Any, ...]]:
    """Return what gives the columns of a record of a kind; looking the fields up each time takes as long as indexing."""
    return attrgetter(*(column.name for column in fields(kind)))
