#!/usr/bin/env bash
# librealsense 2.59.1: its recorder writes ROS 2 bags (`.db3`; `.bag` is refused). The headers of images and samples have the
# time of recording, from 0 on; the time of the frame is text in the topic `…/metadata`. Poses of cameras are in /tf_static;
# that of the IMU, though registered, is nowhere.
# Guessed: a ROS 1 bag as up to 2.56, the time of the frame in the header, a transform for each stream.
# Matters here: header stamps of images and IMU differ by exposure, transfer and their jitter; who reads them as sensor times
# has a time offset that changes from frame to frame.
# Source: rs2::recorder, rs2::software_device; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pyrealsense2==2.59.1.11053 rosbags==0.11.9
PYTHONPATH="$folder/packages" python3 - "$folder" <<'PYTHON'
import re
import sqlite3
import sys
import time
from pathlib import Path

import pyrealsense2 as rs
from rosbags.typesys import Stores, get_typestore

folder = Path(sys.argv[1])
device = rs.software_device()
try:
    rs.recorder(str(folder / "a.bag"), device)
    refused = False
except RuntimeError as error:
    refused = "db3" in str(error)
print("pyrealsense2", rs.__version__, "refuses .bag:", refused)
stereo, motion = device.add_sensor("Stereo Module"), device.add_sensor("Motion Module")
lens = rs.intrinsics()
lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = 64, 48, 50.0, 50.0, 31.5, 23.5
lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.0] * 5
video = rs.video_stream()
video.type, video.index, video.uid, video.fmt = rs.stream.infrared, 1, 1, rs.format.y8
video.width, video.height, video.fps, video.bpp, video.intrinsics = 64, 48, 20, 1, lens
camera = stereo.add_video_stream(video)
turned = rs.motion_stream()
turned.type, turned.index, turned.uid, turned.fps = rs.stream.gyro, 0, 2, 200
turned.fmt, turned.intrinsics = rs.format.motion_xyz32f, rs.motion_device_intrinsic()
gyro = motion.add_motion_stream(turned)
pose = rs.extrinsics()
pose.rotation, pose.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0.01, 0.02, 0.03]
camera.register_extrinsics_to(gyro, pose)
path = folder / "a.db3"
recorder, kept = rs.recorder(str(path), device), rs.frame_queue(100)
sensors = recorder.query_sensors()
for sensor, profile in zip(sensors, (camera, gyro)):
    sensor.open([profile])
    sensor.start(kept)
for k in range(5):
    value = rs.vector()
    value.x, value.y, value.z = 0.0, 0.0, 1.0
    sample = rs.software_motion_frame()
    sample.data, sample.timestamp, sample.frame_number = value, 1000.0 + 50 * k, k
    sample.domain, sample.profile = rs.timestamp_domain.hardware_clock, gyro.as_motion_stream_profile()
    motion.on_motion_frame(sample)
    image = rs.software_video_frame()
    image.pixels, image.stride, image.bpp = bytes(64 * 48), 64, 1
    image.timestamp, image.frame_number = 1000.0 + 50 * k, k
    image.domain, image.profile = rs.timestamp_domain.hardware_clock, camera.as_video_stream_profile()
    stereo.on_video_frame(image)
    time.sleep(0.02)
for sensor in sensors:
    sensor.stop()
    sensor.close()
del recorder
store = get_typestore(Stores.ROS2_HUMBLE)
rows = sqlite3.connect(path).execute(
    "SELECT topics.name, topics.type, data FROM messages JOIN topics ON topics.id = topic_id ORDER BY messages.id"
).fetchall()
headers, stated, frames = [], [], set()
for name, kind, data in rows:
    if name.endswith("image/data/compressed"):
        stamp = store.deserialize_cdr(data, kind).header.stamp
        headers.append(stamp.sec + 1e-9 * stamp.nanosec)
    if name.endswith("image/metadata"):
        stated.append(float(re.search(rb";timestamp=([\d.]+)", data)[1]))
    if name == "/tf_static":
        frames |= {t.child_frame_id for t in store.deserialize_cdr(data, kind).transforms}
print("headers, s:", [round(t, 4) for t in headers])
print("metadata, ms:", stated, "frames of /tf_static:", sorted(frames))
assert refused
assert stated == [1000.0, 1050.0, 1100.0, 1150.0, 1200.0]
assert max(headers) < 0.9
assert frames == {"Infrared1"}
assert not any("Gyro" in name and "/tf" in name for name, _, _ in rows)
PYTHON
