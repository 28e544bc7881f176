#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: a second `KalmanFilter.correct` in one step undoes the first. It starts from the prediction (statePre, errorCovPre) again, not from
# what the first correction left. A position that one sensor gives to 0.1 m is at the reading of a second sensor, which gives it to 1 m, once that one was
# added; `errorCovPost` agrees with the wrong answer. With both copied from post to pre in between, the result is the weighted mean.
# Guessed: sensors, or the left and the right camera, may be added one by one, in any order, as in the textbook.
# Matters here: who fuses a trajectory with GNSS, or two odometries, by this class keeps the sensor that came last, without a warning. `vio`'s filters have
# their own updates: one after the other is the same as both at once (tests/filters).
# Source: https://github.com/opencv/opencv/blob/4.x/modules/video/src/kalman.cpp, correct; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for release in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$release" "opencv-python-headless==$release" numpy==2.3.5
    PYTHONPATH="$folder/$release" python3 - <<'PYTHON'
import cv2
import numpy as np

PRIOR, READINGS = 10.0, ((2.0, 0.1), (5.0, 1.0))  # sigma of the prediction; reading and sigma of two sensors, m


def fused(copy):
    """Position and its sigma after both sensors; copy: what the first one left is the second one's prediction."""
    kalman = cv2.KalmanFilter(1, 1, 0, cv2.CV_64F)
    kalman.transitionMatrix = kalman.measurementMatrix = np.eye(1)
    kalman.processNoiseCov = np.zeros((1, 1))
    kalman.statePost, kalman.errorCovPost = np.zeros((1, 1)), np.array([[PRIOR**2]])
    kalman.predict()
    for reading, sigma in READINGS:
        kalman.measurementNoiseCov = np.array([[sigma**2]])
        kalman.correct(np.array([[reading]]))
        if copy:
            kalman.statePre, kalman.errorCovPre = kalman.statePost.copy(), kalman.errorCovPost.copy()
    return float(kalman.statePost[0, 0]), float(np.sqrt(kalman.errorCovPost[0, 0]))


weights = np.array([PRIOR**-2] + [sigma**-2 for _, sigma in READINGS])
exact = float(weights[1:] @ [reading for reading, _ in READINGS] / weights.sum())
sigma = float(weights.sum() ** -0.5)
print("opencv", cv2.__version__, "two corrections: %.3f +- %.3f m; copied between: %.3f +- %.3f m;" % (*fused(False), *fused(True)),
      f"both sensors by weights: {exact:.3f} +- {sigma:.3f} m")
assert np.allclose(fused(True), (exact, sigma))
last = (PRIOR**-2 + READINGS[1][1] ** -2) ** -0.5
assert np.allclose(fused(False), (READINGS[1][0] * last**2 / READINGS[1][1] ** 2, last))
PYTHON
done
