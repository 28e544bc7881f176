"""Times that are written as dates, one a line: those of KITTI's raw drives."""

from __future__ import annotations

import re
from datetime import datetime, timedelta, timezone
from pathlib import Path

from vio.errors import DataError
from vio.files.text import check_increasing, text_lines
from vio.records import NS_PER_S, IntArray

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_MAX_SINCE = timedelta(days=100_000)  # so that nanoseconds fit 64 bits


def is_date(text: str) -> bool:
    """Whether a line begins as '2011-09-26 14:02:25' does."""
    return re.match(r"\d{4}-\d{2}-\d{2}[ T]", text.strip()) is not None


def drive_times(path: Path, numbers: IntArray) -> IntArray:
    """Read times in nanoseconds since 1970 (F,) of images with frame numbers (F,).

    The file holds one line an image, or one for each frame of the drive that the images are a part of.

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
            f"{path} holds {len(lines)} times for {len(numbers)} images up to number {numbers[-1]}; there must be one "
            "line an image, or one for each frame of the drive"
        )
    times = [_parse_date(lines[row][1], path, lines[row][0]) for row in rows]
    return check_increasing(times, lambda k: f"{path}, line {lines[rows[k]][0]}")


def _parse_date(text: str, path: Path, number: int) -> int:
    """Parse '2011-09-26 14:02:25.951199337' as UTC, to nanoseconds since 1970."""
    whole, _, fraction = text.strip().partition(".")
    try:
        since = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=timezone.utc) - _EPOCH
        if not re.fullmatch(r"\d{0,9}", fraction) or abs(since) > _MAX_SINCE:
            raise ValueError(text)
    except ValueError as error:
        raise DataError(
            f"{path}, line {number}: {text.strip()[:40]!r} is no time of the form '2011-09-26 14:02:25.951199337'"
        ) from error
    return since // timedelta(seconds=1) * NS_PER_S + int(fraction.ljust(9, "0") or 0)
