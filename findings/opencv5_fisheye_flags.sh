#!/usr/bin/env bash
# OpenCV 5.0.0: `cv2.fisheye.CALIB_*` are gone, and the flags of `cv2.CALIB_*` that take their place have other numbers:
# those of 4.14.0 are accepted and mean something else. Without a word, 2 + 8 no longer recomputes the poses and fixes the
# skew: of exact pixels of a lens with 4 px of skew 4.14.0 returns none with 0.4 px of error, 5.0.0 4.1 px with 9.6.
# Guessed: constants that move keep their numbers, or old numbers are refused.
# Matters here: numbers stored in a script or a file calibrate another camera.
# Source: cv2.fisheye.calibrate; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/try.py" <<'PYTHON'
import cv2
import numpy as np

rng = np.random.default_rng(0)
board = np.array([(x, y, 0.0) for y in range(6) for x in range(8)])[None] * 0.05
K = np.array([[300.0, 4.0, 320], [0, 300.0, 240], [0, 0, 1]])  # of a skewed lens
D = np.array([0.01, -0.005, 0.001, 0.0])
pixels = []
for _ in range(12):
    turn = rng.uniform(-0.6, 0.6, 3)
    move = np.array([rng.uniform(-0.3, 0.0), rng.uniform(-0.25, 0.0), rng.uniform(0.3, 0.5)])
    pixels.append(cv2.fisheye.projectPoints(board, turn, move, K, D, alpha=4.0 / 300.0)[0])
skewed = {}
for name, flags in (("2 + 8", 2 + 8), ("2", 2)):
    found = cv2.fisheye.calibrate([board] * 12, pixels, (640, 480), None, None, flags=flags)
    skewed[name] = abs(float(found[1][0, 1]))
    print(f"OpenCV {cv2.__version__} flags {name}: skew {skewed[name]:.3f} px, rms {found[0]:.3f} px")
names = [name for name in dir(cv2.fisheye) if name.startswith("CALIB_")]
if cv2.__version__.startswith("5"):
    assert names == []
    assert cv2.CALIB_FIX_SKEW == 33554432
    assert skewed["2 + 8"] > 1.0
else:
    assert cv2.fisheye.CALIB_FIX_SKEW == 8
    assert skewed["2 + 8"] == 0.0
PYTHON
for version in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$version" numpy==2.4.6 "opencv-python-headless==$version"
    PYTHONPATH="$folder/$version" python3 "$folder/try.py"
done
