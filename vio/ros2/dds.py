"""The graph over DDS, with the package cyclonedds and without ROS.

ROS 2 maps a topic `/name` to DDS's `rt/name`, and a type `pkg/msg/Name` to `pkg::msg::dds_::Name_`.
Messages pass as the bytes that they are: cyclonedds's own coder makes a list of an image's bytes,
30 ms at 752x480.
Reference: the article "Topic and Service name mapping to DDS" of ROS 2's design.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import (
    DDSException,
    InstanceState,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from vio.datasets.bags.cdr import Field, fields_of
from vio.errors import DataError
from vio.numerics.kinds import Capacity
from vio.ros2.transport import Quality


class _QueueLimits(NamedTuple):
    """How many messages wait."""

    # messages that wait for `spin`; of a topic that must not lose any, all
    depth_messages: Capacity[int] = 1000
    max_images: Capacity[int] = 50  # that wait where none must be lost: then the sender waits
    taken_messages: Capacity[int] = 10_000  # at a time
    last_s: Capacity[float] = 30.0  # that a receiver may take for the last messages


_QUEUE = _QueueLimits()
_BASE: dict[str, Any] = {
    "bool": bool,
    "string": str,
    "byte": idl.byte,
    "char": idl.uint8,
    "float32": idl.float32,
    "float64": idl.float64,
    **{
        f"{sign}int{bits}": getattr(idl, f"{sign}int{bits}")
        for sign in ("", "u")
        for bits in (8, 16, 32, 64)
    },
}

_ARRAY: Any = idl.array
_SEQUENCE: Any = idl.sequence


class _Raw:
    """A message as bytes, in the place of cyclonedds's own object."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.sample_info: Any = None  # set by cyclonedds


@functools.cache
def _struct(kind: str) -> Any:
    """Return the type of DDS for a message type, with its fields, by which others check that it
    is theirs.
    """
    package, _, name = kind.split("/")
    fields = {field.name: _field(field) for field in fields_of(kind)}
    return make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", fields)


def _field(field: Field) -> Any:
    if "/" in field.kind:
        of = _struct(field.kind)
    else:
        of = _BASE[field.kind]
    if field.many == "array":
        return _ARRAY[of, field.length]
    if field.many == "sequence":
        if field.length:
            return _SEQUENCE[of, field.length]
        return _SEQUENCE[of]
    return of


@functools.cache
def _raw_struct(kind: str) -> Any:
    """Return the type of a topic, whose messages are not decoded."""
    made = _struct.__wrapped__(kind)  # one of its own: as a part of other types, it stays as it is

    def serialize(self: Any, *_: Any, **__: Any) -> bytes:
        return bytes(self.raw)

    made.serialize = serialize
    made.deserialize = staticmethod(lambda data, *_, **__: _Raw(data))
    return made


def _qos(quality: Quality, *, of_images: bool = False) -> Qos:
    reliable = Policy.Reliability.Reliable(duration(hours=1))  # which a sender waits for room
    format_of_ros = Policy.DataRepresentation(
        use_cdrv0_representation=True, use_xcdrv2_representation=False
    )
    if quality == "sensor":
        return Qos(
            Policy.Reliability.BestEffort,
            Policy.History.KeepLast(_QUEUE.depth_messages),
            format_of_ros,
        )
    if quality == "reliable":
        limits = []
        if of_images:
            limits = [Policy.ResourceLimits(max_samples=_QUEUE.max_images)]
        return Qos(reliable, Policy.History.KeepAll, format_of_ros, *limits)
    return Qos(
        reliable, Policy.Durability.TransientLocal, Policy.History.KeepLast(1), format_of_ros
    )


class DdsTransport:
    """A participant of a DDS domain, see `Transport`."""

    def __init__(self, domain: int | None) -> None:
        if domain is None:
            number = int(os.environ.get("ROS_DOMAIN_ID", "0") or 0)
        else:
            number = domain
        try:
            self._participant = DomainParticipant(number)
        except DDSException as error:
            raise DataError(
                f"DDS domain {number} cannot be joined: {error}; check CYCLONEDDS_URI"
            ) from error
        self._waitset = WaitSet(self._participant)
        self._readers: list[tuple[DataReader[Any], Any, Callable[[bytes], None]]] = []
        self._writers: dict[str, DataWriter[Any]] = {}
        self._topics: dict[tuple[str, str], Topic[Any]] = {}
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._own: set[str] = set()

    def _topic(self, name: str, kind: str) -> Topic[Any]:
        key = name, kind
        if key not in self._topics:
            self._topics[key] = Topic(self._participant, f"rt{name}", _raw_struct(kind))
        return self._topics[key]

    def subscribe(
        self, topic: str, kind: str, take: Callable[[bytes], None], quality: Quality
    ) -> None:
        """Hand the messages of a topic to a function."""
        qos = _qos(quality, of_images="Image" in kind)
        reader: DataReader[Any] = DataReader(self._participant, self._topic(topic, kind), qos=qos)
        condition = ReadCondition(reader, SampleState.NotRead | ViewState.Any | InstanceState.Any)
        self._waitset.attach(condition)
        self._readers.append((reader, condition, take))

    def advertise(self, topic: str, kind: str, quality: Quality) -> Callable[[bytes], None]:
        """Return the function that publishes on a topic."""
        made = _raw_struct(kind)
        writer: DataWriter[Any] = DataWriter(
            self._participant, self._topic(topic, kind), qos=_qos(quality)
        )
        self._writers[topic] = writer
        self._own.add(str(writer.guid))

        def publish(data: bytes) -> None:
            message = made.__new__(made)
            message.raw = data
            writer.write(message)

        return publish

    def subscribers(self, topic: str) -> int:
        """Return how many receive a topic that was advertised here."""
        return len(self._writers[topic].get_matched_subscriptions())

    def topics(self) -> Mapping[str, frozenset[str]]:
        """Return the topics of other participants with their types."""
        found: dict[str, set[str]] = {}
        for sample in self._publications.read(10_000):
            name = getattr(sample, "topic_name", None)
            kind = getattr(sample, "type_name", "")
            if name is None or not name.startswith("rt/") or str(sample.key) in self._own:
                continue
            package, _, rest = kind.partition("::msg::dds_::")
            found.setdefault(name[2:], set()).add(
                f"{package}/msg/{rest.removesuffix('_')}" if rest else kind
            )
        return {name: frozenset(kinds) for name, kinds in found.items()}

    def spin(self, timeout_s: float) -> None:
        """Hand over what has come."""
        self._waitset.wait(duration(seconds=timeout_s))
        taken = [
            (sample.sample_info.source_timestamp, take, sample.data)
            for reader, condition, take in self._readers
            for sample in reader.take(_QUEUE.taken_messages, condition=condition)
            if isinstance(sample, _Raw)
        ]
        # Topics are read one after the other: their messages are handed over in the order in which
        # they were sent.
        for _, take, data in sorted(taken, key=lambda each: each[0]):
            take(data)

    def close(self) -> None:
        """Leave the domain, once what was published reliably has been received, or nobody takes
        it.
        """
        for writer in self._writers.values():
            writer.wait_for_acks(duration(seconds=_QUEUE.last_s))
        for _, condition, _ in self._readers:
            self._waitset.detach(condition)
        self._readers.clear()
        self._writers.clear()
        del self._participant
