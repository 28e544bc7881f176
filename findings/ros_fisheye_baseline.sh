#!/usr/bin/env bash
# camera_calibration 1.17.0 (Debian 12, ROS's own calibrator; ROS 2's has the same lines): for a stereo pair of fisheye cameras the left part of P is K R in both CameraInfos, no matrix of a
# camera; the focal length of P[0, 3] is another one. The baseline by the rule of the message, -P[0, 3] / P[0, 0], is 10 % short here, though R and T of the calibration are right to 1 mm.
# Its maps take the two raw matrices in the place of a common one, so in rectified images the rows are as far apart as the two principal points, here 7 px; the error that its window shows
# is 14 px. Of pinhole cameras all of that is right.
# Guessed: what the calibrator writes follows the definition of CameraInfo, P = [f 0 cx Tx; 0 f cy Ty; 0 0 1 0], so that its two cameras are a rectified pair.
# Matters here: `vio` read such a pair, and all lengths were 10 % short, silently; now it refuses it and asks for R and T, which the calibrator prints
# (tests/datasets/test_rig.py, "ROS, fisheye"). Where the principal points differ, its rectified images are none for a stereo method.
# Source: calibrator.py, StereoCalibrator.set_alpha; https://github.com/ros-perception/image_pipeline/issues/626 asks why P differs; sensor_msgs/CameraInfo; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" opencv-python-headless==4.14.0.94 scipy==1.17.1
cd "$folder"
apt-get download -qq python3-camera-calibration=1.17.0-1 python3-cv-bridge=1.16.2+ds-1+b3 python3-image-geometry=1.16.2+ds-1 python3-sensor-msgs=1.13.1-1 \
    python3-std-msgs=0.5.13-2 python3-geometry-msgs=1.13.1-1 python3-genpy=0.6.16-2 python3-genmsg=0.6.0-1 2>/dev/null
for package in python3-*.deb; do dpkg -x "$package" debian; done
PYTHONPATH="$folder/packages:$folder/debian/usr/lib/python3/dist-packages" python3 - <<'PYTHON'
import contextlib
import io

import cv2
import numpy as np
from camera_calibration.calibrator import CAMERA_MODEL, ChessboardInfo, StereoCalibrator
from scipy.spatial.transform import Rotation

SIZE, BASELINE, SQUARE = (640, 480), 0.12, 0.04
K_LEFT = np.array([[450, 0, 322], [0, 450, 238], [0, 0, 1.0]])
K_RIGHT = np.array([[456, 0, 316], [0, 456, 245], [0, 0, 1.0]])
R = Rotation.from_euler("xyz", [0.8, -1.2, 0.5], degrees=True).as_matrix()
T = -R @ [BASELINE, 0, 0]
LENS = {"fisheye": np.array([-0.03, 0.01, -0.005, 0.001]), "pinhole": np.array([-0.28, 0.09, 0, 0, 0])}
BOARD = np.array([[SQUARE * column, SQUARE * row, 0] for row in range(6) for column in range(8)])


def seen(points, K, name):
    """Return the pixels (N, 1, 2) of points (N, 3) of a camera."""
    project = cv2.fisheye.projectPoints if name == "fisheye" else cv2.projectPoints
    return project(points[:, None], np.zeros(3), np.zeros(3), K, LENS[name])[0].reshape(-1, 1, 2)


def calibrated(name):
    """Return the calibrator after 30 views of a board, and the corners of both cameras."""
    rng = np.random.default_rng(0)
    info = ChessboardInfo("chessboard", 8, 6, SQUARE)
    views = []
    while len(views) < 30:
        turn = Rotation.from_euler("xyz", rng.uniform([-30, -30, -20], [30, 30, 20]), degrees=True)
        points = turn.apply(BOARD - BOARD.mean(0)) + rng.uniform([-0.3, -0.25, 0.4], [0.3, 0.25, 1.2])
        both = seen(points, K_LEFT, name), seen(points @ R.T + T, K_RIGHT, name)
        if all(np.all(pixels > 5) and np.all(pixels < np.array(SIZE) - 5) for pixels in both):
            left, right = ((pixels + rng.normal(0, 0.1, pixels.shape)).astype(np.float32) for pixels in both)
            views.append((left, right, None, None, info))
    found = StereoCalibrator([info])
    found.size = found.l.size = found.r.size = SIZE
    found.set_cammodel(CAMERA_MODEL.FISHEYE if name == "fisheye" else CAMERA_MODEL.PINHOLE)
    flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW
    found.l.fisheye_calib_flags = found.r.fisheye_calib_flags = flags
    with contextlib.redirect_stdout(io.StringIO()):
        found.cal_fromcorners(views)
    return found, [view[:2] for view in views]


def rectified(camera, pixels, name):
    """Return where the maps of the calibrator put pixels (N, 1, 2)."""
    if name == "fisheye":  # by the matrix that its maps are made with
        return cv2.fisheye.undistortPoints(pixels.astype(float), camera.intrinsics, camera.distortion, R=camera.R, P=camera.intrinsics)
    return camera.undistort_points(pixels)


print("camera_calibration 1.17.0, OpenCV", cv2.__version__)
for name in ("pinhole", "fisheye"):
    calibrator, views = calibrated(name)
    left, right = (np.array(message.P).reshape(3, 4) for message in calibrator.as_message())
    stated = -right[0, 3] / right[0, 0]
    rows = np.concatenate([(rectified(calibrator.l, a, name) - rectified(calibrator.r, b, name))[:, 0, 1] for a, b in views])
    shown = np.mean([calibrator.epipolar_error(calibrator.l.undistort_points(a), calibrator.r.undistort_points(b)) for a, b in views])
    print(f"{name}: length of T {np.linalg.norm(calibrator.T):.4f} m (true {BASELINE}), -P[0, 3] / P[0, 0] {stated:.4f} m;",
          f"rows of rectified images are {np.sqrt(np.mean(rows**2)):.2f} px apart, shown {shown:.2f} px; P of the right camera:")
    print(right.round(4))
    assert abs(np.linalg.norm(calibrator.T) - BASELINE) < 1e-3
    if name == "pinhole":
        assert abs(stated - BASELINE) < 1e-3 and np.sqrt(np.mean(rows**2)) < 0.2 and shown < 0.2
        continue
    for P, camera in ((left, calibrator.l), (right, calibrator.r)):
        assert np.allclose(P[:, :3], camera.intrinsics @ camera.R) and abs(P[1, 0]) > 1
    assert 0.100 < stated < 0.110
    assert abs(rows.mean() - (K_LEFT - K_RIGHT)[1, 2]) < 0.5 and shown > 10
PYTHON
