#!/usr/bin/env bash
# Bags that ROS 1's own rosbag (Debian's package python3-rosbag) writes, compresses and splits are read here, with the
# same images and times. Outside CI: apt-get install python3-rosbag python3-sensor-msgs.
# Bags written here are those of ROS 2, so there is none that ROS 1 could play.
#
#     tools/ros1_bags.sh PYTHON      # the Python that has stereo-vio
set -euo pipefail
python=${1:-python3}
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

/usr/bin/python3 - "$folder" <<'PYTHON'
import random
import sys

import genpy
import rosbag
from sensor_msgs.msg import CameraInfo, Image, Imu

folder = sys.argv[1]

def messages():
    """Yield topics and messages of two seconds: pairs at 10 Hz and an IMU at 100 Hz."""
    random.seed(0)
    for k in range(200):
        stamp = genpy.Time(1500000000 + k // 100, 10_000_000 * (k % 100))
        imu = Imu()
        imu.header.stamp = stamp
        imu.angular_velocity.x = 0.001 * k
        imu.linear_acceleration.z = 9.81
        yield "/imu", imu, stamp
        if k % 10:
            continue
        for side, shift in (("left", 0.0), ("right", -40.0)):
            image = Image(height=120, width=160, encoding="mono8", step=160)
            image.header.stamp = stamp
            image.data = bytes(random.randrange(256) for _ in range(160 * 120))
            yield f"/{side}/image_rect", image, stamp
            info = CameraInfo(height=120, width=160, distortion_model="plumb_bob", D=[0.0] * 5)
            info.header.stamp = stamp
            info.K = [200.0, 0, 80, 0, 200.0, 60, 0, 0, 1]
            info.R = [1.0, 0, 0, 0, 1, 0, 0, 0, 1]
            info.P = [200.0, 0, 80, shift, 0, 200.0, 60, 0, 0, 0, 1, 0]
            yield f"/{side}/camera_info", info, stamp


for compression in ("none", "bz2", "lz4"):
    with rosbag.Bag(f"{folder}/{compression}.bag", "w", compression=compression, chunk_threshold=65536) as bag:
        for topic, message, stamp in messages():
            bag.write(topic, message, stamp)
for k in range(2):  # as `rosbag record --split --duration=1` ends one bag and begins the next
    with rosbag.Bag(f"{folder}/split_{k}.bag", "w") as part, rosbag.Bag(f"{folder}/none.bag") as whole:
        for topic, message, stamp in whole.read_messages():
            if (stamp.secs - 1500000000) == k:
                part.write(topic, message, stamp)
PYTHON

"$python" - "$folder" <<'PYTHON'
import hashlib
import sys
from pathlib import Path

from vio.datasets import open_dataset
from vio.records import StereoFrame

folder = Path(sys.argv[1])


def digest(names):
    """Return the counts of frames and samples of some bags in turn, and a digest of all values."""
    sums = hashlib.sha256()
    frames = samples = 0
    for name in names:
        for event in open_dataset(folder / name).events():
            sums.update(str(event.time_ns).encode())
            if isinstance(event, StereoFrame):
                frames += 1
                sums.update(event.left.tobytes() + event.right.tobytes())
            else:
                samples += 1
                sums.update(event.gyro.tobytes() + event.accel.tobytes())
    return frames, samples, sums.hexdigest()[:12]


found = {name: digest([f"{name}.bag"]) for name in ("none", "bz2", "lz4")}
found["split"] = digest(["split_0.bag", "split_1.bag"])
for name, values in found.items():
    print(name, *values)
# without the pose of the IMU in the camera its samples are left out
assert found["none"][:2] == (20, 0), found
assert len(set(found.values())) == 1, found
PYTHON
