#!/usr/bin/env bash
# cosysairsim 3.5.0 (Cosys-AirSim; AirSim 1.8.1 has the same functions): `write_pfm` and `read_pfm` have the rows of a PFM file from the top down. The format has them from the bottom up. So OpenCV reads an
# image of AirSim's upside down, and `read_pfm` of AirSim's reads Middlebury's, and any other, upside down; one after the other they agree, so a test of both sees nothing.
# Guessed: a file with the header of a format is in that format.
# Matters here: the depths of a simulated stereo pair, as truth for disparities or of an RGB-D recording, are those of the mirrored row: sky where the road is. Of a level floor and a wall, seen by a
# camera in the middle, it is not obvious: depths still are smooth and of the right size. `vio` reads no PFM files; with OpenCV, flip AirSim's.
# Source: https://netpbm.sourceforge.net/doc/pfm.html, "bottom to top"; cosysairsim/utils.py, which flips nothing; AirSim's issue 921 shows such an image; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/packages" cosysairsim==3.5.0 opencv-contrib-python-headless==4.14.0.94 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - "$folder" <<'PYTHON'
import sys
from importlib.metadata import version
from pathlib import Path

import cosysairsim
import cv2
import numpy as np

folder = Path(sys.argv[1])
print("cosysairsim", version("cosysairsim"), "OpenCV", cv2.__version__)
HEIGHT, WIDTH, FOCAL, CV, ABOVE = 120, 160, 100.0, 59.5, 1.5
rows = np.arange(HEIGHT)[:, None]
with np.errstate(divide="ignore"):
    depth = np.where(rows > CV, FOCAL * ABOVE / (rows - CV), 50.0).clip(0, 50.0)  # a floor and, above, a wall
depth = (depth + np.zeros(WIDTH)).astype(np.float32)

ours = folder / "airsim.pfm"
cosysairsim.write_pfm(str(ours), depth)
by_opencv = cv2.imread(str(ours), cv2.IMREAD_UNCHANGED)
theirs = folder / "opencv.pfm"
assert cv2.imwrite(str(theirs), depth)
by_airsim, scale = cosysairsim.read_pfm(str(theirs))
both, _ = cosysairsim.read_pfm(str(ours))
raw = theirs.read_bytes()[-4 * WIDTH * HEIGHT :]
for name, read in (("AirSim's file by OpenCV", by_opencv), ("OpenCV's file by AirSim", by_airsim), ("AirSim's by AirSim", both)):
    same, flipped = np.array_equal(read, depth), np.array_equal(read[::-1], depth)
    print(f"{name}: depth in row 110 is {read[110, 80]:.2f} m for {depth[110, 80]:.2f} m; equal {same}, equal upside down {flipped}")
assert np.array_equal(np.frombuffer(raw, "<f4", WIDTH), depth[-1]), "the format's first row is the lowest"
assert np.array_equal(by_opencv[::-1], depth) and np.array_equal(by_airsim[::-1], depth) and np.array_equal(both, depth)
assert not np.array_equal(by_opencv, depth)
assert np.array_equal(cv2.imread(str(theirs), cv2.IMREAD_UNCHANGED), depth)
PYTHON
