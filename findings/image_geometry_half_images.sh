#!/usr/bin/env bash
# image_geometry 1.16.2 (Debian 12, ROS 1's own Python class): of images that the driver bins 2 x 2, `StereoCameraModel` returns twice the depth. CameraInfo
# is of the whole sensor; focal lengths and principal points are divided by the binning, the baseline's entry P[0, 3] is not. And where the two principal
# points differ, `projectPixelTo3d` is not the inverse of `project3dToPixel`, as its text says: a point 8 m ahead comes back 12 m behind.
# Guessed: half the image, half of all that is in pixels; and of two principal points the difference counts, as a comment in its source has it.
# Matters here: depths by ROS's reference class, beside which a trajectory or a map in metres is checked, are wrong by the binning, without a warning. `vio`
# divides P[0, 3] too, and keeps a principal point for each camera (tests/datasets/test_rig.py: a binned part, and principal points that differ).
# Source: image_geometry/cameramodels.py, fromCameraInfo of both classes; https://docs.ros.org/en/noetic/api/sensor_msgs/html/msg/CameraInfo.html; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" opencv-python-headless==4.14.0.94
cd "$folder"
apt-get download -qq python3-image-geometry=1.16.2+ds-1 python3-sensor-msgs=1.13.1-1 python3-std-msgs=0.5.13-2 \
    python3-geometry-msgs=1.13.1-1 python3-genpy=0.6.16-2 python3-genmsg=0.6.0-1 2>/dev/null
for package in python3-*.deb; do dpkg -x "$package" debian; done
PYTHONPATH="$folder/packages:$folder/debian/usr/lib/python3/dist-packages" python3 - <<'PYTHON'
from image_geometry import StereoCameraModel
from sensor_msgs.msg import CameraInfo

FOCAL, BASELINE, POINT = 400.0, 0.12, (1.0, 0.5, 8.0)


def info(cx, tx, binning):
    """CameraInfo of a rectified camera: a 640 x 480 sensor, of which images may have half the size."""
    message = CameraInfo(height=480, width=640, distortion_model="plumb_bob", D=[0.0] * 5)
    message.K = [FOCAL, 0, cx, 0, FOCAL, 240.0, 0, 0, 1]
    message.R = [1.0, 0, 0, 0, 1, 0, 0, 0, 1]
    message.P = [FOCAL, 0, cx, tx, 0, FOCAL, 240.0, 0, 0, 0, 1, 0]
    message.binning_x = message.binning_y = binning
    return message


print("image_geometry 1.16.2")
for name, cx_right, binning, expected_z in (
    ("whole images", 320.0, 1, 8.0),
    ("images binned 2 x 2", 320.0, 2, 16.0),
    ("right principal point 10 px further right", 330.0, 1, -12.0),
):
    model = StereoCameraModel()
    model.fromCameraInfo(info(320.0, 0.0, binning), info(cx_right, -FOCAL * BASELINE, binning))
    x, y, z = POINT
    u_left = (320.0 + FOCAL * x / z) / binning  # where the images show the point
    u_right = (cx_right + FOCAL * (x - BASELINE) / z) / binning
    v = (240.0 + FOCAL * y / z) / binning
    found = model.projectPixelTo3d((u_left, v), u_left - u_right)
    projected = model.project3dToPixel(POINT)
    print(
        f"{name}: disparity {u_left - u_right:.1f} px, point {[round(float(c), 3) for c in found]}, true {POINT};",
        f"getZ {model.getZ(u_left - u_right):.2f} m, projected {u_right - projected[1][0]:.1f} px beside the right image's",
    )
    assert abs(found[2] - expected_z) < 1e-9 and abs(model.getZ(u_left - u_right) - expected_z) < 1e-9
    assert abs(projected[0][0] - u_left) < 1e-9
    assert abs(projected[1][0] - u_right) < 1e-9 or binning == 2
PYTHON
