#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: `fisheye.projectPoints` shows a point 95 degrees off the optical axis at the opposite side of the image,
# where one at 85 degrees belongs, and `fisheye.undistortPoints` makes 90 degrees of every pixel beyond 90. Neither says so.
# Guessed: the model is one of angles, so the lenses it is made for, of 190 to 200 degrees, work as far as the polynomial does.
# Matters here: points of a map that are drawn with it over the images of such a lens appear in the wrong half, and features near the
# border get one and the same angle. The lenses of this project use the angle itself, and go on beyond 90 degrees.
# Source: https://github.com/opencv/opencv/issues/19433, https://github.com/opencv/opencv/issues/26174; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for release in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$release" "opencv-python-headless==$release"
    PYTHONPATH="$folder/$release" python3 - <<'PYTHON'
import cv2
import numpy as np

FOCAL, CENTRE = 190.0, 256.0
K = np.array([[FOCAL, 0, CENTRE], [0, FOCAL, CENTRE], [0, 0, 1]])
NO_DISTORTION = np.zeros(4)  # the distance from the centre is the focal length times the angle


def column(degrees):
    angle = np.radians(degrees)
    ray = np.array([[[np.sin(angle), 0.0, np.cos(angle)]]])
    return cv2.fisheye.projectPoints(ray, np.zeros(3), np.zeros(3), K, NO_DISTORTION)[0][0, 0, 0]


def angle_of(column_px):
    pixel = np.array([[[column_px, CENTRE]]])
    return np.degrees(np.arctan(cv2.fisheye.undistortPoints(pixel, K, NO_DISTORTION)[0, 0, 0]))


print("OpenCV", cv2.__version__)
for degrees in (60, 85, 95, 97):
    right = CENTRE + FOCAL * np.radians(degrees)
    shown, back = column(degrees), angle_of(right)
    print(f"{degrees} degrees: column {shown:.1f}, by the model {right:.1f}; that pixel undistorted: {back:.2f} degrees")
    if degrees < 90:
        assert abs(shown - right) < 1e-6 and abs(back - degrees) < 1e-6
    else:
        assert abs(shown - (CENTRE - FOCAL * np.radians(180 - degrees))) < 1e-6  # the mirrored angle, to the left
        assert abs(back - 90) < 1e-6
PYTHON
done
