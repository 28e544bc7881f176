#!/usr/bin/env bash
# OpenCV (contrib) 4.14.0 and 5.0.0: `optflow.calcOpticalFlowSparseRLOF` and `SparseRLOFOpticalFlow` track no point of an array (N, 1, 2), the shape of `goodFeaturesToTrack` and `calcOpticalFlowPyrLK`,
# nor of (N, 2): the places passed in come back (without any, arbitrary ones), and status 1 for all of them. Of (1, N, 2) all are tracked, to 0.02 px.
# Guessed: the function "similar to calcOpticalFlowPyrLK" takes the same arrays, or refuses them; status 1 means that the flow was found.
# Matters here: with this tracker in the place of Lucas-Kanade's, a visual odometry sees a rig at rest, whose points are all found: a standstill that no check of residuals shows.
# One point alone is tracked, as a small test shows. `vio` tracks with calcOpticalFlowPyrLK.
# Source: help(cv2.optflow.calcOpticalFlowSparseRLOF); https://github.com/opencv/opencv_contrib/issues/2663, which reports it of version 4.4; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for version in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$version" "opencv-contrib-python-headless==$version" numpy==2.4.6
    PYTHONPATH="$folder/$version" python3 - <<'PYTHON'
import cv2
import numpy as np

SIZE, SHIFT = 240, np.array([2.5, -1.25])  # px


def image(shift):
    """Return waves of random directions, moved by a shift in px, as a colour image."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(float)
    light = np.full((SIZE, SIZE), 128.0)
    for _ in range(120):
        (kx, ky), phase = rng.normal(0, 0.45, 2), rng.uniform(0, 2 * np.pi)
        light += 6 * np.cos(kx * (x - shift[0]) + ky * (y - shift[1]) + phase)
    return cv2.cvtColor(np.clip(light, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)


first, second = image((0, 0)), image(SHIFT)
gray = [cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) for picture in (first, second)]
points = cv2.goodFeaturesToTrack(gray[0], 50, 0.01, 8)
points = points[np.all((points > 30) & (points < SIZE - 30), axis=(1, 2))]
tracker = cv2.optflow.SparseRLOFOpticalFlow_create()
ways = {
    "calcOpticalFlowPyrLK": lambda p: cv2.calcOpticalFlowPyrLK(*gray, p, p.copy()),
    "calcOpticalFlowSparseRLOF": lambda p: cv2.optflow.calcOpticalFlowSparseRLOF(first, second, p, p.copy()),
    "SparseRLOFOpticalFlow": lambda p: tracker.calc(first, second, p, p.copy()),
}
print("OpenCV", cv2.__version__, "goodFeaturesToTrack:", points.shape, "true shift", SHIFT, "px")
for name, track in ways.items():
    for shape in ((-1, 1, 2), (-1, 2), (1, -1, 2)):
        given = points.reshape(shape)
        found, status, _ = track(given)
        moved = (found - given).reshape(-1, 2)
        print(f"{name} of {given.shape}: median shift {np.median(moved, axis=0).round(3)} px, status {np.unique(status)}")
        assert np.all(status == 1)
        if name == "calcOpticalFlowPyrLK" or shape == (1, -1, 2):
            assert np.abs(np.median(moved, axis=0) - SHIFT).max() < 0.03
        else:
            assert not moved.any()
one = points[:1]
found, status, _ = cv2.optflow.calcOpticalFlowSparseRLOF(first, second, one, one.copy())
print(f"one point of {one.shape}: shift {(found - one).ravel().round(3)} px")
assert np.abs((found - one).ravel() - SHIFT).max() < 0.1
PYTHON
done
