"""Write ROS 2 bags, message by message, with the library rosbags; SQLite or MCAP."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

import numpy as np

from vio.datasets.bags.store import MISSING, ros2_types
from vio.errors import DataError, MissingDependencyError
from vio.geometry.lie import FloatArray, quat_xyzw_from_rotation
from vio.geometry.stereo import StereoCamera
from vio.records import NS_PER_S, Image, ImuSample, Trajectory, VelocitySample

if TYPE_CHECKING:
    from rosbags.rosbag2 import Writer

Storage: TypeAlias = Literal["rosbag2", "mcap"]

_NAME = "recording"
# of metadata.yaml: readers of version 9 read it, those of before do not read 9
_VERSION: Literal[8] = 8
# sensor_msgs/Imu: the covariance of an orientation that is not measured
_UNKNOWN = np.array([-1.0, *np.zeros(8)])
_LATCHED = ("/tf_static",)  # a subscriber gets the last message however late it comes


class MessageSink(Protocol):
    """What takes messages in the place of a bag."""

    def add_connection(self, topic: str, msgtype: str, **options: Any) -> Any:
        """Return what `write` takes for a topic."""

    def write(self, connection: Any, timestamp: int, data: bytes | memoryview) -> None:
        """Take a message as CDR, with its time in ns."""


class BagWriter:
    """Makes ROS 2 messages, for an opened bag or for publishing; each is logged at its own stamp.

    T maps coordinates of the child to the parent's.
    """

    def __init__(self, writer: Writer | MessageSink, latched: Sequence[str] = ()) -> None:
        self._writer = writer
        self._store = ros2_types()
        self._connections: dict[str, Any] = {}
        self._latched = (*_LATCHED, *latched)

    def image(self, topic: str, frame: str, time_ns: int, image: Image) -> None:
        """Write a gray image (H, W)."""
        height, width = image.shape
        data = np.ascontiguousarray(image).reshape(-1)
        self._put(
            topic, time_ns, "sensor_msgs/msg/Image", frame, height, width, "mono8", 0, width, data
        )

    def camera_info(
        self, topic: str, frame: str, time_ns: int, camera: StereoCamera, *, right: bool
    ) -> None:
        """Write the calibration of one half of a rectified pair."""
        P = np.column_stack(
            [camera.K, [-camera.fu * camera.baseline_m if right else 0.0, 0.0, 0.0]]
        )
        matrices = (np.zeros(5), camera.K.ravel(), np.eye(3).ravel(), P.ravel())
        whole = self._make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        size = (camera.height, camera.width)
        self._put(
            topic,
            time_ns,
            "sensor_msgs/msg/CameraInfo",
            frame,
            *size,
            "plumb_bob",
            *matrices,
            0,
            0,
            whole,
        )

    def imu(self, topic: str, frame: str, sample: ImuSample) -> None:
        """Write angular rate and specific force; there is no orientation."""
        values = (self._quaternion(np.eye(3)), _UNKNOWN, self._vector(sample.gyro), np.zeros(9))
        kind = "sensor_msgs/msg/Imu"
        self._put(
            topic, sample.time_ns, kind, frame, *values, self._vector(sample.accel), np.zeros(9)
        )

    def twist(self, topic: str, frame: str, sample: VelocitySample) -> None:
        """Write linear and angular velocity in the frame."""
        twist = self._make(
            "geometry_msgs/msg/Twist", self._vector(sample.linear), self._vector(sample.angular)
        )
        self._put(topic, sample.time_ns, "geometry_msgs/msg/TwistStamped", frame, twist)

    def pose(
        self,
        topic: str,
        frame: str,
        time_ns: int,
        T: FloatArray,
        covariance: FloatArray | None = None,
    ) -> None:
        """Write a pose (4, 4), with the covariance (6, 6) of its position and of its rotation
        about fixed axes.
        """
        if covariance is None:
            self._put(topic, time_ns, "geometry_msgs/msg/PoseStamped", frame, self._pose(T))
            return
        pose = self._make("geometry_msgs/msg/PoseWithCovariance", self._pose(T), covariance.ravel())
        self._put(topic, time_ns, "geometry_msgs/msg/PoseWithCovarianceStamped", frame, pose)

    def path(self, topic: str, frame: str, trajectory: Trajectory, time_ns: int) -> None:
        """Write a whole trajectory with times as one message."""
        assert trajectory.times_ns is not None
        poses = [
            self._make("geometry_msgs/msg/PoseStamped", self._header(t, frame), self._pose(T))
            for t, T in zip(trajectory.times_ns.tolist(), trajectory.T_world_body, strict=True)
        ]
        self._put(topic, time_ns, "nav_msgs/msg/Path", frame, poses)

    def transform(self, parent: str, child: str, time_ns: int, T: FloatArray) -> None:
        """Write a moving transform of /tf."""
        self._transforms("/tf", time_ns, [(parent, child, T)])

    def static_transforms(
        self, time_ns: int, transforms: Sequence[tuple[str, str, FloatArray]]
    ) -> None:
        """Write the transforms (parent, child, T) of /tf_static as one message."""
        self._transforms("/tf_static", time_ns, transforms)

    def points(
        self, topic: str, frame: str, time_ns: int, points: FloatArray, sigmas: FloatArray
    ) -> None:
        """Write points (M, 3) with standard deviations (M,) as a PointCloud2 of x y z sigma."""
        data = np.column_stack([points, sigmas]).astype("<f4")
        names = ("x", "y", "z", "sigma")
        kind = "sensor_msgs/msg/PointField"
        float32 = self._store.types[kind].FLOAT32
        fields = [self._make(kind, name, 4 * k, float32, 1) for k, name in enumerate(names)]
        raw = np.frombuffer(data.tobytes(), dtype=np.uint8)
        row = 16 * len(data)
        self._put(
            topic,
            time_ns,
            "sensor_msgs/msg/PointCloud2",
            frame,
            1,
            len(data),
            fields,
            False,
            16,
            row,
            raw,
            True,
        )

    def odometry(
        self,
        topic: str,
        frames: tuple[str, str],
        time_ns: int,
        T: FloatArray,
        covariance: FloatArray,
        twist: tuple[FloatArray, FloatArray, FloatArray],
    ) -> None:
        """Write a pose (4, 4) of the child in the parent's frame, and its motion in its own axes.

        Args:
            topic: its name.
            frames: parent and child.
            time_ns: stamp.
            T: (4, 4).
            covariance: (6, 6) of position and of rotation about the parent's axes.
            twist: linear (3,) m/s and angular velocity (3,) rad/s, and their covariance (6, 6).
        """
        linear, angular, spread = twist
        pose = self._make("geometry_msgs/msg/PoseWithCovariance", self._pose(T), covariance.ravel())
        motion = self._make("geometry_msgs/msg/Twist", self._vector(linear), self._vector(angular))
        motion = self._make("geometry_msgs/msg/TwistWithCovariance", motion, spread.ravel())
        self._put(topic, time_ns, "nav_msgs/msg/Odometry", frames[0], frames[1], pose, motion)

    def diagnostics(
        self, name: str, time_ns: int, level: int, text: str, values: Mapping[str, str]
    ) -> None:
        """Write the state of a part on /diagnostics: level 0 is fine, 1 a warning, 2 an error."""
        pairs = [
            self._make("diagnostic_msgs/msg/KeyValue", key, value) for key, value in values.items()
        ]
        status = self._make("diagnostic_msgs/msg/DiagnosticStatus", level, name, text, "", pairs)
        self._put("/diagnostics", time_ns, "diagnostic_msgs/msg/DiagnosticArray", "", [status])

    def empty(self, topic: str) -> None:
        """Write a message without content."""
        self._write(topic, 0, self._make("std_msgs/msg/Empty"))

    def _transforms(
        self, topic: str, time_ns: int, transforms: Sequence[tuple[str, str, FloatArray]]
    ) -> None:
        items = []
        for parent, child, T in transforms:
            moved = self._make(
                "geometry_msgs/msg/Transform", self._vector(T[:3, 3]), self._quaternion(T[:3, :3])
            )
            items.append(
                self._make(
                    "geometry_msgs/msg/TransformStamped",
                    self._header(time_ns, parent),
                    child,
                    moved,
                )
            )
        self._write(topic, time_ns, self._make("tf2_msgs/msg/TFMessage", items))

    def _put(self, topic: str, time_ns: int, kind: str, frame: str, *values: Any) -> None:
        """Write a message that begins with a header."""
        self._write(topic, time_ns, self._make(kind, self._header(time_ns, frame), *values))

    def _write(self, topic: str, time_ns: int, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            qos = [_latched_qos()] if topic in self._latched else []
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._store, offered_qos_profiles=qos
            )
        data = self._store.serialize_cdr(message, kind)
        # a bag's clock has no sign
        self._writer.write(self._connections[topic], max(time_ns, 0), data)

    def _make(self, kind: str, *values: Any) -> Any:
        return self._store.types[kind](*values)

    def _header(self, time_ns: int, frame: str) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", time_ns // NS_PER_S, time_ns % NS_PER_S)
        return self._make("std_msgs/msg/Header", stamp, frame)

    def _vector(self, values: FloatArray, kind: str = "Vector3") -> Any:
        return self._make(f"geometry_msgs/msg/{kind}", *(float(x) for x in values))

    def _quaternion(self, R: FloatArray) -> Any:
        return self._vector(quat_xyzw_from_rotation(R), "Quaternion")

    def _pose(self, T: FloatArray) -> Any:
        return self._make(
            "geometry_msgs/msg/Pose", self._vector(T[:3, 3], "Point"), self._quaternion(T[:3, :3])
        )


def _latched_qos() -> Any:
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    forever = QosTime(2147483647, 4294967295)
    last = QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL
    return Qos(*last, forever, forever, QosLiveliness.AUTOMATIC, forever, False)


@contextlib.contextmanager
def bag_writer(
    folder: Path, storage: Storage, *, latched: Sequence[str] = ()
) -> Iterator[BagWriter]:
    """Open a new bag in an existing folder: `metadata.yaml` and `recording.db3` or
    `recording.mcap`.

    Args:
        folder: without a bag.
        storage: "rosbag2" (SQLite) or "mcap".
        latched: topics whose last message a late subscriber gets, besides /tf_static.

    Raises:
        MissingDependencyError: rosbags is not installed.
        DataError: the storage cannot be written.
    """
    try:
        import apsw
        from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
    except ImportError as error:
        raise MissingDependencyError(MISSING) from error

    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    inner = folder / _NAME  # the library makes a folder of its own, which names the file
    try:
        with Writer(inner, version=_VERSION, storage_plugin=plugin) as writer:
            yield BagWriter(writer, latched)
        for file in list(inner.iterdir()):
            shutil.move(file, folder / file.name)
        inner.rmdir()
    except (apsw.Error, WriterError) as error:
        raise DataError(
            f"cannot write the bag {folder}: {error}; check the disk's free space"
        ) from error
