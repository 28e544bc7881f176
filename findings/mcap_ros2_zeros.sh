#!/usr/bin/env bash
# mcap-ros2-support 0.6.0: what its `Writer` does not find in a message is written as zero, without an error. A ROS 1 message (genpy), whose times are `secs` and `nsecs`,
# is written whole but for its stamp, which becomes 0. A position given as a list becomes (0, 0, 0); three numbers of a covariance are filled up with 33 zeros.
# A covariance as a numpy array raises an error.
# Guessed: a message that does not fit its definition is refused, as by rosbags ("Unexpected array length").
# Matters here: of a recording converted with it from ROS 1 all images and IMU samples have the stamp 0, so that pairs and clocks are gone (ours then takes the times of recording, and
# says so); or a trajectory is at the origin, with a covariance of zero.
# Source: `_get_property` and `_write_complex_type` in mcap_ros2/_dynamic.py; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" mcap-ros2-support==0.6.0 mcap==1.6.0 numpy==2.4.6
cd "$folder"
apt-get download -qq python3-genpy=0.6.16-2 python3-genmsg=0.6.0-1 python3-std-msgs=0.5.13-2 python3-geometry-msgs=1.13.1-1 python3-roslib=1.15.8-3 2>/dev/null
for package in python3-*.deb; do dpkg -x "$package" debian; done
PYTHONPATH="$folder/packages:$folder/debian/usr/lib/python3/dist-packages" python3 - <<'PYTHON'
import io
from importlib.metadata import version

import genpy
import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from mcap_ros2.reader import read_ros2_messages
from mcap_ros2.writer import Writer

KIND = "geometry_msgs/msg/PoseWithCovarianceStamped"
PARTS = {
    None: "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
}
DEFINITION = "".join((f"{'=' * 80}\nMSG: {name}\n" if name else "") + text for name, text in PARTS.items())


def stored(message):
    """Write one message, and return its stamp (s), position and covariance as they are read again."""
    file = io.BytesIO()
    writer = Writer(file)
    writer.write_message("/pose", writer.register_msgdef(KIND, DEFINITION), message, log_time=10**9)
    writer.finish()
    file.seek(0)
    (read,) = (message.ros_msg for message in read_ros2_messages(file))
    stamp, point = read.header.stamp, read.pose.pose.position
    return stamp.sec + 1e-9 * stamp.nanosec, (point.x, point.y, point.z), list(read.pose.covariance)


def message(stamp=None, position=None, covariance=None):
    return {
        "header": {"stamp": stamp or {"sec": 5, "nanosec": 0}, "frame_id": "map"},
        "pose": {
            "pose": {"position": {"x": 1.0, "y": 2.0, "z": 3.0} if position is None else position},
            "covariance": [0.25] * 36 if covariance is None else covariance,
        },
    }


print("mcap-ros2-support", version("mcap-ros2-support"))
assert stored(message()) == (5.0, (1.0, 2.0, 3.0), [0.25] * 36)

ros1 = PoseWithCovarianceStamped()
ros1.header.stamp = genpy.Time(5, 0)
ros1.pose.pose.position.x = 1.0
ros1.pose.covariance = [0.25] * 36
stamp, position, covariance = stored(ros1)
print("a message of ROS 1: stamp", stamp, "position", position, "covariance", covariance[:2])
assert (stamp, position, covariance) == (0.0, (1.0, 0.0, 0.0), [0.25] * 36)

position = stored(message(position=[1.0, 2.0, 3.0]))[1]
print("a position that is a list:", position)
assert position == (0.0, 0.0, 0.0)
stamp = stored(message(stamp=5.0))[0]
print("a stamp of 5.0 s:", stamp)
assert stamp == 0.0
covariance = stored(message(covariance=[0.25, 0.25, 0.25]))[2]
print("a covariance of three numbers:", covariance[:5], "...")
assert covariance == [0.25] * 3 + [0.0] * 33
try:
    stored(message(covariance=np.full(36, 0.25)))
    raise AssertionError("a numpy array is written")
except ValueError as error:
    print("a covariance that is an ndarray:", error)
PYTHON
