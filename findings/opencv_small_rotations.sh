#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: `Rodrigues` returns a rotation vector of exact zeros for each matrix that turns by less than 1e-5 rad (2 arc
# seconds), in float64. A gyro at 200 Hz that turns by 0.1 degrees a second turns by 8.7e-6 rad a sample: the sum of its steps is 0 instead of 6 degrees a minute.
# Guessed: an error of the order of rounding, as in the other direction, where 1e-8 rad come out exactly.
# Matters here: increments of an IMU, biases (1e-3 rad/s at 200 Hz are 5e-6 rad), corrections of an optimiser and derivatives by steps of 1e-6
# go through it in Python. The pose stands still, or an iteration has "converged". SciPy's `Rotation` and ours keep them.
# Source: docs.opencv.org, Rodrigues; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for release in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$release" "opencv-python-headless==$release" scipy==1.17.1
    PYTHONPATH="$folder/$release" python3 - <<'PYTHON'
import cv2
import numpy as np
from scipy.spatial.transform import Rotation

AXIS = np.array([2.0, -1.0, 2.0]) / 3
print("OpenCV", cv2.__version__, "angle, and what comes back from its matrix, rad:")
for angle in (1e-3, 2e-5, 9e-6, 1e-6):
    matrix = cv2.Rodrigues(AXIS * angle)[0]
    back = cv2.Rodrigues(matrix)[0].ravel()
    exact = Rotation.from_matrix(matrix).as_rotvec()
    print(f"  {angle:.0e}: OpenCV {np.linalg.norm(back):.10f}, SciPy {np.linalg.norm(exact):.10f}")
    assert np.allclose(exact, AXIS * angle, rtol=1e-6, atol=0)
    assert np.allclose(back, AXIS * angle, rtol=1e-4, atol=0) if angle > 1e-5 else not back.any()

RATE_HZ, SECONDS = 200, 60
turn = np.radians(0.1) / RATE_HZ * np.array([0.0, 0.0, 1.0])
poses = Rotation.from_rotvec(np.arange(RATE_HZ * SECONDS + 1)[:, None] * turn).as_matrix()
steps = [cv2.Rodrigues(before.T @ after)[0].ravel() for before, after in zip(poses[:-1], poses[1:], strict=True)]
summed = np.degrees(np.linalg.norm(np.sum(steps, axis=0)))
print(f"  a minute at 0.1 degrees a second, summed from {len(steps)} steps: {summed} degrees instead of 6")
assert summed == 0.0
PYTHON
done
