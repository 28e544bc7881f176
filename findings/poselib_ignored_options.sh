#!/usr/bin/env bash
# poselib 2.0.5: the options of an estimate are a dictionary, and a key or value that it does not know is passed over: a relative pose
# with `max_reproj_error` (the name of the limit for homographies and absolute poses; here it is `max_epipolar_error`), `threshold`,
# `confidence`, or a loss called "HUBBER" is the default's, to the last bit.
# Guessed: an error, or a warning, for an option that is none; and one name for the limit, which is in pixels everywhere.
# Matters here: who compares a front end or matches of this project with poselib, and sets the limit by the other name, compares with
# 1 px for two images, 12 px for points, and 12 px for a homography, whatever was asked for.
# Source: poselib.RansacOptions() lists the keys; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" poselib==2.0.5 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import numpy as np
import poselib

CAMERA = {"model": "PINHOLE", "width": 640, "height": 480, "params": [460, 460, 320, 240]}
rng = np.random.default_rng(0)
points = rng.uniform([-2, -1.5, 3], [2, 1.5, 6], (400, 3))


def seen(at):
    return 460 * at[:, :2] / at[:, 2:] + [320, 240] + rng.normal(0, 1, (400, 2))


first, second = seen(points), seen(points - [0.3, 0.02, 0.05])
second[:120] = rng.uniform(0, 480, (120, 2))
CALLS = {
    "relative pose": lambda ransac, refine: poselib.estimate_relative_pose(first, second, CAMERA, CAMERA, ransac, refine)[1],
    "absolute pose": lambda ransac, refine: poselib.estimate_absolute_pose(second, points, CAMERA, ransac, refine)[1],
    "homography": lambda ransac, refine: poselib.estimate_homography(first, second, ransac, refine)[1],
}
LIMITS = ({}, {"max_epipolar_error": 3.0}, {"max_reproj_error": 3.0}, {"threshold": 3.0}, {"confidence": 0.5})
print("poselib", poselib.__version__, "inliers by options:")
counts = {}
for name, estimate in CALLS.items():
    counts[name] = [estimate(options, {})["num_inliers"] for options in LIMITS]
    print(f"  {name}:", dict(zip(map(str, LIMITS), counts[name], strict=True)))
default, epipolar, reprojection, threshold, confidence = counts["relative pose"]
assert default == reprojection == threshold == confidence != epipolar
for name in ("absolute pose", "homography"):
    default, epipolar, reprojection, threshold, confidence = counts[name]
    assert default == epipolar == threshold == confidence != reprojection


def translation(**refine):
    pose, _ = poselib.estimate_relative_pose(first, second, CAMERA, CAMERA, {}, refine)
    return pose.t.tolist()


losses = {name: translation(loss_type=name) for name in ("CAUCHY", "HUBER", "HUBBER")}
print("  translation by loss:", losses)
assert losses["HUBBER"] == translation() == losses["CAUCHY"] != losses["HUBER"]
PYTHON
