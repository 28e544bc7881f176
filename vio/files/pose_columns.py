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
    unit = next((u for cells in reversed(named) if (u := time_unit(cells[0])) is not None), None)
    if unit is None:
        first = [split_cells(text)[0] for text in headers if text.strip()]
        unit = next((u for cell in reversed(first) if (u := time_unit(cell)) is not None), None)
    if unit is None:
        unit = time_unit_in_words(headers)
    if count < 8:
        return PoseColumns(0, (1, 2, 3), None, "none", unit)
    order = next((o for text in reversed(headers) if (o := _order_in(text)) is not None), None)
    first_is_w = w_first if order is None else order == "wxyz"
    assumed: Orientations = "w first, assumed" if w_first else "w last, assumed"
    return PoseColumns(
        0,
        (1, 2, 3),
        (5, 6, 7, 4) if first_is_w else (4, 5, 6, 7),
        assumed if order is None else "stated",
        unit,
    )


def _named_columns(cells: Sequence[str]) -> PoseColumns | None:
    """Return the columns that a header names; None: it does not name quaternion and position."""
    names = [re.sub(r"[^a-z]", "", without_unit(cell)) for cell in cells]
    quaternion = _components(names, _QUATERNION, "xyzw")
    if quaternion is None:
        return None
    others = ["" if k in quaternion else name for k, name in enumerate(names)]
    position = _components([n if not _OTHER.match(n) else "" for n in others], _POSITION, "xyz")
    if position is None:
        return None
    times = [k for k, name in enumerate(names) if _is_time(name)]
    # that of a message goes before that of its recording
    stamp = next((k for k in times if "headerstamp" in names[k]), times[0] if times else 0)
    after = stamp + 1
    has_ns = names[stamp] in ("sec", "secs", "seconds") and "nsec" in names[after : after + 1]
    unit = "s" if has_ns else time_unit(cells[stamp])
    a, b, c = position
    x, y, z, w = quaternion
    return PoseColumns(stamp, (a, b, c), (x, y, z, w), "stated", unit, after if has_ns else None)


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
    return [columns[c] for c in wanted] if set(columns) >= set(wanted) else None


def _order_in(text: str) -> str | None:
    """Return wxyz or xyzw, the order in which a comment names a quaternion; None: it names none."""
    if spelt := _SPELT.search(text):
        return "wxyz" if spelt[0][0].lower() == "w" else "xyzw"
    order = ""
    for word in _WORDS.findall(text):
        name = re.sub(r"[^a-z]", "", word.lower())
        match = _QUATERNION.fullmatch(name)
        component = "w" if name == "w" else (match[1] or match[2]) if match is not None else ""
        order += component
    return order if order in ("wxyz", "xyzw") else None
