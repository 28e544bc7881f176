#!/usr/bin/env bash
# OpenCV 5.0.0: corners of a chessboard come as (N, 2) and ids of markers as (N,), where 4.14.0 has (N, 1, 2) and (N, 1);
# goodFeaturesToTrack, projectPoints and undistortPoints keep the dimension of one. SOLVEPNP_IPPE and others have new
# numbers, and so has CV_16SC2 (11 to 35).
# Guessed: all functions for points change together, and numbers of constants stay.
# Matters here: code that indexes [:, 0] takes the u of each corner for its pixel; flags stored as numbers choose another
# solver.
# Source: cv2.findChessboardCorners, cv2.aruco.ArucoDetector; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/try.py" <<'PYTHON'
import cv2
import numpy as np

five = cv2.__version__.startswith("5")
image = np.full((480, 640), 255, np.uint8)
for i in range(8):
    for j in range(7):
        if (i + j) % 2:
            image[60 + 40 * j : 100 + 40 * j, 60 + 40 * i : 100 + 40 * i] = 0
corners = cv2.findChessboardCorners(image, (7, 6))[1].shape
features = cv2.goodFeaturesToTrack(image, 10, 0.01, 5).shape
plain = cv2.undistortPoints(np.zeros((5, 2)), np.eye(3), np.zeros(5)).shape
tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
page = np.full((400, 400), 255, np.uint8)
page[120:280, 120:280] = cv2.aruco.generateImageMarker(tags, 3, 160)
ids = cv2.aruco.ArucoDetector(tags).detectMarkers(page)[1].shape
print("OpenCV", cv2.__version__, "chessboard", corners, "ids", ids, "goodFeatures", features, "undistort", plain)
print("SOLVEPNP_IPPE", cv2.SOLVEPNP_IPPE, "SOLVEPNP_AP3P", cv2.SOLVEPNP_AP3P, "CV_16SC2", cv2.CV_16SC2)
assert (corners, ids) == (((42, 2), (1,)) if five else ((42, 1, 2), (1, 1)))
assert features[1:] == (1, 2)
assert plain == (5, 1, 2)
numbers = (cv2.SOLVEPNP_AP3P, cv2.SOLVEPNP_IPPE, cv2.CV_16SC2)
assert numbers == ((3, 4, 35) if five else (5, 6, 11))
PYTHON
for version in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$version" numpy==2.4.6 "opencv-python-headless==$version"
    PYTHONPATH="$folder/$version" python3 "$folder/try.py"
done
