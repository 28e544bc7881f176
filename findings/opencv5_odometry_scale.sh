#!/usr/bin/env bash
# OpenCV 5.0.0: `Odometry`, new in the main module, divides a depth image by 5000 as soon as its largest value is above 10. Depths in millimetres, of which
# `rescaleDepth` and `depthTo3d` of the same module know that they are millimetres, give a translation of a fifth. Depths in metres are taken as they are, until
# one pixel is beyond 10 m: then a motion of 5 cm is one of 10 micrometres. Both calls return True, and the settings have no scale.
# Guessed: 16 bit are millimetres, floats are metres, as in the module's other functions.
# Matters here: depths of a stereo camera, given to it for comparison, come back with a scale that changes with the view. `vio` does not use it.
# Source: modules/3d/src/rgbd/odometry_frame_impl.cpp and odometry_functions.cpp ("scale bug") of opencv; help(cv2.depthTo3d); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" opencv-python-headless==5.0.0.93 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
K = np.array([[FOCAL, 0.0, 159.5], [0.0, FOCAL, 119.5], [0.0, 0.0, 1.0]])
u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
rays = np.stack([(u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL, np.ones_like(u, dtype=float)], axis=-1)
TRUE = np.array([-0.03, 0.0, -0.05])  # of points of the first camera to the second one


def depth(centre, far_m):
    """Return depths in m of a corridor with a box in it, from a position in it."""
    found = np.full((HEIGHT, WIDTH), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis, at in ((1, 1.0), (1, -1.5), (0, 2.0), (0, -2.0), (2, far_m)):
            along = (at - centre[axis]) / rays[..., axis]
            found = np.minimum(found, np.where(along > 0.0, along, np.inf))
        ends = [(corner - centre) / rays for corner in (np.array([-0.6, 0.2, 2.0]), np.array([0.1, 1.0, 2.6]))]
    near, far = np.fmin(*ends).max(axis=-1), np.fmax(*ends).min(axis=-1)
    return np.where((near < far) & (near > 0.0), np.minimum(found, near), found)


print("OpenCV", cv2.__version__, "true translation", TRUE)
assert not [name for name in dir(cv2.OdometrySettings) if "scale" in name.lower() and "sobel" not in name.lower()]
for name, corner_m, unit, kind, expected_z in (
    ("float, metres, up to 9 m", 9.0, 1.0, np.float32, -0.05),
    ("float, metres, one pixel at 11 m", 11.0, 1.0, np.float32, -0.05 / 5000.0),
    ("16 bit, millimetres", 9.0, 1000.0, np.uint16, -0.01),
    ("16 bit, 5000 a metre", 9.0, 5000.0, np.uint16, -0.05),
):
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(K.astype(np.float32))
    odometry = cv2.Odometry(cv2.OdometryType_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
    images = [(unit * depth(centre, 9.0)).astype(kind) for centre in (np.zeros(3), -TRUE)]
    for image in images:
        image[0, 0] = unit * corner_m
    ok, T = odometry.compute(*images)
    print(f"  {name}: {ok}, translation {T[:3, 3]}")
    assert ok and abs(T[2, 3] / expected_z - 1.0) < 0.05
millimetres = cv2.rescaleDepth(np.full((2, 2), 2000, np.uint16), cv2.CV_32F)
print("  rescaleDepth of 2000:", millimetres[0, 0], "m")
assert np.allclose(millimetres, 2.0)
PYTHON
