"""Write recordings as ROS bags with the library rosbags, for tests of their reader."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from vio.geometry.lie import FloatArray, quat_xyzw_from_rotation
from vio.geometry.stereo import StereoCamera
from vio.records import Image, ImuSample

STORES = {
    "bag": get_typestore(Stores.ROS1_NOETIC),
    "db3": get_typestore(Stores.ROS2_HUMBLE),
    "mcap": get_typestore(Stores.ROS2_HUMBLE),
}

# ROS 1 keeps tf2_msgs apart from its common messages.
STORES["bag"].register(
    get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
)


@dataclass(frozen=True, slots=True)
class Note:
    """One message to write."""

    topic: str
    kind: str
    logged_ns: int
    fields: Any


@dataclass(slots=True)
class Script:
    """The messages of a bag, built for one of the kinds of storage."""

    storage: str
    notes: list[Note] = field(default_factory=list)
    empty: list[tuple[str, str]] = field(default_factory=list)  # topics without messages

    def make(self, kind: str, *values: Any) -> Any:
        """Return a message of a type."""
        return STORES[self.storage].types[kind](*values)

    def header(self, time_ns: int, frame: str) -> Any:
        """Return a std_msgs/Header."""
        stamp = self.make("builtin_interfaces/msg/Time", time_ns // 10**9, time_ns % 10**9)
        return self.make(
            "std_msgs/msg/Header", *([0] if self.storage == "bag" else []), stamp, frame
        )

    def add(
        self, topic: str, kind: str, time_ns: int, fields: Any, logged_ns: int | None = None
    ) -> None:
        """Add a message that was logged at its stamp, or at another time."""
        self.notes.append(Note(topic, kind, time_ns if logged_ns is None else logged_ns, fields))

    def image(
        self, topic: str, time_ns: int, pixels: np.ndarray, encoding: str = "mono8", *, cut: int = 0
    ) -> None:
        """Add a sensor_msgs/Image whose pixels are (H, W) or (H, W, C), without its last `cut`
        bytes.
        """
        data = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
        height, width = pixels.shape[:2]
        kind = "sensor_msgs/msg/Image"
        step = len(data) // height
        header = self.header(time_ns, "left" if "left" in topic else "right")
        fields = self.make(kind, header, height, width, encoding, 0, step, data[: len(data) - cut])
        self.add(topic, kind, time_ns, fields)

    def compressed(self, topic: str, time_ns: int, pixels: Image) -> None:
        """Add a sensor_msgs/CompressedImage."""
        kind = "sensor_msgs/msg/CompressedImage"
        data = cv2.imencode(".png", pixels)[1].reshape(-1)
        self.add(topic, kind, time_ns, self.make(kind, self.header(time_ns, "left"), "png", data))

    def imu(self, topic: str, sample: ImuSample, logged_ns: int | None = None) -> None:
        """Add a sensor_msgs/Imu."""
        kind, vector = "sensor_msgs/msg/Imu", "geometry_msgs/msg/Vector3"
        nothing = np.zeros(9)
        fields = self.make(
            kind,
            self.header(sample.time_ns, "imu"),
            self.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
            nothing,
            self.make(vector, *map(float, sample.gyro)),
            nothing,
            self.make(vector, *map(float, sample.accel)),
            nothing,
        )
        self.add(topic, kind, sample.time_ns, fields, logged_ns)

    def pose(self, topic: str, time_ns: int, T: FloatArray) -> None:
        """Add a geometry_msgs/PoseStamped."""
        kind = "geometry_msgs/msg/PoseStamped"
        self.add(
            topic, kind, time_ns, self.make(kind, self.header(time_ns, "world"), self._pose(T))
        )

    def odometry(
        self, topic: str, time_ns: int, T: FloatArray, linear: FloatArray, angular: FloatArray
    ) -> None:
        """Add a nav_msgs/Odometry."""
        kind, vector = "nav_msgs/msg/Odometry", "geometry_msgs/msg/Vector3"
        twist = self.make(
            "geometry_msgs/msg/Twist",
            *(self.make(vector, *map(float, x)) for x in (linear, angular)),
        )
        fields = self.make(
            kind,
            self.header(time_ns, "odom"),
            "base",
            self.make("geometry_msgs/msg/PoseWithCovariance", self._pose(T), np.zeros(36)),
            self.make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36)),
        )
        self.add(topic, kind, time_ns, fields)

    def camera_info(self, topic: str, time_ns: int, camera: StereoCamera, *, right: bool) -> None:
        """Add the CameraInfo of one half of a rectified pair."""
        kind, roi = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/RegionOfInterest"
        P = np.column_stack([camera.K, [-camera.fu * camera.baseline_m if right else 0.0, 0, 0]])
        fields = self.make(
            kind,
            self.header(time_ns, "right" if right else "left"),
            camera.height,
            camera.width,
            "plumb_bob",
            np.zeros(5),
            camera.K.ravel(),
            np.eye(3).ravel(),
            P.ravel(),
            0,
            0,
            self.make(roi, 0, 0, 0, 0, False),
        )
        self.add(topic, kind, time_ns, fields)

    def static(self, time_ns: int, parent: str, child: str, T: FloatArray) -> None:
        """Add a transform of /tf_static: coordinates of the child to those of the parent."""
        self.moving(time_ns, parent, child, T, "/tf_static")

    def moving(
        self, time_ns: int, parent: str, child: str, T: FloatArray, topic: str = "/tf"
    ) -> None:
        """Add a transform of /tf."""
        kind, stamped = "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/TransformStamped"
        p, q = T[:3, 3], quat_xyzw_from_rotation(T[:3, :3])
        transform = self.make(
            "geometry_msgs/msg/Transform",
            self.make("geometry_msgs/msg/Vector3", *map(float, p)),
            self.make("geometry_msgs/msg/Quaternion", *map(float, q)),
        )
        item = self.make(stamped, self.header(time_ns, parent), child, transform)
        self.add(topic, kind, time_ns, self.make(kind, [item]))

    def _pose(self, T: FloatArray) -> Any:
        q = quat_xyzw_from_rotation(T[:3, :3])
        return self.make(
            "geometry_msgs/msg/Pose",
            self.make("geometry_msgs/msg/Point", *map(float, T[:3, 3])),
            self.make("geometry_msgs/msg/Quaternion", *map(float, q)),
        )

    def vector(self, topic: str, time_ns: int, values: FloatArray) -> None:
        """Add a geometry_msgs/Vector3Stamped."""
        kind = "geometry_msgs/msg/Vector3Stamped"
        vector = self.make("geometry_msgs/msg/Vector3", *map(float, values))
        self.add(topic, kind, time_ns, self.make(kind, self.header(time_ns, "imu"), vector))

    def transform(self, topic: str, time_ns: int, T: FloatArray) -> None:
        """Add a geometry_msgs/Transform."""
        kind = "geometry_msgs/msg/Transform"
        p, q = T[:3, 3], quat_xyzw_from_rotation(T[:3, :3])
        fields = self.make(
            kind,
            self.make("geometry_msgs/msg/Vector3", *map(float, p)),
            self.make("geometry_msgs/msg/Quaternion", *map(float, q)),
        )
        self.add(topic, kind, time_ns, fields)

    def write(self, path: Path, *, sort: bool = True, packed: bool = False) -> Path:
        """Write the bag, its messages sorted by their times of recording unless that order is to
        be kept in which they were added; a ROS 2 bag is a folder. `packed`: each message of a ROS 2
        bag is compressed.
        """
        store = STORES[self.storage]
        ros1 = self.storage == "bag"
        plugin = StoragePlugin.MCAP if self.storage == "mcap" else StoragePlugin.SQLITE3
        made = Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=plugin)
        if packed:
            assert isinstance(made, Writer2)
            made.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
        with made as writer:
            pairs = dict.fromkeys([(n.topic, n.kind) for n in self.notes] + self.empty)
            connections = {pair: writer.add_connection(*pair, typestore=store) for pair in pairs}
            notes = sorted(self.notes, key=lambda n: n.logged_ns) if sort else self.notes
            for note in notes:
                serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
                data = serialize(note.fields, note.kind)
                writer.write(connections[(note.topic, note.kind)], note.logged_ns, data)
        return path


def of_stereo(
    script: Script, frames: Iterable[tuple[int, Image, Image]], *, compressed: bool = False
) -> Script:
    """Add stereo frames (time, left, right)."""
    for time_ns, left, right in frames:
        for side, image in (("left", left), ("right", right)):
            if compressed:
                script.compressed(f"/{side}/image_raw/compressed", time_ns, image)
            else:
                script.image(f"/{side}/image_raw", time_ns, image)
    return script


def noise_frames(count: int) -> Iterator[tuple[int, Image, Image]]:
    """Yield frames of noise, 64 x 48 pixels, 20 Hz from 10^18 ns."""
    rng = np.random.default_rng(count)
    for k in range(count):
        left, right = rng.integers(0, 256, (2, 48, 64)).astype(np.uint8)
        yield 10**18 + 50_000_000 * k, left, right
