"""The graph by rclpy, where ROS 2 is installed and its setup.bash was sourced: with its middleware
and its settings.

The only file that imports ROS. Messages pass as bytes here too (`raw=True`), so that both ways
share all other code. Written against the reference of rclpy (Humble to Rolling); it could not be
run where this was developed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosidl_runtime_py.utilities import get_message

from vio.errors import DataError
from vio.numerics.kinds import Capacity
from vio.ros2.transport import Quality

_DEPTH: Capacity[int] = 1000  # messages that wait for `spin`, or for a slow subscriber


class RclpyTransport:
    """A node of the graph, see `Transport`."""

    def __init__(self, domain: int | None) -> None:
        self._context = Context()
        # The command line handles signals itself.
        rclpy.init(
            context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO
        )
        self._node = rclpy.create_node("vio", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._publishers: dict[str, Any] = {}

    def subscribe(
        self, topic: str, kind: str, take: Callable[[bytes], None], quality: Quality
    ) -> None:
        """Hand the messages of a topic to a function."""
        self._node.create_subscription(_type(kind), topic, take, _qos(quality), raw=True)

    def advertise(self, topic: str, kind: str, quality: Quality) -> Callable[[bytes], None]:
        """Return the function that publishes on a topic."""
        publisher = self._node.create_publisher(_type(kind), topic, _qos(quality))
        self._publishers[topic] = publisher
        return publisher.publish

    def subscribers(self, topic: str) -> int:
        """Return how many receive a topic that was advertised here."""
        return int(self._publishers[topic].get_subscription_count())

    def topics(self) -> Mapping[str, frozenset[str]]:
        """Return the topics of other nodes with their types."""
        own = self._node.get_name()
        return {
            name: frozenset(kinds)
            for name, kinds in self._node.get_topic_names_and_types()
            if any(info.node_name != own for info in self._node.get_publishers_info_by_topic(name))
        }

    def spin(self, timeout_s: float) -> None:
        """Hand over what has come: one message at least, or after the time none."""
        self._executor.spin_once(timeout_sec=timeout_s)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)


def _type(kind: str) -> Any:
    """Return ROS's class of a message type."""
    try:
        return get_message(kind)
    except (ModuleNotFoundError, AttributeError, ValueError) as error:
        raise DataError(
            f"{kind} is not known to this ROS 2: {error}; install its package"
        ) from error


def _qos(quality: Quality) -> QoSProfile:
    if quality == "sensor":
        return QoSProfile(
            history=HistoryPolicy.KEEP_LAST, depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT
        )
    if quality == "reliable":
        return QoSProfile(
            history=HistoryPolicy.KEEP_LAST, depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE
        )
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )
