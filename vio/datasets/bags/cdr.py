"""ROS 2 messages as bytes (CDR) and back, and the fields of their types, by the library rosbags."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from vio.datasets.bags.store import OF_A_MESSAGE, named_damage, ros2_types


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message type."""

    name: str
    kind: str  # a built-in type such as uint32 or string, or another message's
    many: Literal["one", "array", "sequence"] = "one"
    length: int = 0  # of an array; of a sequence the most elements, 0: any number


def decoded(data: bytes, kind: str, where: str) -> Any:
    """Return the fields of a message.

    Raises:
        DataError: the message does not fit its type.
    """
    with named_damage(where):
        return ros2_types().deserialize_cdr(data, kind)


def live_decoded(data: bytes, kind: str, topic: str) -> Any:
    """Return the fields of a message that came over a topic.

    Raises:
        DataError: the message does not fit its type.
    """
    with named_damage(topic, OF_A_MESSAGE):
        return ros2_types().deserialize_cdr(data, kind)


def fields_of(kind: str) -> tuple[Field, ...]:
    """Return the fields of a message type."""
    from rosbags.interfaces import Nodetype

    found = []
    for name, (node, value) in ros2_types().fielddefs[kind][1]:
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            (inner, of), length = value
            many: Literal["array", "sequence"] = "array" if node == Nodetype.ARRAY else "sequence"
            found.append(Field(name, of[0] if inner == Nodetype.BASE else of, many, length))
        else:
            found.append(Field(name, value[0] if node == Nodetype.BASE else value))
    return tuple(found)
