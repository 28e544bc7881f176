"""Which columns of a table of poses are what: as its header names them, else as the form has them.

What headers name: `qx`, `q_RS_w []`, `quaternion_x`, `pose.orientation.w`; `tx`, `p_RS_R_x [m]`,
`x`; `timestamp [ns]`, `sec`, `nsec`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from vio.dataclass import dataclass
from vio.files.units import header_cells, split_cells, time_unit, time_unit_in_words, without_unit
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
    nanoseconds: int | None = None  # column of them, where that of the stamps has whole seconds


def pose_columns(headers: Sequence[str], count: int, *, w_first: bool) -> PoseColumns:
    """Return the columns of a table.

    Args:
        headers: its comments, and the line of names above the data where it has one.
        count: of columns, at least 4.
        w_first: where no header says it, the quaternions begin with w.
    """
    named = [cells for text in headers if (cells := header_cells(text, count))]
    for cells in reversed(named):
        found = _named_columns(cells)
        if found is not None:
            return found
    unit = _stated_unit(headers, named)
    if count < 8:
        return PoseColumns(0, (1, 2, 3), None, "none", unit)
    w_stands_first, orientations = _assumed_order(headers, w_first=w_first)
    quaternion = (5, 6, 7, 4) if w_stands_first else (4, 5, 6, 7)
    return PoseColumns(0, (1, 2, 3), quaternion, orientations, unit)


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


def _named_columns(cells: Sequence[str]) -> PoseColumns | None:
    """Return the columns that a header names; None: it does not name quaternion and position."""
    names = [_name_of(without_unit(cell)) for cell in cells]
    quaternion = _components(names, _QUATERNION, "xyzw")
    if quaternion is None:
        return None
    others = ["" if k in quaternion else name for k, name in enumerate(names)]
    position = _components([n if not _OTHER.match(n) else "" for n in others], _POSITION, "xyz")
    if position is None:
        return None
    a, b, c = position
    x, y, z, w = quaternion
    stamp = _stamp_column(names)
    after = stamp + 1
    if names[stamp] in ("sec", "secs", "seconds") and "nsec" in names[after : after + 1]:
        return PoseColumns(stamp, (a, b, c), (x, y, z, w), "stated", "s", after)
    return PoseColumns(stamp, (a, b, c), (x, y, z, w), "stated", time_unit(cells[stamp]))


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
