#!/usr/bin/env bash
# av2 0.3.6 (Argoverse 2): `PinholeCamera.compute_pixel_ray_directions` takes the middle of the image for the principal point, and leaves the calibration's cx and cy out; so do
# `frustum_planes`. `project_cam_to_img` of the same camera uses them: a point, projected and turned back into a ray, is beside itself by the principal point's offset.
# Guessed: "given (u,v) coordinates and intrinsics, generate pixel rays" uses the intrinsics, which the camera has; the two functions are inverse to one another.
# Matters here: rays of a stereo pair whose cameras differ in cx have that difference as disparity: with 5 px between the two, as may be, points at 40 m come out at 34. Rows shift as
# well, so headings and gravity of a camera pose from such rays are off by 0.3 degrees. Cameras with a centred principal point show nothing.
# Source: https://github.com/argoverse/av2-api, tests/unit/geometry/camera/test_pinhole_camera.py (cx 1235.0, cy 1008.5 of `stereo_front_left`); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" --no-deps av2==0.3.6 numpy==2.4.6 scipy==1.17.1 pandas==3.1.1 pyarrow==26.0.1 \
    opencv-python-headless==4.14.0.94 universal-pathlib==0.3.10 pathlib-abc==0.5.2 fsspec==2026.9.0 python-dateutil==4.0.0 six==1.17.0
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from av2.geometry.camera.pinhole_camera import Intrinsics, PinholeCamera
from av2.geometry.se3 import SE3

W, H, F, BASELINE = 2464, 2056, 3670.0, 0.3
POINTS = np.array([[2.0, -1.0, 40.0], [-3.0, 1.0, 20.0], [0.5, 0.2, 8.0]])  # in the left camera, m


def camera(cx, cy):
    return PinholeCamera(SE3(np.eye(3), np.zeros(3)), Intrinsics(F, F, cx, cy, W, H), "stereo_front_left")


def there_and_back(cx, cy, points):
    """Return the rays (N, 3), scaled to z = 1, of where the points are seen."""
    view = camera(cx, cy)
    rays = view.compute_pixel_ray_directions(view.project_cam_to_img(points)[0])
    return rays / rays[:, 2:]


print("av2", version("av2"))
for name, (left, right) in {"centred": ((W / 2, H / 2),) * 2, "calibrated": ((1235.0, 1008.5), (1230.0, 1012.0))}.items():
    rays = there_and_back(*left, POINTS)
    other = there_and_back(*right, POINTS - (BASELINE, 0, 0))
    off = np.degrees(np.arctan(rays[:, :2]) - np.arctan(POINTS[:, :2] / POINTS[:, 2:]))
    depths = BASELINE / (rays[:, 0] - other[:, 0])
    print(f"{name}: rays are off by {off[0].round(3)} degrees; depths {depths.round(2)} for {POINTS[:, 2]} m")
    assert np.allclose(rays[:, :2] - POINTS[:, :2] / POINTS[:, 2:], (np.array(left) - (W / 2, H / 2)) / F)
    assert np.allclose(depths, BASELINE / (BASELINE / POINTS[:, 2] + (left[0] - right[0]) / F))
assert np.array_equal(camera(1235.0, 1008.5).frustum_planes(), camera(0.0, 0.0).frustum_planes())
PYTHON
