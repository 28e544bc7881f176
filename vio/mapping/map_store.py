"""The map's file: SQLite, version 2, described in docs/maps.md; version 1 is read, and becomes 2 when written to.

What belongs together is written in one transaction, so that a process that dies leaves the state before it.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.mapping.features import DESCRIPTOR_BYTES, KeyframeFeatures

VERSION = 2
_OLDEST = 1  # whose sessions name neither projection nor kind of their cameras: all were pinhole stereo pairs
APPLICATION_ID = 0x53564D50  # "SVMP" in the file's header
_SCHEMA = """
CREATE TABLE sessions (id INTEGER PRIMARY KEY, source TEXT NOT NULL, part INTEGER NOT NULL, upright INTEGER NOT NULL,
    fu REAL NOT NULL, fv REAL NOT NULL, cu REAL NOT NULL, cv REAL NOT NULL, baseline_m REAL NOT NULL,
    width INTEGER, height INTEGER, projection TEXT NOT NULL, kind TEXT NOT NULL);
CREATE TABLE keyframes (id INTEGER PRIMARY KEY, session INTEGER NOT NULL, frame INTEGER NOT NULL,
    time_ns INTEGER NOT NULL, T_map_cam BLOB NOT NULL, T_odom_cam BLOB NOT NULL, drift BLOB NOT NULL,
    path_m REAL NOT NULL, up_cam BLOB, up_sigma_rad REAL);
CREATE TABLE features (keyframe INTEGER PRIMARY KEY, z BLOB NOT NULL, has_right BLOB NOT NULL, sigma_px BLOB NOT NULL,
    descriptors BLOB NOT NULL);
CREATE TABLE odometry (second INTEGER PRIMARY KEY, first INTEGER NOT NULL, T_i_j BLOB NOT NULL,
    covariance BLOB NOT NULL);
CREATE TABLE loops (id INTEGER PRIMARY KEY, first INTEGER NOT NULL, second INTEGER NOT NULL, T_i_j BLOB NOT NULL,
    covariance BLOB NOT NULL, inliers INTEGER NOT NULL, kept INTEGER NOT NULL);
"""


@dataclass(frozen=True, slots=True)
class SessionRow:
    """One recording in a map."""

    source: str
    camera: StereoCamera
    upright: bool  # whether z of its odometry frame is up
    part: int  # sessions that loops have joined share the number


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
class LoopRow:
    """A place seen again."""

    first: int  # keyframe
    second: int  # later keyframe
    pose: RelativePose  # of the second camera in the first
    inliers: int
    kept: bool  # False: it contradicts the others


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
        remedy = "wait for the run that uses it" if "locked" in str(error) else "check the path and the free space"
        raise DataError(f"{path}: the map cannot be used ({error}); {remedy}") from error
    except sqlite3.DatabaseError as error:
        raise DataError(f"{path}: is damaged or no map ({error}); restore a copy or build it again") from error


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
        check_path(path)
        if not create and not path.is_file():
            raise DataError(f"{path}: there is no such map; vio run --map {path} makes one")
        with self._errors():
            if read_only:
                uri = f"{path.absolute().as_uri()}?mode=ro"
                self._db = sqlite3.connect(uri, uri=True, check_same_thread=False, timeout=1.0)
            else:
                self._db = sqlite3.connect(path, check_same_thread=False, timeout=1.0)
                self._db.execute("PRAGMA locking_mode = EXCLUSIVE")
            self._db.isolation_level = None
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
            if not read_only:
                self._db.execute("BEGIN IMMEDIATE")
                self._bring_up_to_date()

    def _bring_up_to_date(self) -> None:
        """Add what version 1 had not."""
        if self._pragma("user_version") == VERSION:
            return
        for column, value in (("projection", "pinhole"), ("kind", "stereo")):
            self._db.execute(f"ALTER TABLE sessions ADD COLUMN {column} TEXT NOT NULL DEFAULT '{value}'")
        self._db.execute(f"PRAGMA user_version = {VERSION}")

    @property
    def version(self) -> int:
        """Version of the file's form."""
        return self._pragma("user_version")

    def _pragma(self, name: str) -> int:
        return int(self._db.execute(f"PRAGMA {name}").fetchone()[0])

    def _errors(self) -> contextlib.AbstractContextManager[None]:
        return _errors_of(self.path)

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

    def add_session(self, row: SessionRow) -> int:
        """Add a session and return its number."""
        c = row.camera
        values = (row.source, row.part, row.upright, c.fu, c.fv, c.cu, c.cv, c.baseline_m, c.width, c.height)
        number = self._count("sessions")
        self._insert("sessions", (number, *values, c.projection, c.kind))
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

    def set_poses(self, T_map_cam: FloatArray) -> None:
        """Replace the poses (K, 4, 4) of all keyframes."""
        with self._errors():
            self._db.executemany(
                "UPDATE keyframes SET T_map_cam = ? WHERE id = ?", [(_blob(T), k) for k, T in enumerate(T_map_cam)]
            )

    def set_kept(self, kept: list[bool]) -> None:
        """Say of each loop whether it agrees with the others."""
        with self._errors():
            self._db.executemany("UPDATE loops SET kept = ? WHERE id = ?", [(k, n) for n, k in enumerate(kept)])

    def set_parts(self, parts: list[int]) -> None:
        """Replace the part of each session."""
        with self._errors():
            self._db.executemany("UPDATE sessions SET part = ? WHERE id = ?", [(p, n) for n, p in enumerate(parts)])

    def truncate(self, sessions: int, keyframes: int, loops: int) -> None:
        """Forget what was added after there were so many."""
        with self._errors():
            for table, column, count in (
                ("sessions", "id", sessions),
                ("keyframes", "id", keyframes),
                ("features", "keyframe", keyframes),
                ("odometry", "second", keyframes),
                ("loops", "id", loops),
            ):
                self._db.execute(f"DELETE FROM {table} WHERE {column} >= ?", (count,))

    def _insert(self, table: str, values: tuple[Any, ...]) -> None:
        with self._errors():
            self._db.execute(f"INSERT INTO {table} VALUES ({','.join('?' * len(values))})", values)

    def _count(self, table: str) -> int:
        with self._errors():
            return int(self._db.execute(f"SELECT count(*) FROM {table}").fetchone()[0])

    # Reading

    def sessions(self) -> list[SessionRow]:
        """Return all sessions."""
        return [
            SessionRow(source, StereoCamera(*camera), bool(upright), part)
            for _, source, part, upright, *camera in self._all("sessions")
        ]

    def keyframes(self) -> list[KeyframeRow]:
        """Return all keyframes."""
        return [
            KeyframeRow(
                session,
                frame,
                time_ns,
                _matrix(T_map, 4),
                _matrix(T_odom, 4),
                _matrix(drift, 6),
                path_m,
                None if up is None else np.frombuffer(up, dtype="<f8").copy(),
                sigma,
            )
            for _, session, frame, time_ns, T_map, T_odom, drift, path_m, up, sigma in self._all("keyframes")
        ]

    def odometry(self) -> list[tuple[int, int, RelativePose]]:
        """Return all motions between keyframes, (first, second, motion)."""
        rows = self._all("odometry", "second")
        return [(first, second, RelativePose(_matrix(T, 4), _matrix(C, 6))) for second, first, T, C in rows]

    def loops(self) -> list[LoopRow]:
        """Return all loops."""
        return [
            LoopRow(first, second, RelativePose(_matrix(T, 4), _matrix(C, 6)), inliers, bool(kept))
            for _, first, second, T, C, inliers, kept in self._all("loops")
        ]

    def features(self, keyframe: int) -> KeyframeFeatures:
        """Return the features of one keyframe."""
        with self._errors():
            row = self._db.execute("SELECT * FROM features WHERE keyframe = ?", (keyframe,)).fetchone()
        if row is None:
            raise DataError(f"{self.path}: is damaged (keyframe {keyframe} has no features); restore a copy")
        _, z, has_right, sigma, descriptors = row
        bits = np.frombuffer(descriptors, dtype=np.uint8).reshape(-1, DESCRIPTOR_BYTES)
        return KeyframeFeatures(
            np.frombuffer(z, dtype="<f4").astype(np.float64).reshape(-1, 4),
            np.unpackbits(np.frombuffer(has_right, dtype=np.uint8), count=len(bits)).astype(np.bool_),
            np.frombuffer(sigma, dtype="<f4").astype(np.float64),
            bits.copy(),
        )

    def _all(self, table: str, key: str = "id") -> list[Any]:
        with self._errors():
            return self._db.execute(f"SELECT * FROM {table} ORDER BY {key}").fetchall()


def _blob(array: FloatArray) -> bytes:
    return np.ascontiguousarray(array, dtype="<f8").tobytes()


def _matrix(blob: bytes, size: int) -> FloatArray:
    return np.frombuffer(blob, dtype="<f8").reshape(size, size).copy()
