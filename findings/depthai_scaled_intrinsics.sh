#!/usr/bin/env bash
# DepthAI 3.12.0 and OpenCV 4.14.0: intrinsics for half the image size have half the principal point, as where
# pixels count from the corner of the image. In pixels that count from the centre of the first one, as all of
# OpenCV does, an image that cv2.resize halves has its principal point a quarter of a pixel further left and up.
# Guessed: the intrinsics of the smaller size are those of the image that OpenCV makes of it.
# Matters here: a quarter of a pixel is more than a tracked feature's noise, and turns the camera.
# Source: depthai.CalibrationHandler.getCameraIntrinsics, cv2.resize; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" depthai==3.12.0 opencv-python-headless==4.14.0.94
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import cv2
import depthai as dai
import numpy as np

stored = dai.CalibrationHandler()
socket = dai.CameraBoardSocket.CAM_B
stored.setCameraIntrinsics(socket, [[800.0, 0, 640], [0, 800.0, 400], [0, 0, 1]], 1280, 800)
stated = stored.getCameraIntrinsics(socket, 640, 400)
u = np.arange(1280) - 640.0
v = np.arange(800) - 400.0
spot = np.exp(-(u[None] ** 2 + v[:, None] ** 2) / (2 * 12.0**2))
half = cv2.resize(spot, (640, 400), interpolation=cv2.INTER_LINEAR)
centre = [(half.sum(axis=k) * np.arange(half.shape[1 - k])).sum() / half.sum() for k in (0, 1)]
print("depthai", dai.__version__, "OpenCV", cv2.__version__)
print("principal point by depthai", stated[0][2], stated[1][2], "a spot at it, resized", centre)
assert (stated[0][2], stated[1][2]) == (320.0, 200.0)
assert np.allclose(centre, [319.75, 199.75], atol=1e-3)
PYTHON
