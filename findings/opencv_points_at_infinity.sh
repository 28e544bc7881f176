#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: `convertPointsFromHomogeneous` does not divide where the size of the last coordinate is below 1.2e-7: it returns the first three as they are.
# A pair of pixels without disparity, triangulated by `triangulatePoints`, whose results have a length of 1, becomes a point one unit from the camera, most
# of them behind it. With 0.001 px of disparity the same pixels are 48 km away, in front.
# Guessed: zeros, as its text says for a last coordinate of 0; or infinite, as `reprojectImageTo3D` returns for the same disparity.
# Matters here: key points on whole pixels (FAST, ORB) have a disparity of 0 for all that is farther than some 100 m. Sky and skyline become a cloud of points
# at 1 m, which a check for zeros or infinity does not find, and a median depth or a scale takes them for the nearest ones. `vio` uses neither function.
# Source: the documentation of convertPointsFromHomogeneous in OpenCV; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for release in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$release" "opencv-python-headless==$release"
    PYTHONPATH="$folder/$release" python3 - <<'PYTHON'
import cv2
import numpy as np

FOCAL, BASELINE_M = 400.0, 0.12
P_left = np.array([[FOCAL, 0, 320, 0], [0, FOCAL, 240, 0], [0, 0, 1, 0]])
P_right = P_left.copy()
P_right[0, 3] = -FOCAL * BASELINE_M
Q = np.array([[1, 0, 0, -320], [0, 1, 0, -240], [0, 0, 0, FOCAL], [0, 0, 1 / BASELINE_M, 0]])
left = np.random.default_rng(0).integers((0, 0), (640, 480), (2000, 2)).astype(float).T


def triangulated(disparity):
    right = left - [[disparity], [0.0]]
    return cv2.convertPointsFromHomogeneous(cv2.triangulatePoints(P_left, P_right, left, right).T).reshape(-1, 3)


print("OpenCV", cv2.__version__)
for disparity in (1.0, 0.001, 0.0):
    points = triangulated(disparity)
    image = cv2.reprojectImageTo3D(np.full((480, 640), disparity, np.float32), Q)
    behind = np.mean(points[:, 2] < 0)
    length = np.linalg.norm(points, axis=1)
    print(
        f"disparity {disparity} px: depths {points[:, 2].min():.4g} to {points[:, 2].max():.4g} m, {behind:.1%} behind,",
        f"distances {length.min():.4g} to {length.max():.4g} m; reprojectImageTo3D {image[0, 0, 2]:.4g} m",
    )
    if disparity > 0:
        assert behind == 0 and np.allclose(points[:, 2], FOCAL * BASELINE_M / disparity, rtol=1e-4)
    else:
        assert behind > 0.1 and np.abs(length - 1).max() < 1e-6 and np.isinf(image[..., 2]).all()
PYTHON
done
