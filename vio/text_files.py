"""Text files both ways: numbered lines, exact digits, and clocks in integer nanoseconds that only increase."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.records import NS_PER_S, IntArray

INT64_MAX = 2**63 - 1


def text_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a text file with their numbers from 1, blank lines at its end dropped.

    Raises:
        DataError: the file is missing or is no text.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file ({error.reason}); give the original file") from error
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}; give a readable file") from error
    while lines and not lines[-1].strip():
        lines.pop()
    return list(enumerate(lines, start=1))


def read_numbers(path: Path, columns: int, *, separator: str | None = None, skip: int = 0) -> FloatArray:
    """Read a text table of numbers (N, columns), skipping the first `skip` lines and blank ones at the end.

    Raises:
        DataError: the file cannot be read, or a line holds something else; the message names the line.
    """
    rows: list[list[float]] = []
    for number, line in text_lines(path)[skip:]:
        fields = line.split(separator)
        if len(fields) != columns:
            raise DataError(f"{path}, line {number}: {len(fields)} values where {columns} belong; mend that line")
        try:
            rows.append([float(value) for value in fields])
        except ValueError as error:
            raise DataError(f"{path}, line {number}: not a number ({error}); write plain decimals") from error
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def write_text(path: Path, text: str) -> None:
    r"""Write UTF-8 with `\n` line ends on every system."""
    path.write_text(text, encoding="utf-8", newline="\n")


def exact_text(values: npt.ArrayLike, separator: str = " ") -> str:
    """The shortest decimals of numbers (any shape, row by row) that read back to the same bits."""
    return separator.join(repr(float(value)) for value in np.ravel(values))


def seconds_text(time_ns: int) -> str:
    """Decimal seconds of nanoseconds, exact to the last digit."""
    whole, rest = divmod(abs(int(time_ns)), NS_PER_S)
    return f"{'-' if time_ns < 0 else ''}{whole}.{rest:09d}"


def check_increasing(times_ns: npt.ArrayLike, where: Callable[[int], str]) -> IntArray:
    """Return times (N,) in nanoseconds that strictly increase.

    Args:
        times_ns: integers that fit 64 bits.
        where: names the entry of a given number, for the message ("times.txt, line 3").

    Raises:
        DataError: a time is not later than the one before; the message names its entry.
    """
    times = np.asarray(times_ns, dtype=np.int64)
    back = np.flatnonzero(times[1:] <= times[:-1])
    if len(back):
        k = int(back[0]) + 1
        what = "repeats" if times[k] == times[k - 1] else "runs backwards"
        now, before = seconds_text(int(times[k])), seconds_text(int(times[k - 1]))
        raise DataError(f"{where(k)}: the clock {what} ({now} s after {before} s); remove or reorder that entry")
    return times
