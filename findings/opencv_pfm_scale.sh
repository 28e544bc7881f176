#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: `imread` divides the values of a PFM file by the size of the scale in its header. The PFM library of the author of the
# Middlebury benchmark writes 1/255 there by default, beside disparities in pixels, and ignores it when it reads: OpenCV returns 255 times as many pixels.
# Pillow 13.0.0 returns what is stored.
# Guessed: the sign gives the order of the bytes, and a reader returns the numbers that are stored; or else a scale factor multiplies.
# Matters here: disparities of stereo benchmarks are PFM files. Depths from them are 255 times too small, without a warning, and the
# image looks right, as all of it is scaled alike. Files that OpenCV itself writes have a scale of 1. `vio` reads no PFM file.
# Source: github.com/dscharstein/pfmLib, ImageIOpfm.cpp; OpenCV's grfmt_pfm.cpp; man page pfm(5), by which the number is a scale factor; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/pillow" pillow==13.0.0
for release in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$release" "opencv-python-headless==$release"
    PYTHONPATH="$folder/$release:$folder/pillow" python3 - "$folder" <<'PYTHON'
import sys
from pathlib import Path

import cv2
import numpy as np
import PIL
from PIL import Image

disparities = np.linspace(10.0, 60.0, 12, dtype="<f4").reshape(3, 4)  # pixels; rows in the file run from the bottom
file = Path(sys.argv[1]) / "disp0.pfm"
print("OpenCV", cv2.__version__, "Pillow", PIL.__version__)
for scale, ratio in (("-1", 1.0), ("-0.003922", 1 / 0.003922), ("-0.5", 2.0)):
    file.write_bytes(f"Pf\n4\n3\n{scale}\n".encode() + disparities[::-1].tobytes())
    by_opencv = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    by_pillow = np.array(Image.open(file))
    depth = 1000.0 * 0.1 / by_opencv[0, 0]  # focal length 1000 px, baseline 0.1 m
    print(f"scale {scale}: OpenCV {by_opencv[0, 0]:.2f} px (depth {depth:.3f} m), Pillow {by_pillow[0, 0]:.2f} px, stored {disparities[0, 0]:.2f} px")
    assert np.allclose(by_opencv, ratio * disparities, rtol=1e-5)
    assert np.array_equal(by_pillow, disparities)
cv2.imwrite(str(file), disparities)
assert file.read_bytes().startswith(b"Pf\n4 3\n-1\n")
PYTHON
done
