"""Stamps of the messages in recordings of RealSense's SDK.

Its older recorder (`.bag`) writes the time of a frame into the header of its message. The one of
librealsense 2.59 (`.db3`) writes the time of recording there, after exposure and transfer; the time
of the frame is text of another topic, `…/image/metadata` or `…/imu/metadata`, recorded at the same
time: `Frame number=1;timestamp_domain=Hardware Clock;system_time=0.000000;timestamp=1005.000000`,
in milliseconds. Seen in files that librealsense 2.59.1 wrote. The time of an image is that of its
readout; how long before it the middle of the exposure was, is the difference of two more entries.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from vio.records import IntArray

TEXT = "std_msgs/msg/String"
_DATA = re.compile(r"(/device_\d+/sensor_\d+/[^/]+/(?:image|imu))/data(?:/compressed)?")
_TIME = re.compile(rb"(?:^|[;\0])timestamp=(\d+)(?:\.(\d+))?(?:[;\0]|$)")
# microseconds of one clock of the device
_READOUT = re.compile(rb"(?:^|[;\0])Frame Timestamp=(\d+)(?:[;\0]|$)")
_MIDDLE = re.compile(rb"(?:^|[;\0])Sensor Timestamp=(\d+)(?:[;\0]|$)")
_MS_DIGITS = 6  # of a millisecond in nanoseconds
NOTE = (
    "the headers of RealSense's recorder have the times of recording; the times of the frames are "
    "taken, as its metadata state them"
)


@dataclass(frozen=True, slots=True)
class SdkStamps:
    """Times of recording (N,), in order, and stamps (N,) of the messages of a topic, ns."""

    logged_ns: IntArray
    stamp_ns: IntArray

    def at(self, logged_ns: int) -> int | None:
        """Return the stamp of the message that was recorded at a time; None: it has none."""
        k = int(np.searchsorted(self.logged_ns, logged_ns))
        if k == len(self.logged_ns) or self.logged_ns[k] != logged_ns:
            return None
        return int(self.stamp_ns[k])


def metadata_topics(topics: Mapping[str, str]) -> dict[str, str]:
    """Return the topic of the metadata of each data topic, by the types of all topics; empty where
    a data topic has none.
    """
    found: dict[str, str] = {}
    for name in topics:
        stream = _DATA.fullmatch(name)
        if stream is not None:
            found[name] = f"{stream[1]}/metadata"
    if not all(topics.get(name) == TEXT for name in found.values()):
        return {}
    return found


def sdk_stamps(messages: Iterable[tuple[int, bytes]]) -> SdkStamps:
    """Return the stamps of a topic from its metadata, given as times of recording and data; of
    images the middle of the exposure, where the metadata state it.

    Raises:
        ValueError: a message states no time.
    """
    rows: list[tuple[int, int, int]] = []
    for logged_ns, data in messages:
        time = _TIME.search(data)
        if time is None:
            raise ValueError(f"no timestamp in {data[:80]!r}")
        part = (time[2] or b"").ljust(_MS_DIGITS, b"0")[:_MS_DIGITS]
        stamp_ns = int(time[1]) * 10**_MS_DIGITS + int(part)
        rows.append((logged_ns, stamp_ns, _half_exposure_ns(data)))
    rows.sort()
    table = np.array(rows, dtype=np.int64).reshape(-1, 3)
    logged, stamps, halves = table.T
    if len(stamps) < 2:
        return SdkStamps(logged, stamps)
    possible = (halves >= 0) & (halves <= 0.5 * np.median(np.diff(stamps)))  # of one clock
    return SdkStamps(logged, stamps - np.where(possible, halves, 0))


def _half_exposure_ns(data: bytes) -> int:
    """Return how long before its readout the middle of an image's exposure was; 0: not stated."""
    readout = _READOUT.search(data)
    middle = _MIDDLE.search(data)
    if readout is None or middle is None:
        return 0
    return 1000 * (int(readout[1]) - int(middle[1]))
