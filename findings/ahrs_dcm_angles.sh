#!/usr/bin/env bash
# ahrs 0.4.0: roll, pitch and yaw of `DCM` are not those of `Quaternion`. Of 10, 20 and 30 degrees, `DCM(rpy=...)` takes the yaw first: a rotation 33 degrees from that of `Quaternion(rpy=...)`.
# `DCM.to_rpy` and `to_angles` return the angles of the inverse rotation, (1, -22, -28), so `DCM(rpy=a).to_rpy()` is a in no order, while `Quaternion(rpy=a).to_angles()` is a.
# Matrix and quaternion of one rotation agree (`to_DCM`, `to_quaternion`): the angles alone differ.
# Guessed: one package, one meaning of "rpy"; the text of Quaternion.from_rpy says that both classes give the same quaternion of the same angles.
# Matters here: a filter's attitude as angles, to be compared with a VIO or set as the mounting of an IMU, is another rotation's. A level rig at rest shows signs and order at most; of a rig that is
# mounted with a roll of 5, a pitch of -10 and a yaw of 90 degrees, the one is 103 degrees from the other.
# Source: https://ahrs.readthedocs.io, classes DCM ("angles are given in reverse order") and Quaternion ("With both approaches the same quaternion is obtained"); this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" ahrs==0.4.0 numpy==2.4.6 scipy==1.17.1
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from ahrs import DCM, Quaternion
from scipy.spatial.transform import Rotation

print("ahrs", version("ahrs"))
apart = {}
for degrees in ((1, 2, 3), (10, 20, 30), (5, -10, 90)):
    rpy = np.radians(degrees)
    true = Rotation.from_euler("ZYX", rpy[::-1])  # yaw, then pitch, then roll, each about the turned axis
    quaternion, matrix = Quaternion(rpy=rpy), DCM(rpy=rpy)
    assert np.allclose(quaternion.to_DCM(), true.as_matrix()) and np.allclose(quaternion.to_angles(), rpy)
    assert np.allclose(DCM(quaternion.to_DCM()).to_quaternion(), quaternion)

    assert np.allclose(matrix, Rotation.from_euler("ZYX", rpy).as_matrix())
    apart[degrees] = np.degrees((Rotation.from_matrix(np.asarray(matrix)) * true.inv()).magnitude())
    back = DCM(true.as_matrix()).to_rpy()
    assert np.allclose(back, true.inv().as_euler("ZYX")[::-1]) and not np.allclose(back, rpy, atol=0.01)
    assert np.allclose(DCM(true.as_matrix()).to_angles(), back)
    print(f"rpy {degrees}: Quaternion.to_angles {np.degrees(quaternion.to_angles()).round(1)}; DCM(rpy) is {apart[degrees]:.1f} degrees from it;",
          f"to_rpy of the quaternion's matrix {np.degrees(back).round(1)}, of DCM(rpy) {np.degrees(matrix.to_rpy()).round(1)}")
assert 32 < apart[10, 20, 30] < 34 and apart[5, -10, 90] > 90
PYTHON
