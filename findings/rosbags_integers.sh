#!/usr/bin/env bash
# rosbags 0.11.9: an array of int64 in a field of float64 is written as its bits: a camera matrix given as [500, 0, 320, ...] comes back as 2.5e-321, 0, 1.6e-321, in
# messages of ROS 1 and ROS 2, and the bag is valid. float32 in the same field, or uint16 for image data, raises an error.
# Guessed: 500 is written as 500.0, as for the numbers beside it (a float field of a message takes an int), or refused, as float32 is.
# Matters here: a converter that writes K, P or the diagonal of a covariance with numpy and without a decimal point makes a bag whose calibration, or covariance, is zero
# to 320 digits. numpy makes int64 of whole numbers; arrays that contain one fraction are right, so one camera of two may be.
# Source: rosbags.typesys.stores and the serializers of its Typestore; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" rosbags==0.11.9 numpy==2.4.6
FOLDER="$folder" PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import os
from importlib.metadata import version
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

KIND = "sensor_msgs/msg/CameraInfo"
CAMERA = np.array([[500, 0, 320], [0, 500, 240], [0, 0, 1]])
print("rosbags", version("rosbags"))
assert CAMERA.dtype == np.int64


def info(types, camera):
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    header = types["std_msgs/msg/Header"]
    if "seq" in header.__dataclass_fields__:
        header = header(seq=0, stamp=stamp, frame_id="camera")
    else:
        header = header(stamp=stamp, frame_id="camera")
    region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    projection = np.hstack([camera, np.zeros((3, 1), dtype=camera.dtype)])
    return types[KIND](
        header, 480, 640, "plumb_bob", np.zeros(5), camera.ravel(), np.eye(3).ravel(), projection.ravel(), 0, 0, region
    )


for name in ("ROS1_NOETIC", "ROS2_HUMBLE"):
    store = get_typestore(Stores[name])
    write, read = (
        (store.serialize_ros1, store.deserialize_ros1)
        if name.startswith("ROS1")
        else (store.serialize_cdr, store.deserialize_cdr)
    )
    for camera in (CAMERA, CAMERA.astype(np.float64)):
        back = read(write(info(store.types, camera), KIND), KIND)
        matrix = getattr(back, "K" if name.startswith("ROS1") else "k")
        print(f"{name}, {camera.dtype}: {matrix[:3]}")
        if camera.dtype == np.int64:
            assert np.array_equal(matrix.view(np.int64), CAMERA.ravel()) and 0 < matrix[0] < 1e-300
        else:
            assert np.array_equal(matrix, CAMERA.ravel())
    try:
        write(info(store.types, CAMERA.astype(np.float32)), KIND)
        raise AssertionError("float32 is written")
    except ValueError as error:
        print(f"{name}, float32: {error}")

store = get_typestore(Stores.ROS2_HUMBLE)
point = store.types["geometry_msgs/msg/Point"]
back = store.deserialize_cdr(store.serialize_cdr(point(500, 0, 320), "geometry_msgs/msg/Point"), "geometry_msgs/msg/Point")
print("numbers beside arrays:", back.x, back.z)
assert (back.x, back.z) == (500.0, 320.0)

path = Path(os.environ["FOLDER"]) / "bag"
with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    connection = writer.add_connection("/camera_info", KIND, typestore=store)
    writer.write(connection, 10**9, store.serialize_cdr(info(store.types, CAMERA), KIND))
with Reader(path) as reader:
    for connection, _, raw in reader.messages():
        stored = store.deserialize_cdr(raw, connection.msgtype)
        print("in a bag:", stored.k[:3])
        assert stored.k[0] < 1e-300
PYTHON
