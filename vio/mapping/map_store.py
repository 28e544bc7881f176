"""The map's file: SQLite, version 5, described in docs/maps.md; older ones are read, and become 5 when written to.

What belongs together is written in one transaction, so that a process that dies leaves the state before it. A file is
checked when it is opened: it has our tables and nothing else, SQLite finds its pages whole, each row agrees with its
checksum (from version 3 on), and its values fit together.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import sqlite3
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from vio.calibration.stereo_field import TERMS, DisplacementField
from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.mapping.features import DESCRIPTOR_BYTES, KeyframeFeatures
from vio.mapping.place_index import SEGMENT, Segment
from vio.records import IntArray

VERSION = 5
_OLDEST = 1
_SINCE = {
    "projection": 2,
    "kind": 2,
    "crc32": 3,
    "field": 4,
    "field_covariance": 4,
    "places": 5,
    "earth": 5,
}  # version that brought a column or a table; before 2 all were pinhole stereo pairs
_BEFORE = {"projection": "'pinhole'", "kind": "'stereo'", "crc32": "0"}  # what rows of older versions get; else NULL
_KEYS = {
    "sessions": "id",
    "keyframes": "id",
    "features": "keyframe",
    "odometry": "second",
    "loops": "id",
    "places": "id",
    "earth": "id",
}
_TELLING_FEATURES = 20
_ROTATION_TOLERANCE = 1e-3  # of R R^T
_MOST_S = 300.0  # of one step with the file
_STEP = 10_000  # instructions of SQLite between two looks at the clock, and at signals
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


@dataclass(frozen=True, slots=True)
class SessionRow:
    """One recording in a map."""

    source: str
    camera: StereoCamera
    upright: bool  # whether z of its odometry frame is up
    part: int  # sessions that loops have joined share the number
    field: DisplacementField | None = None  # what its stereo calibration is off by; None: not estimated


@dataclass(frozen=True, slots=True)
class KeyframeRow:
    """One keyframe, without its features."""

    session: int
    frame: int
    time_ns: int
    T_map_cam: FloatArray  # (4, 4) in the frame of its part of the map
    T_odom_cam: FloatArray  # (4, 4) by the filter
    drift: FloatArray  # (6, 6) covariance that the odometry has gathered since the session began, see `MapBuilder`
    path_m: float  # since the session began
    up_cam: FloatArray | None  # (3,) direction of the vertical; None without an IMU
    up_sigma_rad: float


@dataclass(frozen=True, slots=True)
class PlacesRow:
    """What finds `SEGMENT` keyframes that follow one another again, made of their features."""

    words: Segment
    points: FloatArray  # (SEGMENT, P, 3) see `Overlaps`
    stereo: IntArray  # (SEGMENT,) stereo points


@dataclass(frozen=True, slots=True)
class EarthRow:
    """Where a map is on the earth, as GNSS said when it was last asked."""

    origin: tuple[float, float, float]  # WGS84: latitude and longitude in degrees, height in metres
    T_enu_map: FloatArray  # (4, 4) to east, north, up at the origin, of the first session's part
    covariance: FloatArray  # (6, 6) of xi in T_enu_map exp(xi)


@dataclass(frozen=True, slots=True)
class LoopRow:
    """A place seen again."""

    first: int  # keyframe
    second: int  # later keyframe
    pose: RelativePose  # of the second camera in the first
    inliers: int
    kept: bool  # False: it contradicts the others


def is_map(path: Path) -> bool:
    """Whether a file is a map of any version: by its header."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        header = file.read(72)
    return header.startswith(b"SQLite format 3\0") and header[68:] == APPLICATION_ID.to_bytes(4, "big")


def check_path(path: Path) -> None:
    """Raise DataError where a map's file can neither be nor be made."""
    if path.is_dir() or not path.absolute().parent.is_dir():
        fault = "is a folder" if path.is_dir() else f"its folder {path.parent} does not exist"
        raise DataError(f"{path}: {fault}; name a file in a folder that exists")


@contextlib.contextmanager
def _errors_of(path: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.OperationalError as error:
        if "interrupted" in str(error):  # by a signal's handler, whose exception SQLite takes for a wish to stop
            raise KeyboardInterrupt from error
        remedy = "wait for the run that uses it" if "locked" in str(error) else "check the path and the free space"
        raise DataError(f"{path}: the map cannot be used ({error}); {remedy}") from error
    except sqlite3.DatabaseError as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, fault: object) -> DataError:
    line = " ".join(str(fault).split())
    return DataError(f"{path}: is damaged or no map ({line}); restore a copy or build it again")


class MapStore:
    """A map's file, open."""

    def __init__(
        self, path: Path, *, create: bool = False, read_only: bool = False, known_as: Path | None = None
    ) -> None:
        """Open a map.

        Args:
            path: the file.
            create: make it where it does not exist.
            read_only: change nothing.
            known_as: what messages call it; None: its path.

        Raises:
            DataError: there is no such map, it is damaged, of another version, or in use by another process.
        """
        self.path = path if known_as is None else known_as
        self._end_s = math.inf
        check_path(path)
        if not create and not path.is_file():
            raise DataError(f"{path}: there is no such map; vio run --map {path} makes one")
        with contextlib.ExitStack() as undo, self._errors():
            if read_only:
                uri = f"{path.absolute().as_uri()}?mode=ro"
                self._db = sqlite3.connect(uri, uri=True, check_same_thread=False, timeout=1.0)
            else:
                self._db = sqlite3.connect(path, check_same_thread=False, timeout=1.0)
            undo.callback(self._db.close)
            self._db.isolation_level = None
            self._db.create_function("row_crc32", -1, _row_crc32, deterministic=True)
            self._db.set_progress_handler(self._is_late, _STEP)
            empty = not self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
            if empty and create:
                self._db.executescript(
                    f"BEGIN; PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {VERSION}; "
                    f"{_SCHEMA} COMMIT;"
                )
            elif self._pragma("application_id") != APPLICATION_ID:
                raise DataError(f"{path}: is no map of this program; give a file that vio run --map wrote")
            elif not _OLDEST <= self._pragma("user_version") <= VERSION:
                raise DataError(
                    f"{path}: is a map of version {self._pragma('user_version')}, this program reads {VERSION}; use "
                    "the program that wrote it, or build the map again"
                )
            self._db.execute("BEGIN")  # one state of the file, whatever another process commits
            self._checked: dict[str, list[Any]] = {}  # rows that were read to check them, until they are asked for
            before = self._pragma("data_version")
            self._check()
            if not read_only:
                self._db.execute("COMMIT")
                # Readers see the last commit while this process writes; its transaction never ends, so no other writes.
                self._db.execute("PRAGMA journal_mode = WAL")
                self._db.execute("BEGIN IMMEDIATE")
                if self._pragma("data_version") != before:  # another process wrote meanwhile
                    self._check()
                self._bring_up_to_date()
            undo.pop_all()

    def _check(self) -> None:
        """Raise DataError unless the file holds our tables, whole, with values that fit together."""
        if (found := _schema_of(self._db)) != _expected(self.version):
            other = sorted({name for _, name, *_ in found ^ _expected(self.version)})
            raise _damaged(self.path, f"{', '.join(other)} is not as this program makes it")
        ((answer,),) = self._db.execute("PRAGMA quick_check(1)")
        if answer != "ok":
            raise _damaged(self.path, answer)
        self._checked.clear()
        sessions, rows, odometry, loops = self.sessions(), self.keyframes(), self.odometry(), self.loops()
        self._checked = {"sessions": sessions, "keyframes": rows, "odometry": odometry, "loops": loops}
        keyframes = len(rows)
        if any(not 0 <= k.session < len(sessions) for k in rows):
            raise _damaged(self.path, "a keyframe belongs to no session")
        pairs = [(i, j) for i, j, _ in odometry] + [(o.first, o.second) for o in loops]
        if any(not 0 <= i < j < keyframes for i, j in pairs):
            raise _damaged(self.path, "a motion is between keyframes that are not there")
        if [k for (k,) in self._db.execute("SELECT keyframe FROM features ORDER BY keyframe")] != list(
            range(keyframes)
        ):
            raise _damaged(self.path, "a keyframe has no features")

    def _bring_up_to_date(self) -> None:
        """Add what older versions had not."""
        if self.version == VERSION:
            return
        for table, statement in zip(_KEYS, _SCHEMA.strip().split(";\n"), strict=True):
            if self.version < _SINCE.get(table, _OLDEST):
                self._db.execute(statement)
                continue
            before = set(self._columns(table))
            if before == {column for _, name, _, column, *_ in _expected(VERSION) if name == table}:
                continue
            self._db.execute(f"ALTER TABLE {table} RENAME TO older")
            self._db.execute(statement)
            values = ", ".join(c if c in before else _BEFORE.get(c, "NULL") for c in self._columns(table))
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
        self._end_s = time.monotonic() + _MOST_S
        with _errors_of(self.path):
            try:
                yield
            except sqlite3.OperationalError as error:
                if not self._is_late():
                    raise
                raise DataError(f"{self.path}: a step took more than {_MOST_S:.0f} s; build the map again") from error

    def _is_late(self) -> bool:
        return time.monotonic() > self._end_s

    # Writing

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
                with contextlib.suppress(sqlite3.OperationalError):  # it stays so while another process reads
                    self._db.execute("PRAGMA journal_mode = DELETE")
            self._db.close()

    def images(self) -> set[bytes]:
        """Return a hash of the descriptors of each keyframe that is distinctive enough."""
        with self._errors():
            least = _TELLING_FEATURES * DESCRIPTOR_BYTES
            rows = self._db.execute("SELECT descriptors FROM features WHERE length(descriptors) >= ?", (least,))
            return {hashlib.blake2b(bits, digest_size=16).digest() for (bits,) in rows}

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

    def add_session(self, row: SessionRow) -> int:
        """Add a session and return its number."""
        c = row.camera
        values = (row.source, row.part, row.upright, c.fu, c.fv, c.cu, c.cv, c.baseline_m, c.width, c.height)
        number = self._count("sessions")
        self._insert("sessions", (number, *values, c.projection, c.kind, *_field_blobs(row.field)))
        return number

    def add_keyframe(self, row: KeyframeRow, features: KeyframeFeatures) -> int:
        """Add a keyframe and return its number."""
        number = self._count("keyframes")
        up = None if row.up_cam is None else _blob(row.up_cam)
        poses = _blob(row.T_map_cam), _blob(row.T_odom_cam), _blob(row.drift)
        self._insert(
            "keyframes", (number, row.session, row.frame, row.time_ns, *poses, row.path_m, up, row.up_sigma_rad)
        )
        bits = np.packbits(features.has_right).tobytes()
        sizes = features.z.astype("<f4").tobytes(), bits, features.sigma_px.astype("<f4").tobytes()
        self._insert("features", (number, *sizes, features.descriptors.tobytes()))
        return number

    def add_odometry(self, first: int, second: int, pose: RelativePose) -> None:
        """Add the motion between two keyframes that follow one another."""
        self._insert("odometry", (second, first, _blob(pose.T_i_j), _blob(pose.covariance)))

    def add_loop(self, row: LoopRow) -> None:
        """Add a loop."""
        motion = _blob(row.pose.T_i_j), _blob(row.pose.covariance)
        self._insert("loops", (self._count("loops"), row.first, row.second, *motion, row.inliers, row.kept))

    def add_places(self, row: PlacesRow) -> None:
        """Add what finds the keyframes of the next segment again."""
        words = row.words.begins.astype("<u4").tobytes(), row.words.owners.tobytes()
        self._insert("places", (self._count("places"), *words, _blob(row.points), row.stereo.astype("<i8").tobytes()))

    def set_earth(self, row: EarthRow) -> None:
        """Say where the map is on the earth."""
        with self._changes():
            self._db.execute("DELETE FROM earth")
        self._insert("earth", (0, *row.origin, _blob(row.T_enu_map), _blob(row.covariance)))

    def set_poses(self, T_map_cam: Mapping[int, FloatArray]) -> None:
        """Replace poses (4, 4) of keyframes."""
        self._set("keyframes", ("T_map_cam",), {k: (_blob(T),) for k, T in T_map_cam.items()})

    def set_kept(self, kept: Mapping[int, bool]) -> None:
        """Say of loops whether they agree with the others."""
        self._set("loops", ("kept",), {n: (value,) for n, value in kept.items()})

    def set_parts(self, parts: list[int]) -> None:
        """Replace the part of each session."""
        self._set("sessions", ("part",), {n: (part,) for n, part in enumerate(parts)})

    def set_loops(self, rows: Mapping[int, LoopRow]) -> None:
        """Replace what is measured of loops, by their numbers."""
        values = {n: (_blob(o.pose.T_i_j), _blob(o.pose.covariance), o.inliers) for n, o in rows.items()}
        self._set("loops", ("T_i_j", "covariance", "inliers"), values)

    def set_field(self, session: int, field: DisplacementField | None) -> None:
        """Replace what a session found its stereo calibration to be off by."""
        with self._changes():
            update = "UPDATE sessions SET field = ?, field_covariance = ? WHERE id = ?"
            self._db.execute(update, (*_field_blobs(field), session))
            self._sign("sessions", f"WHERE id = {int(session)}")

    def truncate(self, sessions: int, keyframes: int, loops: int) -> None:
        """Forget what was added after there were so many."""
        with self._changes():
            for table, key in _KEYS.items():
                count = {"sessions": sessions, "loops": loops, "places": keyframes // SEGMENT, "earth": 1}.get(
                    table, keyframes
                )
                self._db.execute(f"DELETE FROM {table} WHERE {key} >= ?", (count,))

    def _insert(self, table: str, values: tuple[Any, ...]) -> None:
        with self._changes():
            self._db.execute(f"INSERT INTO {table} VALUES ({'?,' * len(values)}0)", values)
            self._sign(table, f"WHERE {_KEYS[table]} = {int(values[0])}")

    def _set(self, table: str, columns: tuple[str, ...], values: Mapping[int, tuple[Any, ...]]) -> None:
        """Replace values of the rows of some numbers."""
        with self._changes():
            assigned = ", ".join(f"{column} = ?" for column in columns)
            rows = ((*row, n) for n, row in values.items())
            self._db.executemany(f"UPDATE {table} SET {assigned} WHERE id = ?", rows)
            signed = ", ".join(self._columns(table)[:-1])
            update = f"UPDATE {table} SET crc32 = row_crc32({signed}) WHERE id = ?"
            self._db.executemany(update, ((n,) for n in values))

    def _sign(self, table: str, which: str = "") -> None:
        """Write the checksums of rows, of their values as they are stored."""
        self._db.execute(f"UPDATE {table} SET crc32 = row_crc32({', '.join(self._columns(table)[:-1])}) {which}")

    def _columns(self, table: str) -> list[str]:
        return [name for (name,) in self._db.execute("SELECT name FROM pragma_table_info(?)", (table,))]

    def _count(self, table: str) -> int:
        """Number of rows of a table that are numbered from 0 on, without reading them."""
        with self._errors():
            return int(self._db.execute(f"SELECT coalesce(max({_KEYS[table]}), -1) FROM {table}").fetchone()[0]) + 1

    # Reading

    def sessions(self) -> list[SessionRow]:
        """Return all sessions."""

        def made(_: int, source: str, part: int, upright: int, *camera: Any) -> SessionRow:
            lengths: list[Any] = [_number(value) for value in camera[:5]]
            size, names, field = camera[5:7], [source, *camera[7:9]], camera[9:]
            if not all(isinstance(value, (int, type(None))) for value in size) or min(lengths[:2]) <= 0:
                raise ValueError("its camera is none")
            if not all(isinstance(value, str) for value in names):
                raise ValueError("a name is no text")
            pair = StereoCamera(*lengths, *camera[5:9])
            return SessionRow(source, pair, bool(upright), _integer(part), _field_of(pair, *field))

        return self._read("sessions", made)

    def keyframes(self) -> list[KeyframeRow]:
        """Return all keyframes."""

        def made(
            _: int, session: int, frame: int, time_ns: int, T_map: FloatArray, T_odom: FloatArray, drift: FloatArray,
            path_m: float, up: bytes | None, sigma: float | None,
        ) -> KeyframeRow:  # fmt: skip
            numbers = _integer(session), _integer(frame), _integer(time_ns)
            vertical = None if up is None else _array(up, 3), 0.0 if sigma is None else _number(sigma)
            return KeyframeRow(*numbers, T_map, T_odom, drift, _number(path_m), *vertical)

        return self._read("keyframes", made)

    def odometry(self) -> list[tuple[int, int, RelativePose]]:
        """Return all motions between keyframes, (first, second, motion)."""

        def made(second: int, first: int, T: FloatArray, covariance: FloatArray) -> tuple[int, int, RelativePose]:
            return _integer(first), second, RelativePose(T, covariance)

        return self._read("odometry", made)

    def loops(self) -> list[LoopRow]:
        """Return all loops."""

        def made(
            _: int, first: int, second: int, T: FloatArray, covariance: FloatArray, inliers: int, kept: int
        ) -> LoopRow:
            return LoopRow(
                _integer(first), _integer(second), RelativePose(T, covariance), _integer(inliers), bool(kept)
            )

        return self._read("loops", made)

    def earth(self) -> EarthRow | None:
        """Return where the map is on the earth; None: nothing said so."""

        def made(_: int, latitude: float, longitude: float, height: float, T: FloatArray, C: FloatArray) -> EarthRow:
            return EarthRow((_number(latitude), _number(longitude), _number(height)), T, C)

        rows = self._read("earth", made) if self.version >= _SINCE["earth"] else []
        return rows[0] if rows else None

    def places(self) -> list[PlacesRow]:
        """Return what finds keyframes again, of the first full segments; files before version 5 have none."""

        def made(_: int, begins: bytes, owners: bytes, points: bytes, stereo: bytes) -> PlacesRow:
            words = Segment.of(np.frombuffer(begins, dtype="<u4"), np.frombuffer(owners, dtype=np.uint8))
            p = np.frombuffer(points, dtype="<f8").reshape(SEGMENT, -1, 3)
            return PlacesRow(words, p, np.frombuffer(stereo, dtype="<i8").reshape(SEGMENT))

        return self._read("places", made) if self.version >= _SINCE["places"] else []

    def features(self, keyframe: int) -> KeyframeFeatures:
        """Return the features of one keyframe."""

        def made(_: int, z: bytes, has_right: bytes, sigma: bytes, descriptors: bytes) -> KeyframeFeatures:
            bits = np.frombuffer(descriptors, dtype=np.uint8).reshape(-1, DESCRIPTOR_BYTES)
            pixels = np.frombuffer(z, dtype="<f4").astype(np.float64).reshape(len(bits), 4)
            right = np.unpackbits(np.frombuffer(has_right, dtype=np.uint8)).astype(np.bool_)
            sigma_px = np.frombuffer(sigma, dtype="<f4").astype(np.float64)
            if len(sigma_px) != len(bits) or len(right) != 8 * ((len(bits) + 7) // 8):
                raise ValueError("its arrays are of different lengths")
            if not (np.isfinite(pixels[:, :2]).all() and np.isfinite(sigma_px).all()):
                raise ValueError("a pixel is not finite")
            return KeyframeFeatures(pixels, right[: len(bits)], sigma_px, bits.copy())

        found = self._read("features", made, f"WHERE keyframe = {int(keyframe)}")
        if not found:
            raise _damaged(self.path, f"keyframe {keyframe} has no features")
        return found[0]

    def _read(self, table: str, made: Callable[..., _Row], which: str = "") -> list[_Row]:
        """Return what is made of the rows of a table, in the order of their numbers.

        Raises:
            DataError: a row is missing, or not what was written.
        """
        key = _KEYS[table]
        if not which and (checked := self._checked.pop(table, None)) is not None:
            return checked
        with self._errors():
            rows = self._db.execute(f"SELECT * FROM {table} {which} ORDER BY {key}").fetchall()
        signed, columns = self.version >= _SINCE["crc32"], self._columns(table)
        if signed:
            columns = columns[:-1]
            for row in rows:
                if row[-1] != _row_crc32(*row[:-1]):
                    raise self._bad_row(table, row[0], "its checksum does not agree with its content")
        if key == "id" and (lost := next((n for n, row in enumerate(rows) if row[0] != n), None)) is not None:
            raise self._bad_row(table, rows[lost][0], f"row {lost} is missing")
        values: list[Any] = list(zip(*rows, strict=True)) if rows else [[] for _ in columns]
        for n, name in enumerate(columns):
            if name in _SHAPES:
                values[n], fault = _arrays(values[n], _SHAPES[name])
                if fault is not None:
                    raise self._bad_row(table, rows[fault[0]][0], fault[1])
        out = []
        for row in zip(*values[: len(columns)], strict=True):
            try:
                out.append(made(*row))
            except (ValueError, TypeError) as error:
                raise self._bad_row(table, row[0], error) from error
        return out

    def _bad_row(self, table: str, number: object, fault: object) -> DataError:
        return _damaged(self.path, f"row {number} of {table}: {fault}")


def _schema_of(database: sqlite3.Connection) -> set[tuple[Any, ...]]:
    """Return tables and columns, and what else a file has; a view or a trigger would run when rows are read."""
    found = database.execute("SELECT type, name, sql LIKE 'CREATE TABLE %' FROM sqlite_master").fetchall()
    columns = 'SELECT name, type, "notnull", pk, hidden FROM pragma_table_xinfo(?)'
    return {
        (kind, name, plain, *column)
        for kind, name, plain in found
        for column in (database.execute(columns, (name,)).fetchall() if (kind, plain) == ("table", 1) else [()])
    }


@cache
def _expected(version: int) -> frozenset[tuple[Any, ...]]:
    """Return what `_schema_of` finds in a map of a version."""
    with contextlib.closing(sqlite3.connect(":memory:")) as database:
        database.executescript(_SCHEMA)
        return frozenset(row for row in _schema_of(database) if _since(row) <= version)


def _since(row: tuple[Any, ...]) -> int:
    """Version that brought a column, as `_schema_of` gives it."""
    return max(_SINCE.get(row[1], _OLDEST), _SINCE.get(row[3], _OLDEST))


def _row_crc32(*values: Any) -> int:
    """Return the CRC-32 of a row's values as SQLite gives them."""
    crc = 0
    for value in values:
        crc = zlib.crc32(value if isinstance(value, bytes) else f"{value!r};".encode(), crc)
    return crc


def _field_blobs(field: DisplacementField | None) -> tuple[bytes | None, bytes | None]:
    if field is None:
        return None, None
    return _blob(field.coefficients), None if field.covariance is None else _blob(field.covariance)


def _field_of(
    camera: StereoCamera, coefficients: bytes | None = None, covariance: bytes | None = None
) -> DisplacementField | None:
    if coefficients is None:
        return None
    P = None if covariance is None else _array(covariance, TERMS, TERMS)
    return DisplacementField(camera, _array(coefficients, TERMS), P)


def _blob(array: FloatArray) -> bytes:
    return np.ascontiguousarray(array, dtype="<f8").tobytes()


def _array(blob: bytes, *shape: int) -> FloatArray:
    """Return the finite numbers of a blob as an array of a shape."""
    array = np.frombuffer(blob, dtype="<f8").reshape(shape).copy()
    if not np.isfinite(array).all():
        raise ValueError("a number is not finite")
    return array


def _arrays(blobs: Sequence[Any], shape: tuple[int, int]) -> tuple[FloatArray, tuple[int, str] | None]:
    """Return blobs as finite matrices (N, n, n), poses where n is 4, and the first that is none with the reason."""
    length = 8 * shape[0] * shape[1]
    wrong = next((n for n, blob in enumerate(blobs) if not isinstance(blob, bytes) or len(blob) != length), None)
    if wrong is not None:
        return np.zeros((0, *shape)), (wrong, "a matrix is of another size")
    out: FloatArray = np.frombuffer(b"".join(blobs), dtype="<f8").reshape(-1, *shape).copy()
    finite = np.isfinite(out).all(axis=(1, 2))
    if not finite.all():
        return out, (int(np.argmin(finite)), "a number is not finite")
    if shape == (4, 4) and len(out):
        R = out[:, :3, :3]
        rigid = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2)) <= _ROTATION_TOLERANCE
        rigid &= (out[:, 3] == (0, 0, 0, 1)).all(axis=1)
        if not rigid.all():
            return out, (int(np.argmin(rigid)), "a pose is none")
    return out, None


def _number(value: Any) -> float:
    if not isinstance(value, float) or not math.isfinite(value):
        raise ValueError(f"{str(value)[:20]} is no finite number")
    return value


def _integer(value: Any) -> int:
    if not isinstance(value, int):
        raise ValueError(f"{str(value)[:20]} is no integer")
    return value
