#!/usr/bin/env bash
# pykitti 0.3.1: poses of OXTS packets (`T_w_imu`) are in metres of a sphere with the radius of the equator. In Karlsruhe (49 degrees
# north) a drive of 1000 m to the east is 998.1 m long, and one to the north 1001.1 m. So scale depends on where a street leads, by 0.3 %.
# Guessed: metres of the WGS84 ellipsoid, in which the latitudes and longitudes are, so that ground truth is right to centimetres.
# Matters here: errors of scale of 0.1 to 0.2 % against such poses (drives of KITTI raw, and whatever is made of them in this way) are
# those of the ground truth. The IMU's velocities, in the same packets, are in true metres, so that a run that uses them differs, too.
# Source: the projection is that of KITTI's own development kit, as pykitti.utils says; https://github.com/utiasSTARS/pykitti/issues/24
# asks why it is a Mercator's, and not about the radius; this run, against PROJ's geodesics.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --target "$folder/packages" pykitti==0.3.1 opencv-python-headless==4.12.0.88 numpy==2.2.6 pyproj==3.7.2
PYTHONPATH="$folder/packages" FOLDER="$folder" python3 - <<'PYTHON'
import os
from importlib.metadata import version
from pathlib import Path

import numpy as np
from pykitti.utils import load_oxts_packets_and_poses
from pyproj import Geod

START = (8.4, 49.0)  # longitude, latitude
LENGTH_M = 1000.0
REST = ["0"] * 28  # altitude, attitude, velocities, accuracies, flags
ellipsoid = Geod(ellps="WGS84")
found = {}
for name, azimuth in (("east", 90.0), ("north", 0.0)):
    end = ellipsoid.fwd(*START, azimuth, LENGTH_M)[:2]
    lines = [" ".join([repr(lat), repr(lon), *REST]) for lon, lat in (START, end)]
    file = Path(os.environ["FOLDER"], f"{name}.txt")
    file.write_text("\n".join(lines) + "\n")
    first, last = load_oxts_packets_and_poses([str(file)])
    found[name] = float(np.linalg.norm(last.T_w_imu[:3, 3] - first.T_w_imu[:3, 3]))
print("pykitti", version("pykitti"), "1000 m on the ellipsoid:", {k: round(v, 2) for k, v in found.items()})
assert abs(found["east"] - 998.09) < 0.01
assert abs(found["north"] - 1001.08) < 0.01
PYTHON
