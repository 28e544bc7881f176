"""A part of a recording in frames or in seconds: `--start 12s --stop 60s`."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from vio.errors import DataError
from vio.records import NS_PER_S, Recording


@dataclass(frozen=True, slots=True)
class Seconds:
    """A time after the first frame."""

    seconds: float


def parse_bound(text: str) -> int | Seconds:
    """Parse a frame number ("240") or a time after the first frame ("12s", "12.5s").

    Raises:
        ValueError: it is neither.
    """
    if found := re.fullmatch(r"(\d+(?:\.\d+)?|\.\d+)\s*s", text.strip()):
        return Seconds(float(found[1]))
    return int(text)


def frames_between(recording: Recording, start: int | Seconds, stop: int | Seconds | None) -> tuple[int, int | None]:
    """Return the first frame and the frame after the last one (None: to the end) of bounds in frames or seconds.

    The start is the first frame at or after its time, the stop the first one at or after its own.

    Raises:
        DataError: the start is after the last frame.
    """
    first = _frame(recording, start)
    count = len(recording.frame_times_ns)
    if isinstance(start, Seconds) and first >= count:
        length_s = float(recording.frame_times_ns[-1] - recording.frame_times_ns[0]) / NS_PER_S
        raise DataError(f"{recording.path}: --start {start.seconds:g}s is after its last frame at {length_s:.3f} s")
    return first, None if stop is None else _frame(recording, stop)


def _frame(recording: Recording, bound: int | Seconds) -> int:
    if isinstance(bound, int):
        return bound
    times = recording.frame_times_ns
    return int(np.searchsorted(times, times[0] + round(bound.seconds * NS_PER_S)))
