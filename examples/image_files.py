"""Two folders of raw images and a calibration, without any reader: files, a rig, a loop.

python examples/image_files.py LEFT_FOLDER RIGHT_FOLDER camchain.yaml [RATE_HZ]
"""

import sys
from pathlib import Path

import cv2

import vio
from vio.datasets.images import natural_key

left, right, calibration = map(Path, sys.argv[1:4])
rate_hz = float(sys.argv[4]) if len(sys.argv) > 4 else 20.0
# From numbers instead of a file: vio.Rig.raw(K0, K1, T_cam1_cam0, width, height, model="radtan",
# distortion0=..., ...)
rig = vio.load_rig(calibration)
odometry = vio.Odometry(rig, vio.load_config(overrides=["motion=none"]))

shared = {p.name for p in left.iterdir()} & {p.name for p in right.iterdir()}
names = sorted(shared, key=natural_key)  # numbers as numbers: 2.png comes before 10.png
if not names:
    sys.exit(f"no image of {left} has the name of one of {right}")
for k, name in enumerate(names):
    pair = [cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE) for folder in (left, right)]
    if any(image is None for image in pair):
        print(f"{name}: cannot be read")
        continue
    # raw images; they are rectified inside
    estimate = odometry.add_stereo(round(k * 1e9 / rate_hz), *pair)
    if estimate is not None:
        print(name, estimate.T_world_imu[:3, 3].round(4))
odometry.finish()
print(f"{len(odometry.landmarks().ids)} landmarks")
for line in odometry.warnings:
    print("warning:", line)
