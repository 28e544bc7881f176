"""A map's file: SQLite, version 5, described in docs/maps.md; older ones are read, and become 5
when written to.

What belongs together is written in one transaction, so that a process that dies leaves the state
before it. A file is checked when it is opened: it has our tables and nothing else, SQLite finds its
pages whole, each row agrees with its checksum (from version 3 on), and its values fit together.
"""

from __future__ import annotations

import contextlib
import math
import sqlite3
import time
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity

VERSION = 5
_OLDEST = 1
SINCE = {
    "projection": 2,
    "kind": 2,
    "crc32": 3,
    "field": 4,
    "field_covariance": 4,
    "places": 5,
    "earth": 5,
}  # version that brought a column or a table; before 2 all were pinhole stereo pairs
# what rows of older versions get; else NULL
_BEFORE = {"projection": "'pinhole'", "kind": "'stereo'", "crc32": "0"}
KEYS = {
    "sessions": "id",
    "keyframes": "id",
    "features": "keyframe",
    "odometry": "second",
    "loops": "id",
    "places": "id",
    "earth": "id",
}
_ROTATION_TOLERANCE = 1e-3  # of R R^T


class _StepLimits(NamedTuple):
    """How long one step with the file may take."""

    max_s: Capacity[float] = 300.0  # of one step with the file
    # instructions of SQLite between two looks at the clock, and at signals
    instructions_per_look: Capacity[int] = 10_000


_LIMITS = _StepLimits()
BEGIN = b"SQLite format 3\0"  # of a map's file
APPLICATION_ID = 0x53564D50  # "SVMP" in the file's header
_SCHEMA = """
CREATE TABLE sessions (id INTEGER PRIMARY KEY, source TEXT NOT NULL, part INTEGER NOT NULL, upright INTEGER NOT NULL,
    fu REAL NOT NULL, fv REAL NOT NULL, cu REAL NOT NULL, cv REAL NOT NULL, baseline_m REAL NOT NULL,
    width INTEGER, height INTEGER, projection TEXT NOT NULL, kind TEXT NOT NULL, field BLOB, field_covariance BLOB,
    crc32 INTEGER NOT NULL);
CREATE TABLE keyframes (id INTEGER PRIMARY KEY, session INTEGER NOT NULL, frame INTEGER NOT NULL,
    time_ns INTEGER NOT NULL, T_map_cam BLOB NOT NULL, T_odom_cam BLOB NOT NULL, drift BLOB NOT NULL,
    path_m REAL NOT NULL, up_cam BLOB, up_sigma_rad REAL, crc32 INTEGER NOT NULL);
CREATE TABLE features (keyframe INTEGER PRIMARY KEY, z BLOB NOT NULL, has_right BLOB NOT NULL, sigma_px BLOB NOT NULL,
    descriptors BLOB NOT NULL, crc32 INTEGER NOT NULL);
CREATE TABLE odometry (second INTEGER PRIMARY KEY, first INTEGER NOT NULL, T_i_j BLOB NOT NULL,
    covariance BLOB NOT NULL, crc32 INTEGER NOT NULL);
CREATE TABLE loops (id INTEGER PRIMARY KEY, first INTEGER NOT NULL, second INTEGER NOT NULL, T_i_j BLOB NOT NULL,
    covariance BLOB NOT NULL, inliers INTEGER NOT NULL, kept INTEGER NOT NULL, crc32 INTEGER NOT NULL);
CREATE TABLE places (id INTEGER PRIMARY KEY, begins BLOB NOT NULL, owners BLOB NOT NULL, points BLOB NOT NULL,
    stereo BLOB NOT NULL, crc32 INTEGER NOT NULL);
CREATE TABLE earth (id INTEGER PRIMARY KEY, latitude_deg REAL NOT NULL, longitude_deg REAL NOT NULL,
    height_m REAL NOT NULL, T_enu_map BLOB NOT NULL, covariance BLOB NOT NULL, crc32 INTEGER NOT NULL);
"""
_SHAPES = {
    "T_map_cam": (4, 4),
    "T_odom_cam": (4, 4),
    "T_i_j": (4, 4),
    "T_enu_map": (4, 4),
    "drift": (6, 6),
    "covariance": (6, 6),
}


_Row = TypeVar("_Row")


def check_path(path: Path) -> None:
    """Raise DataError where a map's file can neither be nor be made."""
    if path.is_dir():
        raise DataError(f"{path}: is a folder; a map is one file, which vio run --map FILE makes")
    if not path.absolute().parent.is_dir():
        raise DataError(
            f"{path}: its folder {path.parent} does not exist; name a file in a folder that exists"
        )


@contextlib.contextmanager
def _errors_of(path: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.OperationalError as error:
        # by a signal's handler, whose exception SQLite takes for a wish to stop
        if "interrupted" in str(error):
            raise KeyboardInterrupt from error
        remedy = (
            "wait for the run that uses it"
            if "locked" in str(error)
            else "check the path and the free space"
        )
        raise DataError(f"{path}: the map cannot be used ({error}); {remedy}") from error
    except sqlite3.DatabaseError as error:
        raise damaged(path, error) from error


def damaged(path: Path, fault: object) -> DataError:
    """Return the error that says what is wrong with a map's file."""
    with contextlib.suppress(OSError), path.open("rb") as stream:
        if stream.read(len(BEGIN)) != BEGIN:
            return DataError(
                f"{path}: is no map of this program, or its beginning is damaged; give a file that "
                "vio run --map wrote"
            )
    line = " ".join(str(fault).split())
    return DataError(f"{path}: is damaged or no map ({line}); restore a copy or build it again")


class MapDatabase(ABC):
    """Tables of signed rows in a file, open."""

    def __init__(
        self,
        path: Path,
        *,
        create: bool = False,
        read_only: bool = False,
        known_as: Path | None = None,
    ) -> None:
        """Open a map.

        Args:
            path: the file.
            create: make it where it does not exist.
            read_only: change nothing.
            known_as: what messages call it; None: its path.

        Raises:
            DataError: there is no such map, it is damaged, of another version, or in use by another
                process.
        """
        self.path = path if known_as is None else known_as
        self._end_s = math.inf
        check_path(path)
        if not create and not path.is_file():
            raise DataError(f"{path}: there is no such map; vio run --map {path} makes one")
        with contextlib.ExitStack() as undo, self._errors():
            self._db = _connect(path, read_only=read_only)
            undo.callback(self._db.close)
            self._db.isolation_level = None
            self._db.create_function("row_crc32", -1, _row_crc32, deterministic=True)
            self._db.set_progress_handler(self._is_late, _LIMITS.instructions_per_look)
            self._make_or_recognise(path, create=create)
            self._db.execute("BEGIN")  # one state of the file, whatever another process commits
            # rows that were read to check them, until they are asked for
            self._checked: dict[str, list[Any]] = {}
            before = self._pragma("data_version")
            self._check()
            if not read_only:
                self._db.execute("COMMIT")
                # Readers see the last commit while this process writes; its transaction never ends,
                # so no other writes.
                self._db.execute("PRAGMA journal_mode = WAL")
                self._db.execute("BEGIN IMMEDIATE")
                if self._pragma("data_version") != before:  # another process wrote meanwhile
                    self._check()
                self._bring_up_to_date()
            undo.pop_all()

    def _check(self) -> None:
        """Raise DataError unless the file holds our tables, whole, with values that fit
        together.
        """
        if (found := _schema_of(self._db)) != _expected(self.version):
            other = sorted({name for _, name, *_ in found ^ _expected(self.version)})
            raise damaged(self.path, f"{', '.join(other)} is not as this program makes it")
        ((answer,),) = self._db.execute("PRAGMA quick_check(1)")
        if answer != "ok":
            raise damaged(self.path, answer)
        self._checked.clear()
        self._checked = self._contents()

    def _bring_up_to_date(self) -> None:
        """Add what older versions had not."""
        if self.version == VERSION:
            return
        for table, statement in zip(KEYS, _SCHEMA.strip().split(";\n"), strict=True):
            if self.version < SINCE.get(table, _OLDEST):
                self._db.execute(statement)
                continue
            before = set(self._columns(table))
            if before == {column for _, name, _, column, *_ in _expected(VERSION) if name == table}:
                continue
            self._db.execute(f"ALTER TABLE {table} RENAME TO older")
            self._db.execute(statement)
            values = ", ".join(
                c if c in before else _BEFORE.get(c, "NULL") for c in self._columns(table)
            )
            self._db.execute(f"INSERT INTO {table} SELECT {values} FROM older")
            self._db.execute("DROP TABLE older")
            self._sign(table)
        self._db.execute(f"PRAGMA user_version = {VERSION}")

    @property
    def version(self) -> int:
        """Version of the file's form."""
        return self._pragma("user_version")

    def _pragma(self, name: str) -> int:
        return int(self._db.execute(f"PRAGMA {name}").fetchone()[0])

    @contextlib.contextmanager
    def _changes(self) -> Iterator[None]:
        self._checked.clear()
        with self._errors():
            yield

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        self._end_s = time.monotonic() + _LIMITS.max_s
        with _errors_of(self.path):
            try:
                yield
            except sqlite3.OperationalError as error:
                if not self._is_late():
                    raise
                raise DataError(
                    f"{self.path}: a step took more than {_LIMITS.max_s:.0f} s; build the map again"
                ) from error

    def _is_late(self) -> bool:
        return time.monotonic() > self._end_s

    def commit(self) -> None:
        """Bring all that was added to the disk, as one step."""
        with self._errors():
            self._db.execute("COMMIT")
            self._db.execute("BEGIN IMMEDIATE")

    def close(self) -> None:
        """Commit and let the file go."""
        with self._errors():
            if self._db.in_transaction:
                self._db.execute("COMMIT")
                # it stays so while another process reads
                with contextlib.suppress(sqlite3.OperationalError):
                    self._db.execute("PRAGMA journal_mode = DELETE")
            self._db.close()

    def copy_to(self, path: Path, *, known_as: Path) -> None:
        """Write a copy of the whole map.

        Args:
            path: the copy.
            known_as: what messages call it.

        Raises:
            DataError: it cannot be written.
        """
        with _errors_of(known_as), contextlib.closing(sqlite3.connect(path)) as target:
            self._db.backup(target)

    def _insert(self, table: str, values: tuple[Any, ...]) -> None:
        with self._changes():
            self._db.execute(f"INSERT INTO {table} VALUES ({'?,' * len(values)}0)", values)
            self._sign(table, f"WHERE {KEYS[table]} = {int(values[0])}")

    def _set(
        self, table: str, columns: tuple[str, ...], values: Mapping[int, tuple[Any, ...]]
    ) -> None:
        """Replace values of the rows of some numbers."""
        with self._changes():
            assigned = ", ".join(f"{column} = ?" for column in columns)
            rows = ((*row, n) for n, row in values.items())
            self._db.executemany(f"UPDATE {table} SET {assigned} WHERE {KEYS[table]} = ?", rows)
            signed = ", ".join(self._columns(table)[:-1])
            update = f"UPDATE {table} SET crc32 = row_crc32({signed}) WHERE {KEYS[table]} = ?"
            self._db.executemany(update, ((n,) for n in values))

    def _sign(self, table: str, which: str = "") -> None:
        """Write the checksums of rows, of their values as they are stored."""
        self._db.execute(
            f"UPDATE {table} SET crc32 = row_crc32({', '.join(self._columns(table)[:-1])}) {which}"
        )

    def _columns(self, table: str) -> list[str]:
        return [
            name for (name,) in self._db.execute("SELECT name FROM pragma_table_info(?)", (table,))
        ]

    def _count(self, table: str) -> int:
        """Number of rows of a table that are numbered from 0 on, without reading them."""
        with self._errors():
            return (
                int(
                    self._db.execute(
                        f"SELECT coalesce(max({KEYS[table]}), -1) FROM {table}"
                    ).fetchone()[0]
                )
                + 1
            )

    def _read(self, table: str, made: Callable[..., _Row], which: str = "") -> list[_Row]:
        """Return what is made of the rows of a table, in the order of their numbers.

        Raises:
            DataError: a row is missing, or not what was written.
        """
        key = KEYS[table]
        if not which and (checked := self._checked.pop(table, None)) is not None:
            return checked
        with self._errors():
            rows = self._db.execute(f"SELECT * FROM {table} {which} ORDER BY {key}").fetchall()
        columns = self._columns(table)
        if self.version >= SINCE["crc32"]:
            columns = columns[:-1]
            self._check_sums(table, rows)
        if key == "id":
            self._check_numbers(table, rows)
        out = []
        for row in zip(*self._values(table, columns, rows), strict=True):
            try:
                out.append(made(*row))
            except (ValueError, TypeError) as error:
                raise self._bad_row(table, row[0], error) from error
        return out

    def _check_sums(self, table: str, rows: list[Any]) -> None:
        for row in rows:
            if row[-1] != _row_crc32(*row[:-1]):
                raise self._bad_row(table, row[0], "its checksum does not agree with its content")

    def _check_numbers(self, table: str, rows: list[Any]) -> None:
        for n, row in enumerate(rows):
            if row[0] != n:
                raise self._bad_row(table, row[0], f"row {n} is missing")

    def _values(self, table: str, columns: list[str], rows: list[Any]) -> list[Any]:
        """Return the columns of rows, with arrays where they hold some."""
        if not rows:
            return [[] for _ in columns]
        values: list[Any] = list(zip(*rows, strict=True))[: len(columns)]
        for n, name in enumerate(columns):
            if name in _SHAPES:
                values[n], fault = _arrays(values[n], _SHAPES[name])
                if fault is not None:
                    raise self._bad_row(table, rows[fault[0]][0], fault[1])
        return values

    def _make_or_recognise(self, path: Path, *, create: bool) -> None:
        """Write the tables into an empty file, if it may be made; else check that it is a map of a
        version that is read.
        """
        empty = not self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        if empty and create:
            self._db.executescript(
                f"BEGIN; PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = "
                f"{VERSION}; {_SCHEMA} COMMIT;"
            )
        elif self._pragma("application_id") != APPLICATION_ID:
            raise DataError(
                f"{path}: is no map of this program; give a file that vio run --map wrote"
            )
        elif not _OLDEST <= self._pragma("user_version") <= VERSION:
            raise DataError(
                f"{path}: is a map of version {self._pragma('user_version')}, this program "
                f"reads {VERSION}; use the program that wrote it, or build the map again"
            )

    def _bad_row(self, table: str, number: object, fault: object) -> DataError:
        return damaged(self.path, f"row {number} of {table}: {fault}")

    @abstractmethod
    def _contents(self) -> dict[str, list[Any]]:
        """Return the rows of tables, all of which must fit together, by the tables' names.

        Raises:
            DataError: they do not.
        """


def _connect(path: Path, *, read_only: bool) -> sqlite3.Connection:
    target = f"{path.absolute().as_uri()}?mode=ro" if read_only else path
    return sqlite3.connect(target, uri=read_only, check_same_thread=False, timeout=1.0)


def _schema_of(database: sqlite3.Connection) -> set[tuple[Any, ...]]:
    """Return tables and columns, and what else a file has; a view or a trigger would run when
    rows are read.
    """
    found = database.execute(
        "SELECT type, name, sql LIKE 'CREATE TABLE %' FROM sqlite_master"
    ).fetchall()
    columns = 'SELECT name, type, "notnull", pk, hidden FROM pragma_table_xinfo(?)'
    return {
        (kind, name, plain, *column)
        for kind, name, plain in found
        for column in (
            database.execute(columns, (name,)).fetchall() if (kind, plain) == ("table", 1) else [()]
        )
    }


@cache
def _expected(version: int) -> frozenset[tuple[Any, ...]]:
    """Return what `_schema_of` finds in a map of a version."""
    with contextlib.closing(sqlite3.connect(":memory:")) as database:
        database.executescript(_SCHEMA)
        return frozenset(row for row in _schema_of(database) if _since(row) <= version)


def _since(row: tuple[Any, ...]) -> int:
    """Version that brought a column, as `_schema_of` gives it."""
    return max(SINCE.get(row[1], _OLDEST), SINCE.get(row[3], _OLDEST))


def _row_crc32(*values: Any) -> int:
    """Return the CRC-32 of a row's values as SQLite gives them."""
    crc = 0
    for value in values:
        crc = zlib.crc32(value if isinstance(value, bytes) else f"{value!r};".encode(), crc)
    return crc


def _arrays(
    blobs: Sequence[Any], shape: tuple[int, int]
) -> tuple[FloatArray, tuple[int, str] | None]:
    """Return blobs as finite matrices (N, n, n), poses where n is 4, and the first that is none
    with the reason.
    """
    length = 8 * shape[0] * shape[1]
    wrong = next(
        (n for n, blob in enumerate(blobs) if not isinstance(blob, bytes) or len(blob) != length),
        None,
    )
    if wrong is not None:
        return np.zeros((0, *shape)), (wrong, "a matrix is of another size")
    out: FloatArray = np.frombuffer(b"".join(blobs), dtype="<f8").reshape(-1, *shape).copy()
    finite = np.isfinite(out).all(axis=(1, 2))
    if not finite.all():
        return out, (int(np.argmin(finite)), "a number is not finite")
    if shape == (4, 4) and len(out):
        R = out[:, :3, :3]
        off_identity = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3))
        rigid = off_identity.max(axis=(1, 2)) <= _ROTATION_TOLERANCE
        rigid &= (out[:, 3] == (0, 0, 0, 1)).all(axis=1)
        if not rigid.all():
            return out, (int(np.argmin(rigid)), "a pose is none")
    return out, None
