"""Records of equally long columns, such as the features of a frame: select rows, concatenate records."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

from vio.records import BoolArray, IntArray

Record = TypeVar("Record")


def take(record: Record, index: BoolArray | IntArray) -> Record:
    """Select rows of a record by a mask (N,) or indices (K,); the record itself where the mask selects all."""
    if index.dtype == np.bool_ and index.all():
        return record
    return type(record)(*(take(c, index) if is_dataclass(c) else c[index] for c in _columns(record)))


def joined(first: Record, second: Record) -> Record:
    """Concatenate the rows of two records."""
    pairs = zip(_columns(first), _columns(second), strict=True)
    return type(first)(*(joined(a, b) if is_dataclass(a) else np.concatenate([a, b]) for a, b in pairs))


def _columns(record: Any) -> list[Any]:
    return [getattr(record, column.name) for column in fields(record)]
