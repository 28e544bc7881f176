#!/usr/bin/env bash
# OpenCV 5.0.0: `remap` and `warpAffine` interpolate at the very position, also for uint8; 4.14.0 rounds it to 1/32 px.
# Guessed: the fixed-point tables of 4.x are in 5.0 too.
# Matters here: rectified images of the two versions differ by up to 1/64 px, and so do tracks.
# Source: cv2.remap, cv2.warpAffine; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/try.py" <<'PYTHON'
import cv2
import numpy as np

exact = cv2.__version__.startswith("5")
step = np.zeros((8, 64), np.uint8)
step[:, 21:] = 250
image = np.tile(np.arange(64, dtype=np.float32), (8, 1))
u = (20 + np.linspace(0, 1, 101)).astype(np.float32)[None]
v = np.full_like(u, 4)
for name, read in (
    ("float32", cv2.remap(image, u, v, cv2.INTER_LINEAR)),
    ("uint8", 20 + cv2.remap(step, u, v, cv2.INTER_LINEAR) / 250.0),
):
    error = np.abs(read - u).max()
    print(f"OpenCV {cv2.__version__} {name}: remap off by {error:.4f} px at most")
    assert error < 0.0021 if exact else 0.01 < error < 1 / 64 + 1 / 500
M = np.array([[1, 0, 0.37], [0, 1, 0.0]])
flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
shift = float(cv2.warpAffine(image, M, (64, 8), flags=flags)[4, 20]) - 20.0
print(f"warpAffine by 0.37 px shifts by {shift:.4f}")
assert abs(shift - (0.37 if exact else 0.375)) < 1e-4
PYTHON
for version in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$version" numpy==2.4.6 "opencv-python-headless==$version"
    PYTHONPATH="$folder/$version" python3 "$folder/try.py"
done
