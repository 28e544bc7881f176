#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: the lines of `createLineSegmentDetector` lie 1/8 of a pixel too far to the left and above, by default: it looks in an image of 0.8 times the size, and divides what it finds by 0.8,
# as if the first pixel's centre stayed at (0, 0). With scale s they are 0.5 / s - 0.5 off: 0.5 px with 0.5, nothing with 1.
# Guessed: lines of sub-pixel accuracy are in the coordinates of the image, as corners are; the scale changes what is found, not where.
# Matters here: a VIO of points and lines has the two 0.18 px apart, in all frames alike, so that no average removes it; disparities of lines do not show it.
# Detected with scale=1 they agree. SIFT and ORB have offsets of their own (F26, F27). `vio` uses no lines.
# Source: help(cv2.createLineSegmentDetector): `scale`, the scale of the image that will be used to find the lines; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for version in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$version" "opencv-python-headless==$version" numpy==2.4.6
    PYTHONPATH="$folder/$version" python3 - <<'PYTHON'
import cv2
import numpy as np

WIDTH, HEIGHT, FINE = 320, 240, 8  # pixels; parts of a pixel along each axis
HALF = np.array([80.0, 50.0])  # px, of a bright rectangle


def image(angle, centre):
    """Show the rectangle, turned by an angle in rad; the first pixel's centre is (0, 0)."""
    y, x = (np.mgrid[0 : HEIGHT * FINE, 0 : WIDTH * FINE] + 0.5) / FINE - 0.5
    u = (x - centre[0]) * np.cos(angle) + (y - centre[1]) * np.sin(angle)
    v = (y - centre[1]) * np.cos(angle) - (x - centre[0]) * np.sin(angle)
    inside = (np.abs(u) < HALF[0]) & (np.abs(v) < HALF[1])
    light = 50 + 160 * inside.reshape(HEIGHT, FINE, WIDTH, FINE).mean((1, 3), dtype=np.float32)
    return cv2.GaussianBlur(light, (0, 0), 0.8).round().astype(np.uint8)


def offsets(lines, angle, centre):
    """Return the normals (N, 2) of the sides found, and how far each is from its place along them."""
    axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    normals, shifts = [], []
    for ends in (lines.reshape(-1, 2, 2) - centre) @ axes.T:
        for axis in range(2):
            if np.ptp(ends[:, axis]) < 3 and np.ptp(ends[:, 1 - axis]) > 40:
                side = np.sign(ends[:, axis].mean()) * HALF[axis]
                normals.append(axes[axis])
                shifts.append(ends[:, axis].mean() - side)
    return normals, shifts


print("OpenCV", cv2.__version__)
for scale in (0.5, 0.8, 1.0):
    detector = cv2.createLineSegmentDetector() if scale == 0.8 else cv2.createLineSegmentDetector(scale=scale)
    rng = np.random.default_rng(0)
    normals, shifts = [], []
    for _ in range(20):
        angle, centre = rng.uniform(0, np.pi / 2), [160, 120] + rng.uniform(-0.5, 0.5, 2)
        found = offsets(detector.detect(image(angle, centre))[0], angle, centre)
        normals += found[0]
        shifts += found[1]
    shift = np.linalg.lstsq(np.array(normals), np.array(shifts), rcond=None)[0]
    rest = np.array(shifts) - np.array(normals) @ shift
    name = " (the default)" if scale == 0.8 else ""
    print(f"scale {scale}{name}: {len(shifts)} lines are {shift.round(3)} px from their places, {np.sqrt(np.mean(rest**2)):.3f} px without that")
    assert len(shifts) >= 70 and np.allclose(shift, 0.5 - 0.5 / scale, atol=0.02), shift
PYTHON
done
