"""Messages that `BagWriter` makes, published."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from vio.datasets.bags.writer import BagWriter
from vio.ros2.transport import Quality, Transport


class _Published:
    """Takes the place of a bag: each topic is advertised with its first message, or before."""

    def __init__(self, transport: Transport, qualities: Mapping[str, Quality], default: Quality) -> None:
        self._transport, self._qualities, self._default = transport, qualities, default
        self._topics: dict[str, Callable[[bytes], None]] = {}

    def add_connection(self, topic: str, msgtype: str, **_: Any) -> Callable[[bytes], None]:
        if topic not in self._topics:
            self._topics[topic] = self._transport.advertise(topic, msgtype, self._qualities.get(topic, self._default))
        return self._topics[topic]

    def write(self, connection: Callable[[bytes], None], timestamp: int, data: bytes | memoryview) -> None:
        connection(bytes(data))


def publisher(
    transport: Transport, topics: Mapping[str, str], *, latched: tuple[str, ...] = (), default: Quality = "reliable"
) -> BagWriter:
    """Return what makes and publishes messages.

    Args:
        transport: of the graph.
        topics: advertised at once, with their types; others are with their first message.
        latched: topics whose last message a late subscriber gets, besides /tf_static.
        default: quality of the other topics.
    """
    sink = _Published(transport, dict.fromkeys(("/tf_static", *latched), "latched"), default)
    for topic, kind in topics.items():
        sink.add_connection(topic, kind)
    return BagWriter(sink)
