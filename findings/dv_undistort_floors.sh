#!/usr/bin/env bash
# dv-processing 2.0.4: `CameraGeometry.undistort` and `backProjectUndistort` take points of float32, and drop what is behind the decimal point: (100.9, 100.9) comes back as (100, 100) does, to
# the last bit. Points of features come back 0.6 px left of and above their place on average, and up to 2.5 px off where the lens stretches most.
# `backProject` is exact with `subPixel=True`, which these two lack; `project` and `distort` are exact as well.
# Guessed: what takes fractions of a pixel uses them; or, by the text of `backProject` ("rounding the coordinates to first integer"), rounds to the nearest pixel, without a bias.
# Matters here: it is the library of the DAVIS and DVXplorer, stereo rigs of events, images and an IMU. Rays of features made with it are rounded
# to pixels and turned by half of one, 0.07 degrees at f = 450 px, as by a principal point that is off: in both cameras alike, so disparities do not show it.
# Source: dv-processing's texts of these functions, which name a table for speed but no rounding for `undistort`; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" dv-processing==2.0.4 numpy==2.4.6
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/cv" opencv-python-headless==4.14.0.94
PYTHONPATH="$folder/packages:$folder/cv" python3 - <<'PYTHON'
import cv2
import dv_processing as dv
import numpy as np

FX, FY, CX, CY = 450.0, 455.0, 322.0, 238.0
LENS = [-0.3, 0.1, 0.001, -0.002]
matrix = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
camera = dv.camera.CameraGeometry(LENS, FX, FY, CX, CY, (640, 480), dv.camera.DistortionModel.RADIAL_TANGENTIAL)
exactly = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)


def right(points):
    return cv2.undistortPointsIter(points[:, None], matrix, np.array(LENS), None, matrix, exactly)[:, 0]


print("dv-processing", dv.__version__)
assert np.array_equal(camera.undistort((100.9, 100.9)), camera.undistort((100.0, 100.0)))
rng = np.random.default_rng(0)
whole = rng.integers([20, 20], [620, 460], (2000, 2)).astype(float)
parts = whole + rng.uniform(0, 1, whole.shape)
for name, points in (("whole pixels", whole), ("parts of pixels", parts)):
    found = np.array([camera.undistort(tuple(point)) for point in points])
    rays = np.array([camera.backProjectUndistort(tuple(point)) for point in points])
    by_ray = rays[:, :2] / rays[:, 2:] * [FX, FY] + [CX, CY]
    off = found - right(points)
    print(f"{name}: mean {off.mean(0).round(3)} px, farthest {np.hypot(*off.T).max():.2f} px; rays the same to {np.abs(by_ray - found).max():.4f} px")
    assert np.abs(by_ray - found).max() < 1e-3
    if points is whole:
        assert np.abs(off.mean(0)).max() < 0.02 and np.hypot(*off.T).max() < 0.3
    else:
        assert np.all(off.mean(0) < -0.45) and np.hypot(*off.T).max() > 1
        assert np.array_equal(found, [camera.undistort(tuple(point)) for point in np.floor(points)])
PYTHON
