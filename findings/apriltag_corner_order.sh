#!/usr/bin/env bash
# pupil-apriltags 1.0.4.post11 (AprilTag 3) and OpenCV 4.12.0: the same tag, and no corner is the same. OpenCV's dictionary DICT_APRILTAG_36h11
# holds the tags turned by half a turn, and its corners run clockwise from the top left one; AprilTag's run the other way round from its
# bottom left, which is the top right one of OpenCV's. And AprilTag counts pixels from their edges: its corners are 0.4 px further.
# Guessed: corner 0 of a tag is corner 0 of that tag, and a switch of detectors changes the last digits.
# Matters here: corners of the one go with the board of the other only as corners[[1, 0, 3, 2]] - 0.4; without it, each tag of a grid is
# mirrored in its place, and a calibration fails, or these 0.4 px go into the principal points of both cameras.
# Source: `vio calibrate-rig` takes OpenCV's; the README of AprilTag says that corners wrap counter-clockwise around the tag; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pupil-apriltags==1.0.4.post11 opencv-python-headless==4.12.0.88 numpy==2.2.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import cv2
import numpy as np
from pupil_apriltags import Detector

FINE = 8  # fine pixels in a pixel
LEFT, TOP, SIDE = 100, 60, 96  # of the tag, whole pixels
dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
fine = np.full((240 * FINE, 320 * FINE), 255, np.uint8)
rows = slice(TOP * FINE, (TOP + SIDE) * FINE)
columns = slice(LEFT * FINE, (LEFT + SIDE) * FINE)
fine[rows, columns] = cv2.aruco.generateImageMarker(dictionary, 7, SIDE * FINE)
image = fine.reshape(240, FINE, 320, FINE).mean((1, 3)).astype(np.uint8)
image = cv2.GaussianBlur(image, (0, 0), 0.8)

parameters = cv2.aruco.DetectorParameters()
parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
found, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
opencv = found[0].reshape(4, 2)
(tag,) = Detector(families="tag36h11", quad_decimate=1.0).detect(image)
assert ids.ravel().tolist() == [tag.tag_id] == [7]
off = tag.corners[[1, 0, 3, 2]] - opencv
print("opencv", cv2.__version__, "corners", opencv.round(2).tolist())
print("pupil-apriltags", version("pupil-apriltags"), "corners", tag.corners.round(2).tolist())
print("AprilTag's corners 1 0 3 2 from OpenCV's 0 1 2 3, mean:", off.mean(axis=0).round(2))
assert np.abs(off).max() < 1
assert np.abs(tag.corners - opencv).max() > 90
assert np.abs(off.mean(axis=0) - 0.38).max() < 0.05
PYTHON
