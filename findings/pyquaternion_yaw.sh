#!/usr/bin/env bash
# pyquaternion 0.9.9: `yaw_pitch_roll`, "intrinsic Tait-Bryan angles following the z-y'-x'' convention", are those of the convention x-y'-z'': of a pose with
# yaw 60, pitch 20 and roll 30 degrees it returns 54.7, 35.5 and -0.5. The angles rebuild the rotation only as R_x(roll) R_y(pitch) R_z(yaw).
# Angles about one axis alone come back as they are, so a test with one axis passes.
# Guessed: the heading of the pose, as yaw is in ROS, in MAVLink and in the text's own first line.
# Matters here: heading, roll and pitch of an estimate that is compared, plotted or levelled by them are wrong as soon as the rig leans.
# `vio` does not use the package; SciPy's "ZYX" returns 60, 20 and 30.
# Source: pyquaternion/quaternion.py, whose text names both conventions; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pyquaternion==0.9.9 scipy==1.17.1 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from pyquaternion import Quaternion
from scipy.spatial.transform import Rotation

print("pyquaternion", version("pyquaternion"), "| yaw, pitch, roll in degrees")
print("  ", Quaternion.yaw_pitch_roll.__doc__.strip().splitlines()[0])
for angles in ((60.0, 0.0, 0.0), (0.0, 20.0, 0.0), (0.0, 0.0, 30.0), (60.0, 20.0, 30.0)):
    turned = Rotation.from_euler("ZYX", angles, degrees=True)
    x, y, z, w = turned.as_quat()
    found = np.degrees(Quaternion(w, x, y, z).yaw_pitch_roll)
    other = turned.as_euler("XYZ", degrees=True)[::-1]
    print("   given", angles, "found", found.round(1).tolist(), "of x-y'-z''", other.round(1).tolist())
    assert np.allclose(Quaternion(w, x, y, z).rotation_matrix, turned.as_matrix())
    assert np.allclose(found, other, atol=1e-6)
    assert np.allclose(found, angles, atol=1e-6) == (np.count_nonzero(angles) == 1)
PYTHON
