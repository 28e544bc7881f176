"""Read bags with the library rosbags: open them, list topics, stream messages, and name damage
in one line.
"""

from __future__ import annotations

import contextlib
import functools
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vio.datasets.bags.kinds import bag_files
from vio.datasets.bags.sdk_stamps import NOTE as SDK_NOTE
from vio.datasets.bags.sdk_stamps import SdkStamps, metadata_topics, sdk_stamps
from vio.datasets.bags.storage_order import STEP_NS, as_stored, is_set_back
from vio.errors import DataError, MissingDependencyError
from vio.records import NS_PER_S

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_OF_A_BAG = (
    "the bag is truncated or damaged ({why}); copy it again, or repair it with ROS's own tools "
    "(rosbag reindex, ros2 bag reindex, mcap recover)"
)
_ACTIVE = ".active"
_NOT_CLOSED = (
    "rosbag still writes it, or was killed before it closed it; end the recording, or repair it "
    "with rosbag reindex, and rename it to .bag"
)
OF_A_MESSAGE = "a message is truncated or of another type ({why}); check its publisher"
MISSING = "ROS bags need the package rosbags; install it with: pip install rosbags"


@functools.cache
def ros2_types() -> Any:
    """Return the message types of ROS 2.

    Raises:
        MissingDependencyError: rosbags is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingDependencyError(MISSING) from error
    return get_typestore(Stores.ROS2_HUMBLE)


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a bag."""

    name: str
    kind: str  # such as sensor_msgs/msg/Image
    count: int  # messages


@dataclass(frozen=True, slots=True)
class Message:
    """One message as it was recorded."""

    topic: str
    kind: str
    logged_ns: int  # when the bag received it
    data: bytes
    # likewise, where the recorder's clock was set back: on a clock that went on
    recorded_ns: int


class Bag:
    """Opened bags; use it as a context.

    Messages are streamed, so memory does not grow with the file.
    """

    _reader: AnyReader
    _set_back: bool
    _sdk: dict[str, SdkStamps]

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> Bag:
        """Open the files.

        Raises:
            MissingDependencyError: rosbags is not installed.
            DataError: a file is missing, truncated or damaged.
        """
        typestore = ros2_types()
        if self.path.suffix == _ACTIVE:
            raise DataError(f"{self.path}: {_NOT_CLOSED}")
        from rosbags.highlevel import AnyReader

        with named_damage(self.path):
            # ROS 2 bags of before Iron carry no definitions; those of its usual types have not
            # changed since.
            self._reader = AnyReader(bag_files(self.path), default_typestore=typestore)
            self._reader.open()
            # of several files each is in order, and they are merged by time
            only = None
            if len(self._reader.readers) == 1:
                only = self._reader.readers[0]
            self._set_back = only is not None and is_set_back(only)
        with named_damage(self.path):
            self._sdk = self._sdk_stamps()
        return self

    def _sdk_stamps(self) -> dict[str, SdkStamps]:
        """Return the stamps that RealSense's recorder keeps beside its messages, by topic."""
        kinds = {connection.topic: connection.msgtype for connection in self._reader.connections}
        stamps: dict[str, SdkStamps] = {}
        for data, metadata in metadata_topics(kinds).items():
            texts = self.messages([metadata])
            stamps[data] = sdk_stamps((text.logged_ns, text.data) for text in texts)
        return stamps

    @property
    def notes(self) -> tuple[str, ...]:
        """What was found of the bag as a whole."""
        return (SDK_NOTE,) if self._sdk else ()

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    @property
    def topics(self) -> tuple[Topic, ...]:
        """All topics, the empty ones too, in the order of their names."""
        counts: dict[tuple[str, str], int] = {}
        for connection in self._reader.connections:
            key = connection.topic, connection.msgtype
            counts[key] = counts.get(key, 0) + connection.msgcount
        return tuple(Topic(name, kind, count) for (name, kind), count in sorted(counts.items()))

    def messages(self, topics: Collection[str], start_ns: int | None = None) -> Iterator[Message]:
        """Yield the messages of some topics in the order in which they were recorded, from a time
        of the bag's clock (all of them where that clock was set back).

        Raises:
            DataError: the bag is damaged; what came before was yielded.
        """
        chosen = [c for c in self._reader.connections if c.topic in topics]
        if not chosen:
            return
        with named_damage(self.path):
            if not self._set_back:
                for connection, logged_ns, data in self._reader.messages(chosen, start=start_ns):
                    name = connection.topic
                    yield Message(name, connection.msgtype, logged_ns, bytes(data), logged_ns)
                return
            last_ns = shift_ns = 0
            for connection, logged_ns, data in as_stored(self._reader.readers[0], chosen):
                if logged_ns < last_ns - STEP_NS:
                    shift_ns += last_ns - logged_ns
                last_ns = logged_ns
                name = connection.topic
                recorded_ns = logged_ns + shift_ns
                yield Message(name, connection.msgtype, logged_ns, bytes(data), recorded_ns)

    def decoded(self, message: Message) -> Any:
        """Return the fields of a message.

        Raises:
            DataError: the message does not fit its type.
        """
        with named_damage(f"{self.path}, {message.topic}"):
            fields: Any = self._reader.deserialize(message.data, message.kind)
        stamps = self._sdk.get(message.topic)
        stamp_ns = None if stamps is None else stamps.at(message.logged_ns)
        if stamp_ns is not None:
            header = fields.header
            header.stamp = replace(
                header.stamp, sec=stamp_ns // NS_PER_S, nanosec=stamp_ns % NS_PER_S
            )
        return fields


@contextlib.contextmanager
def named_damage(where: Path | str, damage: str = _OF_A_BAG) -> Iterator[None]:
    """Turn what the readers of bags raise on damaged files into one line.

    `damage` says what is damaged and what to do, with the reason in the place of `{why}`.

    Raises:
        DataError: instead of any error of rosbags, its storages, or of the file system.
    """
    import apsw
    from rosbags.highlevel import AnyReaderError
    from rosbags.rosbag1 import ReaderError as ReaderError1
    from rosbags.rosbag2 import ReaderError as ReaderError2
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    errors = (AnyReaderError, ReaderError1, ReaderError2, SerdeError, TypesysError, apsw.Error)
    # Damaged bytes reach the parsers of headers, chunks and compression as the built-in errors.
    builtin = (
        OSError,
        ValueError,
        KeyError,
        IndexError,
        EOFError,
        AssertionError,
        RuntimeError,
        ArithmeticError,
        MemoryError,
        TypeError,
        struct.error,
    )
    try:
        yield
    except (*errors, *builtin) as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise DataError(f"{where}: {damage.format(why=why[:200])}") from error
