"""Which frames of a recording are used: a limited rate, a part (`--start 12s --stop 60s`), pairs
of stamps.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.errors import DataError
from vio.records import NS_PER_S, IntArray, Recording


class _StampRules(NamedTuple):
    """Which stamps belong together."""

    # of an interval that a frame may come early: cameras jitter, and 30 frames/s are rarely exactly
    # 30
    early_share: float = 0.1
    # allowed deviation of the offset between paired stamps from its median
    jitter_ns: int = 1_000_000


_STAMPS = _StampRules()


class FrameRateLimit:
    """Tells which frames of a sequence are used: those that come no sooner than an interval after
    the last one used.

    A sequence that has passed one limit passes the same limit again whole.
    """

    def __init__(self, most_hz: float | None) -> None:
        """Begin a sequence.

        Args:
            most_hz: frames a second; None: no limit.
        """
        self._least_ns = (
            0 if most_hz is None else round((1 - _STAMPS.early_share) * NS_PER_S / most_hz)
        )
        self._last_ns: int | None = None

    def takes(self, time_ns: int) -> bool:
        """Return whether a frame of this time is used; frames come in order of time."""
        if self._last_ns is not None and time_ns - self._last_ns < self._least_ns:
            return False
        self._last_ns = time_ns
        return True


def used_frames(times_ns: IntArray, most_hz: float | None) -> IntArray:
    """Return the numbers (G,) of the frames of a recording that a limit lets through, counted from
    the first of all.

    Args:
        times_ns: of all frames (F,), increasing.
        most_hz: frames a second; None: no limit.
    """
    limit = FrameRateLimit(most_hz)
    return np.flatnonzero([limit.takes(t) for t in times_ns.tolist()])


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


def frames_between(
    recording: Recording, start: int | Seconds, stop: int | Seconds | None
) -> tuple[int, int | None]:
    """Return the first frame and the frame after the last one (None: to the end) of bounds in
    frames or seconds.

    The start is the first frame at or after its time, the stop the first one at or after its own.

    Raises:
        DataError: the start is after the last frame.
    """
    first = _frame(recording, start)
    count = len(recording.frame_times_ns)
    if isinstance(start, Seconds) and first >= count:
        length_s = float(recording.frame_times_ns[-1] - recording.frame_times_ns[0]) / NS_PER_S
        raise DataError(
            f"{recording.path}: --start {start.seconds:g}s is after its last frame at "
            f"{length_s:.3f} s"
        )
    return first, None if stop is None else _frame(recording, stop)


def _frame(recording: Recording, bound: int | Seconds) -> int:
    if isinstance(bound, int):
        return bound
    times = recording.frame_times_ns
    return int(np.searchsorted(times, times[0] + round(bound.seconds * NS_PER_S)))


PAIRED_NS = 3_000_000  # stamps further apart belong to different exposures


def pair_stamps(left_ns: IntArray, right_ns: IntArray) -> tuple[IntArray, IntArray]:
    """Indices (F,), (F,) of paired stamps: equal ones, or nearest ones at a small, constant
    offset.
    """
    _, equal_a, equal_b = np.intersect1d(left_ns, right_ns, assume_unique=True, return_indices=True)
    b = nearest(left_ns, right_ns)
    a = np.arange(len(left_ns))
    offset = right_ns[b] - left_ns
    near = (np.abs(offset) < PAIRED_NS) & (nearest(right_ns, left_ns)[b] == a)
    if 2 * len(equal_a) >= near.sum():
        return equal_a.astype(np.int64), equal_b.astype(np.int64)
    steady = near & (np.abs(offset - np.median(offset[near])) <= _STAMPS.jitter_ns)
    return a[steady], b[steady]


def paired(
    left_ns: IntArray, right_ns: IntArray, names: Sequence[str], where: Path
) -> tuple[IntArray, IntArray, list[str]]:
    """Return what `pair_stamps` does of the images of two cameras, and notes about images that
    differ or are alone.

    Raises:
        DataError: no image of the left camera has one of the right camera.
    """
    a, b = pair_stamps(left_ns, right_ns)
    if not len(a):
        left, right = (
            f"{name} ({t[0]} to {t[-1]} ns)"
            for name, t in zip(names, (left_ns, right_ns), strict=True)
        )
        raise DataError(
            f"{where}: no image of {left} has one of {right} within {PAIRED_NS / 1e6:g} ms; the "
            "cameras must "
            "be synchronised, and their stamps of one clock"
        )
    notes = []
    alone = len(left_ns) - len(a), len(right_ns) - len(b)
    if any(alone):
        notes.append(
            f"{alone[0]} images of {names[0]} and {alone[1]} of {names[1]} have no partner and are "
            "skipped"
        )
    if np.any(right_ns[b] != left_ns[a]):
        offset_ms = float(np.median(right_ns[b] - left_ns[a])) / 1e6
        notes.append(
            f"the stamps of {names[1]} differ from those of {names[0]} (median {offset_ms:+.3f} "
            "ms); each left image "
            "is paired with the nearest right one"
        )
    return a, b, notes


def nearest(of: IntArray, among: IntArray) -> IntArray:
    """Index (N,) of the nearest of sorted times (M,) for each of (N,) times."""
    after = np.clip(np.searchsorted(among, of), 1, max(len(among) - 1, 1))
    after = np.minimum(after, len(among) - 1)
    before = np.maximum(after - 1, 0)
    to_after = np.abs(among[after] - of)
    to_before = np.abs(of - among[before])
    return np.where(to_after < to_before, after, before)
