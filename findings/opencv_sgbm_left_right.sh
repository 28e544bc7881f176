#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: the left-right check of StereoSGBM cannot be turned off by a `disp12MaxDiff` of 0 (the default) or below,
# although its documentation says so: each is taken for 1, the strictest check, bit for bit. `uniquenessRatio` below 0 is taken for 10. A large
# number turns the check off.
# Guessed: as documented.
# Matters here: who turns the check off for dense depth, or makes an own one with a second matcher, loses the pixels all the same, and a
# sweep over -1, 0 and 1 compares one setting with itself. `getDisp12MaxDiff` returns what was set.
# Source: docs.opencv.org, StereoSGBM::create; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/numpy" numpy==2.4.6
for release in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --no-compile --no-deps --target "$folder/$release" "opencv-python-headless==$release"
    PYTHONPATH="$folder/$release:$folder/numpy" python3 - <<'PYTHON'
import cv2
import numpy as np

rng = np.random.default_rng(0)
left = cv2.GaussianBlur(rng.integers(0, 255, (120, 200)).astype(np.uint8), (0, 0), 1.2)
left = cv2.normalize(left, None, 0, 255, cv2.NORM_MINMAX)
right = np.roll(left, -10, axis=1)
right[:, 50:100] = np.roll(left, -20, axis=1)[:, 50:100]  # a nearer surface, which hides a part of the other
right = np.clip(right + rng.normal(0, 8, right.shape), 0, 255).astype(np.uint8)


def disparities(**options):
    return cv2.StereoSGBM_create(0, 32, 5, P1=200, P2=800, **options).compute(left, right)


print("OpenCV", cv2.__version__, "pixels with a disparity:")
default = disparities()
checked = {limit: disparities(disp12MaxDiff=limit) for limit in (-1, 0, 1, 2, 1000)}
for limit, found in checked.items():
    print(f"  disp12MaxDiff {limit}: {np.mean(found >= 0):.2%}, equal to 1: {np.array_equal(found, checked[1])}")
for limit in (-1, 0):
    assert np.array_equal(checked[limit], checked[1]) and np.array_equal(checked[limit], default)
assert not np.array_equal(checked[2], checked[1])
assert np.mean(checked[1000] >= 0) > np.mean(checked[1] >= 0) + 0.03
assert cv2.StereoSGBM_create(disp12MaxDiff=-1).getDisp12MaxDiff() == -1

unique = {ratio: disparities(disp12MaxDiff=1000, uniquenessRatio=ratio) for ratio in (-1, 0, 10)}
print("  uniquenessRatio:", {ratio: f"{np.mean(found >= 0):.2%}" for ratio, found in unique.items()})
assert np.array_equal(unique[-1], unique[10]) and not np.array_equal(unique[0], unique[10])
PYTHON
done
