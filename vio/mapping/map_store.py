"""What a map holds: sessions, keyframes with their features, motions and loops between them, and
its place on earth.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vio.calibration.stereo_field import TERMS, DisplacementField
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.mapping.features import DESCRIPTOR_BYTES, KeyframeFeatures, level_centre_px
from vio.mapping.map_database import APPLICATION_ID, BEGIN, KEYS, SINCE, MapDatabase, damaged
from vio.mapping.place_index import SEGMENT, Segment
from vio.records import BoolArray, IntArray

_TELLING_FEATURES = 20


@dataclass(frozen=True, slots=True)
class SessionRow:
    """One recording in a map."""

    source: str
    camera: StereoCamera
    # whether z is up in its odometry's frame; of the first of a part, in that of the part
    upright: bool
    part: int  # sessions that loops have joined share the number
    # what its stereo calibration is off by; None: not estimated
    field: DisplacementField | None = None


@dataclass(frozen=True, slots=True)
class KeyframeRow:
    """One keyframe, without its features."""

    session: int
    frame: int
    time_ns: int
    T_map_cam: FloatArray  # (4, 4) in the frame of its part of the map
    T_odom_cam: FloatArray  # (4, 4) by the filter
    # (6, 6) covariance that the odometry has gathered since the session began, see `MapBuilder`
    drift: FloatArray
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
    return header.startswith(BEGIN) and header[68:] == APPLICATION_ID.to_bytes(4, "big")


class MapStore(MapDatabase):
    """What a map holds, in its file."""

    def _contents(self) -> dict[str, list[Any]]:
        sessions = self.sessions()
        rows = self.keyframes()
        odometry = self.odometry()
        loops = self.loops()
        keyframes = len(rows)
        if any(not 0 <= k.session < len(sessions) for k in rows):
            raise damaged(self.path, "a keyframe belongs to no session")
        pairs = [(i, j) for i, j, _ in odometry] + [(o.first, o.second) for o in loops]
        if any(not 0 <= i < j < keyframes for i, j in pairs):
            raise damaged(self.path, "a motion is between keyframes that are not there")
        if [
            k for (k,) in self._db.execute("SELECT keyframe FROM features ORDER BY keyframe")
        ] != list(range(keyframes)):
            raise damaged(self.path, "a keyframe has no features")
        return {"sessions": sessions, "keyframes": rows, "odometry": odometry, "loops": loops}

    # Writing

    def images(self) -> set[bytes]:
        """Return a hash of the descriptors of each keyframe that is distinctive enough."""
        with self._errors():
            least = _TELLING_FEATURES * DESCRIPTOR_BYTES
            rows = self._db.execute(
                "SELECT descriptors FROM features WHERE length(descriptors) >= ?", (least,)
            )
            return {hashlib.blake2b(bits, digest_size=16).digest() for (bits,) in rows}

    def add_session(self, row: SessionRow) -> int:
        """Add a session and return its number."""
        c = row.camera
        values = (
            row.source,
            row.part,
            row.upright,
            c.fu,
            c.fv,
            c.cu,
            c.cv,
            c.baseline_m,
            c.width,
            c.height,
        )
        number = self._count("sessions")
        self._insert("sessions", (number, *values, c.projection, c.kind, *_field_blobs(row.field)))
        return number

    def add_keyframe(self, row: KeyframeRow, features: KeyframeFeatures) -> int:
        """Add a keyframe and return its number."""
        number = self._count("keyframes")
        if row.up_cam is None:
            up = None
        else:
            up = _blob(row.up_cam)
        poses = _blob(row.T_map_cam), _blob(row.T_odom_cam), _blob(row.drift)
        self._insert(
            "keyframes",
            (number, row.session, row.frame, row.time_ns, *poses, row.path_m, up, row.up_sigma_rad),
        )
        bits = np.packbits(features.has_right).tobytes()
        z = features.z - level_centre_px(features.sigma_px)
        sizes = z.astype("<f4").tobytes(), bits, features.sigma_px.astype("<f4").tobytes()
        self._insert("features", (number, *sizes, features.descriptors.tobytes()))
        return number

    def add_odometry(self, first: int, second: int, pose: RelativePose) -> None:
        """Add the motion between two keyframes that follow one another."""
        self._insert("odometry", (second, first, _blob(pose.T_i_j), _blob(pose.covariance)))

    def add_loop(self, row: LoopRow) -> None:
        """Add a loop."""
        motion = _blob(row.pose.T_i_j), _blob(row.pose.covariance)
        self._insert(
            "loops", (self._count("loops"), row.first, row.second, *motion, row.inliers, row.kept)
        )

    def add_places(self, row: PlacesRow) -> None:
        """Add what finds the keyframes of the next segment again."""
        words = row.words.begins.astype("<u4").tobytes(), row.words.owners.tobytes()
        self._insert(
            "places",
            (self._count("places"), *words, _blob(row.points), row.stereo.astype("<i8").tobytes()),
        )

    def set_earth(self, row: EarthRow) -> None:
        """Say where the map is on the earth."""
        with self._changes():
            self._db.execute("DELETE FROM earth")
        self._insert("earth", (0, *row.origin, _blob(row.T_enu_map), _blob(row.covariance)))

    def set_poses(self, T_map_cam: Mapping[int, FloatArray]) -> None:
        """Replace poses (4, 4) of keyframes."""
        self._set("keyframes", ("T_map_cam",), {k: (_blob(T),) for k, T in T_map_cam.items()})

    def set_adjusted(self, T_map_cam: Mapping[int, FloatArray]) -> None:
        """Replace the poses (4, 4) of keyframes, and what motions, loops kept and verticals
        measured by what these say.

        So the poses are the optimum of the graph, too. Covariances stay, which measured more than
        the poses need.
        """

        def between(first: int, second: int, pose: RelativePose) -> RelativePose:
            return RelativePose(se3_inverse(T_map_cam[first]) @ T_map_cam[second], pose.covariance)

        def both_moved(first: int, second: int) -> bool:
            return first in T_map_cam and second in T_map_cam

        upright = {k: row.up_cam is not None for k, row in enumerate(self.keyframes())}
        ups = {k: (_blob(T[2, :3]),) for k, T in T_map_cam.items() if upright[k]}
        motions = {
            second: (_blob(between(first, second, motion).T_i_j),)
            for first, second, motion in self.odometry()
            if both_moved(first, second)
        }
        loops = {
            n: replace(o, pose=between(o.first, o.second, o.pose))
            for n, o in enumerate(self.loops())
            if o.kept and both_moved(o.first, o.second)
        }
        self.set_poses(T_map_cam)
        self._set("keyframes", ("up_cam",), ups)
        self._set("odometry", ("T_i_j",), motions)
        self.set_loops(loops)

    def set_kept(self, kept: Mapping[int, bool]) -> None:
        """Say of loops whether they agree with the others."""
        self._set("loops", ("kept",), {n: (value,) for n, value in kept.items()})

    def clear_features(self, keyframes: IntArray) -> None:
        """Leave keyframes with their poses and motions alone."""
        columns = ("z", "has_right", "sigma_px", "descriptors")
        self._set("features", columns, dict.fromkeys(keyframes.tolist(), (b"",) * len(columns)))

    def set_parts(self, parts: list[int]) -> None:
        """Replace the part of each session."""
        self._set("sessions", ("part",), {n: (part,) for n, part in enumerate(parts)})

    def set_loops(self, rows: Mapping[int, LoopRow]) -> None:
        """Replace what is measured of loops, by their numbers."""
        values = {
            n: (_blob(o.pose.T_i_j), _blob(o.pose.covariance), o.inliers) for n, o in rows.items()
        }
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
            for table, key in KEYS.items():
                count = {
                    "sessions": sessions,
                    "loops": loops,
                    "places": keyframes // SEGMENT,
                    "earth": 1,
                }.get(table, keyframes)
                self._db.execute(f"DELETE FROM {table} WHERE {key} >= ?", (count,))

    # Reading

    def sessions(self) -> list[SessionRow]:
        """Return all sessions."""

        def made(_: int, source: str, part: int, upright: int, *camera: Any) -> SessionRow:
            lengths: list[Any] = [_number(value) for value in camera[:5]]
            size = camera[5:7]
            names = [source, *camera[7:9]]
            field = camera[9:]
            if (
                not all(isinstance(value, (int, type(None))) for value in size)
                or min(lengths[:2]) <= 0
            ):
                raise ValueError("its camera is none")
            if not all(isinstance(value, str) for value in names):
                raise ValueError("a name is no text")
            pair = StereoCamera(*lengths, *camera[5:9])
            return SessionRow(source, pair, bool(upright), _integer(part), _field_of(pair, *field))

        return self._read("sessions", made)

    def keyframes(self) -> list[KeyframeRow]:
        """Return all keyframes."""

        def made(_: int, session: int, frame: int, time_ns: int, *of_pose: Any) -> KeyframeRow:
            T_map, T_odom, drift, path_m, up, sigma = of_pose
            numbers = _integer(session), _integer(frame), _integer(time_ns)
            vertical = (
                None if up is None else _array(up, 3),
                0.0 if sigma is None else _number(sigma),
            )
            return KeyframeRow(*numbers, T_map, T_odom, drift, _number(path_m), *vertical)

        return self._read("keyframes", made)

    def odometry(self) -> list[tuple[int, int, RelativePose]]:
        """Return all motions between keyframes, (first, second, motion)."""

        def made(
            second: int, first: int, T: FloatArray, covariance: FloatArray
        ) -> tuple[int, int, RelativePose]:
            return _integer(first), second, RelativePose(T, covariance)

        return self._read("odometry", made)

    def loops(self) -> list[LoopRow]:
        """Return all loops."""

        def made(
            _: int,
            first: int,
            second: int,
            T: FloatArray,
            covariance: FloatArray,
            inliers: int,
            kept: int,
        ) -> LoopRow:
            return LoopRow(
                _integer(first),
                _integer(second),
                RelativePose(T, covariance),
                _integer(inliers),
                bool(kept),
            )

        return self._read("loops", made)

    def earth(self) -> EarthRow | None:
        """Return where the map is on the earth; None: nothing said so."""

        def made(
            _: int, latitude: float, longitude: float, height: float, T: FloatArray, C: FloatArray
        ) -> EarthRow:
            return EarthRow((_number(latitude), _number(longitude), _number(height)), T, C)

        rows = []
        if self.version >= SINCE["earth"]:
            rows = self._read("earth", made)
        return rows[0] if rows else None

    def places(self) -> list[PlacesRow]:
        """Return what finds keyframes again, of the first full segments; files before version 5
        have none.
        """

        def made(_: int, begins: bytes, owners: bytes, points: bytes, stereo: bytes) -> PlacesRow:
            words = Segment.of(
                np.frombuffer(begins, dtype="<u4"), np.frombuffer(owners, dtype=np.uint8)
            )
            p = np.frombuffer(points, dtype="<f8").reshape(SEGMENT, -1, 3)
            return PlacesRow(words, p, np.frombuffer(stereo, dtype="<i8").reshape(SEGMENT))

        if self.version >= SINCE["places"]:
            return self._read("places", made)
        return []

    def show_something(self) -> BoolArray:
        """Mask (K,) of the keyframes that have features."""
        with self._errors():
            rows = self._db.execute(
                "SELECT length(z) > 0 FROM features ORDER BY keyframe"
            ).fetchall()
        return np.array(rows, dtype=np.bool_).reshape(-1)

    def features(self, keyframe: int) -> KeyframeFeatures:
        """Return the features of one keyframe."""

        def made(
            _: int, z: bytes, has_right: bytes, sigma: bytes, descriptors: bytes
        ) -> KeyframeFeatures:
            bits = np.frombuffer(descriptors, dtype=np.uint8).reshape(-1, DESCRIPTOR_BYTES)
            pixels = np.frombuffer(z, dtype="<f4").astype(np.float64).reshape(len(bits), 4)
            right = np.unpackbits(np.frombuffer(has_right, dtype=np.uint8)).astype(np.bool_)
            sigma_px = np.frombuffer(sigma, dtype="<f4").astype(np.float64)
            if len(sigma_px) != len(bits) or len(right) != 8 * ((len(bits) + 7) // 8):
                raise ValueError("its arrays are of different lengths")
            if not (np.isfinite(pixels[:, :2]).all() and np.isfinite(sigma_px).all()):
                raise ValueError("a pixel is not finite")
            pixels += level_centre_px(sigma_px)
            return KeyframeFeatures(pixels, right[: len(bits)], sigma_px, bits.copy())

        found = self._read("features", made, f"WHERE keyframe = {int(keyframe)}")
        if not found:
            raise damaged(self.path, f"keyframe {keyframe} has no features")
        return found[0]


def _field_blobs(field: DisplacementField | None) -> tuple[bytes | None, bytes | None]:
    if field is None:
        return None, None
    return _blob(field.coefficients), None if field.covariance is None else _blob(field.covariance)


def _field_of(
    camera: StereoCamera, coefficients: bytes | None = None, covariance: bytes | None = None
) -> DisplacementField | None:
    if coefficients is None:
        return None
    if covariance is None:
        P = None
    else:
        P = _array(covariance, TERMS, TERMS)
    return DisplacementField(camera, _array(coefficients, TERMS), P)


def _blob(array: FloatArray) -> bytes:
    return np.ascontiguousarray(array, dtype="<f8").tobytes()


def _array(blob: bytes, *shape: int) -> FloatArray:
    """Return the finite numbers of a blob as an array of a shape."""
    array = np.frombuffer(blob, dtype="<f8").reshape(shape).copy()
    if not np.isfinite(array).all():
        raise ValueError("a number is not finite")
    return array


def _number(value: Any) -> float:
    if not isinstance(value, float) or not math.isfinite(value):
        raise ValueError(f"{str(value)[:20]} is no finite number")
    return value


def _integer(value: Any) -> int:
    if not isinstance(value, int):
        raise ValueError(f"{str(value)[:20]} is no integer")
    return value
