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
    UNREAD_LENGTHS,
    factor_of,
    header_cells,
    split_cells,
    time_unit,
    time_unit_in_words,
    unknown_unit,
    unread_length,
    without_unit,
)
from vio.records import Orientations

_QUATERNION = re.compile(
    r"(?:q|quat|quaternion|rot|rotation|att|attitude|orientation)[a-z]*?([wxyz])|"
    r"[a-z]*(?:orientation|quaternion|quat)([wxyz])"
)
# what stands before the letter of a component
_POSITION_STEMS = ("position", "translation", "pos", "trans", "p", "t")
_QUATERNION_STEMS = (
    *("orientation", "quaternion", "rotation", "attitude"),
    *("quat", "rot", "att", "q"),
)
_MAX_OTHER_STEM = 6  # letters of another name of a position
_OTHER = re.compile(
    r"^(?:v|b|w(?!orld)|a|g(?!t$|round)|om|ang|lin|gyr|acc|std|cov|sig|euler|roll|pitch|yaw)"
)
_OF_A_POSITION = frozenset(
    ("std", "stddev", "cov", "var", "sigma", "err", "error", "vel", "velocity")
)
# what stands where a quaternion would, and is none
_NO_QUATERNION = re.compile(
    r"roll|pitch|yaw|heading|euler|omega|kappa|azimuth|vel|speed|^v|status|std|cov"
)
# components of a position on the earth, of right-handed frames
_EAST, _NORTH, _UP, _DOWN, _HEIGHT = (
    re.compile(rf"(?:p|pos|position|local|utm|enu|ned)?(?:{name})")
    for name in (
        "east(?:ing)?",
        "north(?:ing)?",
        "up",
        "down",
        "alt(?:itude)?|height|elev(?:ation)?",
    )
)
_X = re.compile("x")
_Y = re.compile("y")
_ON_EARTH = (
    (_EAST, _NORTH, _UP),
    (_NORTH, _EAST, _DOWN),
    (_EAST, _NORTH, _HEIGHT),
    (_X, _Y, _HEIGHT),
)
# the letter of an axis before what it is, as of X/East; some call x what points north
_ALSO_ON_EARTH = re.compile(r"^[xyz]/(?=(?:east|north|alt)[a-z]*$)")
# a component by its number, as position[0] or q_3
_NUMBERED = re.compile(r"([a-z][a-z_. ]*?)[\[(_. ]?([0-4])[\])]?")
_POSITION_ALONE = re.compile(r"(?:p|t|pos|position|trans|translation|xyz)")
_QUATERNION_ALONE = re.compile(r"(?:q|quat|quaternion|rot|rotation|att|attitude|orientation)")
# a component with the names of its frames behind, as tx_world_device
_OF_FRAMES = re.compile(r"([tpq][xyzw])_[a-z]+_[a-z]+")
# whole seconds of a stamp, and the rest of it in the next column, as header.stamp.sec has them
_SECONDS = re.compile(r"(.*?)(?:secs?|seconds?)")
_NANOSECONDS = re.compile(r"(.*?)(?:n|nano)(?:secs?|seconds?)")
# the groups of OpenVINS's state: the quaternion, JPL's from the world to the IMU, is Hamilton's
# from the IMU to the world in numbers
_STATE = re.compile(r"timestamp\(s\) q p v bg ba\b")
_STATE_COLUMNS = 17  # of the time and these
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
    names_stamp: bool = False  # whether a header names the column of the stamps
    notes: tuple[str, ...] = ()  # about the unit of the positions


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
        DataError: a header states motions between two times, or units of length that are not read.
    """
    if count >= _STATE_COLUMNS and any(_STATE.match(text) for text in headers):
        return PoseColumns(0, (5, 6, 7), (1, 2, 3, 4), "stated", "s", names_stamp=True)
    columns = (
        _named_columns(cells, w_first=w_first) for cells in reversed(_cells_of(headers, count))
    )
    return next((found for found in columns if found is not None), None)


def _cells_of(headers: Sequence[str], count: int) -> list[list[str]]:
    """Return the cells of those headers that name every column."""
    return [cells for text in headers if (cells := header_cells(text, count))]


def are_geographic(headers: Sequence[str]) -> bool:
    """Return whether the last header of a table names latitude and longitude."""
    cells = split_cells(headers[-1].lower()) if headers else []
    parts = [part for cell in cells for part in without_unit(cell).split("/")]
    names = [re.sub(r"[^a-z]", "", part) for part in parts]
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
        DataError: the header states motions between two times, or units of length that are not
            read.
    """
    quaternion, orientations = _quaternion(cells, w_first=w_first)
    position = _position(cells, quaternion or (), by_any_name=quaternion is not None)
    if position is None:
        return None
    names = [_letters(without_unit(cell)) for cell in cells]
    _check_absolute(names)
    to_metres, notes = _to_metres([cells[k] for k in position])
    if quaternion is None and not _are_positions_alone(names, position):
        if to_metres != 1.0:
            raise DataError(
                "its header states a unit of the position, and names no quaternion behind it; name its "
                "columns qx, qy, qz, qw"
            )
        return None
    a, b, c = position
    if quaternion is None:
        of_turn = None
        orientations = "none"
    else:
        x, y, z, w = quaternion
        of_turn = (x, y, z, w)
    named_stamp = _stamp_column(names)
    stamp = named_stamp or 0
    after = stamp + 1
    unit = time_unit(cells[stamp])
    nanoseconds = None
    if _is_rest(names[stamp : after + 1]):
        unit = "s"
        nanoseconds = after
    return PoseColumns(
        *(stamp, (a, b, c), of_turn, orientations, unit, to_metres, nanoseconds),
        names_stamp=named_stamp is not None,
        notes=notes,
    )


def _is_rest(names: Sequence[str]) -> bool:
    """Return whether the second of two columns has the nanoseconds of the first one's seconds: of the
    same name before them.
    """
    if len(names) < 2:
        return False
    seconds = _SECONDS.fullmatch(names[0])
    rest = _NANOSECONDS.fullmatch(names[1])
    return seconds is not None and rest is not None and seconds[1] == rest[1]


def _quaternion(
    cells: Sequence[str], *, w_first: bool
) -> tuple[Sequence[int] | None, Orientations]:
    """Return the columns of x, y, z, w of a quaternion, and whether the header states their order;
    None: it names none.
    """
    names = [without_unit(cell) for cell in cells]
    groups = _components(names, _QUATERNION_STEMS, "xyzw")
    for stem, columns in groups.items():
        if stem and (stem in _QUATERNION_STEMS or _QUATERNION.fullmatch(f"{stem}x")):
            return columns, "stated"
    numbered, orientations = _numbered_quaternion(cells, w_first=w_first)
    bare = groups.get("")
    if numbered is None and bare is not None:
        all_bare = [k for k, name in enumerate(names) if _letters(name) in ("w", "x", "y", "z")]
        if _position(cells, all_bare, by_any_name=False) is not None:
            return bare, "stated"
    return numbered, orientations


def _position(
    cells: Sequence[str], quaternion: Sequence[int], *, by_any_name: bool
) -> Sequence[int] | None:
    """Return the columns of a position: x, y, z by name, by number, or on the earth; None: a header
    names none.

    Args:
        cells: of the header.
        quaternion: its columns.
        by_any_name: whether other words than those of a position may stand before x, y and z.
    """
    lengths = [
        ""
        if k in quaternion
        else _ALSO_ON_EARTH.sub("", without_unit(cell, (*LENGTH_UNITS, *UNREAD_LENGTHS)))
        for k, cell in enumerate(cells)
    ]
    groups = _components(lengths, _POSITION_STEMS, "xyz")
    known = [columns for stem, columns in groups.items() if stem in _POSITION_STEMS]
    numbers = _numbered(cells, _POSITION_ALONE)
    found = [groups.get(""), *known]
    found += [[numbers[n] for n in way] for way in ("012", "123") if set(way) <= set(numbers)]
    letters = [_letters(length) for length in lengths]
    for way in _ON_EARTH:
        columns = [[k for k, name in enumerate(letters) if part.fullmatch(name)] for part in way]
        if all(columns):
            found.append([k for k, *_ in columns])
    if by_any_name:
        found += [
            columns
            for stem, columns in groups.items()
            if len(stem) <= _MAX_OTHER_STEM and not _OTHER.match(stem)
        ]
    return next((columns for columns in found if columns), None)


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
    times = [name for name in names if _is_time(name)]
    if any(name.startswith(("source", "from")) for name in times) and any(
        name.startswith(("dest", "target", "to")) for name in times
    ):
        raise DataError(
            "its header names two times a row, as of motions from one to the other; multiply them, and "
            "give the poses from one common start"
        )


def _are_positions_alone(names: Sequence[str], position: Sequence[int]) -> bool:
    """Return whether no quaternion of other names can follow a position."""
    behind = names[max(position) + 1 :][:4]
    return len(behind) < 4 or any(_NO_QUATERNION.search(name) for name in behind)


def _to_metres(cells: Sequence[str]) -> tuple[float, tuple[str, ...]]:
    """Return the factor to metres of the unit that a header states of a position, and notes.

    Raises:
        DataError: it states several, or one that is not read.
    """
    for cell in cells:
        unread = unread_length(cell)
        if unread is not None:
            raise DataError(
                f"its header states positions in {unread!r} ({', '.join(cells)}), which is not read; "
                "convert them to metres"
            )
    stated = {factor_of(cell, LENGTH_UNITS) for cell in cells} - {None}
    if len(stated) > 1:
        raise DataError(
            f"its header states several units of the position ({', '.join(cells)}); write all in one"
        )
    factor = next(iter(stated), None)
    named = ", ".join(cells)
    if factor is None:
        words = [word for cell in cells if (word := unknown_unit(cell, LENGTH_UNITS))]
        if not words or words[0].isdigit():
            return 1.0, ()
        return 1.0, (f"doubtful: the unit {words[0]!r} of {named} is not known; read as metres",)
    if factor == 1.0:
        return 1.0, ()
    return factor, (f"the positions {named} are converted to metres, by {factor:g}",)


def _letters(name: str) -> str:
    """Return the letters of a column's name, without the names of frames behind a component."""
    return re.sub(r"[^a-z]", "", _without_frames(name))


def _without_frames(name: str) -> str:
    of_frames = _OF_FRAMES.fullmatch(name.strip())
    return name if of_frames is None else of_frames[1]


def _stamp_column(names: Sequence[str]) -> int | None:
    """Return the column of the times; that of a message goes before that of its recording. None:
    none is named.
    """
    times = [k for k, name in enumerate(names) if _is_time(name)]
    of_messages = [k for k in times if "headerstamp" in names[k]]
    return next(iter(of_messages + times), None)


def _is_time(name: str) -> bool:
    return name in ("t", "sec", "secs", "seconds", "ns", "nsec") or bool(
        re.search(r"time|stamp", name)
    )


def _components(
    names: Sequence[str], stems: Sequence[str], wanted: str
) -> dict[str, Sequence[int]]:
    """Return the columns of components, by what stands before their letters (nothing: they are
    bare), in the order of the names; all of one quantity have the same there, but for a bare w.

    Args:
        names: of columns, without units.
        stems: words of which one is enough, whatever names of frames stand beside it.
        wanted: the letters of the components.
    """
    found: dict[str, dict[str, int]] = {}
    words = [_words_of(name) for name in names]
    for k, parts in enumerate(words):
        if not parts or parts[-1][-1] not in wanted or _OF_A_POSITION & set(parts):
            continue
        before = [part for part in (*parts[:-1], parts[-1][:-1]) if part]
        columns = found.setdefault(_stem(before, stems), {})
        of_same = columns.setdefault(parts[-1][-1], k)
        if len("".join(words[of_same])) > len("".join(parts)):  # of a reference, or an estimate
            columns[parts[-1][-1]] = k
    bare_w = {c: k for c, k in found.get("", {}).items() if c == "w"}
    whole = {stem: {**bare_w, **columns} for stem, columns in found.items()}
    return {
        stem: [columns[c] for c in wanted]
        for stem, columns in whole.items()
        if set(columns) >= set(wanted)
    }


def _words_of(name: str) -> list[str]:
    """Return the words of a column's name; behind a bracket that another column closes."""
    return re.findall(r"[a-z]+", re.sub(r".*[\[(]", "", _without_frames(name)))


def _stem(before: Sequence[str], stems: Sequence[str]) -> str:
    """Return the word of these stems in what stands before a component, else all of it."""
    joined = "".join(before)
    known = [word for word in before if word in stems]
    known += [stem for stem in stems if len(stem) > 2 and joined.endswith(stem)]
    return known[0] if known else joined


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
