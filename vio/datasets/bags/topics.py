"""Which topics of a bag are cameras, IMU, velocities and ground truth: by type and name, or as
named.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vio.datasets.bags.store import Topic
from vio.datasets.unused import listed
from vio.errors import DataError

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMU = "sensor_msgs/msg/Imu"
VECTOR = "geometry_msgs/msg/Vector3Stamped"
TRANSFORM = "geometry_msgs/msg/Transform"
TF = "tf2_msgs/msg/TFMessage"
ODOMETRY = "nav_msgs/msg/Odometry"
TWISTS = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped")
POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
_ROLES: dict[str, tuple[str, ...]] = {
    "left": (IMAGE, COMPRESSED),
    "right": (IMAGE, COMPRESSED),
    "imu": (IMU, VECTOR),
    "accel": (IMU, VECTOR),
    "velocity": (ODOMETRY, *TWISTS),
    "reference": (*POSES, ODOMETRY, TF),
}
# What distinguishes the two cameras of a pair in topics' names, left first.
_SIDES = (
    ("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("Infrared_1", "Infrared_2"),
    ("infrared_1", "infrared_2"), ("infrared1", "infrared2"), ("infra_1", "infra_2"),
    ("cam0", "cam1"), ("camera0", "camera1"), ("camera_0", "camera_1"), ("infra1", "infra2"),
    ("fisheye1", "fisheye2"), ("fisheye_1", "fisheye_2"), ("Fisheye_1", "Fisheye_2"),
    ("cam_0", "cam_1"), ("cam1", "cam2"), ("image_0", "image_1"), ("0", "1"),
)  # fmt: skip
# what image_transport appends to the topic of the raw images
_TRANSPORTS = re.compile(r"/(?:compressed|zstd)$")
# share of the other's messages that raw images must have, to be taken in the place of compressed
# ones
_WHOLE = 0.9
_NO_GRAY = re.compile(
    r"depth|disparity|mask|label|semantic|thermal|theora|confidence|points", re.IGNORECASE
)
_NO_STREAMS = (CAMERA_INFO, TF, TRANSFORM)
_TRUTH = re.compile(
    r"ground_?truth|\bgt\b|_gt|gt_|vicon|mocap|optitrack|leica|truth|vrpn", re.IGNORECASE
)
# Drivers that publish the two sensors of an IMU apart: `/camera/gyro/sample`, `/imu/acceleration`.
_GYRO = re.compile(r"gyr|angular_?vel", re.IGNORECASE)
_ACCEL = re.compile(r"acc", re.IGNORECASE)
_NO_FORCE = re.compile(r"free|linear_acc|gravity|filtered_acc", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Roles:
    """The topics that a recording is made of."""

    left: Topic
    right: Topic | None  # None: the recording is that of one camera
    imu: Topic | None  # the gyro alone where `accel` is another topic
    accel: Topic | None
    velocity: Topic | None
    reference: Topic | None

    @property
    def cameras(self) -> tuple[Topic, ...]:
        """The image topics: left and right, or left alone."""
        if self.right is None:
            return (self.left,)
        return (self.left, self.right)


def choose(topics: Sequence[Topic], named: str | None, where: str) -> tuple[Roles, tuple[str, ...]]:
    """Return the topics of each role, and notes about what was chosen, is empty, or is not used.

    Args:
        topics: all topics of the bag.
        named: `left=/a,right=/b,imu=/c`, which takes the place of the choice; a role named `none`
            is left out.
        where: the bag, for messages.

    Raises:
        DataError: a named topic is missing, empty or of another type, or no pair can be chosen of
            several image topics.
    """
    given = _named(topics, named, where)
    filled = [t for t in topics if t.count]
    notes: list[str] = []
    if "left" in given and "right" in given:
        left = given["left"]
        right = given["right"]
        assert left is not None
    else:
        left, right = _cameras(filled, given, where, notes)
    imu, accel = _imu(filled, given, left, notes)
    if "reference" in given:
        reference = given["reference"]
    else:
        reference = _reference(filled, notes)
    velocity = given.get("velocity")
    if "velocity" not in given and imu is None:
        velocity = _only_velocity(filled, reference)
    roles = Roles(left, right, imu, accel, velocity, reference)
    return roles, (*notes, *_not_used(topics, roles))


def _only_velocity(filled: Sequence[Topic], reference: Topic | None) -> Topic | None:
    """Return the topic of velocities that is not the reference; None: there is none, or several."""
    moving = [t for t in filled if t.kind in (ODOMETRY, *TWISTS) and t != reference]
    return moving[0] if len(moving) == 1 else None


def _named(topics: Sequence[Topic], named: str | None, where: str) -> dict[str, Topic | None]:
    """Return the topics that are named by role; None: the role is left out."""
    if named is None:
        return {}
    given: dict[str, Topic | None] = {}
    for part in named.split(","):
        role, equals, name = (x.strip() for x in part.partition("="))
        if role not in _ROLES or not equals or not name:
            raise DataError(
                f"--topics {named!r}: {part!r} is no ROLE=/TOPIC; roles are {', '.join(_ROLES)}"
            )
        left_out = name == "none" and role != "left"
        if left_out:
            given[role] = None
        else:
            given[role] = _topic_for(role, name, topics, where)
    return given


def _topic_for(role: str, name: str, topics: Sequence[Topic], where: str) -> Topic:
    """Return the topic of a name, with or without the slash in front.

    Raises:
        DataError: there is none, or it is empty or of another type than its role takes.
    """
    by_name = {t.name: t for t in topics}
    topic = by_name.get(name) or by_name.get(f"/{name}")
    if topic is None:
        fit = [t.name for t in topics if t.kind in _ROLES[role] and t.count]
        raise DataError(
            f"{where}: holds no topic {name!r} for {role}; those of its type are {listed(fit)}"
        )
    if topic.kind not in _ROLES[role]:
        raise DataError(
            f"{where}: {name} holds {topic.kind}, not {' or '.join(_ROLES[role])} as {role} must"
        )
    if not topic.count:
        raise DataError(
            f"{where}: {name} ({role}) holds no message; name another topic, or another bag"
        )
    return topic


def _cameras(
    filled: Sequence[Topic], given: dict[str, Topic | None], where: str, notes: list[str]
) -> tuple[Topic, Topic | None]:
    """Choose the left and right image topic.

    None in the place of the right one where there is one camera.
    """
    images = list(filter(_may_be_gray, filled))
    left_named = given.get("left")
    named = [t for t in (left_named,) if t is not None and t not in images]
    alone, others = _one_camera([*images, *named])
    if alone is not None and given.get("right") is None:
        if left_named is not None:
            return left_named, None
        if others:
            same = f"{alone.name} is taken; {listed(others)} shows the same camera"
            notes.append(f"{same} (choose with --topics left=/NAME)")
        return alone, None
    _check_pair_possible(images, given, where)
    return _pair(images, given, where)


def _may_be_gray(topic: Topic) -> bool:
    return topic.kind in (IMAGE, COMPRESSED) and not _NO_GRAY.search(topic.name)


def _check_pair_possible(
    images: Sequence[Topic], given: dict[str, Topic | None], where: str
) -> None:
    """Raise DataError where no right image is wanted, or there are less than two."""
    have = listed([t.name for t in images])
    if "right" in given and given["right"] is None:
        raise DataError(f"{where}: of {have}, name the camera: --topics left=/A,right=none")
    if len(images) < 2:
        needed = "stereo needs two" if images else "one camera needs one, stereo two"
        raise DataError(
            f"{where}: holds {len(images)} image topics with messages ({have}); {needed}"
        )


def _pair(
    images: Sequence[Topic], given: dict[str, Topic | None], where: str
) -> tuple[Topic, Topic]:
    """Choose left and right of several image topics by their names.

    Raises:
        DataError: no pair, or several, could be meant.
    """
    pairs = _named_as_pairs(images)
    for role, k in (("left", 0), ("right", 1)):
        if given.get(role) is not None:
            pairs = [p for p in pairs if p[k] == given[role]]
    if len(pairs) > 1:
        pairs = _best_ranked(pairs)
    if len(pairs) == 1:
        return pairs[0]
    what = "no two topics are named as left and right"
    if pairs:
        what = "several topics could be the pair"
    names = listed([t.name for t in images])
    raise DataError(f"{where}: {what} ({names}); name them with --topics left=/A,right=/B")


def _best_ranked(pairs: Sequence[tuple[Topic, Topic]]) -> list[tuple[Topic, Topic]]:
    """Return the pairs whose left topic ranks first; several may."""
    best = min(_rank(left) for left, _ in pairs)
    return [pair for pair in pairs if _rank(pair[0]) == best]


def _named_as_pairs(images: Sequence[Topic]) -> list[tuple[Topic, Topic]]:
    """Return the pairs of topics whose names differ by the first words for the sides that any
    pair has.
    """
    by_name = {t.name: t for t in images}
    for a, b in _SIDES:
        pairs = []
        for left in images:
            head, found, tail = left.name.rpartition(a)
            right = by_name.get(f"{head}{b}{tail}") if found else None
            if right is not None and right != left and right.kind == left.kind:
                pairs.append((left, right))
        if pairs:
            return pairs
    return []


def _one_camera(images: Sequence[Topic]) -> tuple[Topic | None, list[str]]:
    """Return the topic of the only camera and its others, as one may be recorded raw and
    compressed; None: several.
    """
    if len({without_transport(t.name) for t in images}) != 1:
        return None, []
    most = max(t.count for t in images)
    best = min((t for t in images if t.count > _WHOLE * most), key=_rank)
    return best, [t.name for t in images if t != best]


def without_transport(name: str) -> str:
    """Return the topic of the raw images that a topic's are compressed of, or the topic itself."""
    return _TRANSPORTS.sub("", name)


def _rank(topic: Topic) -> tuple[int, int, int]:
    """Raw images before rectified ones, uncompressed before compressed, gray before colour."""
    return (
        int("rect" in topic.name),
        int(topic.kind == COMPRESSED),
        int("color" in topic.name or "rgb" in topic.name),
    )


def _imu(
    filled: Sequence[Topic], given: dict[str, Topic | None], left: Topic, notes: list[str]
) -> tuple[Topic | None, Topic | None]:
    """Choose the topic of the IMU, or those of gyro and accelerometer where no topic has both."""
    named = given.get("imu")
    accel_named = given.get("accel")
    if "imu" in given and not _lacks_accel(given):
        return named, accel_named
    sensors = list(filter(_may_be_imu, filled))
    both: Sequence[Topic] = ()
    if named is None:
        both = _of_sensor(sensors, "")
    gyros = _of_sensor(sensors if named is None else [named], "gyro")
    accels = _of_sensor(sensors, "accel") if accel_named is None else [accel_named]
    if gyros and accels and not both:
        return _joined_imu(gyros, accels, left, notes)
    return _single(_of_kind(both or gyros, IMU), left, notes), None


def _of_kind(topics: Sequence[Topic], kind: str) -> list[Topic]:
    return [topic for topic in topics if topic.kind == kind]


def _lacks_accel(given: Mapping[str, Topic | None]) -> bool:
    """Tell whether the topic named for the IMU is a gyro, and none is named for the accelerometer."""
    named = given.get("imu")
    return named is not None and "accel" not in given and _sensor_of(named) == "gyro"


def _may_be_imu(topic: Topic) -> bool:
    return topic.kind == IMU or (topic.kind == VECTOR and bool(_sensor_of(topic)))


def _joined_imu(
    gyros: Sequence[Topic], accels: Sequence[Topic], left: Topic, notes: list[str]
) -> tuple[Topic, Topic]:
    """Choose the gyro that is named most as the left camera, and the accelerometer named as it."""
    gyro = max(gyros, key=lambda t: (_shared(t.name, left.name), t.count))
    accel = max(accels, key=lambda t: (_shared(t.name, gyro.name), t.count))
    notes.append(
        f"{gyro.name} and {accel.name} are joined to one IMU: the acceleration is interpolated at "
        "the gyro's stamps (choose with --topics imu=/GYRO,accel=/ACCEL)"
    )
    return gyro, accel


def _of_sensor(topics: Sequence[Topic], sensor: str) -> list[Topic]:
    return [t for t in topics if _sensor_of(t) == sensor]


def _sensor_of(topic: Topic) -> str:
    """Return gyro or accel where a topic's name says that it holds one of them alone, else
    nothing.
    """
    gyro = _GYRO.search(topic.name) is not None
    accel = _ACCEL.search(topic.name) is not None
    if topic.kind == VECTOR and _NO_FORCE.search(topic.name):
        return ""
    return "" if gyro == accel else "gyro" if gyro else "accel"


def _single(found: Sequence[Topic], left: Topic, notes: list[str]) -> Topic | None:
    """Choose the topic of the IMU: the only one, or the one whose name shares most with the left
    camera's.
    """
    if len(found) < 2:
        return found[0] if found else None
    best = max(found, key=lambda t: (_shared(t.name, left.name), t.count))
    others = listed([t.name for t in found if t != best])
    notes.append(
        f"{best.name} is taken as imu; others are {others} (choose with --topics imu=/NAME)"
    )
    return best


def _shared(a: str, b: str) -> int:
    """Count the leading parts that two names share."""
    parts = list(zip(a.strip("/").split("/"), b.strip("/").split("/"), strict=False))
    return next((k for k, (x, y) in enumerate(parts) if x != y), len(parts))


def _reference(filled: Sequence[Topic], notes: list[str]) -> Topic | None:
    """Choose ground truth: a pose topic whose name states it; other poses, maybe estimates, are
    only reported.
    """
    poses = [t for t in filled if t.kind in (*POSES, ODOMETRY)]
    named = [t for t in poses if _TRUTH.search(t.name)]
    if named:
        return named[0]
    if poses:
        notes.append(
            f"{listed([t.name for t in poses])} may be ground truth: if so, give --topics "
            "reference=/NAME"
        )
    return None


def _not_used(topics: Sequence[Topic], roles: Roles) -> list[str]:
    used = {
        roles.left,
        roles.right,
        roles.imu,
        roles.accel,
        roles.velocity,
        roles.reference,
    }
    empty = [t.name for t in topics if not t.count]
    others = [t.name for t in topics if t.count and t not in used and t.kind not in _NO_STREAMS]
    notes = [f"topics without a message: {listed(empty)}"] if empty else []
    if others:
        return [*notes, f"not used: {listed(others)}"]
    return notes
