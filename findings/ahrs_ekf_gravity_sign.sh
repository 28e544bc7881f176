#!/usr/bin/env bash
# ahrs 0.4.0: an EKF in the frame NED (z down) takes the accelerometer for the direction of gravity. An accelerometer
# at rest measures the opposite, so that a level sensor with z down comes out upside down.
# Guessed: specific force in either frame, as in ENU, where the same class is right.
# Matters here: ours are specific forces (9.81 up at rest); they need the sign changed for this frame only.
# Source: ahrs.filters.EKF; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" ahrs==0.4.0 scipy==1.17.1
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from ahrs.filters import EKF
from scipy.spatial.transform import Rotation

print("ahrs", version("ahrs"))
count = 3000
for frame, down in (("ENU", -1.0), ("NED", 1.0)):
    at_rest = np.tile([0.3, 0.0, -down * 9.8], (count, 1))  # specific force, nearly level
    filtered = EKF(gyr=np.zeros((count, 3)), acc=at_rest, frequency=100.0, frame=frame)
    turn = np.degrees(Rotation.from_quat(filtered.Q[-1], scalar_first=True).magnitude())
    print(f"{frame}: a level sensor is turned by {turn:.0f} deg")
    assert (turn > 170.0) if frame == "NED" else (turn < 10.0)
PYTHON
