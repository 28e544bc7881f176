"""Dates as people name images by and write into lists, as UTC in nanoseconds since 1970."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from vio.records import NS_PER_S, IntArray

_DAY = r"(?P<y>19\d\d|20\d\d){0}(?P<mo>0[1-9]|1[0-2]){0}(?P<d>0[1-9]|[12]\d|3[01])"
_CLOCK = r"(?P<h>[01]\d|2[0-3]){0}(?P<mi>[0-5]\d){0}(?P<s>[0-5]\d)"
# `2024-05-12_14-03-22-123456`, `20240512T140322.123`, `20240512140322123`
_PART = r"[-_.:]?"
_NAMED = re.compile(
    r"(?:[A-Za-z]+\d?[_-])?"
    + _DAY.format(r"[-_.]?")
    + r"[-_ T.]?"
    + _CLOCK.format(_PART)
    + r"(?:[-_.,]?(?P<part>\d{9}|\d{6}|\d{3}))?Z?(?:[_-][A-Za-z]+\d?)?"
)
# whose nanoseconds fit 64 bits
_WRITTEN = re.compile(
    r"(?P<day>(?:19|20|21)\d\d-\d\d-\d\d)[ T](?P<clock>\d\d:\d\d:\d\d(?:\.\d{0,9}|"
    # a decimal comma, where no commas are between the cells
    r",\d{1,9}(?=[;\t]|\s+[^,\s]|[Z+-]|$))?)"
    r"(?:Z|(?P<sign>[+-])(?P<hours>[01]\d):?(?P<minutes>[0-5]\d))?"
)


def date_ns(text: str) -> int:
    """Parse '2011-09-26 14:02:25.951199337', or with T, and Z or the zone, as of ISO 8601.

    Raises:
        ValueError: it is another form, or no date.
    """
    found = _WRITTEN.fullmatch(text.strip())
    if found is None:
        raise ValueError(text)
    written = f"{found['day']}T{found['clock'].rstrip('.').replace(',', '.')}"
    local_ns = int(np.datetime64(written, "ns").astype(np.int64))
    if found["sign"] is None:
        return local_ns
    ahead_s = 3600 * int(found["hours"]) + 60 * int(found["minutes"])
    return local_ns - int(f"{found['sign']}1") * ahead_s * NS_PER_S


def undated(line: str) -> str:
    """Return a line of a table that begins with a date of ISO 8601 with its nanoseconds since 1970
    instead; others as they are.
    """
    start = int(line[:1] == '"')
    if line[start + 4 : start + 5] != "-" or (found := _WRITTEN.match(line, start)) is None:
        return line
    rest = line[found.end() + start :]
    if line[: found.end() + start].count('"') != 2 * start or rest[:1] not in ",;\t ":
        return line
    try:
        return f"{date_ns(found[0])}{rest}"
    except ValueError:  # as of a 13th month, which its reader reports
        return line


def are_whole_dates(stems: Sequence[str]) -> bool:
    """Return whether names state dates to the second, as those of phones: 20240512_140322."""
    found = [_NAMED.fullmatch(stem) for stem in stems]
    return all(name is not None and name["part"] is None for name in found)


def dates_in_names(stems: Sequence[str]) -> IntArray | None:
    """Return the dates (N,) that names state to a fraction of a second; None: they state others."""
    times = list[int]()
    for stem in stems:
        found = _NAMED.fullmatch(stem)
        if found is None or found["part"] is None:
            return None
        day = f"{found['y']}-{found['mo']}-{found['d']}"
        clock = f"{found['h']}:{found['mi']}:{found['s']}.{found['part']}"
        try:
            times.append(int(np.datetime64(f"{day}T{clock}", "ns").astype(np.int64)))
        except ValueError:  # as of the 31st of June
            return None
    return np.array(times, dtype=np.int64)
