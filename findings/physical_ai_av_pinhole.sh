#!/usr/bin/env bash
# physical_ai_av 0.2.3, the developer kit of NVIDIA's PhysicalAI-Autonomous-Vehicles data set: `PinholeCameraModel.ray2pixel` divides by the length of a ray and not by its depth, so it multiplies the
# principal point by the cosine of the angle too: 30 degrees from the axis of a camera of 1920 x 1080 the pixel is 218 px off, at 45 degrees 595 px. `pixel2ray` raises for the pixels (..., 2) of its own text.
# `FThetaCameraModel.ray2pixel` is right, but for a ray along the optical axis, and `pixel2ray` for the principal point, return NaN.
# Guessed: a pinhole camera of a vendor's kit projects as a pinhole camera, and a fisheye camera has an axis.
# Matters here: who rectifies images of that data set, or projects its lidar points as truth for depths, gives this class to `CameraIntrinsics.from_intrinsics_df`, which takes the f-theta one unless told otherwise; near the
# middle of the image errors are small (1.1 px at 2.5 degrees), and lidar points on the road ahead look right.
# Source: physical_ai_av/utils/camera_models.py; OpenCV's projectPoints for comparison; this run. Its module is loaded by its path, as the packages for downloads are not needed for it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --no-deps --target "$folder/packages" physical_ai_av==0.2.3 numpy==2.4.6 \
    opencv-contrib-python-headless==4.14.0.94
python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/packages" pandas==3.0.0 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import importlib.util
from importlib.metadata import distribution, version

import cv2
import numpy as np
import pandas as pd

path = distribution("physical_ai_av").locate_file("physical_ai_av/utils/camera_models.py")
spec = importlib.util.spec_from_file_location("camera_models", path)
models = importlib.util.module_from_spec(spec)
spec.loader.exec_module(models)
print("physical_ai_av", version("physical_ai_av"), "OpenCV", cv2.__version__)

F, CX, CY = 1000.0, 957.3, 541.8
row = pd.Series({"width": 1920, "height": 1080, "cx": CX, "cy": CY, "fw_poly_0": 0.0, "fw_poly_1": F, "fw_poly_2": 0.0, "fw_poly_3": 0.0, "fw_poly_4": 0.0,
                 "bw_poly_0": 0.0, "bw_poly_1": 1 / F, "bw_poly_2": 0.0, "bw_poly_3": 0.0, "bw_poly_4": 0.0})
pinhole, ftheta = models.PinholeCameraModel.from_camera_row(row), models.FThetaCameraModel.from_camera_row(row)
angles = np.radians([0.0, 2.5, 10.0, 30.0, 45.0])
rays = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1)
true = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), pinhole.camera_matrix, np.zeros(5))[0][:, 0]
found = pinhole.ray2pixel(rays)
off = np.linalg.norm(found - true, axis=-1)
for degrees, a, b, error in zip(np.degrees(angles), found, true, off, strict=True):
    print(f"{degrees:4.1f} degrees to the right: {np.round(a, 1).tolist()} for {np.round(b, 1).tolist()}, {error:.1f} px off")
assert np.allclose(found, (true - [CX, CY]) * np.cos(angles)[:, None] + np.array([CX, CY]) * np.cos(angles)[:, None])
assert off[0] < 1e-9 and 1.0 < off[1] < 3.0 and off[3] > 200 and off[4] > 500
try:
    pinhole.pixel2ray(true)
except ValueError as error:
    print("pixel2ray of (N, 2) raises:", str(error)[:90])
else:
    raise AssertionError("pixel2ray takes pixels now")

oblique = ftheta.ray2pixel(rays[1:])
assert np.allclose(oblique, np.stack([CX + F * angles[1:], CY + 0 * angles[1:]], -1))
with np.errstate(invalid="ignore"):
    axis, back = ftheta.ray2pixel(np.array([0.0, 0.0, 1.0])), ftheta.pixel2ray(np.array([CX, CY]))
print("f-theta: the optical axis becomes", axis, "and the principal point", back)
assert np.isnan(axis).all() and np.isnan(back[:2]).all()
PYTHON
