"""What the node needs of ROS 2: messages as bytes, in and out, and which topics there are."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from typing import Any, Literal, Protocol, TypeAlias

from vio.datasets.bags.writer import BagWriter
from vio.errors import MissingDependencyError, extra_text

# "sensor": unreliable, as drivers publish; "reliable": none is lost, and the sender waits for a
# slow receiver; "latched": whoever comes late gets the last message.
Quality: TypeAlias = Literal["sensor", "reliable", "latched"]
TransportName: TypeAlias = Literal["auto", "dds", "rclpy"]


class Transport(Protocol):
    """A participant of the graph.

    Messages are CDR with its header of four bytes; types as in sensor_msgs/msg/Image.
    """

    def subscribe(
        self, topic: str, kind: str, take: Callable[[bytes], None], quality: Quality
    ) -> None:
        """Hand the messages of a topic to a function, which `spin` calls."""

    def advertise(self, topic: str, kind: str, quality: Quality) -> Callable[[bytes], None]:
        """Return the function that publishes on a topic; it may be called from any thread."""

    def subscribers(self, topic: str) -> int:
        """Return how many others receive what is published on a topic that was advertised here."""

    def topics(self) -> Mapping[str, frozenset[str]]:
        """Return the topics that others publish on, with their types."""

    def spin(self, timeout_s: float) -> None:
        """Hand over what has come, and wait for it for some time."""

    def close(self) -> None:
        """Leave the graph."""


def open_transport(name: TransportName = "auto", domain: int | None = None) -> Transport:
    """Join the graph: with rclpy where ROS 2 is installed, else over DDS.

    Args:
        name: "dds" and "rclpy" choose one.
        domain: the graph's number; None: that of the environment (ROS_DOMAIN_ID), or 0.

    Raises:
        MissingDependencyError: neither is installed, or not the one that is named.
    """
    if name == "rclpy" or (name == "auto" and importlib.util.find_spec("rclpy") is not None):
        from vio.ros2.rclpy_transport import RclpyTransport

        return RclpyTransport(domain)
    if importlib.util.find_spec("cyclonedds") is None:
        raise MissingDependencyError(
            "ROS 2 needs the package cyclonedds, or an installed ROS 2 whose setup.bash was "
            f"sourced; {extra_text('ros2')}"
        )
    from vio.ros2.dds import DdsTransport

    return DdsTransport(domain)


class _Published:
    """Takes the place of a bag: each topic is advertised with its first message, or before."""

    def __init__(
        self, transport: Transport, qualities: Mapping[str, Quality], default: Quality
    ) -> None:
        self._transport = transport
        self._qualities = qualities
        self._default = default
        self._topics: dict[str, Callable[[bytes], None]] = {}

    def add_connection(self, topic: str, msgtype: str, **_: Any) -> Callable[[bytes], None]:
        if topic not in self._topics:
            self._topics[topic] = self._transport.advertise(
                topic, msgtype, self._qualities.get(topic, self._default)
            )
        return self._topics[topic]

    def write(
        self, connection: Callable[[bytes], None], timestamp: int, data: bytes | memoryview
    ) -> None:
        connection(bytes(data))


def publisher(
    transport: Transport,
    topics: Mapping[str, str],
    *,
    latched: tuple[str, ...] = (),
    default: Quality = "reliable",
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
