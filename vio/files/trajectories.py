"""Trajectory files: TUM, KITTI and EuRoC ground truth.

Times never pass through a float: they are integer nanoseconds here and decimal text in the files.
"""

from __future__ import annotations

import logging
import os
import re
from array import array
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple, NoReturn, TypeAlias, get_args

import numpy as np

from vio.dataclass import dataclass
from vio.errors import DataError
from vio.files.atomic import atomic_write_text
from vio.files.dates import are_whole_dates, dates_in_names, undated
from vio.files.messages import joined_stamps
from vio.files.pose_columns import PoseColumns, are_geographic, named_columns, pose_columns
from vio.files.pose_matrices import joined_matrices, matrices_of_files
from vio.files.stamps import POSE_PACE, parse_stamps
from vio.files.text import exact_text, lines_of, seconds_text, whole_ns_stamps
from vio.files.units import header_cells, split_cells, with_decimal_points
from vio.geometry.lie import (
    FloatArray,
    nearest_rotation,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
    se3_from_parts,
    se3_inverse,
)
from vio.numerics.kinds import Capacity, Tolerance
from vio.numerics.robust import median
from vio.records import BodyFrame, BoolArray, IntArray, Orientations, Trajectory

logger = logging.getLogger(__name__)

TrajectoryFormat: TypeAlias = Literal["tum", "kitti", "euroc"]

# deviation of a quaternion's norm or of R^T R from one accepted as rounding
ROTATION_TOLERANCE = 1e-3
_MIN_COLUMNS = 4  # a stamp and a position
_POSE_COLUMNS = 8
_KITTI_COLUMNS = 12
_WHOLE_COLUMNS = 16  # of KITTI's form with the last row of each pose, 0 0 0 1
# of KITTI-360's poses of the IMU, and of cam0: with the number of the frame, or a time, in front
_LED_COLUMNS: dict[int, BodyFrame] = {_KITTI_COLUMNS + 1: "imu", _WHOLE_COLUMNS + 1: "cam0"}
_MATRIX_COLUMNS = (_KITTI_COLUMNS, _WHOLE_COLUMNS, *_LED_COLUMNS)
_GRAPH = re.compile(r"(?:VERTEX|EDGE|PARAMS)[_A-Z0-9]*(?::\w+)? ")
_WHOLE = re.compile(r"[+-]?\d+")
_IMAGE = re.compile(r"\"?([^\s,;\"]*)\.(?:png|jpe?g|tiff?|bmp|pgm|ppm|webp)\"?", re.IGNORECASE)
_NUMBER_OF_A_FRAME = re.compile(
    r"#?\s*(?:frames?|images?|index|idx|num(?:ber)?|(?:frame|image)[ _]?(?:id|index|idx|no|num(?:ber)?))"
)


class _PoseRules(NamedTuple):
    """What a pose of a file may be."""

    max_coordinate_m: float = 1e12  # of a coordinate, in metres: beyond, squares overflow
    max_frame_number: int = 10_000_000  # whole numbers beyond are times
    largest: Tolerance[float] = 1.001  # an element of a rotation
    rounded_norm: float = 0.02  # from one, of quaternions with two decimals
    even_step: float = 0.2  # between times, from the usual one …
    even_steps: float = 0.8  # … of this share of the rows
    exact_deviation: Tolerance[float] = 1e-12  # rotations this close to orthonormal keep their bits


_POSES = _PoseRules()
_COLUMNS: dict[TrajectoryFormat, str] = {
    "tum": "8 columns 'timestamp tx ty tz qx qy qz qw'",
    "kitti": "12 columns, the first three rows of a 4x4 pose (or 16, all four)",
    "euroc": "at least 8 comma-separated columns 'timestamp [ns], px, py, pz, qw, qx, qy, qz'",
}
_EUROC_HEADER = (
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w, q_RS_x, q_RS_y, q_RS_z\n"
)


class _CommentRules(NamedTuple):
    """How much of a comment is read and shown."""

    # bytes: the frames of a day with gaps are numbered in a comment of less
    max_line_bytes: Capacity[int] = 2**20
    max_list_characters: int = 100  # characters of frame numbers in a warning


_COMMENTS = _CommentRules()
_DEFAULT_BODY: dict[TrajectoryFormat, BodyFrame] = {"tum": "imu", "kitti": "cam0", "euroc": "imu"}


@dataclass(frozen=True, slots=True)
class _Table:
    """The lines of a text file that hold poses, with their numbers."""

    path: Path
    comments: list[str]  # without the leading '#'
    rows: list[str]
    line_numbers: list[int]  # from 1, one per row
    separator: str | None  # of the fields of the first row; None: white space
    header: str = ""  # the line of names above the data that is no comment; empty: none

    @property
    def commas(self) -> bool:
        """Whether commas or semicolons separate the fields."""
        return self.separator is not None

    def fields(self, row: int, most: int = -1) -> list[str]:
        """Return the fields of a row as text; behind the first `most`, the rest is one field."""
        return self.rows[row].split(self.separator, most)

    def column(self, column: int) -> list[str]:
        """Return the fields of one column as text."""
        last = column + 1
        return [self.fields(row, last)[column].strip() for row in range(len(self.rows))]

    def where(self, row: int) -> str:
        return f"{self.path}, line {self.line_numbers[row]}"

    def fail(self, row: int, what: str) -> NoReturn:
        raise DataError(f"{self.where(row)}: {what}")


def read_trajectory(
    path: str | os.PathLike[str],
    *,
    fmt: TrajectoryFormat | None = None,
    body: BodyFrame | None = None,
) -> Trajectory:
    """Read a trajectory; the format is detected from the content unless given.

    A KITTI file describes cam0 and has no times, as do TartanAir's (a position and a quaternion a
    row, of axes forward, right and down), and matrices over four lines or in a file each, numbered
    in its name; KITTI-360's have the number of the frame (or a time) before 12 numbers of the IMU's
    pose, or 16 of cam0's; an EuRoC file describes the IMU; a TUM file describes the frame of its
    comment `# body: imu` or `# body: cam0`, else the IMU. `body`
    overrides all of these. A header may name the columns, in any order and among others, and the
    unit of the stamps. Where it does not, a quaternion has w first between commas and last between
    white space, which `Trajectory.orientations` says; quaternions of zeros, and files with four
    columns, state positions alone. A comment `# frames: 0-41 45-99` in a TUM file (written by `write_tum`)
    numbers the poses.

    Raises:
        DataError: the file cannot be used; the message names file, line and remedy.
    """
    if fmt is not None and fmt not in get_args(TrajectoryFormat):
        raise DataError(
            f"unknown trajectory format {fmt!r}; choose one of "
            f"{', '.join(get_args(TrajectoryFormat))}"
        )
    if Path(path).is_dir():
        return _of_files(Path(path), body)
    table = _read_table(Path(path))
    if not table.rows:
        raise DataError(f"{table.path}: holds no poses; give a TUM, KITTI or EuRoC trajectory file")
    named = _named(table)
    if fmt is None and (untimed := _untimed_columns(table, named)) is not None:
        return _untimed(table, untimed, body)
    kind = fmt or _detect(table, named)
    _check_columns(table, kind, None if fmt is not None else named)
    if kind == "kitti":
        return _matrices(table, body)
    table = _without_repeats(table)
    columns = named or _unnamed(table, w_first=kind == "euroc")
    for note in columns.notes:
        logger.warning("%s: %s", table.path, note)
    table = _without_lost(table, columns)
    times_ns = _times_ns(table, columns, kind)
    poses, orientations = _quaternion_poses(table, columns, kind)
    comments = table.comments if kind == "tum" else []
    header_body = _header(comments, r"body:\s*(\S+)")
    frames = _header(comments, r"frames:\s*(.*\S)")
    numbers = None if frames is None else _parse_frames(table, frames)
    trajectory = Trajectory(
        poses, times_ns, _body(table, header_body, body) or _DEFAULT_BODY[kind], numbers
    )
    return _with_orientations(table, trajectory, orientations, columns.orientations)


def _of_files(folder: Path, body: BodyFrame | None) -> Trajectory:
    """Return the poses of a folder of files with one matrix each; the numbers in their names are
    those of frames, or times.
    """
    rows, names = matrices_of_files(folder)
    table = _Table(folder, [], rows, list(range(1, len(rows) + 1)), None)
    trajectory = Trajectory(_kitti_poses(table, 0), None, body or _DEFAULT_BODY["kitti"])
    if all(name.isdecimal() and int(name) < _POSES.max_frame_number for name in names):
        return replace(trajectory, frame_indices=np.array([int(k) for k in names], dtype=np.int64))
    return replace(trajectory, times_ns=parse_stamps(names, table.where, None, pace=POSE_PACE))


def _untimed_columns(table: _Table, named: PoseColumns | None) -> PoseColumns | None:
    """Return the columns of a position and a quaternion that have no time, by their header, or by
    the norm of the quaternions where there are seven columns; None: there is a time, or no such
    pose.
    """
    if named is not None:
        of_pose = (*named.position, *(named.quaternion or ()))
        return named if not named.names_stamp and named.stamp in of_pose else None
    count = _POSE_COLUMNS - 1
    if any(len(table.fields(row)) != count for row in range(len(table.rows))):
        return None
    columns = pose_columns([], _POSE_COLUMNS, w_first=table.commas)
    assert columns.quaternion is not None
    x, y, z, w = (column - 1 for column in columns.quaternion)
    norm = np.linalg.norm(_floats(table, (x, y, z, w), finite=False), axis=1)
    if not (np.abs(norm - 1) <= _POSES.rounded_norm).all():
        return None
    if _rises_as_a_clock(_floats(table, (0,), finite=False)[:, 0]):
        raise DataError(
            f"{table.path}: its seven columns may be a position and a quaternion, or begin with the time, by how "
            "evenly the first one rises; name them in a header, as tx ty tz qx qy qz qw"
        )
    return replace(columns, position=(0, 1, 2), quaternion=(x, y, z, w))


def _rises_as_a_clock(values: FloatArray) -> bool:
    """Return whether numbers (N,) rise from row to row, and nearly all by one step."""
    steps = np.diff(values)
    if len(steps) == 0 or not (steps > 0).all():
        return False
    usual = median(steps)
    even = np.abs(steps - usual) <= _POSES.even_step * usual
    return float(np.mean(even)) >= _POSES.even_steps


def _untimed(table: _Table, columns: PoseColumns, body: BodyFrame | None) -> Trajectory:
    """Return poses without times, one of cam0 for each frame, as TartanAir has them."""
    for note in columns.notes:
        logger.warning("%s: %s", table.path, note)
    poses, known = _quaternion_poses(table, columns, "tum")
    trajectory = Trajectory(poses, None, body or _DEFAULT_BODY["kitti"])
    if not known.all():  # those that stay keep their numbers
        trajectory = trajectory.numbered()
    return _with_orientations(table, trajectory, known, columns.orientations)


def _named(table: _Table) -> PoseColumns | None:
    """Return the columns that a header names; None: none names those of a pose.

    Raises:
        DataError: a header states what are no poses.
    """
    count = len(table.fields(0))
    if count < _MIN_COLUMNS:
        return None
    try:
        named = named_columns(table.comments, count, w_first=table.commas)
    except DataError as error:
        raise DataError(f"{table.path}: {error}") from error
    if named is None and are_geographic(table.comments):
        raise DataError(
            f"{table.path}: its header names latitude and longitude, which are no metres; give "
            "positions in metres, as a local frame of east, north and up has them"
        )
    if named is None or _are_of_matrices(table, named):
        return None
    return named


def _are_of_matrices(table: _Table, named: PoseColumns) -> bool:
    """Return whether a header that names a position names elements of matrices beside it."""
    count = len(table.fields(0))
    if count not in _MATRIX_COLUMNS or named.quaternion is not None:
        return False
    first = table.fields(0)[0]
    if count not in _LED_COLUMNS and _is_number(first) and abs(float(first)) > _POSES.largest:
        return False
    return not named.names_stamp or (count in _LED_COLUMNS and not table.commas)


def _unnamed(table: _Table, *, w_first: bool) -> PoseColumns:
    """Return the columns of a table whose header does not name them."""
    return pose_columns(table.comments, len(table.fields(0)), w_first=w_first)


def _without_repeats(table: _Table) -> _Table:
    """Return a table without rows that repeat the one above, with a warning."""
    kept = [k for k, row in enumerate(table.rows) if not k or row != table.rows[k - 1]]
    repeated = len(table.rows) - len(kept)
    if repeated:
        logger.warning("%s: %d rows repeat the one above and are left out", table.path, repeated)
    return _some_rows(table, kept)


def _without_lost(table: _Table, columns: PoseColumns) -> _Table:
    """Return a table without poses none of whose numbers is one, as where a camera system lost the
    body, with a warning; where most are such, more is wrong.
    """
    cells = (*columns.position, *(columns.quaternion or ()))
    last = max(cells) + 1
    kept = []
    for k in range(len(table.rows)):
        fields = table.fields(k, last)
        if not all(fields[cell].strip().lower() == "nan" for cell in cells):
            kept.append(k)
    lost = len(table.rows) - len(kept)
    if not 0 < lost < len(kept):
        return table
    logger.warning("%s: %d poses are not numbers and are left out", table.path, lost)
    return _some_rows(table, kept)


def _some_rows(table: _Table, kept: Sequence[int]) -> _Table:
    return replace(
        table,
        rows=[table.rows[k] for k in kept],
        line_numbers=[table.line_numbers[k] for k in kept],
    )


def _matrices(table: _Table, body: BodyFrame | None) -> Trajectory:
    """Return poses that are written as matrices, with the numbers of frames or the times that stand
    before them.
    """
    count = len(table.fields(0))
    if count not in _LED_COLUMNS:
        return Trajectory(_kitti_poses(table, 0), None, body or _DEFAULT_BODY["kitti"])
    poses = _kitti_poses(table, 1)
    stamps = table.column(0)
    trajectory = Trajectory(poses, None, body or _LED_COLUMNS[count])
    whole = all(_WHOLE.fullmatch(stamp) for stamp in stamps)
    if whole and abs(int(stamps[-1])) < _POSES.max_frame_number:
        numbers = np.array([int(stamp) for stamp in stamps], dtype=np.int64)
        back = np.flatnonzero(np.diff(numbers) <= 0)
        if len(back) or numbers[0] < 0:
            table.fail(
                int(back[0]) + 1 if len(back) else 0, "the numbers of frames do not increase"
            )
        return replace(trajectory, frame_indices=numbers)
    return replace(trajectory, times_ns=parse_stamps(stamps, table.where, None, pace=POSE_PACE))


def _with_orientations(
    table: _Table, trajectory: Trajectory, known: BoolArray, orientations: Orientations
) -> Trajectory:
    """Return the poses whose orientation is known (N,), or positions alone where none is."""
    if not known.any():
        return replace(trajectory, orientations="none")
    if not known.all():
        logger.warning(
            "%s: %d of %d poses have no orientation (a quaternion of zeros); they are left out",
            table.path,
            int((~known).sum()),
            len(known),
        )
        times_ns = trajectory.times_ns
        frames = trajectory.frame_indices
        trajectory = replace(
            trajectory,
            T_world_body=trajectory.T_world_body[known],
            times_ns=None if times_ns is None else times_ns[known],
            frame_indices=None if frames is None else frames[known],
        )
    return replace(trajectory, orientations=orientations)


def _stamp_texts(table: _Table, columns: PoseColumns) -> list[str]:
    """Return the stamps as text, with the nanoseconds that stand in a column of their own, unless
    seconds have decimals already.
    """
    stamps = table.column(columns.stamp)
    if columns.nanoseconds is None or any("." in stamp for stamp in stamps):
        return stamps
    parts = table.column(columns.nanoseconds)
    return [f"{s}.{ns.zfill(9)}" for s, ns in zip(stamps, parts, strict=True)]


def _times_ns(table: _Table, columns: PoseColumns, kind: TrajectoryFormat) -> IntArray:
    """Return the stamps (N,): in the unit that is stated, else in nanoseconds where a table of
    EuRoC's form has whole numbers, else by their size and by how far apart poses are.
    """
    stamps = _stamp_texts(table, columns)
    _check_numbers(table, columns, stamps)
    unit = columns.unit
    if unit is None and kind == "euroc" and _are_nanoseconds(stamps):
        unit = "ns"
    if unit == "ns":
        return whole_ns_stamps(stamps, table.where, signed=True)
    doubts = list[str]()
    # TUM's form has decimals of seconds
    if kind == "tum" and any("." in stamp for stamp in stamps):
        pace = None
    else:
        pace = POSE_PACE
    times_ns = parse_stamps(stamps, table.where, unit, pace=pace, doubts=doubts)
    for doubt in doubts:
        logger.warning("%s", doubt)
    return times_ns


def _check_numbers(table: _Table, columns: PoseColumns, stamps: Sequence[str]) -> None:
    """Raise DataError where a header calls the numbers of frames so that are taken for times."""
    if columns.names_stamp or not table.comments:
        return
    names = header_cells(table.comments[-1], len(table.fields(0)))
    is_number = bool(names) and _NUMBER_OF_A_FRAME.fullmatch(names[columns.stamp].strip().lower())
    if is_number and all(
        _WHOLE.fullmatch(stamp) and abs(int(stamp)) < _POSES.max_frame_number for stamp in stamps
    ):
        raise DataError(
            f"{table.path}: its column {names[columns.stamp]!r} numbers frames, and none has their times; "
            "write the time of each frame in its place"
        )


def _are_nanoseconds(stamps: Sequence[str]) -> bool:
    """Return whether stamps are whole numbers and, in nanoseconds, as far apart as poses are."""
    if not all(_WHOLE.fullmatch(stamp) for stamp in stamps):
        return False
    step_s = 1e-9 * (int(stamps[-1]) - int(stamps[0])) / max(len(stamps) - 1, 1)
    return len(stamps) < 2 or abs(step_s) >= POSE_PACE.least_s


def write_tum(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write `timestamp tx ty tz qx qy qz qw`, seconds with nine decimals, metres; body and frames
    in the comments.

    Raises:
        DataError: the trajectory has no times, or the file cannot be written.
    """
    if trajectory.times_ns is None:
        raise DataError(
            f"cannot write {path}: a TUM file needs times and this trajectory has none; write "
            "KITTI form"
        )
    text = tum_text(
        trajectory.times_ns,
        trajectory.T_world_body,
        body=trajectory.body,
        frames=trajectory.frame_indices,
    )
    atomic_write_text(path, text)


def tum_text(
    times_ns: IntArray,
    T_world_body: FloatArray,
    *,
    body: BodyFrame | None = None,
    frames: IntArray | None = None,
) -> str:
    """Return the lines of `write_tum`.

    Args:
        times_ns: (N,)
        T_world_body: (N, 4, 4)
        body: what the poses describe, for the comments; None: no comments, as lines to append.
        frames: (N,) numbers for the comments, where known.
    """
    lines = []
    if body is not None:
        lines.append(f"# body: {body}")
        if frames is not None and len(frames):
            lines.append(f"# frames: {frames_text(frames)}")
        lines.append("# timestamp tx ty tz qx qy qz qw")
    values = np.concatenate(
        [T_world_body[:, :3, 3], quat_xyzw_from_rotation(T_world_body[:, :3, :3])], axis=1
    )
    lines += [
        f"{seconds_text(t)} {exact_text(row)}"
        for t, row in zip(times_ns.tolist(), values, strict=True)
    ]
    return "".join(f"{line}\n" for line in lines)


def write_kitti(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write the first three rows of each cam0 pose as 12 numbers a line, without comments.

    Every reader of this form assumes that row k is frame k; other frame numbers are logged as a
    warning.

    Raises:
        DataError: the poses describe the IMU, or the file cannot be written.
    """
    if trajectory.body != "cam0":
        raise DataError(
            f"cannot write {path}: KITTI form describes cam0; convert with Trajectory.in_cam0 first"
        )
    frames = trajectory.frame_indices
    if frames is not None and not np.array_equal(frames, np.arange(len(trajectory))):
        text = frames_text(frames)
        if len(text) > _COMMENTS.max_list_characters:
            text = f"{frames[0]} to {frames[-1]} with gaps, {len(frames)} in all"
        logger.warning(
            "%s: its rows are the frames %s; tools that number rows from 0 will misread them",
            Path(path).name,
            text,
        )
    rows = trajectory.T_world_body[:, :3, :].reshape(-1, 12)
    atomic_write_text(path, "".join(f"{exact_text(row)}\n" for row in rows))


def write_euroc(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write `timestamp [ns], p x y z, q w x y z` of the IMU, the columns of EuRoC's ground truth up
    to the velocity.

    Raises:
        DataError: the poses describe the camera or have no times, or the file cannot be written.
    """
    if trajectory.body != "imu" or trajectory.times_ns is None:
        lacks = (
            "describes the IMU; convert with Trajectory.in_imu"
            if trajectory.body != "imu"
            else "needs times"
        )
        raise DataError(f"cannot write {path}: EuRoC form {lacks} first")
    T = trajectory.T_world_body
    q_wxyz = np.roll(quat_xyzw_from_rotation(T[:, :3, :3]), 1, axis=1)
    values = np.concatenate([T[:, :3, 3], q_wxyz], axis=1)
    rows = (
        f"{t},{exact_text(row, ',')}\n"
        for t, row in zip(trajectory.times_ns.tolist(), values, strict=True)
    )
    atomic_write_text(path, "".join([_EUROC_HEADER, *rows]))


def is_trajectory_file(path: Path) -> bool:
    """Return whether a text file begins like a trajectory: comments, then a row of 8 or 12
    numbers, or a wider csv.
    """
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        lines = iter(
            lambda: stream.readline(_COMMENTS.max_line_bytes).decode("utf-8", errors="replace"), ""
        )
        rows = (line for line in lines if line.strip() and line[0] not in "#%")
        first = undated(next((line for line in rows if not _is_header(line)), ""))
    fields = split_cells(first.rstrip().rstrip(",;"))
    try:
        [float(field) for field in fields]
    except ValueError:
        return False
    if "," in first:
        return len(fields) >= 8
    return len(fields) in (8, 12)


def in_first_cam0(trajectory: Trajectory, T_cam0_imu: FloatArray) -> Trajectory:
    """Return a trajectory in KITTI's convention: cam0 poses relative to the first one."""
    cam0 = trajectory.in_cam0(T_cam0_imu)
    return replace(cam0, T_world_body=se3_inverse(cam0.T_world_body[0]) @ cam0.T_world_body)


def _read_table(path: Path) -> _Table:
    comments: list[str] = []
    rows: list[str] = []
    line_numbers: list[int] = []
    header = ""
    for number, text in lines_of(path):
        line = text.strip()
        if line[:1] in ("#", "%"):
            comments.append(line[1:].strip())
        elif line and not rows and _is_header(line):
            comments.append(line)
            header = line
        elif line:
            rows.append(undated(line.rstrip(",;").rstrip()))
            line_numbers.append(number)
    joined = joined_matrices(rows)
    if joined is not None:
        rows, firsts = joined
        line_numbers = [line_numbers[first] for first in firsts]
    rows, named = joined_stamps(_without_suffixes(rows, path), path, stated=bool(comments))
    comments += named
    first = rows[0] if rows else ""
    cells = split_cells(first)
    if "," in first and re.search(r"[;\t]", first) and all(map(_is_number, cells)):
        rows = [";".join(split_cells(row)) for row in rows]  # decimal commas
        return _Table(path, comments, rows, line_numbers, ";", header)
    if with_decimal_points(first) is not None:
        rows = [with_decimal_points(row) or row for row in rows]
        first = rows[0]
    separator = "," if "," in first else ";" if ";" in first else None
    _check_poses(path, comments, first)
    return _Table(path, comments, rows, line_numbers, separator, header)


def _without_suffixes(rows: Sequence[str], path: Path) -> list[str]:
    """Return rows that begin with the names of images, as of photogrammetry, with their times
    instead: whole numbers beyond those of frames, decimals, or dates with fractions of a second.

    Raises:
        DataError: the names are no times.
    """
    if not rows or _IMAGE.match(rows[0]) is None:
        return list(rows)
    names = [_IMAGE.match(row) for row in rows]
    found = [name for name in names if name is not None]
    if len(found) < len(rows):
        return list(rows)
    stems = [re.split(r"[/\\]", name[1])[-1] for name in found]
    dates = dates_in_names(stems)
    if dates is not None:
        stems = [str(time) for time in dates.tolist()]
    elif are_whole_dates(stems) or not all(map(_is_time, stems)):
        raise DataError(
            f"{path}: begins its rows with names of images ({found[0][0]}), which are no times (numbers, or "
            "dates with fractions of a second); write the time of each image in its place"
        )
    return [
        f"{stem}{row[name.end() :]}" for stem, name, row in zip(stems, found, rows, strict=True)
    ]


def _is_time(stem: str) -> bool:
    """Return whether the name of an image is a time: decimals, or beyond the numbers of frames."""
    return re.fullmatch(r"\d+\.\d+", stem) is not None or (
        stem.isdecimal() and int(stem) >= _POSES.max_frame_number
    )


def _check_poses(path: Path, comments: Sequence[str], first: str) -> None:
    """Raise DataError for poses of other programs that are no table of them.

    Args:
        path: the file.
        comments: its comments and headers.
        first: its first row.
    """
    if any("IMAGE_ID" in comment and "QW" in comment for comment in comments):
        what = "is a model of COLMAP, whose poses map the world to each camera and have no times"
    elif re.match(r"[{\[]", first):
        what = "is JSON"
    elif re.match(r"Format Version,|Objects\b|Trajectories\b", "\n".join((*comments[:1], first))):
        what = "is an export of Motive or Vicon, which names its columns in several lines"
    else:
        return
    raise DataError(f"{path}: {what}; write a table of {_COLUMNS['tum']}, in metres")


def _is_header(line: str) -> bool:
    """Return whether no cell of a line is a number."""
    cells = split_cells(line)
    return len(cells) >= _MIN_COLUMNS and not any(map(_is_number, cells))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _detect(table: _Table, named: PoseColumns | None) -> TrajectoryFormat:
    """Detect the format from the first row, and from the columns that a header names."""
    n = len(table.fields(0))
    kitti = n in _MATRIX_COLUMNS
    if table.commas:
        return "kitti" if kitti and named is None and _begins_with_a_matrix(table) else "euroc"
    if _GRAPH.match(table.rows[0]):
        raise DataError(
            f"{table.path}: is a graph of poses (g2o, TORO), which have no times; write them as "
            f"TUM form, {_COLUMNS['tum']}"
        )
    if n not in (_MIN_COLUMNS, _POSE_COLUMNS) and named is None and not kitti:
        forms = "; ".join(f"{kind}: {columns}" for kind, columns in _COLUMNS.items())
        table.fail(0, f"{n} columns fit no known format ({forms}){_without_times(n)}")
    return "kitti" if kitti and named is None else "tum"


def _begins_with_a_matrix(table: _Table) -> bool:
    """Return whether the first row holds a rotation and a position, row by row, as `_kitti_poses`
    reads them.
    """
    first = int(len(table.fields(0)) in _LED_COLUMNS)
    try:
        _kitti_poses(_some_rows(table, [0]), first)
    except DataError:
        return False
    return True


def _without_times(count: int) -> str:
    """Return what a number of columns without a header may be, for a message."""
    if count != _POSE_COLUMNS - 1:
        return ""
    return (
        "; angles in place of a quaternion are not read: give the first four columns alone, and a quaternion "
        "without a time has the norm 1"
    )


def _check_columns(table: _Table, kind: TrajectoryFormat, named: PoseColumns | None) -> None:
    """Check that each row has the columns of its form, or as many as a header names."""
    count = len(table.fields(0))
    expected = {"tum": _POSE_COLUMNS, "kitti": _KITTI_COLUMNS, "euroc": max(count, _POSE_COLUMNS)}[
        kind
    ]
    if kind == "kitti" and count in _MATRIX_COLUMNS:
        expected = count
    if kind != "kitti" and (count == _MIN_COLUMNS or named is not None):
        expected = count
    for row, line in enumerate(table.rows):
        separator = table.separator
        if separator is None:
            count = len(line.split())
        else:
            count = line.count(separator) + 1
        if count != expected:
            table.fail(
                row,
                f"{count} columns instead of {expected}; {kind} form has {_COLUMNS[kind]}"
                f"{_other_names(table) or _without_times(count)}",
            )


def _other_names(table: _Table) -> str:
    """Return that a header names no pose, for a message; empty: there is none."""
    names = split_cells(table.header)
    if not names:
        return ""
    return f"; its header ({', '.join(names[:4])}, …) names no pose: give a table of poses"


def _floats(table: _Table, columns: Sequence[int], *, finite: bool = True) -> FloatArray:
    """Return columns as numbers (N, K), finite ones unless others may be among them."""
    last = max(columns) + 1
    values = array("d")
    row = 0
    try:
        for row in range(len(table.rows)):
            fields = table.fields(row, last)
            values.extend(float(fields[column]) for column in columns)
    except ValueError as error:
        table.fail(row, f"{error}; only numbers and comment lines with '#' are allowed")
    out = np.array(values).reshape(-1, len(columns))
    bad = ~(np.abs(out) < _POSES.max_coordinate_m).all(axis=1)
    if finite and bad.any():
        table.fail(
            int(np.argmax(bad)),
            f"a pose is not finite, or beyond {_POSES.max_coordinate_m:g} (first of {int(bad.sum())}); remove "
            "such lines",
        )
    return out


def _quaternion_poses(
    table: _Table, columns: PoseColumns, kind: TrajectoryFormat
) -> tuple[FloatArray, BoolArray]:
    """Return poses (N, 4, 4), and whether the orientation of each is known (N,).

    Those without one (a quaternion of zeros, or of NaN in all poses) have the identity's.
    """
    p = columns.to_metres * _floats(table, columns.position)
    if columns.quaternion is None:
        return se3_from_parts(np.eye(3), p), np.zeros(len(p), dtype=np.bool_)
    q_xyzw = _floats(table, columns.quaternion, finite=False)
    if np.isnan(q_xyzw).all():
        q_xyzw = np.zeros_like(q_xyzw)
    known = np.any(q_xyzw != 0, axis=1)
    q_xyzw[~known] = (0.0, 0.0, 0.0, 1.0)
    not_finite = ~(np.abs(q_xyzw) < _POSES.max_coordinate_m).all(axis=1)
    if not_finite.any():
        table.fail(
            int(np.argmax(not_finite)),
            f"a pose is not finite, or beyond {_POSES.max_coordinate_m:g} (first of {int(not_finite.sum())}); "
            "remove such lines",
        )
    norm = np.linalg.norm(q_xyzw, axis=1)
    off = np.abs(norm - 1)
    bad = off > _POSES.rounded_norm
    if not bad.any() and (off > ROTATION_TOLERANCE).any():
        logger.warning(
            "%s: quaternions have norms of %.4g to %.4g, as with too few digits: attitudes are off by some "
            "%.1g deg",
            table.path,
            norm.min(),
            norm.max(),
            4 * np.degrees(off.max()),
        )
    if bad.any():
        row = int(np.argmax(bad))
        table.fail(
            row,
            f"the quaternion has norm {norm[row]:.6g}, not 1; check the column order "
            f"({_COLUMNS[kind]}){'' if columns.orientations == 'stated' else _other_names(table)}",
        )
    return se3_from_parts(rotation_from_quat_xyzw(q_xyzw), p), known


def _kitti_poses(table: _Table, first: int) -> FloatArray:
    """Return the poses whose matrices begin in a column."""
    behind = first + _KITTI_COLUMNS
    if len(table.fields(0)) == first + _WHOLE_COLUMNS:
        last = _floats(table, range(behind, first + _WHOLE_COLUMNS))
        wrong = (last != [0.0, 0.0, 0.0, 1.0]).any(axis=1)
        if wrong.any():
            table.fail(
                int(np.argmax(wrong)),
                f"the last of {_WHOLE_COLUMNS} columns are not 0 0 0 1, as of a 4x4 pose row by row",
            )
    values = _floats(table, range(first, behind)).reshape(-1, 3, 4)
    R = values[:, :, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
        mirrored = np.linalg.det(R) < 0
    bad = ~(deviation <= ROTATION_TOLERANCE) | mirrored
    if bad.any():
        row = int(np.argmax(bad))
        why = (
            "mirrors"
            if deviation[row] <= ROTATION_TOLERANCE
            else f"is off orthonormal by {deviation[row]:.3g}"
        )
        table.fail(row, f"the rotation {why}; KITTI form has {_COLUMNS['kitti']}, row by row")
    orthonormal = np.where(
        (deviation <= _POSES.exact_deviation)[:, None, None], R, nearest_rotation(R)
    )
    return se3_from_parts(orthonormal, values[:, :, 3])


def _header(comments: Sequence[str], pattern: str) -> str | None:
    """Return the value of the first comment that matches the pattern."""
    found = (re.fullmatch(pattern, comment) for comment in comments)
    return next((match.group(1) for match in found if match), None)


def _body(table: _Table, header_body: str | None, requested: BodyFrame | None) -> BodyFrame | None:
    if header_body is not None and header_body not in get_args(BodyFrame):
        raise DataError(
            f"{table.path}: its comment names the body {header_body!r}; use '# body: imu' or '# "
            "body: cam0'"
        )
    if requested is not None:
        if header_body is not None and header_body != requested:
            logger.warning(
                "%s describes %s according to its comment; read as %s, as requested",
                table.path,
                header_body,
                requested,
            )
        return requested
    return "cam0" if header_body == "cam0" else "imu" if header_body == "imu" else None


def frames_text(frames: IntArray) -> str:
    """Format frame numbers as ranges: [0 1 2 5] becomes '0-2 5-5', and [0 2 4], every second
    frame, '0-4/2'.
    """
    numbers = frames.tolist()
    runs = []
    first = 0
    while first < len(numbers):
        last = min(first + 1, len(numbers) - 1)
        step = max(numbers[last] - numbers[first], 1)
        while last + 1 < len(numbers) and numbers[last + 1] - numbers[last] == step:
            last += 1
        if step > 1 and last == first + 1:  # two frames apart are no rhythm
            last = first
        runs.append(
            f"{numbers[first]}-{numbers[last]}" + (f"/{step}" if step > 1 and last > first else "")
        )
        first = last + 1
    return " ".join(runs)


def _parse_frames(table: _Table, text: str) -> IntArray:
    spans = frame_spans(text)
    if spans is None or sum(map(len, spans)) != len(table.rows):
        raise DataError(
            f"{table.path}: its comment '# frames: {text[:60]}' does not number its "
            f"{len(table.rows)} poses; "
            "remove the comment or correct it"
        )
    return np.concatenate(
        [np.arange(span.start, span.stop, span.step, dtype=np.int64) for span in spans]
    )


def frame_spans(text: str) -> list[range] | None:
    """Return the ranges that a text such as `0-41 45-99/2` names; None: they do not increase, or it
    is no such text.
    """
    spans = []
    for run in text.split():
        match = re.fullmatch(r"(\d{1,9})-(\d{1,9})(?:/([1-9]\d{0,8}))?", run)
        if match is None:
            return None
        first, last, step = match.groups(default="1")
        spans.append(range(int(first), int(last) + 1, int(step)))
    ordered = all(len(a) and len(b) and a[-1] < b[0] for a, b in pairwise(spans))
    return spans if ordered else None
