"""Which columns of a table of poses are what: as its header names them, else as the form has them.

What headers name: `qx`, `q_RS_w []`, `quaternion_x`, `pose.orientation.w`; `tx`, `p_RS_R_x [m]`,
`x [mm]`, `position[0]`, `easting`; `timestamp [ns]`, `sec`, `nsec`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from vio.dataclass import dataclass
from vio.errors import DataError
from vio.files.units import (
    LENGTH_UNITS,
    factor_of,
    header_cells,
    split_cells,
    time_unit,
    time_unit_in_words,
    without_unit,
)
from vio.records import Orientations

_QUATERNION = re.compile(
    r"(?:q|quat|quaternion|rot|rotation|att|attitude|orientation)[a-z]*?([wxyz])|"
    r"[a-z]*(?:orientation|quaternion|quat)([wxyz])"
)
_POSITION = re.compile(
    r"(?:p|t(?!im|stamp)|pos|position|trans|translation)?[a-z]{0,6}?([xyz])|"
    r"[a-z]*(?:position|translation)([xyz])"
)
_OTHER = re.compile(r"^(?:v|b|w|a|g|om|ang|lin|gyr|acc|std|cov|sig|euler|roll|pitch|yaw)")
# what stands where a quaternion would, and is none
_NO_QUATERNION = re.compile(r"roll|pitch|yaw|heading|euler|azimuth|vel|speed|^v|status|std|cov")
# components of a position on the earth, of right-handed frames
_ON_EARTH = (
    ("east", "north", "up"),
    ("north", "east", "down"),
    ("east", "north", "alt|height|elev"),
)
# a component by its number, as position[0] or q_3
_NUMBERED = re.compile(r"([a-z][a-z_. ]*?)[\[(_. ]?([0-4])[\])]?")
_POSITION_ALONE = re.compile(r"(?:p|t|pos|position|trans|translation|xyz)")
_QUATERNION_ALONE = re.compile(r"(?:q|quat|quaternion|rot|rotation|att|attitude|orientation)")
# a component with the names of its frames behind, as tx_world_device
_OF_FRAMES = re.compile(r"([tpq][xyzw])_[a-z]+_[a-z]+")
_SPELT = re.compile(r"\b(?:w[ ,]*x[ ,]*y[ ,]*z|x[ ,]*y[ ,]*z[ ,]*w)\b", re.IGNORECASE)
_WORDS = re.compile(r"[A-Za-z_][A-Za-z_0-9.]*")


@dataclass(frozen=True, slots=True)
class PoseColumns:
    """The columns of a table of poses, and the unit of its stamps."""

    stamp: int
    # columns of x, y, z
    position: tuple[int, int, int]
    # columns of x, y, z, w; None: there are only positions
    quaternion: tuple[int, int, int, int] | None
    orientations: Orientations
    unit: str | None = None  # of the stamps; None: not stated
    to_metres: float = 1.0  # of the positions
    nanoseconds: int | None = None  # column of them, where that of the stamps has whole seconds


def pose_columns(headers: Sequence[str], count: int, *, w_first: bool) -> PoseColumns:
    """Return the columns of a table.

    Args:
        headers: its comments, and the line of names above the data where it has one.
        count: of columns, at least 4.
        w_first: where no header says it, the quaternions begin with w.
    """
    found = named_columns(headers, count, w_first=w_first)
    if found is not None:
        return found
    unit = _stated_unit(headers, _cells_of(headers, count))
    if count < 8:
        return PoseColumns(0, (1, 2, 3), None, "none", unit)
    w_stands_first, orientations = _assumed_order(headers, w_first=w_first)
    quaternion = (5, 6, 7, 4) if w_stands_first else (4, 5, 6, 7)
    return PoseColumns(0, (1, 2, 3), quaternion, orientations, unit)


def named_columns(headers: Sequence[str], count: int, *, w_first: bool) -> PoseColumns | None:
    """Return the columns that the last header to do so names; None: none names a position, or it may
    be followed by a quaternion of other names.

    Args:
        headers: as in `pose_columns`.
        count: of columns.
        w_first: where the components of a quaternion are numbered from 1, whether w is the first.

    Raises:
        DataError: a header states motions between two times, or several units of length.
    """
    columns = (
        _named_columns(cells, w_first=w_first) for cells in reversed(_cells_of(headers, count))
    )
    return next((found for found in columns if found is not None), None)


def _cells_of(headers: Sequence[str], count: int) -> list[list[str]]:
    """Return the cells of those headers that name every column."""
    return [cells for text in headers if (cells := header_cells(text, count))]


def are_geographic(headers: Sequence[str]) -> bool:
    """Return whether the last header of a table names latitude and longitude."""
    names = (
        [re.sub(r"[^a-z]", "", without_unit(cell)) for cell in split_cells(headers[-1].lower())]
        if headers
        else []
    )
    return any(name.startswith("lat") for name in names) and any(
        name.startswith(("lon", "lng")) for name in names
    )


def _assumed_order(headers: Sequence[str], *, w_first: bool) -> tuple[bool, Orientations]:
    """Return whether w is the first component of the quaternions, and whether a header says it."""
    for text in reversed(headers):
        order = _order_in(text)
        if order is not None:
            return order == "wxyz", "stated"
    return w_first, "w first, assumed" if w_first else "w last, assumed"


def _stated_unit(headers: Sequence[str], named: Sequence[Sequence[str]]) -> str | None:
    """Return the unit of the stamps that the last header to do so states, by the name of its first
    cell, else in words; None: none states it.

    Args:
        headers: comments and lines of names.
        named: the cells of those that name every column.
    """
    names = [cells[0] for cells in reversed(named)]
    names += [cells[0] for text in reversed(headers) if (cells := split_cells(text))]
    for name in names:
        unit = time_unit(name)
        if unit is not None:
            return unit
    return time_unit_in_words(headers)


def _named_columns(cells: Sequence[str], *, w_first: bool) -> PoseColumns | None:
    """Return the columns that a header names; None: it names no position, or what stands at the
    place of a quaternion may be one.

    Raises:
        DataError: the header states motions between two times, or several units of length.
    """
    names = [_name_of(without_unit(cell)) for cell in cells]
    quaternion = _components(names, _QUATERNION, "xyzw")
    orientations: Orientations = "stated"
    if quaternion is None:
        quaternion, orientations = _numbered_quaternion(cells, w_first=w_first)
    position = _position(cells, names, quaternion or ())
    if position is None:
        return None
    _check_absolute(names)
    if quaternion is None and not _are_positions_alone(names, position):
        return None
    a, b, c = position
    if quaternion is None:
        of_turn = None
        orientations = "none"
    else:
        x, y, z, w = quaternion
        of_turn = (x, y, z, w)
    stamp = _stamp_column(names)
    after = stamp + 1
    unit = time_unit(cells[stamp])
    nanoseconds = None
    if names[stamp] in ("sec", "secs", "seconds") and "nsec" in names[after : after + 1]:
        unit = "s"
        nanoseconds = after
    to_metres = _to_metres([cells[k] for k in position])
    return PoseColumns(stamp, (a, b, c), of_turn, orientations, unit, to_metres, nanoseconds)


def _position(
    cells: Sequence[str], names: Sequence[str], quaternion: Sequence[int]
) -> list[int] | None:
    """Return the columns of a position: x, y, z by name, by number, or on the earth; None: a header
    names none.
    """
    lengths = [_name_of(without_unit(cell, LENGTH_UNITS)) for cell in cells]
    usable = [
        "" if k in quaternion or _OTHER.match(name) else length
        for k, (name, length) in enumerate(zip(names, lengths, strict=True))
    ]
    named = _components(usable, _POSITION, "xyz")
    if named is None:
        numbers = _numbered(cells, _POSITION_ALONE)
        named = next(
            ([numbers[n] for n in way] for way in ("012", "123") if set(way) <= set(numbers)), None
        )
    if named is not None:
        return named
    for way in _ON_EARTH:
        found = [[k for k, name in enumerate(names) if re.match(part, name)] for part in way]
        if all(found):
            return [columns[0] for columns in found]
    return None


def _numbered(cells: Sequence[str], whose: re.Pattern[str]) -> dict[str, int]:
    """Return the columns of components that have a number, by it."""
    found: dict[str, int] = {}
    for k, cell in enumerate(cells):
        match = _NUMBERED.fullmatch(cell.strip().lower())
        if match is not None and whose.fullmatch(re.sub(r"[^a-z]", "", match[1])):
            found.setdefault(match[2], k)
    return found


def _numbered_quaternion(
    cells: Sequence[str], *, w_first: bool
) -> tuple[list[int] | None, Orientations]:
    """Return the columns of x, y, z, w of a quaternion whose components have numbers, of which 0 is
    w where it is there, and the order that is taken for granted.
    """
    numbers = _numbered(cells, _QUATERNION_ALONE)
    if set("0123") <= set(numbers):
        return [numbers[n] for n in "1230"], "w first, assumed"
    if not set("1234") <= set(numbers):
        return None, "none"
    if w_first:
        return [numbers[n] for n in "2341"], "w first, assumed"
    return [numbers[n] for n in "1234"], "w last, assumed"


def _check_absolute(names: Sequence[str]) -> None:
    """Raise DataError where each row has the time of another one beside its own."""
    if any(name.startswith(("source", "from")) for name in names) and any(
        name.startswith(("dest", "target", "to")) for name in names
    ):
        raise DataError(
            "its header names two times a row, as of motions from one to the other; multiply them, and "
            "give the poses from one common start"
        )


def _are_positions_alone(names: Sequence[str], position: Sequence[int]) -> bool:
    """Return whether no quaternion of other names can follow a position."""
    behind = names[max(position) + 1 :][:4]
    return len(behind) < 4 or any(_NO_QUATERNION.search(name) for name in behind)


def _to_metres(cells: Sequence[str]) -> float:
    """Return the factor to metres of the unit that a header states of a position.

    Raises:
        DataError: it states several.
    """
    stated = {factor_of(cell, LENGTH_UNITS) for cell in cells} - {None}
    if len(stated) > 1:
        raise DataError(
            f"its header states several units of the position ({', '.join(cells)}); write all in one"
        )
    return next(iter(stated), None) or 1.0


def _name_of(cell: str) -> str:
    """Return the letters of a column's name, without the names of frames behind a component."""
    of_frames = _OF_FRAMES.fullmatch(cell.strip())
    return re.sub(r"[^a-z]", "", cell if of_frames is None else of_frames[1])


def _stamp_column(names: Sequence[str]) -> int:
    """Return the column of the times; that of a message goes before that of its recording."""
    times = [k for k, name in enumerate(names) if _is_time(name)]
    of_messages = [k for k in times if "headerstamp" in names[k]]
    return next(iter(of_messages + times), 0)


def _is_time(name: str) -> bool:
    return name in ("t", "sec", "secs", "seconds", "ns", "nsec") or bool(
        re.search(r"time|stamp", name)
    )


def _components(names: Sequence[str], form: re.Pattern[str], wanted: str) -> list[int] | None:
    """Return the columns of components, each of which is named once; None: they are not."""
    columns: dict[str, int] = {}
    for k, name in enumerate(names):
        match = form.fullmatch(name)
        if match is not None and name:
            columns.setdefault(match[1] or match[2], k)
        elif name == "w" and "w" in wanted:
            columns.setdefault("w", k)
    if set(columns) >= set(wanted):
        return [columns[c] for c in wanted]
    return None


def _order_in(text: str) -> str | None:
    """Return wxyz or xyzw, the order in which a comment names a quaternion; None: it names none."""
    if spelt := _SPELT.search(text):
        return "wxyz" if spelt[0][0].lower() == "w" else "xyzw"
    order = ""
    for word in _WORDS.findall(text):
        name = re.sub(r"[^a-z]", "", word.lower())
        match = _QUATERNION.fullmatch(name)
        if name == "w":
            component = "w"
        elif match is not None:
            component = match[1] or match[2]
        else:
            component = ""
        order += component
    return order if order in ("wxyz", "xyzw") else None
