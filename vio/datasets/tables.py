"""Tables of stamped samples as people write them: any separator, a header or none, stamps in s,
ms, us or ns.
"""

from __future__ import annotations

import contextlib
import itertools
import re
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.datasets.common import check_gravity_column
from vio.datasets.samples import MotionSamples, velocity_samples
from vio.errors import DataError
from vio.files.dates import date_ns, undated
from vio.files.stamps import SAMPLE_PACE, Pace, parse_stamps
from vio.files.text import check_increasing, lines_of, text_lines, whole_ns_stamps
from vio.files.units import (
    ACCEL_UNITS,
    GYRO_UNITS,
    factor_in_words,
    factor_of,
    header_cells,
    split_cells,
    time_unit,
    time_unit_in_words,
    unknown_unit,
    without_unit,
)
from vio.geometry.lie import FloatArray
from vio.imu.sampling import sampling_notes
from vio.imu.two_sensors import JOINED, joined_record, parted_sensors
from vio.numerics.robust import median
from vio.records import NS_PER_S, BoolArray, ImuRecord, IntArray, VelocitySample

_NUMBER = re.compile(
    r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE
)
_SECONDS = re.compile(r"(^|[^n])secs?$|seconds?$")  # ends of names in small letters
_NANOSECONDS = re.compile(r"n(ano)?secs?$|nanoseconds?$")
_PLAIN = re.compile(r"[0-9.eE+-]*")  # numbers in these are written as `_NUMBER` says, or are none
# columns that number the IMUs of a flight controller
_UNITS_OF_A_LOG = ("i", "instance", "imu_id", "imu", "device_id", "sensor_id")
_TIME = re.compile(r"time|stamp|sec|\bt\b|tow\b")  # in a cell of a header in small letters
# ends of names of the parts of a date, in order, and of what may follow them
_DATE_PARTS = ("year", "month", "day", "hour", "min(?:ute)?", "sec(?:ond)?s?")
_OF_SECONDS = (  # names of parts of a second, with their lengths
    (re.compile(r"nano(?:sec(?:ond)?s?)?$|nsecs?$"), 1),
    (re.compile(r"micro(?:sec(?:ond)?s?)?$|^(?:utc|gps)?(?:us|usecs?)$"), 1000),
    (re.compile(r"milli(?:sec(?:ond)?s?)?$|^(?:utc|gps)?(?:ms|msecs?)$"), 1_000_000),
)
_YEARS = range(1970, 2262)  # whose nanoseconds are times
_COUNTER = "sampletimefine"  # a clock that is called by what it counts: two makes, two ticks
_COARSE_TICK_NS = 100_000
_FINE_TICK_NS = 1000
_MAX_COARSE_STEP = 1000  # between readings, of the coarse ticks
# of a time that is counted from another one
_RELATIVE = re.compile(r"relative|elapsed|delta|offset")
# of what is no reading, though it is called by one: covariances, rates, biases
_NO_READING = re.compile(r"cov|hz$|integral|bias|std|sigma|clip")
_INDEXED_AXIS = re.compile(r"[\[(]([012xyz])[\])]")
_IMU_COLUMNS = 7
_SENSOR_COLUMNS = 4  # of a gyro or an accelerometer alone
_IMU_FORM = "timestamp, gyro x y z [rad/s], accel x y z [m/s^2]"
# columns of `sensor_msgs/Imu` in the order of its fields
_MESSAGE = (
    *("sec", "nanosec", "frame_id", "qx", "qy", "qz", "qw"),
    *(f"q_cov_{k}" for k in range(9)),
    *("wx", "wy", "wz"),
    *(f"w_cov_{k}" for k in range(9)),
    *("ax", "ay", "az"),
    *(f"a_cov_{k}" for k in range(9)),
)
# of data sets, whose tables have no header, by the names of their files: KAIST Urban's, NCLT's
_KNOWN = {
    "xsens_imu.csv": (
        *("timestamp [ns]", "qx", "qy", "qz", "qw", "euler_x", "euler_y", "euler_z"),
        *("wx", "wy", "wz", "ax", "ay", "az", "mx", "my", "mz"),
    ),
    "ms25.csv": ("timestamp [us]", "mx", "my", "mz", "ax", "ay", "az", "wx", "wy", "wz"),
}
# Of times that two lines share: at most so many, and the unit in which all steps are whole numbers is
# at most so much of the usual one, or the times were rounded
_MAX_SHARED = 0.35
_FINE = 0.1
_MAX_LATE = 0.05  # share of lines that may have been written late
_OWN_PLACE = 0.5  # of the usual interval that is free on both sides of such a line
_WORD = re.compile(r"[A-Za-z_]+\d*")
_OF_EACH_SENSOR = "write the lines of each sensor into a file of its own, gyro.csv and accel.csv (timestamp, x, y, z)"
# letters of sensors' names that are those of axes
_NO_AXIS = re.compile(r"gyr(?:o(?:scope)?)?|velocity")
_OTHER_UNITS = {"rad/s": "deg/s or mdps", "m/s^2": "g or mg"}  # for messages
VELOCITY_HEADER = "time_s,vx_mps,vy_mps,vz_mps,wx_radps,wy_radps,wz_radps"


@dataclass(frozen=True, slots=True)
class NumberTable:
    """The stamps of a file as text, and its other columns as numbers."""

    path: Path
    header: tuple[str, ...]  # lower case, with the units of a line below it; empty: none
    comments: tuple[str, ...]  # lines above the data that are no header
    stamps: tuple[str, ...]
    values: FloatArray  # (N, K); NaN: no number
    lines: Sequence[int]  # (N,) line numbers from 1

    def where(self, row: int) -> str:
        """Name the place of a row for a message."""
        return f"{self.path}, line {self.lines[row]}"


def read_table(path: Path, columns: int, form: str, cut: list[str] | None = None) -> NumberTable:
    """Read a table of stamps and numbers; see `table_rows`."""
    comments = list[str]()
    rows = table_rows(path, columns, form, cut, comments)
    header = tuple(field.lower() for field in next(rows)[1])
    stamps = list[str]()
    values = array("d")
    lines = array("q")
    for number, fields in rows:
        stamps.append(fields[0])
        lines.append(number)
        values.extend(_numbers(fields[1:]))
    table = np.array(values).reshape(-1, columns - 1)
    return NumberTable(path, header, tuple(comments), tuple(stamps), table, lines)


def _numbers(texts: Sequence[str]) -> list[float]:
    """Return what fields say as numbers; NaN: no number."""
    if _PLAIN.fullmatch("".join(texts)):
        with contextlib.suppress(ValueError):
            return [float(text) for text in texts]
    return [float(text) if _NUMBER.fullmatch(text) else float("nan") for text in texts]


def stamped_rows(path: Path, columns: int, form: str) -> tuple[IntArray, list[str], list[int]]:
    """Return the times (N,) of a table that are in whole nanoseconds, or in the unit that its
    header states, the last field of each line, and its number.

    Raises:
        DataError: as `table_rows`, or a stamp is another number, or not later than the one before.
    """
    (_, header), *rows = table_rows(path, columns, form)
    lines = [number for number, _ in rows]
    stamps = [fields[0] for _, fields in rows]
    stated = time_unit(header[0]) if header else None
    where = lambda k: f"{path}, line {lines[k]}"  # noqa: E731
    times_ns = _times_ns(stamps, where, stated, increasing=True)
    return times_ns, [fields[-1] for _, fields in rows], lines


def _times_ns(
    stamps: Sequence[str], where: Callable[[int], str], stated: str | None, *, increasing: bool
) -> IntArray:
    """Return times (N,) that are whole nanoseconds where no other unit is stated."""
    if stated in (None, "ns"):
        return whole_ns_stamps(stamps, where, increasing=increasing)
    return parse_stamps(stamps, where, stated, increasing=increasing)


def table_rows(
    path: Path,
    columns: int,
    form: str,
    cut: list[str] | None = None,
    comments: list[str] | None = None,
) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the fields of each line of a table, and before the first one 0 and those
    of the header.

    Commas, semicolons or white space separate. The header is the last comment or text line above;
    it may have none. Where that line holds units alone, they are put behind the names of the line
    above it.

    Args:
        path: the file.
        columns: expected number of columns.
        form: their names, for messages.
        cut: where to note a last line that ends too early, which is left out then; None: it is an
            error.
        comments: where to note the other lines above the data.

    Raises:
        DataError: the file cannot be read or is empty, or a line has another number of columns.
    """
    above = _LinesAbove(columns, [] if comments is None else comments)
    is_data = False
    lines = (
        (number, undated(text) if (text := line.strip())[4:5] == "-" else text)
        for number, line in lines_of(path)
    )
    for number, text in lines:
        if not is_data and above.take(number, text):
            continue
        if not text or text.startswith("#"):
            continue
        if above.is_header(text):  # again, in a file that another was appended to
            continue
        fields = split_cells(text)
        if len(fields) != columns:
            if cut is not None and is_data and _is_cut(fields, columns, lines):
                early = f"the last line ends too early ({len(fields)} of {columns} values)"
                cut.append(f"{path}, line {number}: {early}; left out")
                return
            named = next((field for field in fields[1:] if _WORD.fullmatch(field)), None)
            if named is None or _NUMBER.fullmatch(named):
                remedy = ""
            else:
                remedy = f"; where {named!r} says whose a line is, {_OF_EACH_SENSOR}"
            raise DataError(
                f"{path}, line {number}: {len(fields)} values instead of {columns} ({form}){remedy}"
            )
        if not is_data:
            is_data = True
            yield 0, above.header
        yield number, fields
    if not is_data:
        raise DataError(
            f"{path}: holds no line of data ({form}){above.unread or '; copy it again, or remove it'}"
        )


def _is_cut(fields: Sequence[str], columns: int, further: Iterator[object]) -> bool:
    """Tell whether a line is too short and no further one follows, which is taken."""
    return len(fields) < columns and next(further, None) is None


class _LinesAbove:
    """The lines above the data of a table: its header, and comments."""

    def __init__(self, columns: int, comments: list[str]) -> None:
        self.header = list[str]()
        self.unread = ""  # of a line of text below the header: why it is no data
        self._named = ""  # the header, as it is written
        self._columns = columns
        self._comments = comments

    def is_header(self, text: str) -> bool:
        """Whether a line is the header."""
        return text == self._named

    def take(self, number: int, text: str) -> bool:
        """Take a line, unless it is one of data; return whether it was taken."""
        if not text:
            return True
        is_comment = text.startswith("#")
        if not is_comment and _NUMBER.fullmatch(next(iter(split_cells(text)), "")):
            return False
        if not self.unread:
            self.unread = self._why_unread(number, text)
        cells = header_cells(text, self._columns)
        if cells:
            self.header = _with_units(self.header, cells)
            self._named = text.lstrip("# ")
        else:
            self._comments.append(text)
        return True

    def _why_unread(self, number: int, text: str) -> str:
        """Return why a line above the data may be data that is not read, and what to do; empty: it is
        a comment, or the header.
        """
        cells = split_cells(text)
        if cells and _WORD.fullmatch(cells[0]) and _are_numbers(cells[1:]):
            return f"; line {number}, {text[:40]!r}, begins with a word: {_OF_EACH_SENSOR}"
        if self.header and not text.startswith("#"):
            return (
                f"; line {number}, {text[:40]!r}, does not begin with a number (decimals need a "
                "point); copy it again, or remove it"
            )
        return ""


def _are_numbers(cells: Sequence[str]) -> bool:
    """Whether cells are a stamp and three readings at least."""
    return len(cells) > 3 and all(map(_NUMBER.fullmatch, cells))


def _with_units(header: list[str], cells: list[str]) -> list[str]:
    """Return the cells of the last line above the data; units alone go behind the names above."""
    units = [cell.strip("[](){} ") for cell in cells]
    alone = all(
        not unit
        or time_unit(f"[{unit}]") is not None
        or factor_of(f"[{unit}]", GYRO_UNITS) is not None
        or factor_of(f"[{unit}]", ACCEL_UNITS) is not None
        for unit in units
    )
    if not (header and alone):
        return cells
    return [f"{name} [{unit}]" for name, unit in zip(header, units, strict=True)]


def stamps_ns(
    table: NumberTable, pace: Pace | None = None, doubts: list[str] | None = None
) -> IntArray:
    """Return the first column as nanoseconds (N,), in any order; the unit as stated, else by its
    size.

    Args:
        table: the file's.
        pace: how far apart the rows may be, see `parse_stamps`.
        doubts: where to note a unit that the pace decided.

    Raises:
        DataError: a stamp is no number.
    """
    unit = _stated_unit(table)
    return parse_stamps(table.stamps, table.where, unit, pace=pace, doubts=doubts, increasing=False)


def in_order(
    table: NumberTable, times_ns: IntArray, notes: list[str]
) -> tuple[NumberTable, IntArray]:
    """Return a table and its times (N,), which strictly increase, without lines that repeat the one
    above, and with those in their place that were written late; both are noted.

    A late line fits between two others. After a clock was set back lines do not, or there are more
    of them.

    Raises:
        DataError: the times do not increase otherwise.
    """
    if not (np.diff(times_ns) <= 0).any():
        return table, times_ns
    repeats = np.zeros(len(times_ns), dtype=np.bool_)
    repeats[1:] = (np.diff(times_ns) == 0) & (table.values[1:] == table.values[:-1]).all(axis=1)
    kept = np.flatnonzero(~repeats)
    if repeats.any():
        notes.append(
            f"{table.path}: {int(repeats.sum())} lines repeat the one above and are left out"
        )
    times = times_ns[kept]
    late = times < np.maximum.accumulate(times)
    if late.any() and _fits(times, late):
        kept = kept[np.argsort(times, kind="stable")]
        notes.append(f"{table.path}: {int(late.sum())} lines were written late and are sorted")
    shared = _shared(times_ns[kept])
    if shared.any():
        notes.append(
            f"{table.path}: {int(shared.sum())} of {len(kept)} lines have the time of the one above, "
            "and other readings, as a driver writes that stamps two samples at once; they are left "
            "out: record the sensor's own stamps"
        )
        kept = kept[~shared]
    table = _rows(table, kept)
    return table, check_increasing(times_ns[kept], table.where)


def _shared(times_ns: IntArray) -> BoolArray:
    """Return which times (N,) are those of the one before, where single ones are, of stamps that are
    finer than their steps; none where they may be rounded, or a clock stood still.
    """
    shared = np.zeros(len(times_ns), dtype=np.bool_)
    steps = np.diff(times_ns)
    shared[1:] = steps == 0
    alone = not (shared[1:] & shared[:-1]).any() and shared.sum() <= _MAX_SHARED * len(shared)
    apart = steps[steps > 0]
    if not alone or (steps < 0).any() or not len(apart):
        return np.zeros_like(shared)
    is_fine = np.gcd.reduce(apart) <= _FINE * median(apart)
    return shared if is_fine else np.zeros_like(shared)


def _fits(times_ns: IntArray, late: BoolArray) -> bool:
    """Return whether sorted times are further apart than half of the usual, and few were late."""
    steps = np.diff(np.sort(times_ns))
    usual = median(steps)
    place = np.searchsorted(np.sort(times_ns), times_ns[late])
    before = steps[np.maximum(place - 1, 0)]
    after = steps[np.minimum(place, len(steps) - 1)]
    own = np.minimum(before, after) > _OWN_PLACE * usual
    return bool(own.all()) and late.sum() <= _MAX_LATE * len(late)


def _rows(table: NumberTable, rows: IntArray) -> NumberTable:
    """Return some lines of a table."""
    kept = rows.tolist()
    return replace(
        table,
        stamps=tuple(table.stamps[k] for k in kept),
        values=table.values[rows],
        lines=[table.lines[k] for k in kept],
    )


def _stated_unit(table: NumberTable) -> str | None:
    """Return the unit of the stamps that the header states, or a comment above it."""
    unit = time_unit(table.header[0]) if table.header else None
    return time_unit_in_words(table.comments) if unit is None else unit


def read_imu_table(
    path: Path, *, cut: list[str] | None = None, whole_ns: bool = False
) -> tuple[ImuRecord, tuple[str, ...]]:
    """Read raw inertial readings; a header may name the order of its columns, and their units.

    With a header that names them, there may be other columns.

    Args:
        path: the file.
        cut: see `table_rows`.
        whole_ns: whether stamps are in whole nanoseconds where the header states no other unit.

    Returns:
        The record, and notes about what was converted or looks wrong.

    Raises:
        DataError: a line lacks seven finite numbers, the stamps do not increase, or the order of
            columns is unclear.
    """
    table = _imu_table(path, cut)
    notes: list[str] = []
    if whole_ns:
        unit = _stated_unit(table)
        times_ns = _times_ns(table.stamps, table.where, unit, increasing=False)
    else:
        times_ns = stamps_ns(table, SAMPLE_PACE, notes)
    times_ns, values = _readings(table, times_ns, notes)
    order = _imu_order(table)
    if order is None:
        remedy = "exchange these columns with 5 to 7, or add a header such as 'timestamp [ns],ax,ay,az,wx,wy,wz'"
        check_gravity_column(values, str(path), _IMU_FORM, remedy)
        order = range(6)
    gyro_factor, gyro_notes = _factor(table, order[:3], GYRO_UNITS, "gyro", "rad/s")
    accel_factor, accel_notes = _factor(table, order[3:], ACCEL_UNITS, "accelerometer", "m/s^2")
    gyro = values[:, order[:3]]
    accel = values[:, order[3:]]
    record = ImuRecord(
        times_ns,
        gyro if gyro_factor == 1.0 else gyro * gyro_factor,
        accel if accel_factor == 1.0 else accel * accel_factor,
    )
    parts = parted_sensors(record.gyro, record.accel)
    if parts is not None:
        of_gyro, of_accel = parts
        joined = joined_record(
            (times_ns[of_gyro], record.gyro[of_gyro]), (times_ns[of_accel], record.accel[of_accel])
        )
        if joined is not None:
            record = joined
            notes.append(f"{path}: holds gyro and accelerometer in lines of their own: {JOINED}")
    return record, (*notes, *gyro_notes, *accel_notes, *sampling_notes(record, str(path)))


def read_sensor_table(
    path: Path, sensor: Literal["gyro", "accelerometer"], notes: list[str]
) -> tuple[IntArray, FloatArray]:
    """Read the readings of one sensor; a header may name the order of its axes, and their units.

    Args:
        path: the file.
        sensor: what it holds.
        notes: where to note what is converted, left out or sorted.

    Returns:
        Stamps (N,) in nanoseconds and readings (N, 3) in rad/s or m/s^2.

    Raises:
        DataError: a line lacks four finite numbers, or the stamps do not increase.
    """
    units, si = (GYRO_UNITS, "rad/s") if sensor == "gyro" else (ACCEL_UNITS, "m/s^2")
    table = _sensor_table(path, f"timestamp, {sensor} x y z [{si}]", notes)
    times_ns, values = _readings(table, stamps_ns(table, SAMPLE_PACE, notes), notes)
    axes = [_sensor_and_axis(cell)[1] for cell in table.header[1:]]
    if sorted(axes) == ["x", "y", "z"]:
        order = [axes.index(axis) for axis in "xyz"]
    else:
        order = [0, 1, 2]
    factor, said = _factor(table, order, units, sensor, si)
    notes += said
    return times_ns, values[:, order] * factor


def _sensor_table(path: Path, form: str, cut: list[str]) -> NumberTable:
    """Read the stamps and three readings, or the axes that the header names of more columns."""
    count = column_count(path)
    if count > _SENSOR_COLUMNS:
        table = _time_first(read_table(path, count, form, cut))
        axes = [_sensor_and_axis(cell)[1] for cell in table.header[1:]]
        if all(axes.count(axis) == 1 for axis in "xyz"):
            return _columns_of(table, [k for k, axis in enumerate(axes) if axis])
    return read_table(path, _SENSOR_COLUMNS, form, cut)


def _readings(
    table: NumberTable, times_ns: IntArray, notes: list[str]
) -> tuple[IntArray, FloatArray]:
    """Return times (N,) and all other columns (N, K) of readings in the order of their times, without
    those of which none is finite.

    Raises:
        DataError: of a line some are not, or the clock goes back.
    """
    table, times_ns = _without_gaps(table, times_ns, notes)
    table, times_ns = in_order(table, times_ns, notes)
    return times_ns, _finite(table)


def _without_gaps(
    table: NumberTable, times_ns: IntArray, notes: list[str]
) -> tuple[NumberTable, IntArray]:
    """Leave out readings none of which is finite, which a driver writes before its first ones, with
    a note.

    Of a line in which some are, or where most lines are such, more is wrong.
    """
    lost = np.asarray(np.isnan(table.values).all(axis=1))
    count = int(lost.sum())
    if not count or 2 * count > len(lost):
        return table, times_ns
    kept = np.flatnonzero(~lost)
    notes.append(f"{table.path}: {count} readings are not numbers and are left out")
    return _rows(table, kept), times_ns[kept]


def names_readings(path: Path) -> str | None:
    """Return the name by which a file would be read that could be an IMU's by its own name, or by its
    header, and by its first line of data; None: it could not.
    """
    name = path.name.lower()
    try:
        count = column_count(path)
        if count >= _IMU_COLUMNS and ("imu" in name or _is_named_imu(path, count)):
            return "imu.csv"
    except DataError:
        return None
    if count < _SENSOR_COLUMNS:
        return None
    if "gyr" in name:
        return "gyro.csv"
    return "accel.csv" if "acc" in name else None


def _is_named_imu(path: Path, count: int) -> bool:
    """Return whether the header of a table names the axes of a gyro and of an accelerometer."""
    header = next(table_rows(path, count, _IMU_FORM))[1]
    named = {_sensor_and_axis(cell.lower()) for cell in header}
    return named >= set(itertools.product("wa", "xyz"))


def column_count(path: Path) -> int:
    """Return the number of columns of a table; 0: it holds no line of data."""
    rows = (split_cells(undated(line.strip())) for _, line in lines_of(path))
    return next((len(fields) for fields in rows if _NUMBER.fullmatch(fields[0])), 0)


def _imu_table(path: Path, cut: list[str] | None) -> NumberTable:
    """Read the stamps and six readings, or what the header names of more columns."""
    count = column_count(path)
    if count <= _IMU_COLUMNS:
        return read_table(path, _IMU_COLUMNS, _IMU_FORM, cut)
    table = read_table(path, count, _IMU_FORM, cut)
    if not table.header:
        table = replace(table, header=_known_header(table))
    table = _of_one_unit(_time_first(table), cut)
    order = _imu_order(table) if table.header else None
    if order is None:
        raise DataError(
            f"{table.where(0)}: {count} values instead of {_IMU_COLUMNS} ({_IMU_FORM}); name the "
            "columns in a header, or write these seven"
        )
    return _columns_of(table, order)


def read_logged_table(path: Path, form: str, cut: list[str] | None = None) -> NumberTable:
    """Read all columns of a table of messages or of a logger, with the time that its header names
    in front; see `read_table`.
    """
    table = read_table(path, column_count(path), form, cut)
    timed = _time_first(table)
    if not table.header or table.header[0] in timed.header:
        return timed
    # what stood in the place of stamps is a column of numbers as the others
    first = [float(cell) if _NUMBER.fullmatch(cell) else np.nan for cell in table.stamps]
    return replace(
        timed,
        header=(*timed.header, table.header[0]),
        values=np.column_stack([timed.values, first]),
    )


def _known_header(table: NumberTable) -> tuple[str, ...]:
    """Return the names of the columns of a table without a header: of messages `sensor_msgs/Imu` as
    `ros2 topic echo --csv` writes them, which begin with seconds, nanoseconds and the name of a
    frame, or of a data set's, by the name of its file; empty: not known.
    """
    count = 1 + table.values.shape[1]
    name = table.path.name.lower()
    if name in _KNOWN and count == len(_KNOWN[name]):
        return _KNOWN[name]
    nanoseconds = table.values[:, 0]
    is_message = (
        count == len(_MESSAGE)
        and all(stamp.isdecimal() for stamp in table.stamps)
        and (np.isfinite(nanoseconds) & (nanoseconds == np.rint(nanoseconds))).all()
        and ((nanoseconds >= 0) & (nanoseconds < NS_PER_S)).all()
        and np.isnan(table.values[:, 1]).all()
    )
    return _MESSAGE if is_message else ()


def _of_one_unit(table: NumberTable, notes: list[str] | None) -> NumberTable:
    """Return the rows of the first IMU where a column of their number says that there are several,
    with a note.
    """
    numbered = [k for k, cell in enumerate(table.header[1:]) if cell in _UNITS_OF_A_LOG]
    if not numbered:
        return table
    units = table.values[:, numbered[0]]
    kept = np.flatnonzero(units == units[0])
    count = len(np.unique(units))
    if count > 1 and notes is not None:
        notes.append(
            f"{table.path}: holds {count} IMUs; the readings of number {units[0]:g} are used"
        )
    return _rows(table, kept)


def _columns_of(table: NumberTable, columns: Sequence[int]) -> NumberTable:
    """Return the stamps of a table and some of its other columns."""
    return replace(
        table,
        header=(table.header[0], *(table.header[1 + k] for k in columns)),
        values=table.values[:, columns],
    )


def _time_first(table: NumberTable) -> NumberTable:
    """Return a table whose stamps are the column that its header calls the time, the seconds and
    nanoseconds of two columns, or the dates of several; as it is where the header names none.

    The stamp of a message goes before that of its recording, an absolute time before others, and any
    of them before dates that are invalid, or in whole seconds.
    """
    date = _date_columns(table.header)
    of_date = date.columns if date is not None else frozenset()
    times = [k for k, cell in enumerate(table.header) if k not in of_date and _TIME.search(cell)]
    if date is not None:
        try:
            dated = _dated(table, date)
        except DataError:
            if not times:
                raise
        else:
            if not times or any(int(stamp) % NS_PER_S for stamp in dated.stamps):
                return dated
    return _timed(table, times) if times else table


def _timed(table: NumberTable, times: Sequence[int]) -> NumberTable:
    """Return a table whose stamps are one of several columns of times, or that and the one behind it
    where they hold seconds and nanoseconds.
    """
    stamp = min(times, key=lambda k: _rank_of_time(table.header[k]))
    names = [re.sub(r"[^a-z]", "", cell) for cell in table.header[stamp:][:2]]
    rest = stamp + 1
    in_parts = (
        len(names) > 1
        and _SECONDS.search(names[0]) is not None
        and _NANOSECONDS.search(names[1]) is not None
    )
    is_counter = names[0] == _COUNTER
    if stamp == 0 and not in_parts and not is_counter:
        return table
    # their digits, of which numbers keep sixteen
    rows = itertools.islice(table_rows(table.path, len(table.header), _IMU_FORM, []), 1, None)
    cells = [(fields[stamp], fields[rest] if in_parts else "0") for _, fields in rows]
    header = table.header[stamp]
    stamps = tuple(whole for whole, _ in cells)
    if in_parts and all(part.isdigit() for pair in cells for part in pair):
        header = "time [ns]"
        stamps = tuple(str(int(whole) * NS_PER_S + int(part)) for whole, part in cells)
    elif is_counter and all(whole.isdigit() for whole in stamps):
        header = "time [ns]"
        stamps = _in_nanoseconds([int(whole) for whole in stamps])
    others = [k for k in range(1, len(table.header)) if k != stamp and not (in_parts and k == rest)]
    return replace(
        table,
        header=(header, *(table.header[k] for k in others)),
        stamps=stamps,
        values=table.values[:, [k - 1 for k in others]],
    )


def _in_nanoseconds(counts: Sequence[int]) -> tuple[str, ...]:
    """Return the stamps of a counter whose tick is told by how far readings are apart."""
    step = median(np.abs(np.diff(counts))) if len(counts) > 1 else 0
    tick_ns = _COARSE_TICK_NS if step <= _MAX_COARSE_STEP else _FINE_TICK_NS
    return tuple(str(count * tick_ns) for count in counts)


class _DateColumns(NamedTuple):
    """The columns of a date."""

    parts: tuple[int, ...]  # of year, month, day, hour, minute, second
    fraction: int | None  # of a part of a second, where seconds are whole; None: there is none
    fraction_ns: int  # its length

    @property
    def columns(self) -> frozenset[int]:
        """All of them."""
        return frozenset(self.parts) | ({self.fraction} if self.fraction is not None else set())


def _date_columns(header: Sequence[str]) -> _DateColumns | None:
    """Return the columns of a date; None: the header names none, or several parts of a second."""
    names = [re.sub(r"[^a-z]", "", cell) for cell in header]
    fractions = [
        (k, length)
        for form, length in _OF_SECONDS
        for k, name in enumerate(names)
        if form.search(name) and not re.search("stamp|^time", name)
    ]
    taken = {k for k, _ in fractions}
    found = [
        [k for k, name in enumerate(names) if k not in taken and re.search(f"{part}$", name)]
        for part in _DATE_PARTS
    ]
    if not all(found):
        return None
    parts = tuple(min(columns, key=lambda k: len(names[k])) for columns in found)
    if len({length for _, length in fractions}) > 1:
        return None
    fraction, length = next(iter(fractions), (None, 1))
    return _DateColumns(parts, fraction, length)


def _dated(table: NumberTable, date: _DateColumns) -> NumberTable:
    """Return a table whose stamps are the dates of several columns.

    Raises:
        DataError: a line has no date there.
    """
    rows = itertools.islice(table_rows(table.path, len(table.header), _IMU_FORM, []), 1, None)
    stamps = list[str]()
    for number, fields in rows:
        try:
            stamps.append(str(_date_ns(date, fields)))
        except (ValueError, ArithmeticError) as error:
            raise DataError(
                f"{table.path}, line {number}: its columns of year to second hold no date with a "
                f"year of {_YEARS.start} to {_YEARS.stop - 1}"
            ) from error
    others = [k for k in range(1, len(table.header)) if k not in date.columns]
    return replace(
        table,
        header=("time [ns]", *(table.header[k] for k in others)),
        stamps=tuple(stamps),
        values=table.values[:, [k - 1 for k in others]],
    )


def _date_ns(date: _DateColumns, fields: Sequence[str]) -> int:
    """Return the time of a line in nanoseconds since 1970.

    Raises:
        ValueError, ArithmeticError: it has none.
    """
    year, month, day, hour, minute = (int(fields[k]) for k in date.parts[:5])
    second = Decimal(fields[date.parts[5]])
    fraction_ns = 0
    if date.fraction is not None and second == int(second):
        fraction_ns = int(Decimal(fields[date.fraction]) * date.fraction_ns)
    if year not in _YEARS or not 0 <= second < 61 or not 0 <= fraction_ns < NS_PER_S:
        raise ValueError("no date")
    whole = np.datetime64(f"{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}", "ns")
    return int(whole.astype(np.int64)) + int(second * NS_PER_S) + fraction_ns


def _rank_of_time(cell: str) -> tuple[bool, bool]:
    """Return by what times of one row are chosen, the least one first."""
    letters = re.sub(r"[^a-z]", "", cell)
    return _RELATIVE.search(letters) is not None, "headerstamp" not in letters


def _factor(
    table: NumberTable, columns: Sequence[int], units: Mapping[str, float], name: str, si: str
) -> tuple[float, list[str]]:
    """Return the factor to SI units of three columns, as the header or a comment states it, and
    notes.

    Raises:
        DataError: the header states several units of them.
    """
    if table.header:
        cells = [table.header[1 + k] for k in columns]
    else:
        cells = []
    stated = {factor_of(cell, units) for cell in cells} - {None}
    if len(stated) > 1:
        raise DataError(
            f"{table.path}: the header states several units of the {name} ({', '.join(cells)}); "
            "write all in one"
        )
    factor = next(iter(stated), None)
    if factor is None:
        factor = factor_in_words(table.comments, units)
    if factor is None:
        word = next(filter(None, (unknown_unit(cell, units) for cell in cells)), None)
        if word is None:
            return 1.0, []
        note = (
            f"{table.path}: doubtful: the unit {word!r} of the {name} is not known; it is read "
            f"as {si}; if it is another, all its readings are off by a factor: write it as "
            f"{' or '.join(list(units)[:1])}, {_OTHER_UNITS[si]}"
        )
        return 1.0, [note]
    if factor == 1.0:
        return 1.0, []
    note = f"{table.path}: the header states {_words(factor)}; the {name} is converted to {si}"
    return factor, [note]


def _words(factor: float) -> str:
    """Return the name of a unit, given its factor to SI units."""
    names = {GYRO_UNITS["deg/s"]: "degrees", ACCEL_UNITS["g"]: "g"}
    return names.get(factor, f"units of {factor:.6g} SI units")


def _imu_order(table: NumberTable) -> Sequence[int] | None:
    """Return the columns of gyro x y z and accel x y z by the header's names.

    None: it names no axes.
    """
    found: dict[tuple[str, str], list[int]] = {}
    for k, cell in enumerate(table.header[1:]):
        found.setdefault(_sensor_and_axis(cell), []).append(k)
    if not any(kind and axis for kind, axis in found):
        return None
    wanted = list(itertools.product("wa", "xyz"))
    counts = [len(found.get(key, ())) for key in wanted]
    if len(table.header) <= _IMU_COLUMNS:
        others = found.keys() - wanted
    else:
        others = set()
    if others or counts != [1] * len(wanted):
        raise DataError(
            f"{table.path}: the header {','.join(table.header)[:80]!r} does not name gyro and "
            "accel; write "
            "'timestamp [ns],wx,wy,wz,ax,ay,az', or no header for that order"
        )
    return [found[key][0] for key in wanted]


def _sensor_and_axis(cell: str) -> tuple[str, str]:
    """Return the sensor and the axis that a cell of a header names; empty where it names none."""
    letters = re.sub(r"[^a-z]", "", without_unit(cell)).replace("axis", "")
    of_axis = _NO_AXIS.sub("", letters)
    if _NO_READING.search(letters):
        return "", ""
    indexed = _INDEXED_AXIS.search(cell)
    if indexed is not None:
        return _sensor(letters), dict(zip("012", "xyz", strict=True)).get(indexed[1], indexed[1])
    axis = next((c for c in reversed(of_axis) if c in "xyz"), "")
    return _sensor(letters), axis


def sensor_of(name: str) -> str:
    """Return w for the name of a gyro's readings, a for an accelerometer's, else nothing."""
    letters = re.sub(r"[^a-z]", "", name.lower())
    return "" if _NO_READING.search(letters) else _sensor(letters)


def _sensor(letters: str) -> str:
    """Return w for the name of a gyro's column, a for an accelerometer's, else nothing."""
    if re.match(r"w|g(?!rav|ps|nss)|om|ang|rot|rs?sw", letters) or re.search(
        r"gyr|ang(?:ular)?(?:vel|rate)|omega", letters
    ):
        return "w"
    return "a" if letters.startswith(("a", "lin")) or "acc" in letters else ""


def read_velocity_table(path: Path, notes: list[str]) -> MotionSamples[VelocitySample]:
    """Read body velocity and angular rate in the IMU frame.

    Args:
        path: the file.
        notes: where to note lines that are left out or sorted.

    Raises:
        DataError: the header or a line is another one, or the clock does not increase.
    """
    table = read_table(path, 7, VELOCITY_HEADER)
    if ",".join(table.header) != VELOCITY_HEADER:
        raise DataError(f"{path}, line 1: expected the header {VELOCITY_HEADER}")
    table, times_ns = in_order(table, stamps_ns(table), notes)
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
        return date_ns(text)
    except ValueError as error:
        raise DataError(
            f"{path}, line {number}: {text.strip()[:40]!r} is no time of the form '2011-09-26 "
            "14:02:25.951199337' in UTC"
        ) from error
