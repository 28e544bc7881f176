#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0 (contrib): `ximgproc.createDisparityWLSFilter(matcher)` edits the matcher it is given: the left-right check, the speckle filter and the uniqueness ratio (of
# StereoBM the texture threshold too) are off afterwards. The same matcher's next disparities have wrong ones where they were marked as missing before.
# Guessed: "sets up all the relevant filter parameters automatically based on the matcher instance" reads the matcher, and what is set up is the filter.
# Matters here: one matcher often serves a filtered image to look at and raw disparities to measure by: lifted points, checks of a VIO's depths, masks of moving objects. Once the
# filter is made, in whatever part of the program, half-hidden and bare regions have depths, without a warning. Give the filter a matcher of its own, or set the values again.
# Source: the documentation of createDisparityWLSFilter, https://docs.opencv.org/4.x/d9/d51/classcv_1_1ximgproc_1_1DisparityWLSFilter.html; its `__doc__`; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for opencv in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$opencv" opencv-contrib-python-headless==$opencv numpy==2.4.6
    PYTHONPATH="$folder/$opencv" python3 - <<'PYTHON'
import cv2
import numpy as np

NEAR, FAR, H, W = 40, 8, 240, 400  # disparities, px
rng = np.random.default_rng(0)
texture = cv2.GaussianBlur(rng.uniform(0, 255, (H, W + 100)), (0, 0), 1.2)
texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
front = cv2.normalize(cv2.GaussianBlur(rng.uniform(0, 255, (120, 120)), (0, 0), 1.2), None, 0, 255, cv2.NORM_MINMAX)
left, right = texture[:, :W].copy(), texture[:, FAR : W + FAR].copy()
left[60:180, 200:320] = front  # a board before a wall, and beside it what the right camera does not see
right[60:180, 200 - NEAR : 320 - NEAR] = front
left, right = ((view + rng.normal(0, 4, view.shape)).clip(0, 255).astype(np.uint8) for view in (left, right))
true = np.full((H, W), FAR)
true[60:180, 200:320] = NEAR


def settings(matcher):
    names = ("Disp12MaxDiff", "SpeckleWindowSize", "UniquenessRatio") + (("TextureThreshold",) if hasattr(matcher, "getTextureThreshold") else ())
    return {name: getattr(matcher, "get" + name)() for name in names}


def wrong(matcher):
    """Return how many disparities are given though more than 2 px off."""
    disparities = matcher.compute(left, right) / 16.0
    region = np.s_[10:-10, 80:-10]
    return int(((disparities >= 0) & (abs(disparities - true) > 2))[region].sum())


print("OpenCV", cv2.__version__)
sgbm = cv2.StereoSGBM_create(0, 64, 5, P1=200, P2=800, disp12MaxDiff=1, uniquenessRatio=10, speckleWindowSize=100, speckleRange=2)
bm = cv2.StereoBM_create(64, 15)
bm.setDisp12MaxDiff(1)
bm.setSpeckleWindowSize(100)
bm.setSpeckleRange(2)
for name, matcher in (("StereoSGBM", sgbm), ("StereoBM", bm)):
    before, errors = settings(matcher), wrong(matcher)
    cv2.ximgproc.createDisparityWLSFilter(matcher)  # its result is not even kept
    after, later = settings(matcher), wrong(matcher)
    print(f"{name}: {before}, {errors} wrong disparities;\n    after a filter was made: {after}, {later} wrong disparities")
    assert before["Disp12MaxDiff"] == 1 and before["SpeckleWindowSize"] == 100 and before["UniquenessRatio"] > 0
    assert after["Disp12MaxDiff"] == 1000000
    assert all(value == 0 for key, value in after.items() if key != "Disp12MaxDiff")
    assert later > 3 * errors + 500
PYTHON
done
