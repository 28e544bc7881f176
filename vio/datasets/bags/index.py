"""One pass over a bag: the stamps of its images, its inertial samples, velocities, poses,
calibration and frames.

Nothing of an image is kept but its stamp, so memory does not grow with the images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from vio.datasets.bags.clock_steps import mended
from vio.datasets.bags.pictures import band_of_message, raw_gray
from vio.datasets.bags.store import Bag, Message, Topic
from vio.datasets.bags.topics import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    TF,
    VECTOR,
    Roles,
)
from vio.datasets.images import UnreadableImageError
from vio.datasets.levels import LEVEL_IMAGES, Band, is_mosaic
from vio.datasets.rigs.camera_info import CameraInfo, region_of
from vio.datasets.samples import MotionSamples, velocity_samples
from vio.errors import DataError
from vio.geometry.lie import FloatArray, rotation_from_quat_xyzw, se3_from_parts, se3_inverse
from vio.imu.two_sensors import GAPS, JOINED, joined_record, parted_sensors
from vio.numerics.robust import median
from vio.records import NS_PER_S, ImuRecord, IntArray, Trajectory, VelocitySample

__all__ = ["BagIndex", "Stamps", "camera_info_of", "index_bag", "info_topic", "stamp_of"]


class _SharedStampRules(NamedTuple):
    """When stamps that samples share are no times of theirs."""

    max_share: float = 0.5  # of the samples that share one with another
    min_logged_share: float = 0.9  # of the samples that the recorder's clock tells apart


_SHARED_STAMPS = _SharedStampRules()
# Names of RealSense's recorder for the distortions that ROS has names for.
_SDK_MODELS = {
    "none": "plumb_bob",
    "brown conrady": "plumb_bob",
    "kannala brandt4": "equidistant",
}
_SMALLER = {"milliseconds": 1_000_000, "microseconds": 1000}  # nanoseconds in each
_MIN_A_SECOND = 5  # stamps, that do not lie at its beginning by chance
_MOVING = "/tf, "  # how the moving frames are named among the streams


_Taker: TypeAlias = Callable[[Any, Message], None]  # of the fields of a message


@dataclass(slots=True)
class Rows:
    """The samples of one topic, in the order of recording."""

    times_ns: list[int] = field(default_factory=list)  # stamps; 0: there is none
    logged_ns: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.times_ns)

    def add(self, time_ns: int, message: Message, values: tuple[float, ...]) -> None:
        """Add a sample."""
        self.times_ns.append(time_ns)
        self.logged_ns.append(message.recorded_ns)
        self.values.append(values)

    def taken(self, rows: IntArray, columns: slice) -> Rows:
        """Return some samples, and some of their values."""
        kept = rows.tolist()
        return Rows(
            [self.times_ns[k] for k in kept],
            [self.logged_ns[k] for k in kept],
            [self.values[k][columns] for k in kept],
        )

    def in_order(self) -> tuple[IntArray, FloatArray]:
        """Return increasing times (N,) and values (N, K); of equal stamps the first."""
        times, first = np.unique(np.array(self.times_ns, dtype=np.int64), return_index=True)
        return times, np.array([self.values[k] for k in first.tolist()], dtype=np.float64)


@dataclass(slots=True)
class Stamps:
    """The images of one topic, in the order of recording."""

    times_ns: list[int] = field(default_factory=list)
    logged_ns: list[int] = field(default_factory=list)  # see `Message.recorded_ns`
    # stamp and time of recording as they were written
    raw: list[tuple[int, int]] = field(default_factory=list)
    encodings: dict[str, int] = field(default_factory=dict)  # and how many images have each
    size: tuple[int, int] | None = None  # width and height of the first raw image, pixels
    frame_id: str = ""
    bands: list[Band] = field(default_factory=list)  # of levels of 16-bit images
    mosaic: bool = False  # the first raw gray image looks like one of a Bayer pattern

    @property
    def unstamped(self) -> bool:
        """Whether no header has a stamp, so that the times of logging must serve."""
        return len(self.raw) > 1 and not any(stamp for stamp, _ in self.raw)

    def ordered(self) -> tuple[IntArray, IntArray, int]:
        """Return increasing stamps (N,), the rows in the order of recording that have them (N,),
        and how many stamps were repeated.
        """
        stamps = self.logged_ns if self.unstamped else self.times_ns
        times, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)
        return times, first.astype(np.int64), len(stamps) - len(times)


@dataclass(slots=True)
class BagIndex:
    """What one pass over a bag found."""

    left: Stamps = field(default_factory=Stamps)
    right: Stamps = field(default_factory=Stamps)
    imu: Rows = field(default_factory=Rows)  # gyro and accelerometer, or the gyro alone
    accel: Rows = field(default_factory=Rows)  # where it is a topic of its own
    imu_frame: str = ""
    velocities: Rows = field(default_factory=Rows)
    poses: Rows = field(default_factory=Rows)  # x y z qx qy qz qw
    # likewise, of /tf
    moving: dict[tuple[str, str], Rows] = field(default_factory=dict)
    infos: dict[str, CameraInfo] = field(default_factory=dict)  # by topic
    # T_parent_child of frames that do not move
    frames: dict[tuple[str, str], FloatArray] = field(default_factory=dict)
    frames_from: str = "/tf_static"
    disordered: dict[str, int] = field(default_factory=dict)  # samples that came late, by topic
    not_finite: dict[str, int] = field(default_factory=dict)  # samples left out, by topic
    notes: list[str] = field(default_factory=list)  # about clocks and stamps

    def imu_record(self) -> ImuRecord | None:
        """The inertial samples in the order of their stamps, at those of the gyro where the
        accelerometer is another topic; None: there are none.
        """
        if not self.imu:
            return None
        times, values = self.imu.in_order()
        if self.accel:
            return joined_record((times, values[:, :3]), self.accel.in_order())
        return ImuRecord(times, values[:, :3], values[:, 3:])

    def velocity_samples(self) -> MotionSamples[VelocitySample] | None:
        """The velocities in the order of their stamps; None: there are none."""
        if not self.velocities:
            return None
        times, values = self.velocities.in_order()
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
            self.frames[names_of(item)] = transform_of(item.transform)

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


def _trajectory(rows: Rows, *, imu: bool) -> Trajectory | None:
    """Return poses x y z qx qy qz qw in the order of their stamps; None: there are none."""
    if not rows:
        return None
    times, values = rows.in_order()
    q = values[:, 3:]
    norm = np.linalg.norm(q, axis=1)
    usable = norm > 0.5
    R = rotation_from_quat_xyzw(q[usable] / norm[usable, None])
    return Trajectory(
        se3_from_parts(R, values[usable, :3]), times[usable], "imu" if imu else "cam0"
    )


def names_of(item: Any) -> tuple[str, str]:
    """Return the parent and the child of a geometry_msgs/TransformStamped."""
    return str(item.header.frame_id).lstrip("/"), str(item.child_frame_id).lstrip("/")


def transform_of(fields: Any) -> FloatArray:
    """Return a geometry_msgs/Transform as a matrix (4, 4)."""
    t = fields.translation
    q = fields.rotation
    R = rotation_from_quat_xyzw(np.array([q.x, q.y, q.z, q.w]))
    return se3_from_parts(R, [t.x, t.y, t.z])


def stamp_of(fields: Any) -> int:
    """Return the stamp of a message's header, ns."""
    stamp = fields.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def info_topic(topics: Sequence[Topic], image: Topic) -> str | None:
    """Return the CameraInfo topic of an image topic: `camera_info` in its namespace, or in one
    above; in the bags of RealSense's own recorder, `info/camera_info` of the stream.
    """
    known = {t.name for t in topics if t.kind == CAMERA_INFO and t.count}
    parts = image.name.split("/")
    sdk = image.name.removesuffix("/image/data") + "/info/camera_info"
    if sdk in known:
        return sdk
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
    takers: dict[str, list[_Taker]] = {
        topic.name: [partial(_image, bag, stamps, topic)] for topic, stamps in cameras
    }
    for name, taker in _takers_of_motion(index, roles):
        takers.setdefault(name, []).append(taker)
    for name in infos:
        takers[name] = [partial(_info, index)]
    for topic in bag.topics:
        if topic.kind == TF and topic.name.endswith("tf_static"):
            takers[topic.name] = [lambda fields, message: index.add_frames(fields)]
    for message in bag.messages(list(takers)):
        fields = bag.decoded(message)
        for taker in takers[message.topic]:
            taker(fields, message)
    _settle_stamps(index, roles)
    for images, stamps in cameras:
        _check_one_depth(images, stamps, bag.path)
    return index


def _takers_of_motion(index: BagIndex, roles: Roles) -> Iterator[tuple[str, _Taker]]:
    """Yield topic and taker of samples and poses; one odometry may be both velocity and
    reference.
    """
    streams = (
        (roles.imu, _gyro if roles.accel is not None else _imu),
        (roles.accel, _accel),
        (roles.velocity, _velocity),
        (roles.reference, _pose),
    )
    for topic, take in streams:
        if topic is not None:
            yield topic.name, partial(take, index)


def _check_one_depth(topic: Topic, stamps: Stamps, path: Path) -> None:
    """Raise DataError where images of 8 and of 16 bits are mixed."""
    depths = {"16" in name for name in stamps.encodings}
    if len(depths) > 1:
        raise DataError(
            f"{path}: {topic.name} mixes {', '.join(stamps.encodings)}; record one encoding"
        )


def _image(bag: Bag, stamps: Stamps, topic: Topic, fields: Any, message: Message) -> None:
    stamps.times_ns.append(stamp_of(fields))
    stamps.raw.append((stamps.times_ns[-1], message.logged_ns))
    stamps.logged_ns.append(message.recorded_ns)
    stamps.frame_id = stamps.frame_id or str(fields.header.frame_id)
    name = str(fields.encoding) if topic.kind == IMAGE else "compressed"
    stamps.encodings[name] = stamps.encodings.get(name, 0) + 1
    compressed = topic.kind == COMPRESSED
    where = f"{bag.path}, {topic.name}"
    if not compressed:
        stamps.size = stamps.size or (int(fields.width), int(fields.height))
        if len(stamps.times_ns) == 1 and name in ("mono8", "mono16", "8UC1", "16UC1"):
            stamps.mosaic = _looks_like_mosaic(fields, where)
    if (len(stamps.times_ns) - 1) % max(topic.count // LEVEL_IMAGES, 1) == 0:
        band = band_of_message(fields, where, compressed=compressed)
        stamps.bands += [] if band is None else [band]


def _looks_like_mosaic(fields: Any, where: str) -> bool:
    try:
        return is_mosaic(raw_gray(fields, where))
    except UnreadableImageError:
        return False


def _add(
    index: BagIndex, rows: Rows, message: Message, time_ns: int, values: tuple[float, ...]
) -> None:
    if not np.isfinite(values).all():
        index.not_finite[message.topic] = index.not_finite.get(message.topic, 0) + 1
        return
    rows.add(time_ns, message, values)


def _imu(index: BagIndex, fields: Any, message: Message) -> None:
    values = (*_rates(fields, message), *_forces(fields, message))
    index.imu_frame = index.imu_frame or str(fields.header.frame_id)
    _add(index, index.imu, message, stamp_of(fields), values)


def _gyro(index: BagIndex, fields: Any, message: Message) -> None:
    index.imu_frame = index.imu_frame or str(fields.header.frame_id)
    _add(index, index.imu, message, stamp_of(fields), _rates(fields, message))


def _accel(index: BagIndex, fields: Any, message: Message) -> None:
    _add(index, index.accel, message, stamp_of(fields), _forces(fields, message))


def _rates(fields: Any, message: Message) -> tuple[float, float, float]:
    w = fields.vector if message.kind == VECTOR else fields.angular_velocity
    return w.x, w.y, w.z


def _forces(fields: Any, message: Message) -> tuple[float, float, float]:
    a = fields.vector if message.kind == VECTOR else fields.linear_acceleration
    return a.x, a.y, a.z


def _velocity(index: BagIndex, fields: Any, message: Message) -> None:
    twist = fields.twist.twist if hasattr(fields.twist, "twist") else fields.twist
    v = twist.linear
    w = twist.angular
    values = (v.x, v.y, v.z, w.x, w.y, w.z)
    _add(index, index.velocities, message, stamp_of(fields), values)


def _pose(index: BagIndex, fields: Any, message: Message) -> None:
    if message.kind == TF:
        for item in fields.transforms:
            key = (str(item.header.frame_id).lstrip("/"), str(item.child_frame_id).lstrip("/"))
            p = item.transform.translation
            q = item.transform.rotation
            values = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
            _add(index, index.moving.setdefault(key, Rows()), message, stamp_of(item), values)
        return
    if hasattr(fields, "transform"):
        p = fields.transform.translation
        q = fields.transform.rotation
    else:
        pose = fields.pose.pose if hasattr(fields.pose, "pose") else fields.pose
        p = pose.position
        q = pose.orientation
    values = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
    _add(index, index.poses, message, stamp_of(fields), values)


def _settle_stamps(index: BagIndex, roles: Roles) -> None:
    """Give each stream stamps that tell one time: without those of no time, and without the steps
    of a clock that was set back.
    """
    _split_mixed(index, roles)
    streams = _streams(index, roles)
    behind_ns = _behind_the_log(index)
    for name, rows in streams.items():
        _check_digits(name, rows.times_ns)
        if isinstance(rows, Rows):
            index.notes += _stamped(name, rows, behind_ns)
        if any(rows is samples for samples in (index.imu, index.accel, index.velocities)):
            index.notes += _of_one_stamp(name, rows, behind_ns)
    _mend_clocks(index, streams)
    for name, rows in streams.items():
        if isinstance(rows, Rows) and not name.startswith(_MOVING):
            late = int((np.diff(np.array(rows.times_ns, dtype=np.int64)) < 0).sum())
            if late:
                index.disordered.setdefault(name, late)


def _mend_clocks(index: BagIndex, streams: Mapping[str, Stamps | Rows]) -> None:
    """Take out the steps of clocks that were set back, and note them."""
    usable = {
        name: rows
        for name, rows in streams.items()
        if len(rows.times_ns) > 1 and any(rows.times_ns)
    }
    arrays = {
        name: (
            np.array(rows.times_ns, dtype=np.int64),
            np.array(rows.logged_ns, dtype=np.int64),
        )
        for name, rows in usable.items()
    }
    stamps, steps = mended(arrays)
    if not steps:
        return
    begin_ns = min(int(logged.min()) for _, logged in arrays.values())
    index.notes += [step.note(begin_ns) for step in steps]
    for name, rows in usable.items():
        rows.times_ns = stamps[name].tolist()


def _split_mixed(index: BagIndex, roles: Roles) -> None:
    """Part the messages of one topic that hold the gyro or the accelerometer alone, as two streams
    that a driver sends on one topic.
    """
    if roles.imu is None or roles.accel is not None or len(index.imu) < 2:
        return
    values = np.array(index.imu.values)
    parts = parted_sensors(values[:, :3], values[:, 3:])
    if parts is None:
        return
    of_gyro, of_accel = parts
    whole = index.imu
    index.imu = whole.taken(of_gyro, slice(0, 3))
    index.accel = whole.taken(of_accel, slice(3, 6))
    index.notes.append(
        f"{roles.imu.name} holds gyro and accelerometer in messages of their own: {JOINED}"
    )


def _streams(index: BagIndex, roles: Roles) -> dict[str, Stamps | Rows]:
    """Return the stamped messages of the topics in use, by topic."""
    images = (index.left, index.right)
    found: dict[str, Stamps | Rows] = {
        topic.name: stamps for topic, stamps in zip(roles.cameras, images, strict=False)
    }
    samples = (
        (roles.imu, index.imu),
        (roles.imu if roles.accel is None else roles.accel, index.accel),
        (roles.velocity, index.velocities),
        (roles.reference, index.poses),
    )
    for topic, rows in samples:
        if topic is not None and rows:
            # one odometry may be both velocity and reference, and one topic both sensors
            found[topic.name if topic.name not in found else f"{topic.name} (2)"] = rows
    for (parent, child), rows in index.moving.items():
        found[f"{_MOVING}{parent} to {child}"] = rows
    return found


def _behind_the_log(index: BagIndex) -> int:
    """Return what must be added to the times of recording to get the clock of the stamps, ns.

    Zero where the two tell the same time but for the delays of messages.
    """
    for stamps in (index.left, index.right):
        if any(stamps.times_ns):
            logged = np.array(stamps.logged_ns, dtype=np.int64)
            offset_ns = round(median(np.array(stamps.times_ns, dtype=np.int64) - logged))
            return offset_ns if abs(offset_ns) > NS_PER_S else 0
    return 0


def _stamped(name: str, rows: Rows, behind_ns: int) -> list[str]:
    """Leave out the samples without a stamp, or give all of them the times of recording where none
    has one; return a note of it.
    """
    without = [k for k, time_ns in enumerate(rows.times_ns) if time_ns == 0]
    if len(without) == len(rows) > 1:
        rows.times_ns = [logged_ns + behind_ns for logged_ns in rows.logged_ns]
        return [
            f"the headers of {name} have no stamps; the times of logging are used, which jitter"
        ]
    if not without or min(rows.times_ns) < 0 or _begins_at_zero(rows):
        return []
    stamped = rows.taken(np.flatnonzero(rows.times_ns), slice(None))
    rows.times_ns = stamped.times_ns
    rows.logged_ns = stamped.logged_ns
    rows.values = stamped.values
    return [f"{len(without)} messages of {name} have no stamp and are left out"]


def _of_one_stamp(name: str, rows: Stamps | Rows, behind_ns: int) -> list[str]:
    """Give samples the times of recording where most share their stamp with another one, as where a
    driver stamps them with the time of the last frame; return a note of samples that differ and
    share a stamp.
    """
    assert isinstance(rows, Rows)
    times = np.array(rows.times_ns, dtype=np.int64)
    order = np.argsort(times, kind="stable")
    values = np.array(rows.values)[order]
    alike = np.diff(times[order]) == 0
    count = int((alike & (values[1:] != values[:-1]).any(axis=1)).sum())
    if not count:
        return []
    told_apart = len(set(rows.logged_ns)) > _SHARED_STAMPS.min_logged_share * len(rows)
    if count > _SHARED_STAMPS.max_share * len(rows) and told_apart:
        rows.times_ns = [logged_ns + behind_ns for logged_ns in rows.logged_ns]
        return [
            f"{count} of {len(rows)} messages of {name} have the stamp of another one, as where a "
            "driver stamps samples with the time of the last frame; the times of logging are used, "
            "which jitter"
        ]
    return [
        f"{count} of {len(rows)} messages of {name} have the stamp of another one, though they "
        "differ, and are left out; a driver that repeats stamps is to be mended"
    ]


def _check_digits(name: str, times_ns: Sequence[int]) -> None:
    """Raise DataError where a driver put microseconds or milliseconds into the nanoseconds."""
    stamps = np.array(times_ns, dtype=np.int64)
    stamps = stamps[stamps != 0]
    seconds, counts = np.unique(stamps // NS_PER_S, return_counts=True)
    most = int((stamps % NS_PER_S).max(initial=0))
    unit = next((name for name, size in _SMALLER.items() if most < NS_PER_S // size), None)
    # the seconds in the middle are whole
    if unit is None or len(seconds) < 3 or counts[1:-1].min() < _MIN_A_SECOND or most == 0:
        return
    raise DataError(
        f"{name}: all its stamps lie within the first {most} ns of a second, as where {unit} were "
        f"written into their nanoseconds; multiply these by {_SMALLER[unit]}"
    )


def _begins_at_zero(rows: Rows) -> bool:
    """Return whether the stamps count from the first one, so that 0 is a time."""
    steps = np.diff(np.unique(np.array(rows.times_ns, dtype=np.int64)))
    return len(steps) > 1 and int(steps[0]) <= GAPS.usual_intervals * float(np.median(steps[1:]))


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
    model = str(fields.distortion_model)
    model = _SDK_MODELS.get(model.lower(), model)
    matrices = (K.reshape(3, 3), R.reshape(3, 3), P.reshape(3, 4))
    roi = fields.roi
    region = region_of([int(x) for x in (roi.x_offset, roi.y_offset, roi.width, roi.height)])
    binning = (max(int(fields.binning_x), 1), max(int(fields.binning_y), 1))
    return CameraInfo(topic, *size, model, tuple(D.tolist()), *matrices, binning, region)
