"""By how much usual clocks differ: leap seconds, time zones, units, and clocks that start with a
device.
"""

from __future__ import annotations

from typing import NamedTuple

from vio.records import NS_PER_S

_UNITS = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # of times that were read as seconds
# seconds by which one clock is ahead of another, since 2017
_LEAP_SECONDS = {18: "GPS time and UTC", 37: "TAI and UTC", 19: "TAI and GPS time"}


class _EpochRules(NamedTuple):
    """When a difference of usual clocks explains that two spans do not overlap."""

    overlap: float = 0.9  # share of the shorter span that both cover then
    max_hours: int = 14  # of a time zone
    # s: whole hours explain any difference of longer spans
    max_span_s: float = 1800.0
    # of the longer span over the shorter one, where a unit explains it
    alike_spans: float = 3.0
    # s: a clock that begins with its device, and one that counts from 1970 (after 1990)
    since_start_s: float = 1e8
    since_1970_s: float = 6.3e8


_EPOCHS = _EpochRules()


def epoch_hint(own_ns: tuple[int, int], other_ns: tuple[int, int], other: str) -> str:
    """Return why the first and last stamps of two streams may not overlap, as the end of a message;
    empty where no usual clock explains it.

    Args:
        own_ns: of the stream whose clock is kept.
        other_ns: of the other one.
        other: its name.
    """
    if own_ns[0] > _EPOCHS.since_1970_s * NS_PER_S and (
        0 <= other_ns[0] < _EPOCHS.since_start_s * NS_PER_S
    ):
        return (
            f"; the times of {other} count from the start of a device or of the recording, not from "
            "1970"
        )
    for unit, factor in _UNITS.items():
        scaled = (round(factor * other_ns[0]), round(factor * other_ns[1]))
        spans = sorted(last - first for first, last in (own_ns, scaled))
        alike = 0 < spans[1] < _EPOCHS.alike_spans * spans[0]
        if alike and _share_of_overlap(own_ns, scaled, 0) >= _EPOCHS.overlap:
            return (
                f"; they would overlap if the times of {other} were in {unit}: state the unit in a "
                f"header, as '# time [{unit}]'"
            )
    span_s = min(last - first for first, last in (own_ns, other_ns)) / NS_PER_S
    hours = {3600 * h: "time zones" for h in range(1, _EPOCHS.max_hours + 1)}
    known = _LEAP_SECONDS | (hours if span_s < _EPOCHS.max_span_s else {})
    found = [
        (sign * size, clocks)
        for size, clocks in known.items()
        for sign in (1, -1)
        if _share_of_overlap(own_ns, other_ns, sign * size) >= _EPOCHS.overlap
    ]
    if not found:
        return ""
    each = " or ".join(f"{abs(s)} s ({clocks})" for s, clocks in found)
    way = "late" if found[0][0] > 0 else "early"
    return f"; they would overlap if the times of {other} were {way} by {each}"


def _share_of_overlap(own_ns: tuple[int, int], other_ns: tuple[int, int], late_s: int) -> float:
    """Return which share of the shorter span both cover where the other is late."""
    late_ns = late_s * NS_PER_S
    first = max(own_ns[0], other_ns[0] - late_ns)
    last = min(own_ns[1], other_ns[1] - late_ns)
    shorter = min(own_ns[1] - own_ns[0], other_ns[1] - other_ns[0])
    return (last - first) / max(shorter, 1)
