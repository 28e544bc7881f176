#!/usr/bin/env bash
# rosbags-image 0.10.4: `message_to_cvimage` leaves `step`, the length of a row with its padding, out: an image whose rows are padded
# (drivers that align rows, or send a part of a larger buffer) comes back sheared, each row further, without an error. And gray
# 8 bit asked for as `mono16` comes back as float64.
# Guessed: `step` is heeded, as cv_bridge and the definition of sensor_msgs/Image do, and an encoding's name is its type.
# Matters here: who reads a bag with it and feeds a live odometry gets sheared images, left and right alike, and sees a calibration
# that fits nothing. `vio run` of the bag reads rows by `step`.
# Source: rosbags.image.message_to_cvimage; the comment on step in sensor_msgs/msg/Image ("Full row length in bytes"); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" rosbags-image==0.10.4 rosbags==0.11.9 opencv-python-headless==4.14.0.94 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from rosbags.image import message_to_cvimage
from rosbags.typesys import Stores, get_typestore

WIDTH, HEIGHT, STEP = 60, 40, 64
types = get_typestore(Stores.ROS2_HUMBLE).types
header = types["std_msgs/msg/Header"](
    stamp=types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id=""
)
image = np.zeros((HEIGHT, WIDTH), np.uint8)
image[:, 30] = 255  # a vertical line


def message(rows):
    return types["sensor_msgs/msg/Image"](
        header=header, height=HEIGHT, width=WIDTH, encoding="mono8",
        is_bigendian=0, step=rows.shape[1], data=rows.ravel(),
    )


tight = message_to_cvimage(message(image))
padded = message_to_cvimage(message(np.pad(image, ((0, 0), (0, STEP - WIDTH)))))
columns = [int(row.argmax()) for row in padded[:8]]
deep = message_to_cvimage(message(image), "mono16")
print("rosbags-image", version("rosbags-image"), "a line in column 30, rows without padding:", (tight == image).all())
print("rows of 64 bytes for 60 pixels: columns", columns, "; mono16 is", deep.dtype)
assert (tight == image).all()
assert columns == [30, 34, 38, 42, 46, 50, 54, 58]
assert deep.dtype == np.float64
PYTHON
