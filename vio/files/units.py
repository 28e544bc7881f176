"""The units that the headers of tables state, in the spellings that people write.

A unit stands in brackets (`wx [deg/s]`), behind the last `_`, `-`, `.`, `:` or space of a name
(`gyro_x_dps`, `time_ns`), or is a word of a comment (`gyro in deg/s`).
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping

import numpy as np

_GRAVITY = 9.80665  # m/s^2
_DEGREE = float(np.pi / 180)
# Powers of ten to nanoseconds, by the spelling without brackets.
TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "milliseconds", "millisecond"), "ms"),
    **dict.fromkeys(("us", "usec", "usecs", "micros", "microseconds", "microsecond"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosec", "nanoseconds", "nanosecond"), "ns"),
}
# Factors to rad/s and to m/s^2, by the spelling that `_plain` returns.
_DEGREES_A_SECOND = ("deg/s", "degs", "deg_s", "degps", "dps", "degree/s", "degrees/s", "degree_s")
_RADIANS_A_SECOND = ("rad/s", "rads", "rad_s", "radps", "radian/s", "radians/s", "r/s")
GYRO_UNITS: Mapping[str, float] = {
    **dict.fromkeys(_RADIANS_A_SECOND, 1.0),
    **dict.fromkeys(("mrad/s", "mrads", "mrad_s", "mradps"), 1e-3),
    **dict.fromkeys((*_DEGREES_A_SECOND, "deg", "degree", "degrees"), _DEGREE),
    **dict.fromkeys(("mdps", "mdeg/s", "mdeg_s", "mdegps", "mdegs"), 1e-3 * _DEGREE),
    **dict.fromkeys(("deg/h", "deg/hr", "deg_h", "dph"), _DEGREE / 3600),
    **dict.fromkeys(("rpm", "rev/min"), 2 * np.pi / 60),
}
ACCEL_UNITS: Mapping[str, float] = {
    **dict.fromkeys(("m/s2", "m/s/s", "mps2", "mpss", "ms2", "m_s2", "m_s_2", "meter/s2"), 1.0),
    **dict.fromkeys(("m/s",), 1.0),  # a spelling without its square
    **dict.fromkeys(("g", "gs", "gn", "g0", "gee"), _GRAVITY),
    **dict.fromkeys(("mg", "millig", "milli_g", "milli-g"), 1e-3 * _GRAVITY),
    **dict.fromkeys(("cm/s2", "cm_s2", "cmps2", "cms2", "gal"), 1e-2),
    **dict.fromkeys(("mm/s2", "mm_s2", "mmps2", "mms2"), 1e-3),
}
_OF_READINGS = frozenset((*GYRO_UNITS, *ACCEL_UNITS))
# Factors to metres.
LENGTH_UNITS: Mapping[str, float] = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 1e-2),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1e-3),
    **dict.fromkeys(("km", "kilometer", "kilometers", "kilometre", "kilometres"), 1e3),
}
# Units of length that are not read; they stand behind names.
UNREAD_LENGTHS = frozenset(
    {
        "ft",
        "foot",
        "feet",
        "in",
        "inch",
        "inches",
        "yd",
        "yard",
        "yards",
        "mi",
        "mile",
        "miles",
        "um",
        "micron",
        "microns",
        "micrometer",
        "micrometers",
        "micrometre",
        "micrometres",
        "nm",
        "dm",
        "decimeter",
        "decimeters",
        "decimetre",
        "decimetres",
    }
)
_BRACKETS = re.compile(r"[\[({<]\s*((?:[^\[\](){}<>]|[({][^(){}]*[)}])*?)\s*[\])}>]")
# a number with a decimal comma, or with no decimals
_DECIMAL_COMMA = re.compile(r"[+-]?\d+(?:,\d*)?(?:[eE][+-]?\d+)?")
_SEPARATORS = re.compile(r"[_\-.:\s,]")
_SPELLINGS = (
    (re.compile(r"[°º◦˚]"), "deg"),
    (re.compile(r"[µμ]"), "u"),
    (re.compile(r"⁻¹|\^\s*\{?-1\}?|\*\*-1"), "-1"),
    (re.compile(r"⁻²|\^\s*\{?-2\}?|\*\*-2"), "-2"),
    (re.compile(r"²|\^\s*\{?2\}?|\*\*2"), "2"),
    (re.compile(r"\b(?:seconds?|secs?)(?![a-z])"), "s"),
    (re.compile(r"\s*(?:/|\bper\b)\s*"), "/"),
    # s^-1 and s^-2 behind a unit
    (re.compile(r"[\s·*.]*s-1$"), "/s"),
    (re.compile(r"[\s·*.]*s-2$"), "/s2"),
    (re.compile(r"/\(s2\)$"), "/s2"),
)


def split_cells(text: str) -> list[str]:
    """Return the cells of a line, between commas, else semicolons, else white space.

    Commas within all numbers between semicolons, tabs or white space are decimal points; quotes
    around cells are left out.
    """
    text = text.replace('"', "")
    if "," in text:
        return _cells_with_decimal_commas(text) or _cells_between(text, ",")
    return _cells_between(text, ";") if ";" in text else text.split()


def _cells_between(text: str, separator: str) -> list[str]:
    return [cell.strip() for cell in text.split(separator)]


def _cells_with_decimal_commas(text: str) -> list[str]:
    """Return the cells between semicolons, else tabs, else white space, where all are numbers with a
    decimal comma, with points; else none.
    """
    separator = next((s for s in (";", "\t") if s in text), None)
    if separator is None:
        cells = text.split()
        if len(cells) < 2 or any(cell.endswith(",") for cell in cells):  # between commas and spaces
            return []
    else:
        cells = _cells_between(text, separator)
    if not all(_DECIMAL_COMMA.fullmatch(cell) for cell in cells):
        return []
    return [cell.replace(",", ".") for cell in cells]


def with_decimal_points(text: str) -> str | None:
    """Return a line of numbers with decimal commas, between white space, with points; None: it is
    another.
    """
    if re.search(r"[;\t]", text) or "," not in text:
        return None
    return " ".join(_cells_with_decimal_commas(text)) or None


def header_cells(text: str, columns: int) -> list[str]:
    """Return the cells of a header's line; none: it has another number of them.

    Between white space, a unit in brackets belongs to the name before it.
    """
    line = text.lstrip("#% ").strip()
    together = re.sub(r"\s+(?=[\[(])", "", line)
    together = re.sub(r"[\[(][^\])]*[\])]", lambda unit: re.sub(r"\s+", "·", unit[0]), together)
    ways = (split_cells(line), re.split(r"\t|\s{2,}", line), together.split())
    return next(([cell.strip() for cell in way] for way in ways if len(way) == columns), [])


def time_unit(cell: str) -> str | None:
    """Return the unit of a time that a header's cell states: s, ms, us or ns; None: it states none.

    A name that is a unit alone, as `nanoseconds`, states it; `s` alone does not.
    """
    text = cell.strip().lower()
    name = _plain(text).strip("#% ")
    if name in TIME_UNITS and name != "s":
        return TIME_UNITS[name]
    return next((TIME_UNITS[word] for word in _candidates(text) if word in TIME_UNITS), None)


def time_unit_in_words(comments: Iterable[str]) -> str | None:
    """Return the unit of time that comments of a file state; None: none, or several."""
    found = set[str]()
    for comment in comments:
        text = comment.lower()
        found |= {TIME_UNITS[word] for word in _in_brackets(text) if word in TIME_UNITS}
        words = re.findall(r"[a-z]+", re.sub(r"[µμ]", "u", text))
        found |= {TIME_UNITS[word] for word in words if word in TIME_UNITS and word != "s"}
        if re.search(r"\bin s$|\bin s\b[^/^]", text):
            found.add("s")
    return found.pop() if len(found) == 1 else None


def factor_of(cell: str, units: Mapping[str, float]) -> float | None:
    """Return the factor to SI units of the unit that a header's cell states; None: it states none
    of these.

    Args:
        cell: such as `gyro_x_dps` or `ax [m s^-2]`.
        units: `GYRO_UNITS` or `ACCEL_UNITS`.
    """
    return next((units[word] for word in _candidates(cell) if word in units), None)


def factor_in_words(comments: Iterable[str], units: Mapping[str, float]) -> float | None:
    """Return the factor to SI units that comments of a file state; None: none, or several.

    A bare `g` or `s` in a comment states nothing.
    """
    found = set[float]()
    for comment in comments:
        text = comment.lower()
        words = [*_in_brackets(text), *(_plain(word) for word in re.split(r"[\s,;:=]+", text))]
        found |= {units[word] for word in words if len(word) > 1 and word in units}
        if re.search(r"\bin g\b", text) and "g" in units:
            found.add(units["g"])
    return found.pop() if len(found) == 1 else None


def unknown_unit(cell: str, units: Mapping[str, float]) -> str | None:
    """Return what stands in a cell's brackets and is none of these units; None: nothing."""
    words = _in_brackets(cell)
    unknown = [word for word in words if word and word not in units and word not in "xyz012"]
    return unknown[0] if unknown else None


def unread_length(cell: str) -> str | None:
    """Return the unit of length that a cell states and that is not read; None: it states none."""
    text = cell.strip().lower()
    tails = (_plain(tail) for tail in _tails(_BRACKETS.sub("", text).strip()))
    return next((word for word in (*_in_brackets(text), *tails) if word in UNREAD_LENGTHS), None)


def without_unit(cell: str, units: Collection[str] = _OF_READINGS) -> str:
    """Return the name of a column without the unit that it states, in lower case.

    Args:
        cell: of a header.
        units: what may stand behind the name.
    """
    text = _BRACKETS.sub("", cell.lower()).strip()
    for candidate in _tails(text):
        word = _plain(candidate)
        if word in units:
            name = text[: len(text) - len(candidate)].rstrip("_-.:/ ")
            if name:
                return name
    return text


def _candidates(cell: str) -> Iterable[str]:
    """Yield what may be the unit of a cell, in the plain spelling."""
    text = cell.strip().lower()
    yield from _in_brackets(text)
    outside = _BRACKETS.sub("", text).strip()
    yield from (_plain(part) for part in (*_tails(outside), *_inner(outside)))


def _tails(text: str) -> Iterable[str]:
    """Yield the ends of a name behind its separators, the longest first."""
    starts = [match.end() for match in _SEPARATORS.finditer(text)]
    yield from (text[start:] for start in starts if start < len(text))
    if "/" in text:  # accel_x/g, but not rad/s
        yield text[text.index("/") + 1 :]


def _inner(text: str) -> Iterable[str]:
    """Yield the parts of a name between its separators, as of `acc_mg_x`."""
    yield from _SEPARATORS.split(text)[1:-1]


def _in_brackets(text: str) -> list[str]:
    return [_plain(found) for found in _BRACKETS.findall(text.lower())]


def _plain(unit: str) -> str:
    """Return a unit in one spelling: `°/s`, `deg s^-1` and `deg/sec` become `deg/s`."""
    text = unit.strip().lower()
    for pattern, spelling in _SPELLINGS:
        text = pattern.sub(spelling, text)
    return text.replace(" ", "").replace("^", "")
