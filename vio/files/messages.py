"""Rows of poses whose stamps are in two columns that no header names: seconds and nanoseconds, as
of `ros2 topic echo --csv`, which writes the names of frames behind them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from vio.errors import DataError
from vio.files.units import split_cells

_SECONDS = re.compile(r"\d{1,10}")
_NANOSECONDS = re.compile(r"\d{1,9}")
_POSE = 7  # numbers of a position and a quaternion
_COVARIANCE = 36
_TWIST = 6
# numbers of PointStamped, PoseStamped and TransformStamped, PoseWithCovarianceStamped, Odometry
_MESSAGES = (3, _POSE, _POSE + _COVARIANCE, _POSE + _TWIST + 2 * _COVARIANCE)
_NAMED = "timestamp,x,y,z,qx,qy,qz,qw"  # the order of ROS's messages
_FEWEST_DIGITS = 6  # of the largest count of nanoseconds: smaller ones are other numbers


def joined_stamps(rows: Sequence[str], path: Path, *, stated: bool) -> tuple[list[str], list[str]]:
    """Return rows whose stamps are in one column, and the header of what else is kept of them.

    Rows without such stamps are returned as they are.

    Args:
        rows: of a table, without its headers and comments.
        path: its file, for messages.
        stated: whether there are any, which name its columns then.

    Raises:
        DataError: they are messages, of another type than poses.
    """
    unchanged = list(rows), list[str]()
    if stated or not rows or not _begins(split_cells(rows[0])):
        return unchanged
    cells = [split_cells(row) for row in rows]
    names = _names_of_frames(cells[0])
    numbers = len(cells[0]) - 2 - names
    is_message = names > 0
    if not is_message and numbers != _POSE:
        return unchanged
    if not all(_begins(row) and len(row) == len(cells[0]) for row in cells):
        return unchanged
    times = [(int(row[0]), int(row[1])) for row in cells]
    is_clock = all(a <= b for a, b in pairwise(times))
    if not is_clock or max(ns for _, ns in times) < 10**_FEWEST_DIGITS:
        return unchanged
    if is_message and numbers not in _MESSAGES:
        raise DataError(
            f"{path}: holds messages as `ros2 topic echo --csv` writes them, whose {numbers} numbers are those "
            "of no pose; write those of Odometry, PoseStamped or TransformStamped"
        )
    first = 2 + names
    kept = [row[first : first + min(numbers, _POSE)] for row in cells]
    separator = "," if is_message or "," in rows[0] else " "
    joined = [
        separator.join((f"{s}.{ns:09d}", *values))
        for (s, ns), values in zip(times, kept, strict=True)
    ]
    return joined, [_NAMED] if is_message and numbers >= _POSE else []


def _begins(cells: Sequence[str]) -> bool:
    """Return whether a row begins with whole seconds and nanoseconds."""
    return (
        len(cells) > 2
        and _SECONDS.fullmatch(cells[0]) is not None
        and _NANOSECONDS.fullmatch(cells[1]) is not None
    )


def _names_of_frames(cells: Sequence[str]) -> int:
    """Return how many cells behind the stamp are no numbers."""
    count = 0
    for cell in cells[2:4]:
        try:
            float(cell)
        except ValueError:
            count += 1
        else:
            break
    return count
