"""Tables that grow by rows: in memory, or in an `.npy` file that is valid after each flush.

A file's header is rewritten in place when rows were flushed (NumPy leaves room for a growing first
axis), so a program that dies leaves a file with all rows of its last flush.
"""

from __future__ import annotations

import io
import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tokenize import TokenError
from typing import BinaryIO, Generic, TypeVar, overload

import numpy as np
import numpy.typing as npt

from vio.errors import DataError
from vio.files.atomic import atomic_write_bytes, check_own, open_own
from vio.numerics.kinds import Capacity

_CHUNK: Capacity[int] = 10_000  # rows of which a checksum is computed at a time
Rows = np.ndarray  # structured (N,)
_Record = TypeVar("_Record")


class Table:
    """Structured rows, appended one or several at a time."""

    def __init__(
        self,
        dtype: np.dtype,
        path: Path | None = None,
        *,
        keep: int = 0,
        summed: tuple[int, int] = (0, 0),
    ) -> None:
        """Begin a table, or continue one.

        Args:
            dtype: structured type of a row.
            path: its file; None: in memory.
            keep: rows of an existing file to keep; what follows them is cut off.
            summed: of how many of these rows a checksum is known, and the checksum, see
                `check_table`.

        Raises:
            DataError: the file cannot be written, is a link, or has fewer rows or another type.
        """
        self.dtype = dtype
        self._path = path
        self._memory: Rows = np.zeros(0, dtype=dtype)
        self._count = keep
        self._summed = summed
        self._file: BinaryIO | None = None
        self._is_synced = False
        if path is not None:
            if keep:
                check_table(path, dtype, keep)
            try:
                self._file = open_own(path, "r+b" if keep else "wb")
                self._write_header()
                self._start = self._file.tell()
                self._file.truncate(self._start + keep * dtype.itemsize)
                self._file.seek(0, os.SEEK_END)
            except OSError as error:
                raise DataError(f"cannot write {path}: {error.strerror or error}") from error

    def _write_header(self) -> None:
        assert self._file is not None
        self._file.seek(0)
        header = {
            "descr": np.lib.format.dtype_to_descr(self.dtype),
            "fortran_order": False,
            "shape": (self._count,),
        }
        np.lib.format.write_array_header_1_0(self._file, header)

    def __len__(self) -> int:
        return self._count

    def append(self, rows: Rows) -> None:
        """Add rows (N,) of the table's type.

        Raises:
            OSError: the disk is full.
        """
        self._is_synced = False
        if self._file is not None:
            self._file.write(rows.tobytes())
        else:
            if self._count + len(rows) > len(self._memory):
                grown = np.zeros(
                    max(2 * len(self._memory), self._count + len(rows), 64), dtype=self.dtype
                )
                grown[: self._count] = self._memory[: self._count]
                self._memory = grown
            self._memory[self._count : self._count + len(rows)] = rows
        self._count += len(rows)

    def replace(self, index: int, row: Rows) -> None:
        """Put a row (1,) in the place of another."""
        self._is_synced = False
        if index < self._summed[0]:
            self._summed = 0, 0
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

    def sync(self) -> None:
        """Flush, and wait until the disk has all rows."""
        self.flush()
        if self._file is not None and not self._is_synced:
            os.fsync(self._file.fileno())
            self._is_synced = True

    def checksum(self, count: int) -> int:
        """Return the CRC-32 of the first `count` rows, which may not change afterwards."""
        done, crc = self._summed
        self._summed = count, _checksum(self.rows(done, count), crc)
        return self._summed[1]

    def rows(self, start: int = 0, stop: int | None = None) -> Rows:
        """Return rows, those of a file mapped into memory and not to be changed."""
        if self._file is None or self._count == 0:
            return self._memory[: self._count][start:stop]
        if not self._file.closed:
            self._file.flush()
        assert self._path is not None
        whole: Rows = np.memmap(
            self._path, dtype=self.dtype, mode="r", offset=self._start, shape=(self._count,)
        )
        return whole[start:stop]

    def close(self) -> None:
        """Flush, and let the file go; the rows can still be read."""
        if self._file is not None:
            self.flush()
            self._file.close()


def check_table(path: Path, dtype: np.dtype, keep: int, summed: tuple[int, int] = (0, 0)) -> None:
    """Check, without a change of it, that a table's file can be continued after `keep` rows.

    Args:
        path: its file.
        dtype: structured type of a row.
        keep: a number of rows.
        summed: a number of rows, and the checksum that they must have.

    Raises:
        DataError: it is missing, has fewer rows or another type, or its rows are not those of the
            checksum.
    """
    try:
        held = np.load(path, mmap_mode="r" if keep else None, allow_pickle=False)
        if held.dtype != dtype or len(held) < keep:
            raise ValueError(f"it has {len(held)} rows, of another kind or fewer than {keep}")
        if _checksum(held[: summed[0]], 0) != summed[1]:
            raise ValueError("its checksum does not agree with its content")
    except (
        OSError,
        ValueError,
        EOFError,
        TokenError,
    ) as error:  # NumPy takes a damaged header for one of Python 2
        reason = " ".join(str(error).split())
        raise DataError(f"{path}: is damaged ({reason}); repeat the run from its start") from error


class KeptRows:
    """Rows of a table's file as a checkpoint has them, kept in a file beside it where they are
    replaced: a program that dies before the next checkpoint goes on from that one.
    """

    def __init__(self, path: Path, dtype: np.dtype) -> None:
        """Begin without rows; `path` is the file's, `dtype` that of the table's rows."""
        self._path = path
        self._dtype = np.dtype(
            [
                ("checkpoint", "<u4"),
                ("index", "<i8"),
                ("row", dtype),
            ]
        )
        self._rows: dict[int, Rows] = {}

    def keep(self, table: Table, indices: Sequence[int], checkpoint: int) -> None:
        """Keep rows of a table, but those that were, before they are replaced.

        `checkpoint` tells which one has them.

        Raises:
            DataError: the file cannot be written.
        """
        new = [k for k in indices if k not in self._rows]
        if not new:
            return
        self._rows.update({k: np.array(table.rows(k, k + 1)) for k in new})
        kept = np.zeros(len(self._rows), dtype=self._dtype)
        kept["checkpoint"] = checkpoint
        kept["index"] = list(self._rows)
        kept["row"] = np.concatenate(list(self._rows.values()))
        buffer = io.BytesIO()
        np.save(buffer, kept, allow_pickle=False)
        atomic_write_bytes(self._path, buffer.getvalue())

    def forget(self) -> None:
        """Remove the file: the rows as they are now are those of a checkpoint."""
        if self._rows:
            self._rows = {}
            self._path.unlink(missing_ok=True)

    def take_back(self, path: Path, checkpoint: int) -> None:
        """Put what was kept back into a table's file, where it is of this checkpoint.

        Raises:
            DataError: a file is damaged, or a link.
        """
        if not self._path.is_file():
            return
        check_own(self._path)
        try:
            kept = np.load(self._path, allow_pickle=False)
            if kept.dtype != self._dtype:
                raise ValueError("it has rows of another kind")
            kept = kept[kept["checkpoint"] == checkpoint]
            held = np.load(path, mmap_mode="r", allow_pickle=False)
            if len(kept) and not 0 <= kept["index"].min() <= kept["index"].max() < len(held):
                raise ValueError("it has rows that the table has not")
            start = held.offset
            with open_own(path, "r+b") as stream:
                for one in kept:
                    stream.seek(start + int(one["index"]) * self._dtype["row"].itemsize)
                    stream.write(one["row"].tobytes())
        except (OSError, ValueError, EOFError, TokenError, AttributeError) as error:
            reason = " ".join(str(error).split())
            raise DataError(
                f"{self._path}: is damaged ({reason}); repeat the run from its start"
            ) from error


def _checksum(rows: Rows, crc: int) -> int:
    """Return the CRC-32 of rows that follow others with the CRC-32 `crc`."""
    for start in range(0, len(rows), _CHUNK):
        crc = zlib.crc32(rows[start : start + _CHUNK].tobytes(), crc)
    return crc


class Records(Sequence[_Record], Generic[_Record]):
    """A table's rows as records, made when they are asked for."""

    def __init__(self, table: Table, decode: Callable[[np.void], _Record]) -> None:
        self._table = table
        self._decode = decode

    def __len__(self) -> int:
        return len(self._table)

    @overload
    def __getitem__(self, index: int) -> _Record: ...

    @overload
    def __getitem__(self, index: slice) -> list[_Record]: ...

    def __getitem__(self, index: int | slice) -> _Record | list[_Record]:
        if isinstance(index, slice):
            return [self._decode(row) for row in self._table.rows()[index]]
        return self._decode(self._table.rows()[range(len(self))[index]])

    def __iter__(self) -> Iterator[_Record]:
        for row in self._table.rows():
            yield self._decode(row)

    @property
    def rows(self) -> Rows:
        """All rows (N,)."""
        return self._table.rows()

    def column(self, name: str) -> npt.NDArray[np.generic]:
        """One field of all records as an array (N, ...)."""
        return np.asarray(self._table.rows()[name])
