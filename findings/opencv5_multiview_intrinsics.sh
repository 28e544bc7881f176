#!/usr/bin/env bash
# OpenCV 5.0.0: `calibrateMultiview` estimates no intrinsics with the rig. Without flags they are `calibrateCamera`'s of each camera alone, to 1e-3 px, and rotation and
# baseline `stereoCalibrate`'s with CALIB_FIX_INTRINSIC. With CALIB_USE_INTRINSIC_GUESS in `flags` a guess that is 20 px wrong comes back as it went in, and the baseline is 122
# instead of 120 mm. `stereoCalibrate` with the same guess and flag finds the focal lengths.
# Guessed: "estimates intrinsics and extrinsics" and "minimizes the total re-projection error for all the points in all the available views from all cameras",
# as its text says: one adjustment, in which each view helps both lenses; and a guess is where an adjustment begins, as in `calibrateCamera`.
# Matters here: over 12 calibrations the third component of the baseline scatters three times as much as that of the joint adjustment, the focal length 1.7 times;
# and what a wrong guess does to the baseline is scale. Only the error of the images, 1.5 times that of the joint adjustment, shows it.
# Source: help(cv2.calibrateMultiviewExtended) of the wheel; cv2 on drawn boards with corners off by 0.2 px; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" opencv-python-headless==5.0.0.93 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import cv2
import numpy as np

SIZE, VIEWS, RUNS = (640, 480), 20, 12
MATRICES = [np.array([[460.0, 0, 320], [0, 458, 240], [0, 0, 1]]), np.array([[455.0, 0, 318], [0, 455, 243], [0, 0, 1]])]
LENS = np.array([-0.28, 0.07, 0, 0, 0])
TURN, MOVE = np.array([0.01, -0.05, 0.02]), np.array([-0.12, 0.003, 0.001])
BOARD = np.array([[0.03 * i, 0.03 * j, 0] for j in range(6) for i in range(8)], np.float32)
rng = np.random.default_rng(0)


def draw_corners():
    """Return the exact corners of each view, for both cameras."""
    views = []
    while len(views) < VIEWS:
        turn = rng.uniform(-0.5, 0.5, 3)
        move = np.array([rng.uniform(-0.25, 0.05), rng.uniform(-0.2, 0.05), rng.uniform(0.3, 0.5)])
        second = cv2.composeRT(turn, move, TURN, MOVE)[:2]
        corners = [
            cv2.projectPoints(BOARD, *pose, matrix, LENS)[0].reshape(-1, 2)
            for pose, matrix in zip(((turn, move), second), MATRICES)
        ]
        if all((c > 5).all() and (c < np.array(SIZE) - 5).all() for c in corners):
            views.append(corners)
    return [[view[camera] for view in views] for camera in (0, 1)]


def multiview(corners, matrices, lenses, guess):
    flags = cv2.CALIB_USE_INTRINSIC_GUESS if guess else 0
    error, found, _, turns, moves = cv2.calibrateMultiview(
        [BOARD] * VIEWS, corners, [SIZE] * 2, np.ones((2, VIEWS), np.uint8), np.zeros(2, np.uint8),
        [m.copy() for m in matrices], [l.copy() for l in lenses], None, None,
        flagsForIntrinsics=np.full(2, flags, np.int32), flags=flags,
    )  # fmt: skip
    return error, found, turns[1].ravel(), moves[1].ravel()


def stereo(corners, matrices, lenses, flags):
    error, left, _, right, _, turn, move = cv2.stereoCalibrate(
        [BOARD] * VIEWS, *corners, matrices[0].copy(), lenses[0].copy(), matrices[1].copy(), lenses[1].copy(), SIZE, flags=flags
    )[:7]
    return error, (left, right), cv2.Rodrigues(turn)[0].ravel(), move.ravel()


print("OpenCV", cv2.__version__)
exact = draw_corners()
results = {"multiview": [], "joint": []}
for run in range(RUNS):
    corners = [[(c + rng.normal(0, 0.2, c.shape)).astype(np.float32) for c in camera] for camera in exact]
    alone = [cv2.calibrateCamera([BOARD] * VIEWS, c, SIZE, None, None) for c in corners]
    matrices, lenses = [a[1] for a in alone], [a[2] for a in alone]
    many = multiview(corners, matrices, lenses, guess=False)
    fixed = stereo(corners, matrices, lenses, cv2.CALIB_FIX_INTRINSIC)
    assert max(np.abs(a - b).max() for a, b in zip(many[1], matrices)) < 1e-3
    assert np.abs(many[2] - fixed[2]).max() < 3e-5 and np.abs(many[3] - fixed[3]).max() < 1e-5
    results["multiview"].append(many)
    results["joint"].append(stereo(corners, matrices, lenses, cv2.CALIB_USE_INTRINSIC_GUESS))
print(f"  without flags, {RUNS} runs: intrinsics of each camera alone, rotation and baseline as with CALIB_FIX_INTRINSIC")
spread = {
    name: (np.std([r[3][2] for r in runs]) * 1e3, np.std([r[1][1][0, 0] for r in runs])) for name, runs in results.items()
}
for name, (depth_mm, focal_px) in spread.items():
    print(f"  {name}: standard deviation of the baseline's z {depth_mm:.2f} mm, of the focal length {focal_px:.2f} px")
assert spread["multiview"][0] > 2 * spread["joint"][0] and spread["multiview"][1] > 1.5 * spread["joint"][1]

wrong = [m + np.diag([20.0, 20.0, 0]) for m in matrices]
many = multiview(corners, wrong, lenses, guess=True)
joint = stereo(corners, wrong, lenses, cv2.CALIB_USE_INTRINSIC_GUESS)
for name, (error, found, _, move) in {"multiview": many, "joint": joint}.items():
    print(f"  guess {wrong[1][0, 0]:.2f} px, {name}: {found[1][0, 0]:.2f} px, error {error:.3f} px, baseline {np.round(1e3 * move, 2)} mm")
assert max(np.abs(a - b).max() for a, b in zip(many[1], wrong)) < 1e-3
assert abs(joint[1][1][0, 0] - 455) < 1.5 and abs(joint[3][0] + 0.12) < 5e-4
assert many[0] > 1.3 * joint[0] and abs(many[3][0] + 0.12) > 1e-3
PYTHON
