#!/usr/bin/env bash
# librealsense 2.59.1: `inverse_brown_conrady` distorts forwards, as OpenCV's five coefficients do (0.04 px), though its
# name says the inverse; `modified_brown_conrady` projects in the same way, and deprojects as if there were no distortion.
# Guessed: inverse is the inverse, and projecting what was deprojected gives the pixel back.
# Matters here: what a D400's colour camera or a ROS bag of it states may be read as radtan; points that were
# deprojected with the modified model are off by many pixels.
# Source: rs2_project_point_to_pixel, rs2_deproject_pixel_to_point; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pyrealsense2==2.59.1.11053 opencv-python-headless==4.14.0.94
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import cv2
import numpy as np
import pyrealsense2 as rs

coefficients = [0.15, -0.45, -0.001, 0.0005, 0.4]
K = np.array([[430.0, 0, 322], [0, 430.0, 238], [0, 0, 1]])
pixels = np.array([(u, v) for u in range(0, 640, 40) for v in range(0, 480, 40)], dtype=float)
points = np.column_stack([(pixels - K[:2, 2]) / 430.0, np.ones(len(pixels))])
by_opencv = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(coefficients))[0][:, 0]
print("pyrealsense2", rs.__version__, "distortion up to", np.abs(by_opencv - pixels).max(), "px")
for name in ("brown_conrady", "inverse_brown_conrady", "modified_brown_conrady"):
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = 640, 480, 430.0, 430.0, 322.0, 238.0
    lens.model, lens.coeffs = getattr(rs.distortion, name), coefficients
    projected = np.array([rs.rs2_project_point_to_pixel(lens, p.tolist()) for p in points])
    back = np.array([rs.rs2_deproject_pixel_to_point(lens, p.tolist(), 1.0) for p in projected])
    to_opencv = np.abs(projected - by_opencv).max()
    returned = 430.0 * np.abs(back - points).max()
    print(f"{name}: {to_opencv:.4f} px from OpenCV, {returned:.3f} px after deprojecting")
    assert to_opencv < 0.04
    assert (returned > 10.0) == (name == "modified_brown_conrady")
PYTHON
