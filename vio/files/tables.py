"""Tables that grow by rows: in memory, or in an `.npy` file that is valid after each flush.

A file's header is rewritten in place when rows were flushed (NumPy leaves room for a growing first axis), so a program
that dies leaves a file with all rows of its last flush.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, Generic, TypeVar, overload

import numpy as np
import numpy.typing as npt

from vio.errors import DataError

Rows = np.ndarray  # structured (N,)
_Record = TypeVar("_Record")


class Table:
    """Structured rows, appended one or several at a time."""

    def __init__(self, dtype: np.dtype, path: Path | None = None, *, keep: int = 0) -> None:
        """Begin a table, or continue one.

        Args:
            dtype: structured type of a row.
            path: its file; None: in memory.
            keep: rows of an existing file to keep; what follows them is cut off.

        Raises:
            DataError: the file cannot be written, or has fewer rows or another type.
        """
        self.dtype, self._path = dtype, path
        self._memory: Rows = np.zeros(0, dtype=dtype)
        self._count = keep
        self._file: BinaryIO | None = None
        if path is not None:
            try:
                self._file = path.open("r+b" if keep else "w+b")
                self._start = self._begin(keep)
            except OSError as error:
                raise DataError(f"cannot write {path}: {error.strerror or error}") from error

    def _begin(self, keep: int) -> int:
        """Write a new file's header, or cut an existing file after `keep` rows; return where rows begin."""
        assert self._file is not None
        if keep:
            np.lib.format.read_magic(self._file)
            (rows,), _, dtype = np.lib.format.read_array_header_1_0(self._file)
            if dtype != self.dtype or rows < keep:
                self._file.close()
                raise DataError(f"{self._path}: has {rows} rows of another kind or fewer than {keep}; it cannot go on")
            start = self._file.tell()
            self._file.truncate(start + keep * self.dtype.itemsize)
        self._write_header()
        start = self._file.tell()
        self._file.seek(0, os.SEEK_END)
        return start

    def _write_header(self) -> None:
        assert self._file is not None
        self._file.seek(0)
        header = {"descr": np.lib.format.dtype_to_descr(self.dtype), "fortran_order": False, "shape": (self._count,)}
        np.lib.format.write_array_header_1_0(self._file, header)

    def __len__(self) -> int:
        """Number of rows."""
        return self._count

    def append(self, rows: Rows) -> None:
        """Add rows (N,) of the table's type.

        Raises:
            OSError: the disk is full.
        """
        if self._file is not None:
            self._file.write(rows.tobytes())
        else:
            if self._count + len(rows) > len(self._memory):
                grown = np.zeros(max(2 * len(self._memory), self._count + len(rows), 64), dtype=self.dtype)
                grown[: self._count] = self._memory[: self._count]
                self._memory = grown
            self._memory[self._count : self._count + len(rows)] = rows
        self._count += len(rows)

    def replace(self, index: int, row: Rows) -> None:
        """Put a row (1,) in the place of another."""
        if self._file is None:
            self._memory[index] = row[0]
            return
        self._file.seek(self._start + index * self.dtype.itemsize)
        self._file.write(row.tobytes())
        self._file.seek(0, os.SEEK_END)

    def flush(self) -> None:
        """Bring all rows to the file, and its header up to date."""
        if self._file is None:
            return
        self._file.flush()
        self._write_header()
        self._file.flush()
        self._file.seek(0, os.SEEK_END)

    def rows(self, start: int = 0, stop: int | None = None) -> Rows:
        """Return rows, those of a file mapped into memory and not to be changed."""
        if self._file is None or self._count == 0:
            return self._memory[: self._count][start:stop]
        if not self._file.closed:
            self._file.flush()
        assert self._path is not None
        whole: Rows = np.memmap(self._path, dtype=self.dtype, mode="r", offset=self._start, shape=(self._count,))
        return whole[start:stop]

    def close(self) -> None:
        """Flush, and let the file go; the rows can still be read."""
        if self._file is not None:
            self.flush()
            self._file.close()


class Records(Sequence[_Record], Generic[_Record]):
    """A table's rows as records, made when they are asked for."""

    def __init__(self, table: Table, decode: Callable[[np.void], _Record]) -> None:
        self._table, self._decode = table, decode

    def __len__(self) -> int:
        """Number of records."""
        return len(self._table)

    @overload
    def __getitem__(self, index: int) -> _Record: ...

    @overload
    def __getitem__(self, index: slice) -> list[_Record]: ...

    def __getitem__(self, index: int | slice) -> _Record | list[_Record]:
        """One record, or a list of some."""
        if isinstance(index, slice):
            return [self._decode(row) for row in self._table.rows()[index]]
        return self._decode(self._table.rows()[range(len(self))[index]])

    def __iter__(self) -> Iterator[_Record]:
        """Yield all records."""
        for row in self._table.rows():
            yield self._decode(row)

    @property
    def rows(self) -> Rows:
        """All rows (N,)."""
        return self._table.rows()

    def column(self, name: str) -> npt.NDArray[np.generic]:
        """One field of all records as an array (N, ...)."""
        return np.asarray(self._table.rows()[name])
