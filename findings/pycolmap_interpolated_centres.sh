#!/usr/bin/env bash
# pycolmap 4.2.1: `interpolate_camera_poses` interpolates the translations of `cam_from_world`, not the positions of the cameras. Half-way of a turn on the spot by 20 degrees, a
# camera 100 m from the origin is 1.5 m away from that spot, one at UTM coordinates (5 million metres) 76 km. A camera that drives straight without a turn, or turns about the
# origin, is where it belongs.
# Guessed: between two poses at one place lies that place, as with SciPy's slerp and linear positions, gtsam's `Pose3.slerp`, or tf2; "linearly interpolate camera pose" says no
# more.
# Matters here: poses of frames between keyframes, of a rolling shutter's rows or of another sensor's times. The error grows with the distance to the origin and the square of the
# turn, is 0 at both ends, and is not seen in tests about the origin. Interpolate the `inverse()` of both instead.
# Source: colmap/geometry/pose.cc, InterpolateCameraPoses; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pycolmap==4.2.1 numpy==2.4.6 scipy==1.17.1
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation


def cam_from_world(centre, degrees):
    """Pose of a camera at `centre`, turned about the vertical."""
    rotation = Rotation.from_euler("z", degrees, degrees=True).inv()
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation.as_quat()), -rotation.apply(centre))


def half_way(first, last):
    """Where the camera is half-way, by both poses and by their inverses."""
    return (
        pycolmap.interpolate_camera_poses(first, last, 0.5).inverse().translation,
        pycolmap.interpolate_camera_poses(first.inverse(), last.inverse(), 0.5).translation,
    )


print("pycolmap", pycolmap.__version__)
STEP = np.array([2.0, 0.0, 0.0])
for start, step, degrees, expected in (
    ([0.0, 0, 0], 0 * STEP, 20, 0.0),
    ([100.0, 0, 0], 0 * STEP, 20, 1.519),
    ([100.0, 0, 0], 0 * STEP, 2, 0.0152),
    ([100.0, 0, 0], STEP, 0, 0.0),
    ([500e3, 5e6, 0], 0 * STEP, 20, 76339.0),
):
    start = np.array(start)
    first, last = cam_from_world(start, 0), cam_from_world(start + step, degrees)
    for t, centre in ((0, start), (1, start + step)):
        end = pycolmap.interpolate_camera_poses(first, last, t).inverse().translation
        assert np.allclose(end, centre, atol=1e-6)  # right at both ends
    given, inverses = half_way(first, last)
    off, right = (np.linalg.norm(x - start - step / 2) for x in (given, inverses))
    print(f"from {start.tolist()} by {step[0]:g} m and {degrees} degrees: half-way {off:.4g} m off, by the inverses {right:.1e} m")
    assert abs(off - expected) < 0.01 * expected + 1e-6 and right < 1e-6
PYTHON
