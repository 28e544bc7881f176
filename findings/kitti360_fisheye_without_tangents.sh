#!/usr/bin/env bash
# kitti360scripts 1.0.0: `CameraFisheye.cam2image` leaves out p1 and p2 of the calibrations that it reads. With values as large as those of KITTI-360's fisheye cameras points are 0.1 px off at 40
# degrees, 0.24 px at 60, 0.49 px at 90 along one diagonal of the image, all to one corner, and a third of that along the other.
# Guessed: the scripts of the data set's authors project by all parameters of the data set's files, as OpenCV's omnidir and CamOdoCal, which wrote them, do.
# Matters here: points of the lidar or of a map in the fisheye images, as truth for matches and depths, are off by as much as features, but all to one corner, which a pose takes for a turn. `vio`
# reads and uses both.
# Source: https://github.com/autonomousvision/kitti360Scripts, kitti360scripts/helpers/project.py; Mei and Rives, ICRA 2007, for the model; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --no-deps --target "$folder/packages" kitti360scripts==1.0.0 opencv-contrib-python-headless==4.14.0.94 numpy==2.4.6 PyYAML==6.0.3
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import cv2
import numpy as np
from kitti360scripts.helpers.project import CameraFisheye

XI, K1, K2, P1, P2, F, CU, CV = 2.21, 0.017, 1.65, 4.2e-4, 4.2e-4, 1336.0, 717.0, 706.0
K = np.array([[F, 0, CU], [0, F, CV], [0, 0, 1]])


def camera(p1, p2):
    """Return the camera as it is after reading a calibration file (PyYAML 6 refuses its reader's call)."""
    made = CameraFisheye.__new__(CameraFisheye)
    made.fi = {
        "mirror_parameters": {"xi": XI},
        "distortion_parameters": {"k1": K1, "k2": K2, "p1": p1, "p2": p2},
        "projection_parameters": {"gamma1": F, "gamma2": F, "u0": CU, "v0": CV},
    }
    return made


def off(angle, azimuth, tangents):
    """Return cam2image - omnidir in px for a direction in degrees from the optical axis, and about it."""
    tangents = np.array(tangents)
    a, b = np.radians(angle), np.radians(azimuth)
    point = 5 * np.array([[np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)]])
    u, v, depth = camera(*tangents).cam2image(point.T)
    assert depth[0] > 0 or angle >= 90
    true = cv2.omnidir.projectPoints(point[None], np.zeros(3), np.zeros(3), K, XI, np.array([[K1, K2, *tangents]]))[0].ravel()
    return np.array([u[0], v[0]]) - true


print("kitti360scripts", version("kitti360scripts"), "OpenCV", cv2.__version__)
for azimuth in (45, 135, 225):
    row = {angle: np.linalg.norm(off(angle, azimuth, (P1, P2))) for angle in (20, 40, 60, 80, 89.9)}
    print(f"azimuth {azimuth} degrees:", ", ".join(f"{angle} degrees {x:.3f} px" for angle, x in row.items()))
    assert (row[89.9] > 0.4) == (azimuth != 135) and row[89.9] > 0.1
worst = max(np.linalg.norm(off(angle, azimuth, (0, 0))) for angle in (20, 60, 89.9) for azimuth in range(0, 360, 30))
print(f"with p1 = p2 = 0: {worst:.1e} px")
assert worst < 1e-9
PYTHON
