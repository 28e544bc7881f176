"""Tables of stamped samples as people write them: any separator, a header or none, stamps in s,
ms, us or ns.
"""

from __future__ import annotations

import contextlib
import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vio.datasets.common import check_gravity_column
from vio.datasets.samples import MotionSamples, velocity_samples
from vio.errors import DataError
from vio.files.text import check_increasing, lines_of, parse_stamps, text_lines, whole_ns_stamps
from vio.geometry.lie import FloatArray
from vio.records import ImuRecord, IntArray, VelocitySample

_NUMBER = re.compile(
    r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE
)
_PLAIN = re.compile(r"[0-9.eE+-]*")  # numbers in these are written as `_NUMBER` says, or are none
_IMU_FORM = "timestamp, gyro x y z [rad/s], accel x y z [m/s^2]"
VELOCITY_HEADER = "time_s,vx_mps,vy_mps,vz_mps,wx_radps,wy_radps,wz_radps"
# below, rotation between samples is no longer small; usual rates are 100 to 400 Hz
_LEAST_IMU_HZ = 50.0


@dataclass(frozen=True, slots=True)
class NumberTable:
    """The stamps of a file as text, and its other columns as numbers."""

    path: Path
    header: tuple[str, ...]  # lower case; empty: none
    stamps: tuple[str, ...]
    values: FloatArray  # (N, K); NaN: no number
    lines: Sequence[int]  # (N,) line numbers from 1

    def where(self, row: int) -> str:
        """Name the place of a row for a message."""
        return f"{self.path}, line {self.lines[row]}"


def read_table(path: Path, columns: int, form: str, cut: list[str] | None = None) -> NumberTable:
    """Read a table of stamps and numbers; see `table_rows`."""
    rows = table_rows(path, columns, form, cut)
    header = tuple(field.lower() for field in next(rows)[1])
    stamps = list[str]()
    values = array("d")
    lines = array("q")
    for number, fields in rows:
        stamps.append(fields[0])
        lines.append(number)
        values.extend(_numbers(fields[1:]))
    return NumberTable(
        path, header, tuple(stamps), np.array(values).reshape(-1, columns - 1), lines
    )


def _numbers(texts: Sequence[str]) -> list[float]:
    """Return what fields say as numbers; NaN: no number."""
    if _PLAIN.fullmatch("".join(texts)):
        with contextlib.suppress(ValueError):
            return [float(text) for text in texts]
    return [float(text) if _NUMBER.fullmatch(text) else float("nan") for text in texts]


def stamped_rows(path: Path, columns: int, form: str) -> tuple[IntArray, list[str], list[int]]:
    """Return the times (N,) of a table that are in whole nanoseconds, the last field of each line,
    and its number.

    Raises:
        DataError: as `table_rows`, or a stamp is another number, or not later than the one before.
    """
    rows = list(table_rows(path, columns, form))[1:]
    lines = [number for number, _ in rows]
    times_ns = whole_ns_stamps(
        [fields[0] for _, fields in rows], lambda k: f"{path}, line {lines[k]}"
    )
    return times_ns, [fields[-1] for _, fields in rows], lines


def table_rows(
    path: Path, columns: int, form: str, cut: list[str] | None = None
) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the fields of each line of a table, and before the first one 0 and those
    of the header.

    Commas, semicolons or white space separate. The header is the last comment or text line above;
    it may have none.

    Args:
        path: the file.
        columns: expected number of columns.
        form: their names, for messages.
        cut: where to note a last line that ends too early, which is left out then; None: it is an
            error.

    Raises:
        DataError: the file cannot be read or is empty, or a line has another number of columns.
    """
    header = list[str]()
    unread = ""
    is_data = False
    lines = lines_of(path)
    for number, line in lines:
        text = line.strip()
        fields = _split(text.lstrip("#"))
        if not text or text.startswith("#") or (not is_data and not _NUMBER.fullmatch(fields[0])):
            if header and text and not text.startswith("#"):
                unread = f"; line {number}, {text[:40]!r}, does not begin with a number (decimals need a point)"
            if not is_data and len(fields) == columns:
                header = fields
            continue
        if len(fields) != columns:
            if cut is not None and is_data and len(fields) < columns and next(lines, None) is None:
                early = f"the last line ends too early ({len(fields)} of {columns} values)"
                cut.append(f"{path}, line {number}: {early}; left out")
                return
            raise DataError(
                f"{path}, line {number}: {len(fields)} values instead of {columns} ({form})"
            )
        if not is_data:
            is_data = True
            yield 0, header
        yield number, fields
    if not is_data:
        raise DataError(
            f"{path}: holds no line of data ({form}){unread}; copy it again, or remove it"
        )


def _split(text: str) -> list[str]:
    for separator in (",", ";"):
        if separator in text:
            return [field.strip() for field in text.split(separator)]
    return text.split()


def stamps_ns(table: NumberTable) -> IntArray:
    """Return the first column as nanoseconds (N,), strictly increasing; the unit as stated, else by
    its size.

    Raises:
        DataError: a stamp is no number, or not later than the one before.
    """
    stated = (
        re.search(r"(?:\[|_|\()\s*(ns|us|ms|sec|s)\s*(?:\]|\)|$)", table.header[0])
        if table.header
        else None
    )
    return parse_stamps(table.stamps, table.where, None if stated is None else stated[1])


def read_imu_table(
    path: Path, *, cut: list[str] | None = None, whole_ns: bool = False
) -> tuple[ImuRecord, tuple[str, ...]]:
    """Read raw inertial readings; a header may name the order of its columns, and the units deg/s
    and g.

    Args:
        path: the file.
        cut: see `table_rows`.
        whole_ns: whether stamps must be in whole nanoseconds.

    Returns:
        The record, and notes about what was converted or looks wrong.

    Raises:
        DataError: a line lacks seven finite numbers, the stamps do not increase, or the order of
            columns is unclear.
    """
    table = read_table(path, 7, _IMU_FORM, cut)
    times_ns = whole_ns_stamps(table.stamps, table.where) if whole_ns else stamps_ns(table)
    values = _finite(table)
    order = _imu_order(table)
    if order is None:
        remedy = "exchange these columns with 5 to 7, or add a header such as 'timestamp [ns],ax,ay,az,wx,wy,wz'"
        check_gravity_column(values, str(path), _IMU_FORM, remedy)
        return ImuRecord(times_ns, values[:, :3], values[:, 3:]), imu_notes(times_ns, str(path))
    gyro = values[:, order[:3]]
    accel = values[:, order[3:]]
    notes: list[str] = []
    if any("deg" in table.header[1 + k] for k in order[:3]):
        gyro = np.radians(gyro)
        notes.append(f"{path}: the header states degrees; the gyro is converted to rad/s")
    if any(re.search(r"[\[(_]g[\])]?$", table.header[1 + k]) for k in order[3:]):
        accel = accel * 9.80665
        notes.append(f"{path}: the header states g; the accelerometer is converted to m/s^2")
    return ImuRecord(times_ns, gyro, accel), (*notes, *imu_notes(times_ns, str(path)))


def _imu_order(table: NumberTable) -> list[int] | None:
    """Return the columns of gyro x y z and accel x y z by the header's names.

    None: it names no axes.
    """
    found: dict[tuple[str, str], int] = {}
    for k, cell in enumerate(table.header[1:]):
        name = re.sub(r"[\[(].*", "", cell)
        name = re.sub(r"(_?(radps|rad_s|mps2|m_s2|dps|degps|deg_s|ms2|rads|g))$", "", name.strip())
        letters = re.sub(r"[^a-z]", "", name)
        kind = (
            "w"
            if re.match(r"w|g|om|ang|rot|rs?sw", letters)
            else "a"
            if letters.startswith(("a", "lin"))
            else ""
        )
        axis = next((c for c in reversed(letters) if c in "xyz"), "")
        found[(kind, axis)] = k
    wanted = [(kind, axis) for kind in "wa" for axis in "xyz"]
    if not any(kind and axis for kind, axis in found):
        return None
    if set(found) != set(wanted):
        raise DataError(
            f"{table.path}: the header {','.join(table.header)[:80]!r} does not name gyro and "
            "accel; write "
            "'timestamp [ns],wx,wy,wz,ax,ay,az', or no header for that order"
        )
    return [found[key] for key in wanted]


def imu_notes(times_ns: IntArray, where: str) -> tuple[str, ...]:
    """Return a note where an IMU is too slow to be integrated between images."""
    if len(times_ns) < 2:
        return ()
    rate_hz = 1e9 / float(np.median(np.diff(times_ns)))
    if rate_hz >= _LEAST_IMU_HZ:
        return ()
    return (
        f"{where}: the IMU has {rate_hz:.3g} Hz, too few to integrate the motion between images; "
        "record at least "
        f"{_LEAST_IMU_HZ:g} Hz, or use --motion none",
    )


def read_velocity_table(path: Path) -> MotionSamples[VelocitySample]:
    """Read body velocity and angular rate in the IMU frame.

    Raises:
        DataError: the header or a line is another one, or the clock does not increase.
    """
    table = read_table(path, 7, VELOCITY_HEADER)
    if ",".join(table.header) != VELOCITY_HEADER:
        raise DataError(f"{path}, line 1: expected the header {VELOCITY_HEADER}")
    times_ns = stamps_ns(table)
    values = _finite(table)
    return velocity_samples(times_ns, values[:, :3], values[:, 3:])


def _finite(table: NumberTable) -> FloatArray:
    """Return all columns but the first as finite numbers (N, K)."""
    bad = ~np.isfinite(table.values).all(axis=1)
    if bad.any():
        raise DataError(
            f"{table.where(int(np.argmax(bad)))}: a reading is not a finite number "
            f"({int(bad.sum())} lines in all); "
            "remove such lines"
        )
    return table.values


# whose nanoseconds fit 64 bits
_DATE = re.compile(r"(19|20|21)\d\d-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{0,9})?")


def is_date(text: str) -> bool:
    """Whether a line begins as '2011-09-26 14:02:25' does."""
    return re.match(r"\d{4}-\d{2}-\d{2}[ T]", text.strip()) is not None


def drive_times(path: Path, numbers: IntArray) -> IntArray:
    """Read times in nanoseconds since 1970 (F,) of images with frame numbers (F,).

    The file holds one line an image, or one for each frame of the drive that the images are a part
    of.

    Raises:
        DataError: the file fits neither, a line is no date, or the clock does not increase.
    """
    lines = text_lines(path)
    if len(lines) == len(numbers):
        rows = list(range(len(numbers)))
    elif numbers[-1] < len(lines):
        rows = numbers.tolist()
    else:
        raise DataError(
            f"{path} holds {len(lines)} times for {len(numbers)} images up to number "
            f"{numbers[-1]}; there must be one "
            "line an image, or one for each frame of the drive"
        )
    times = [_parse_date(lines[row][1], path, lines[row][0]) for row in rows]
    return check_increasing(times, lambda k: f"{path}, line {lines[rows[k]][0]}")


def _parse_date(text: str, path: Path, number: int) -> int:
    """Parse '2011-09-26 14:02:25.951199337' as UTC, to nanoseconds since 1970."""
    try:
        if not _DATE.fullmatch(text.strip()):
            raise ValueError(text)
        return int(np.datetime64(text.strip().rstrip("."), "ns").astype(np.int64))
    except ValueError as error:
        raise DataError(
            f"{path}, line {number}: {text.strip()[:40]!r} is no time of the form '2011-09-26 "
            "14:02:25.951199337'"
        ) from error
