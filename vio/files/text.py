"""Read and write text files: numbered lines, exact digits, and increasing clocks in integer
nanoseconds.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vio.errors import DataError
from vio.files.inputs import read_input
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity
from vio.records import NS_PER_S, IntArray

INT64_MAX = int(np.iinfo(np.int64).max)
# ORB-SLAM writes nanoseconds with a point and zeros behind it
_WHOLE = re.compile(r"(\d{1,19})(?:\.0*)?")
_SIGNED = re.compile(r"([+-]?\d{1,19})(?:\.0*)?")
# what else than ASCII files of Windows have in units: ° ² ³ µ · ¹ º
_LATIN = frozenset("°²³µ·¹º")
# how files of other kinds begin
_BINARY = {
    b"\x93NUMPY": "an array of NumPy",
    b"PK\x03\x04": "a ZIP archive, as those of NumPy (.npz) and Excel",
    b"\x89HDF": "HDF5",
    b"MATLAB": "a file of MATLAB",
    b"SQLite": "a database, such as a map of vio run or a bag",
    b"\x1f\x8b": "packed with gzip",
    b"ply": "a point cloud",
    b"\x80": "a pickle of Python",
}
_PIECE: Capacity[int] = 2**16  # characters that are split into lines at a time
_ROUNDED = 0.05  # share of times that repeat the one before, as rounded ones do


def text_lines(path: Path) -> list[tuple[int, str]]:
    """Read the lines of a text file with their numbers from 1, without blank lines at its end.

    Raises:
        DataError: the file is missing or is no text.
    """
    return list(lines_of(path))


def lines_of(path: Path) -> Iterator[tuple[int, str]]:
    """Yield what `text_lines` returns: an hour of an IMU has 700,000 lines, which take 100 MB at a
    time.

    Raises:
        DataError: the file is missing or is no text.
    """
    try:
        text = _decoded(read_input(path), path)
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}; give a readable file"
        ) from error
    blank: list[tuple[int, str]] = []  # lines that are left out at the end
    for number, line in enumerate(_split_lines(text), start=1):
        if not line.strip():
            blank.append((number, line))
            continue
        if blank:
            yield from blank
            blank = []
        yield number, line


def _decoded(data: bytes, path: Path) -> str:
    """Return text in UTF-8, in UTF-16 where its mark says so, or in Latin-1 where nothing but signs
    of units tells it apart.
    """
    try:
        if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return data.decode("utf-16")
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        text = data.decode("latin-1")
        others = {letter for letter in text if not (letter.isascii() and letter >= "\t")}
        if others <= _LATIN:
            return text
        kind = next((kind for start, kind in _BINARY.items() if data.startswith(start)), None)
        remedy = "give the original file" if kind is None else f"it is {kind}: write it as text"
        raise DataError(f"{path}: not a text file ({error.reason}); {remedy}") from error


def _split_lines(text: str) -> Iterator[str]:
    """Yield `text.splitlines()`, some lines at a time."""
    start = 0
    while start < len(text):
        end = text.find("\n", start + _PIECE) + 1 or len(text)
        yield from text[start:end].splitlines()
        start = end


def read_numbers(path: Path, columns: int) -> FloatArray:
    """Read a text table of numbers (N, columns) between white space, without blank lines at the
    end.

    Raises:
        DataError: the file cannot be read, or a line holds something else; the message names the
            line.
    """
    rows: list[list[float]] = []
    for number, line in text_lines(path):
        fields = line.split()
        if len(fields) != columns:
            raise DataError(
                f"{path}, line {number}: {len(fields)} values instead of {columns}; correct that "
                "line"
            )
        try:
            rows.append([float(value) for value in fields])
        except ValueError as error:
            raise DataError(
                f"{path}, line {number}: not a number ({error}); write plain decimals"
            ) from error
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def write_text(path: Path, text: str) -> None:
    r"""Write UTF-8 with `\n` line ends on every system."""
    path.write_text(text, encoding="utf-8", newline="\n")


def exact_text(values: npt.ArrayLike, separator: str = " ") -> str:
    """Format numbers (any shape, row by row) as the shortest decimals that read back to the same
    bits.
    """
    return separator.join(repr(float(value)) for value in np.ravel(values))


def seconds_text(time_ns: int) -> str:
    """Format nanoseconds as decimal seconds, exact to the last digit."""
    whole, remainder = divmod(abs(int(time_ns)), NS_PER_S)
    return f"{'-' if time_ns < 0 else ''}{whole}.{remainder:09d}"


# of what a counter holds, between its last and its next stamp
_NEAR_OVERFLOW = 0.01
_FEWEST_AGAIN = 10  # times that are those of the beginning


def check_increasing(times_ns: npt.ArrayLike, where: Callable[[int], str]) -> IntArray:
    """Check that times (N,) in nanoseconds strictly increase, and return them.

    Args:
        times_ns: integers that fit 64 bits.
        where: returns the location of an entry for the error message ("times.txt, line 3").

    Raises:
        DataError: a time is not later than the one before; the message names its entry.
    """
    times = np.asarray(times_ns, dtype=np.int64)
    back = np.flatnonzero(times[1:] <= times[:-1])
    if len(back):
        k = int(back[0]) + 1
        what = "runs backwards"
        if times[k] == times[k - 1]:
            what = "repeats"
        now = seconds_text(int(times[k]))
        before = seconds_text(int(times[k - 1]))
        repeated = int(np.count_nonzero(times[1:] == times[:-1]))
        remedy = (
            f"{repeated} of {len(times)} times repeat the one before, as times do that are written "
            "with too few digits; write all their digits (or the time of each entry, where a batch of "
            "them shares one)"
            if repeated > 1 + _ROUNDED * len(times)
            else _overflowed(int(times[k - 1] - times[k]))
            or _begun_again(times, k)
            or "remove or reorder that entry"
        )
        raise DataError(f"{where(k)}: the clock {what} ({now} s after {before} s); {remedy}")
    return times


def _begun_again(times_ns: IntArray, k: int) -> str | None:
    """Return the remedy where times (N,) begin anew at entry k; None: they do not."""
    length = min(k, len(times_ns) - k)
    if length < _FEWEST_AGAIN:
        return None
    if np.array_equal(times_ns[:length], times_ns[k : k + length]):
        return (
            "from there on the times are those of the beginning: it was written twice; keep one "
            "of both parts"
        )
    if times_ns[k] <= times_ns[0] and np.all(np.diff(times_ns[k : k + length]) > 0):
        return (
            "from there on the times increase from before the beginning, as of two recordings in one "
            "file: give each its own"
        )
    return None


def _overflowed(back_ns: int) -> str | None:
    """Return the remedy where a clock goes back by what a counter of 32 bits holds; None: it does
    not.
    """
    units = {"milliseconds": 10**6, "microseconds": 10**3, "nanoseconds": 1}
    for unit, unit_ns in units.items():
        whole_ns = unit_ns << 32
        if abs(back_ns - whole_ns) < _NEAR_OVERFLOW * whole_ns:
            return (
                f"a counter of 32 bits begins again there: add 2^32 {unit} to it and what follows"
            )
    return None


def whole_ns_stamps(
    texts: Sequence[str],
    where: Callable[[int], str],
    *,
    signed: bool = False,
    increasing: bool = True,
) -> IntArray:
    """Return stamps (N,) that are written as whole nanoseconds.

    Args:
        texts: one stamp each.
        where: returns the place of an entry, for messages.
        signed: whether a sign may stand before them.
        increasing: whether they must strictly increase.

    Raises:
        DataError: a stamp is another number, or not later than the one before.
    """
    form = _SIGNED if signed else _WHOLE
    times = list[int]()
    for k, text in enumerate(texts):
        found = form.fullmatch(text)
        if found is None or abs(int(found[1])) > INT64_MAX:
            remedy = "write seconds times 1e9, without a point or exponent"
            raise DataError(f"{where(k)}: {text!r} is no time in whole nanoseconds; {remedy}")
        times.append(int(found[1]))
    if increasing:
        return check_increasing(times, where)
    return np.array(times, dtype=np.int64)
