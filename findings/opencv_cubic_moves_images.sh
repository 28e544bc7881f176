#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: INTER_CUBIC moves what it interpolates, by up to 0.048 px to the left or to the right with the fraction of the pixel, and more the smoother the image is. A ramp of gray values
# comes out as a staircase; a wave of 20 px moves by 0.045 px where `remap` reads a quarter of a pixel on, and back at three quarters. `resize` and `warpAffine` do so too. INTER_LINEAR, the cheaper one,
# moves 0.010 px at a wave of 8 px, 0.0016 px at 20 px and a ramp not at all; INTER_LANCZOS4 at most a third of it.
# Guessed: of linear and cubic interpolation the cubic one is the more exact, as Keys' is, of which OpenCV's has the form. Its parameter is -0.75, where only -0.5 keeps a ramp a ramp.
# Matters here: features of images that are rectified or undistorted with it are off by 0.05 px with a period of a pixel, in each camera by its own map; depth images that are scaled up with it have steps of 5 % of the difference between neighbours. `vio` rectifies by "linear" unless told otherwise.
# Source: modules/imgproc, interpolateCubic (A = -0.75f); Keys, IEEE ASSP 1981, for the parameter; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/run.py" <<'PYTHON'
import cv2
import numpy as np

NAMES = ("INTER_LINEAR", "INTER_CUBIC", "INTER_LANCZOS4")
v, u = np.mgrid[:20, :400].astype(np.float32)


def moved(name, wave, fraction):
    """By how many px a wave lies off after `remap` has read it a fraction of a pixel on."""
    image = np.cos(2 * np.pi * u / wave)
    read = cv2.remap(image, u + np.float32(fraction), v, getattr(cv2, name))[10, 40:360]
    at = np.arange(40, 360)  # whole waves
    phase = np.angle(np.sum(read * np.exp(-2j * np.pi * (at + fraction) / wave)))
    return phase * wave / (2 * np.pi)


print("OpenCV", cv2.__version__)
worst = {}
for name in NAMES:
    for wave in (8, 20, 80):
        row = [moved(name, wave, k / 32) for k in range(32)]
        worst[name, wave] = np.abs(row).max()
        print(f"{name}, wave of {wave} px: {row[8]:+.4f} px at 1/4, {row[16]:+.4f} at 1/2, {row[24]:+.4f} at 3/4; at most {worst[name, wave]:.4f}")
    large = cv2.resize(u, None, fx=2, fy=1, interpolation=getattr(cv2, name))[10]
    step = (large - ((np.arange(800) + 0.5) / 2 - 0.5))[40:760]
    shifted = cv2.warpAffine(u, np.float32([[1, 0, -0.25], [0, 1, 0]]), (400, 20), flags=getattr(cv2, name))
    warp = (shifted - u - 0.25)[10, 40:360]
    print(f"    of a ramp: resize to twice the size {step.min():+.4f} to {step.max():+.4f} px, warpAffine by 1/4 px {warp.mean():+.4f} px")
    worst[name, "ramp"] = max(np.abs(step).max(), np.abs(warp).max())
assert worst["INTER_LINEAR", 20] < 0.004 and worst["INTER_LINEAR", "ramp"] < 1e-4
assert 0.04 < worst["INTER_CUBIC", 20] < 0.05 and 0.04 < worst["INTER_CUBIC", "ramp"] < 0.05
assert worst["INTER_LANCZOS4", 20] < 0.02
PYTHON
for version in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/$version" "opencv-contrib-python-headless==$version" numpy==2.4.6
    PYTHONPATH="$folder/$version" python3 "$folder/run.py"
done
