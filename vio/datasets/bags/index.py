"""One pass over a bag: the stamps of its images, its inertial samples, velocities, poses,
calibration and frames.

Nothing of an image is kept but its stamp, so memory does not grow with the images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from vio.datasets.bags.pictures import band_of_message, raw_gray
from vio.datasets.bags.store import Bag, Message, Topic
from vio.datasets.bags.topics import CAMERA_INFO, COMPRESSED, IMAGE, TF, Roles
from vio.datasets.images import UnreadableImageError
from vio.datasets.levels import Band, is_mosaic
from vio.datasets.rigs.camera_info import CameraInfo, region_of
from vio.datasets.samples import MotionSamples, velocity_samples
from vio.errors import DataError
from vio.geometry.lie import FloatArray, rotation_from_quat_xyzw, se3_from_parts, se3_inverse
from vio.records import NS_PER_S, ImuRecord, IntArray, Trajectory, VelocitySample

__all__ = ["BagIndex", "Stamps", "camera_info_of", "index_bag", "info_topic", "stamp_of"]

_LEVEL_SAMPLES = 8  # images looked at for black and white, spread over the recording


@dataclass(slots=True)
class Stamps:
    """The images of one topic, in the order of their stamps."""

    times_ns: list[int] = field(default_factory=list)
    logged_ns: list[int] = field(default_factory=list)
    encodings: dict[str, int] = field(default_factory=dict)  # and how many images have each
    size: tuple[int, int] | None = None  # width and height of the first raw image, pixels
    frame_id: str = ""
    bands: list[Band] = field(default_factory=list)  # of levels of 16-bit images
    mosaic: bool = False  # the first raw gray image looks like one of a Bayer pattern

    @property
    def unstamped(self) -> bool:
        """Whether no header has a stamp, so that the times of logging must serve."""
        return len(self.times_ns) > 1 and not any(self.times_ns)

    def ordered(self) -> tuple[IntArray, IntArray, int]:
        """Return increasing stamps (N,), the times they were logged (N,), and how many stamps
        were repeated.
        """
        stamps = self.logged_ns if self.unstamped else self.times_ns
        times, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)
        return (
            times,
            np.array(self.logged_ns, dtype=np.int64)[first],
            len(self.times_ns) - len(times),
        )


@dataclass(slots=True)
class BagIndex:
    """What one pass over a bag found."""

    left: Stamps = field(default_factory=Stamps)
    right: Stamps = field(default_factory=Stamps)
    imu: list[tuple[int, tuple[float, ...]]] = field(default_factory=list)
    imu_frame: str = ""
    velocities: list[tuple[int, tuple[float, ...]]] = field(default_factory=list)
    poses: list[tuple[int, tuple[float, ...]]] = field(default_factory=list)  # x y z qx qy qz qw
    # likewise, of /tf
    moving: dict[tuple[str, str], list[tuple[int, tuple[float, ...]]]] = field(default_factory=dict)
    infos: dict[str, CameraInfo] = field(default_factory=dict)  # by topic
    # T_parent_child of tf_static
    frames: dict[tuple[str, str], FloatArray] = field(default_factory=dict)
    disordered: dict[str, int] = field(default_factory=dict)  # samples that came late, by topic

    def imu_record(self) -> ImuRecord | None:
        """The inertial samples in the order of their stamps; None: there are none."""
        if not self.imu:
            return None
        times, values = _sorted(self.imu)
        return ImuRecord(times, values[:, :3], values[:, 3:])

    def velocity_samples(self) -> MotionSamples[VelocitySample] | None:
        """The velocities in the order of their stamps; None: there are none."""
        if not self.velocities:
            return None
        times, values = _sorted(self.velocities)
        return velocity_samples(times, values[:, :3], values[:, 3:])

    def reference(self, *, imu: bool) -> Trajectory | None:
        """The poses as those of the IMU, or of the left camera where there is none; None: there are
        none.

        Raises:
            DataError: poses were to come from /tf, where no moving frame carries the body.
        """
        if self.moving:
            of_imu = imu and bool(self.imu_frame)
            return self._carried(
                (self.imu_frame if of_imu else self.left.frame_id).lstrip("/"), imu=of_imu
            )
        return _trajectory(self.poses, imu=imu)

    def _carried(self, body: str, *, imu: bool) -> Trajectory | None:
        """Return the poses of a frame in the parent of the moving frame that carries it."""
        carriers = {
            key: T for key in self.moving if (T := self.transform(key[1], body)) is not None
        }
        if not carriers:
            names = ", ".join(f"{parent} to {child}" for parent, child in self.moving)
            raise DataError(
                f"/tf: of its moving frames ({names}) none carries {body}; name another "
                "reference=/TOPIC"
            )
        key = max(carriers, key=lambda name: len(self.moving[name]))
        found = _trajectory(self.moving[key], imu=imu)
        return (
            None
            if found is None
            else replace(found, T_world_body=found.T_world_body @ carriers[key])
        )

    def add_frames(self, fields: Any) -> None:
        """Take the transforms of a tf2_msgs/TFMessage as static ones."""
        for item in fields.transforms:
            t = item.transform.translation
            q = item.transform.rotation
            R = rotation_from_quat_xyzw(np.array([q.x, q.y, q.z, q.w]))
            parent, child = (
                str(name).lstrip("/") for name in (item.header.frame_id, item.child_frame_id)
            )
            self.frames[(parent, child)] = se3_from_parts(R, [t.x, t.y, t.z])

    def transform(self, target: str, source: str) -> FloatArray | None:
        """`T_target_source` (4, 4) through the static frames; None: they are not connected."""
        steps: dict[str, list[tuple[str, FloatArray]]] = {}
        for (parent, child), T in self.frames.items():
            steps.setdefault(child, []).append((parent, T))
            steps.setdefault(parent, []).append((child, se3_inverse(T)))
        reached: dict[str, FloatArray] = {source: np.eye(4)}
        waiting = [source]
        while waiting:
            here = waiting.pop(0)
            for there, T in steps.get(here, []):
                if there not in reached:
                    reached[there] = T @ reached[here]
                    waiting.append(there)
        return reached.get(target)


def _trajectory(rows: Sequence[tuple[int, tuple[float, ...]]], *, imu: bool) -> Trajectory | None:
    """Return poses x y z qx qy qz qw in the order of their stamps; None: there are none."""
    if not rows:
        return None
    times, values = _sorted(rows)
    q = values[:, 3:]
    norm = np.linalg.norm(q, axis=1)
    usable = norm > 0.5
    R = rotation_from_quat_xyzw(q[usable] / norm[usable, None])
    return Trajectory(
        se3_from_parts(R, values[usable, :3]), times[usable], "imu" if imu else "cam0"
    )


def _sorted(rows: Sequence[tuple[int, tuple[float, ...]]]) -> tuple[IntArray, FloatArray]:
    """Return increasing times (N,) and values (N, K); of equal stamps the first."""
    times, first = np.unique(np.array([t for t, _ in rows], dtype=np.int64), return_index=True)
    return times, np.array([rows[k][1] for k in first.tolist()], dtype=np.float64)


def stamp_of(fields: Any) -> int:
    """Return the stamp of a message's header, ns."""
    stamp = fields.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def info_topic(topics: Sequence[Topic], image: Topic) -> str | None:
    """Return the CameraInfo topic of an image topic: `camera_info` in its namespace, or in one
    above.
    """
    known = {t.name for t in topics if t.kind == CAMERA_INFO and t.count}
    parts = image.name.split("/")
    for depth in range(len(parts) - 1, 1, -1):
        if (name := "/".join([*parts[:depth], "camera_info"])) in known:
            return name
    return None


def index_bag(bag: Bag, roles: Roles, infos: Sequence[str]) -> BagIndex:
    """Pass once over the messages of the chosen topics.

    Raises:
        DataError: the bag is damaged, or an image topic mixes encodings of different depth.
    """
    index = BagIndex()
    # one has no right images
    cameras = tuple(zip(roles.cameras, (index.left, index.right), strict=False))
    takers: dict[str, list[Callable[[Any, Message], None]]] = {
        topic.name: [partial(_image, bag, stamps, topic)] for topic, stamps in cameras
    }
    for topic, take in ((roles.imu, _imu), (roles.velocity, _velocity), (roles.reference, _pose)):
        if topic is not None:  # one odometry may be both velocity and reference
            takers.setdefault(topic.name, []).append(partial(take, index))
    for name in infos:
        takers[name] = [partial(_info, index)]
    for name in (t.name for t in bag.topics if t.kind == TF and t.name.endswith("tf_static")):
        takers[name] = [lambda fields, message: index.add_frames(fields)]
    for message in bag.messages(list(takers)):
        fields = bag.decoded(message)
        for taker in takers[message.topic]:
            taker(fields, message)
    for images, stamps in cameras:
        depths = {"16" in name for name in stamps.encodings}
        if len(depths) > 1:
            raise DataError(
                f"{bag.path}: {images.name} mixes {', '.join(stamps.encodings)}; record one "
                "encoding"
            )
    return index


def _image(bag: Bag, stamps: Stamps, topic: Topic, fields: Any, message: Message) -> None:
    stamps.times_ns.append(stamp_of(fields))
    stamps.logged_ns.append(message.logged_ns)
    stamps.frame_id = stamps.frame_id or str(fields.header.frame_id)
    name = str(fields.encoding) if topic.kind == IMAGE else "compressed"
    stamps.encodings[name] = stamps.encodings.get(name, 0) + 1
    compressed = topic.kind == COMPRESSED
    where = f"{bag.path}, {topic.name}"
    if not compressed:
        stamps.size = stamps.size or (int(fields.width), int(fields.height))
        if len(stamps.times_ns) == 1 and name in ("mono8", "mono16", "8UC1", "16UC1"):
            stamps.mosaic = _looks_like_mosaic(fields, where)
    if (len(stamps.times_ns) - 1) % max(topic.count // _LEVEL_SAMPLES, 1) == 0:
        band = band_of_message(fields, where, compressed=compressed)
        stamps.bands += [] if band is None else [band]


def _looks_like_mosaic(fields: Any, where: str) -> bool:
    try:
        return is_mosaic(raw_gray(fields, where))
    except UnreadableImageError:
        return False


def _add(
    index: BagIndex, rows: list[tuple[int, tuple[float, ...]]], topic: str, row: tuple[int, Any]
) -> None:
    if rows and row[0] < rows[-1][0]:
        index.disordered[topic] = index.disordered.get(topic, 0) + 1
    rows.append(row)


def _imu(index: BagIndex, fields: Any, message: Message) -> None:
    w = fields.angular_velocity
    a = fields.linear_acceleration
    values = (w.x, w.y, w.z, a.x, a.y, a.z)
    time_ns = stamp_of(fields)
    if not np.isfinite(values).all():
        raise DataError(
            f"{message.topic}: the sample at {time_ns} ns is not finite ({values}); record the IMU "
            "again"
        )
    index.imu_frame = index.imu_frame or str(fields.header.frame_id)
    _add(index, index.imu, message.topic, (time_ns, values))


def _velocity(index: BagIndex, fields: Any, message: Message) -> None:
    twist = fields.twist.twist if hasattr(fields.twist, "twist") else fields.twist
    v = twist.linear
    w = twist.angular
    _add(index, index.velocities, message.topic, (stamp_of(fields), (v.x, v.y, v.z, w.x, w.y, w.z)))


def _pose(index: BagIndex, fields: Any, message: Message) -> None:
    if message.kind == TF:
        for item in fields.transforms:
            key = (str(item.header.frame_id).lstrip("/"), str(item.child_frame_id).lstrip("/"))
            p = item.transform.translation
            q = item.transform.rotation
            index.moving.setdefault(key, []).append(
                (stamp_of(item), (p.x, p.y, p.z, q.x, q.y, q.z, q.w))
            )
        return
    if hasattr(fields, "transform"):
        p = fields.transform.translation
        q = fields.transform.rotation
    else:
        pose = fields.pose.pose if hasattr(fields.pose, "pose") else fields.pose
        p = pose.position
        q = pose.orientation
    _add(index, index.poses, message.topic, (stamp_of(fields), (p.x, p.y, p.z, q.x, q.y, q.z, q.w)))


def _info(index: BagIndex, fields: Any, message: Message) -> None:
    if message.topic not in index.infos:
        index.infos[message.topic] = camera_info_of(fields, message.topic)


def camera_info_of(fields: Any, topic: str) -> CameraInfo:
    """Return a sensor_msgs/CameraInfo.

    ROS 1 and ROS 2 write its matrices in capitals and in small letters.
    """
    D, K, R, P = (
        np.array(getattr(fields, n, getattr(fields, n.upper(), None)), dtype=np.float64)
        for n in "dkrp"
    )
    size = (int(fields.width), int(fields.height))
    matrices = (K.reshape(3, 3), R.reshape(3, 3), P.reshape(3, 4))
    model = str(fields.distortion_model)
    roi = fields.roi
    region = region_of([int(x) for x in (roi.x_offset, roi.y_offset, roi.width, roi.height)])
    binning = (max(int(fields.binning_x), 1), max(int(fields.binning_y), 1))
    return CameraInfo(topic, *size, model, tuple(D.tolist()), *matrices, binning, region)
