#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: `calcOpticalFlowPyrLK` returns status 1 for points that have left the image, by up to the window's size. Where
# there is nothing to compare, the positions are 2 px off (median), single ones 10. Points that stay in the image are right to 0.001 px.
# Guessed: status 0 where the flow is not found, and a point outside cannot be found.
# Matters here: points leave the image of a camera that turns in each frame. A tracker that keeps all of status 1 feeds them to the
# estimate; `vio` drops what is outside.
# Source: https://github.com/opencv/opencv/issues/4799 (open), https://github.com/opencv/opencv/issues/7054 ("there is status"); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/numpy" numpy==2.4.6
for release in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --no-compile --no-deps --target "$folder/$release" "opencv-python-headless==$release"
    PYTHONPATH="$folder/$release:$folder/numpy" python3 - <<'PYTHON'
import cv2
import numpy as np

MOTION = np.array([-8.0, 0.0])
rng = np.random.default_rng(0)
world = cv2.GaussianBlur(rng.integers(0, 255, (400, 400)).astype(np.uint8), (0, 0), 2.5)
world = cv2.normalize(world, None, 0, 255, cv2.NORM_MINMAX)
before, after = world[100:300, 100:300].copy(), world[100:300, 108:308].copy()


def tracked(columns):
    """Return the errors, px, of what has status 1, where it is, and how many points there were."""
    y, x = np.mgrid[20:180:8, columns]
    points = np.c_[x.ravel(), y.ravel()].astype(np.float32)
    found, status, _ = cv2.calcOpticalFlowPyrLK(before, after, points[:, None], None, winSize=(21, 21), maxLevel=2)
    is_found = status.ravel() == 1
    found = found[:, 0]
    return np.linalg.norm(found - points - MOTION, axis=1)[is_found], found[is_found], len(points)


print("OpenCV", cv2.__version__, "all points move 8 px to the left:")
outside, where, count = tracked(slice(1, 8))
inside, _, inside_count = tracked(slice(30, 180, 8))
beyond = where[:, 0] < 0
print(f"  {count} points leave: {len(outside)} have status 1, {beyond.sum()} of them at x < 0")
print(f"    error of those: median {np.median(outside[beyond]):.2f} px, largest {outside.max():.1f} px")
print(f"  {inside_count} points stay: {len(inside)} have status 1, largest error {inside.max():.3f} px")
assert beyond.sum() > 0.7 * count and np.median(outside[beyond]) > 0.8 and outside.max() > 5
assert len(inside) == inside_count and inside.max() < 0.1
PYTHON
done
