#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: `findChessboardCornersSB` with CALIB_CB_NORMALIZE_IMAGE puts the corners of a sharp, evenly lit board 0.23 px beside their place,
# without the flag 0.04 px. It equalises the histogram and takes the fractions of a pixel from the equalised image, too, in which the few greys
# of the edges are stretched. With `findChessboardCorners` the same flag leaves no trace after `cornerSubPix`, which works in the image itself.
# Guessed: a flag for finding a board ("before detection", as its text has it) finds more boards and costs no accuracy.
# Matters here: the detector that is made for accurate calibrations is five times worse than the old one on the best images; the corners' noise of a
# calibration grows from 0.04 to 0.2 px, and its result with it. `vio calibrate-rig` sets the flag to find boards, and estimates each corner anew in the image.
# Source: https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html, findChessboardCornersSB and findChessboardCorners; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for release in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$release" "opencv-python-headless==$release" numpy==2.3.5
    PYTHONPATH="$folder/$release" python3 - <<'PYTHON'
import cv2
import numpy as np

COLS, ROWS, SQUARE, FINE = 9, 6, 40, 4  # inner corners; side of a square; fine pixels in a pixel
WIDTH, HEIGHT = 640, 480
rng = np.random.default_rng(3)
board = np.full(((ROWS + 3) * SQUARE, (COLS + 3) * SQUARE), 255, np.uint8)
for row in range(ROWS + 1):
    for col in range(row % 2, COLS + 1, 2):
        board[(row + 1) * SQUARE : (row + 2) * SQUARE, (col + 1) * SQUARE : (col + 2) * SQUARE] = 0
corners = np.array([[(c + 2) * SQUARE, (r + 2) * SQUARE] for r in range(ROWS) for c in range(COLS)], float) - 0.5
sheet = np.float32([[0, 0], [480, 0], [480, 360], [0, 360]])
to_fine = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1.0]])


def error(found, true):
    """RMS distance of the corners in pixels; a board may be found from its other end."""
    found = np.asarray(found, float).reshape(-1, 2)
    return min(np.sqrt(((f - true) ** 2).sum(axis=1).mean()) for f in (found, found[::-1]))


errors = {"SB": [], "SB, flag": [], "old": [], "old, flag": []}
for _ in range(6):
    seen = np.float32([[60, 50], [590, 45], [580, 430], [55, 425]]) + rng.uniform(-35, 35, (4, 2)).astype(np.float32)
    to_image = cv2.getPerspectiveTransform(sheet, seen)
    fine = cv2.warpPerspective(board, to_fine @ to_image, (WIDTH * FINE, HEIGHT * FINE), borderValue=255)
    image = cv2.GaussianBlur(fine.reshape(HEIGHT, FINE, WIDTH, FINE).mean((1, 3)), (0, 0), 0.7)
    image = np.clip(image * 0.6 + 30 + rng.normal(0, 2, image.shape), 0, 255).round().astype(np.uint8)
    true = cv2.perspectiveTransform(corners[None], to_image)[0]
    for name, flag in (("", 0), (", flag", cv2.CALIB_CB_NORMALIZE_IMAGE)):
        done, found = cv2.findChessboardCornersSB(image, (COLS, ROWS), flags=flag)
        assert done
        errors["SB" + name].append(error(found, true))
        done, found = cv2.findChessboardCorners(image, (COLS, ROWS), flags=flag | cv2.CALIB_CB_ADAPTIVE_THRESH)
        assert done
        found = cv2.cornerSubPix(image, found, (5, 5), (-1, -1), (3, 50, 1e-4))
        errors["old" + name].append(error(found, true))
rms = {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in errors.items()}
print("opencv", cv2.__version__, "RMS of corners, px:", {name: round(value, 3) for name, value in rms.items()})
assert rms["SB"] < 0.06 and rms["old"] < 0.06
assert abs(rms["old, flag"] - rms["old"]) < 0.005
assert 0.18 < rms["SB, flag"] < 0.3
PYTHON
done
