"""The order in which a bag stores its messages, for recordings whose own clock was set back.

Readers of bags sort messages by the times at which they were recorded, which is that order but
where the recorder's clock was set back: there two periods interleave. A bag that a tool wrote topic
after topic is stored in no order of time, either, but within each topic it is.
"""

from __future__ import annotations

import heapq
import importlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

STEP_NS = 10_000_000  # threads that write to one bag disorder it by less
_FEW_CHUNKS = 4  # of an MCAP file that is looked at message by message


def is_set_back(reader: Any) -> bool:
    """Return whether the times of recording of some topic go back in the order of storage."""
    return any(_goes_back(times) for times in _times_by_topic(reader))


def as_stored(
    reader: Any, connections: Sequence[Connection]
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield connection, time of recording and data of messages in the order of storage.

    Args:
        reader: one of rosbags' readers, opened.
        connections: of the messages.
    """
    from rosbags.rosbag1 import Reader as Reader1

    if isinstance(reader, Reader1):
        yield from _as_stored_in_ros1(reader, connections)
        return
    unpacked = _unpacking(reader)
    for storage in _storages(reader):
        names = {(c.topic, c.msgtype): c for c in connections}
        own = [c for c in storage.connections if (c.topic, c.msgtype) in names]
        for connection, logged_ns, data in _stored(storage, own):
            yield names[connection.topic, connection.msgtype], logged_ns, unpacked(data)


def _unpacking(reader: Any) -> Callable[[bytes], bytes]:
    """Return what decompresses a message of a ROS 2 bag, each of which may be compressed."""
    if reader.compression_mode != "message":
        return lambda data: data
    module = importlib.import_module("rosbags.rosbag2.reader")
    zstd: Any = vars(module)["zstd"]  # Python's own, or that of a package

    return lambda data: bytes(zstd.decompress(data))


def _times_by_topic(reader: Any) -> Iterable[Sequence[int]]:
    """Yield the times of recording of each topic in the order of storage, or bounds of them."""
    from rosbags.rosbag1 import Reader as Reader1

    if isinstance(reader, Reader1):
        for entries in reader.indexes.values():
            yield [e.time for e in sorted(entries, key=lambda e: (e.chunk_pos, e.offset))]
        return
    for storage in _storages(reader):
        if hasattr(storage, "dbconn"):
            rows = storage.dbconn.execute("SELECT topic_id, timestamp FROM messages ORDER BY id")
            yield from _grouped(rows)
        elif len(storage.chunks) > _FEW_CHUNKS:
            yield [t for c in storage.chunks for t in (c.message_start_time, c.message_end_time)]
        else:
            scan = storage.messages_scan(storage.connections)
            yield from _grouped((connection.id, logged_ns) for connection, logged_ns, _ in scan)


def _grouped(rows: Iterable[tuple[int, int]]) -> Iterable[Sequence[int]]:
    """Return the times of each topic."""
    times: dict[int, list[int]] = {}
    for topic, time_ns in rows:
        times.setdefault(topic, []).append(time_ns)
    return times.values()


def _goes_back(times: Sequence[int]) -> bool:
    values = np.array(times, dtype=np.int64)
    return bool((np.diff(values) < -STEP_NS).any())


def _storages(reader: Any) -> Sequence[Any]:
    """Return the files of a ROS 2 bag."""
    return getattr(reader.storage, "storages", None) or [reader.storage]


def _stored(
    storage: Any, connections: Sequence[Connection]
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield the messages of one file of a ROS 2 bag in the order of storage."""
    by_id = {c.id: c for c in connections}
    if not hasattr(storage, "dbconn"):
        yield from storage.messages_scan(connections)
        return
    rows = storage.dbconn.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id")
    for topic, logged_ns, data in rows:
        if topic in by_id:
            yield by_id[topic], logged_ns, data


def _as_stored_in_ros1(
    reader: Any, connections: Sequence[Connection]
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield the messages of a ROS 1 bag, whose reader takes them in the order of its index."""
    lists = [
        sorted(reader.indexes[c.id], key=lambda entry: (entry.chunk_pos, entry.offset))
        for c in connections
    ]
    merged = list(heapq.merge(*lists, key=lambda entry: (entry.chunk_pos, entry.offset)))
    first = connections[0]
    kept = reader.indexes[first.id]
    reader.indexes[first.id] = merged
    try:
        yield from reader.messages([first])
    finally:
        reader.indexes[first.id] = kept
