#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: `reprojectImageTo3D(..., handleMissingValues=True)` takes the smallest disparity *of the image* for "missing".
# Where every pixel has a disparity, the farthest surface is deleted (z = 10000). Holes of NaN are not found, and a surface is deleted beside them.
# And StereoSGBM with a `minDisparity` above 1 marks holes by a positive disparity, which without the flag is a surface.
# Guessed: missing is what the matchers mark as missing, (minDisparity - 1), or what is not positive.
# Matters here: disparities of networks, of renders and of depth images are dense, or have holes of NaN: a wall at the end of a room
# is gone from the cloud. Masks of one's own (disparity > 0) do what is meant.
# Source: docs.opencv.org, reprojectImageTo3D ("pixels with the minimal disparity"); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for release in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$release" "opencv-python-headless==$release"
    PYTHONPATH="$folder/$release" python3 - <<'PYTHON'
import cv2
import numpy as np

FOCAL, BASELINE_M = 400.0, 0.1
Q = np.array([[1, 0, 0, -32], [0, 1, 0, -24], [0, 0, 0, FOCAL], [0, 0, 1 / BASELINE_M, 0]])
NEAR, WALL = 20.0, 5.0  # px: 2 m and 8 m


def depths(disparity, **flags):
    return cv2.reprojectImageTo3D(disparity.astype(np.float32), Q, **flags)[..., 2]


dense = np.full((48, 64), NEAR)
dense[:24] = WALL
plain = depths(dense)
handled = depths(dense, handleMissingValues=True)
print("OpenCV", cv2.__version__, "depths of a dense image, m:", np.unique(plain), "with handleMissingValues:", np.unique(handled))
assert np.allclose(np.unique(plain), [2, 8]) and np.allclose(np.unique(handled), [2, 10000])

holed = dense.copy()
holed[:, :8] = np.nan
z = depths(holed, handleMissingValues=True)
print("  the wall beside holes of NaN:", np.unique(z[:24, 8:]), "the holes:", np.unique(z[:, :8]))
assert np.all(z[:24, 8:] == 10000) and np.all(np.isnan(z[:, :8]))

image = np.random.default_rng(0).integers(0, 255, (48, 160), np.uint8)
matcher = cv2.StereoSGBM_create(minDisparity=16, numDisparities=16, blockSize=5)
found = matcher.compute(image, np.roll(image, -20, axis=1)) / 16.0
hole = depths(found)[:, :16]
print("  StereoSGBM from 16 px up marks holes by", np.unique(found[:, :16]), "px: a surface at", np.unique(hole), "m")
assert np.all(found[:, :16] == 15) and np.allclose(hole, FOCAL * BASELINE_M / 15)
PYTHON
done
