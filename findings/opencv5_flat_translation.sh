#!/usr/bin/env bash
# OpenCV 5.0.0: `stereoRectify` refuses a translation of shape (3,), which 4.14.0 takes; (3, 1) works in both.
# Guessed: a vector of NumPy is as good as a column, as it is for the distortion coefficients of the same call.
# Matters here: T[:3, 3] of a transform is such a vector; the error names a matrix product, not the argument.
# Source: cv2.stereoRectify; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/try.py" <<'PYTHON'
import cv2
import numpy as np

K = np.array([[400.0, 0, 320], [0, 400.0, 240], [0, 0, 1]])
T = np.eye(4)
T[0, 3] = -0.1
taken = []
for t in (T[:3, 3], T[:3, 3:]):
    try:
        P2 = cv2.stereoRectify(K, np.zeros(5), K, np.zeros(5), (640, 480), T[:3, :3], t)[3]
        taken.append(abs(P2[0, 3] + 40.0) < 1e-9)
    except cv2.error as error:
        print(t.shape, "refused:", error.err)
        taken.append(False)
print("OpenCV", cv2.__version__, "takes (3,) and (3, 1):", taken)
assert taken == [not cv2.__version__.startswith("5"), True]
PYTHON
for version in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$version" numpy==2.4.6 "opencv-python-headless==$version"
    PYTHONPATH="$folder/$version" python3 "$folder/try.py"
done
