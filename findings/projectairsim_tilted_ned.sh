#!/usr/bin/env bash
# projectairsim 1.1.0: `GeodeticConverter`, by which geodetic points become north, east and down for `move_to_geo_position_async`, `set_geo_pose` and its trajectories, takes the geocentric latitude of the
# home point for its down, though the points are geodetic. At 45 degrees of latitude its level is tilted by 0.19 degrees: a point 1 km to the north at the same height is 3.4 m too low, one to the south
# 3.4 m too high; to the east nothing is wrong, nor at the equator and the poles; south of the equator the signs are the other way.
# Guessed: one of the local frames of geodesy, level with the ellipsoid, as in pymap3d, pyproj and the geodesy of ROS.
# Matters here: the truth of a simulated flight over kilometres is inclined against gravity, of which IMU and horizon are: an estimate that is exact looks 0.19 degrees, or 3.4 m a kilometre, off in
# height, but only along the meridian. `vio` aligns GNSS positions in frames of pymap3d's kind.
# Source: projectairsim/geodetic_converter.py, where `phiP = atan2(z, hypot(x, y))`; this run. Its module is loaded by its path, as the client's other packages are not needed for it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --no-deps --target "$folder/packages" projectairsim==1.1.0 pymap3d==3.2.0 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
import importlib.util
from importlib.metadata import distribution, version

import numpy as np
import pymap3d

path = distribution("projectairsim").locate_file("projectairsim/geodetic_converter.py")
spec = importlib.util.spec_from_file_location("geodetic_converter", path)
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
print("projectairsim", version("projectairsim"), "pymap3d", version("pymap3d"))
for latitude in (0.0, 20.0, 45.0, 60.0, -45.0, 89.9):
    home = (latitude, 8.0, 100.0)
    converter = module.GeodeticConverter(*home)
    row = {}
    for name, ned in (("north", (1000, 0, 0)), ("south", (-1000, 0, 0)), ("east", (0, 1000, 0)), ("down", (0, 0, 100))):
        point = pymap3d.ned2geodetic(*ned, *home)
        row[name] = np.array(converter.geodetic_to_ned(point)) - ned
    tilt = np.degrees(np.arctan2(row["north"][2], 1000))
    shown = ", ".join(f"{name} {np.round(error, 2).tolist()}" for name, error in row.items())
    print(f"latitude {latitude}: errors in m (north, east, down) of points to the {shown}; tilt {tilt:.3f} degrees")
    expected = latitude - np.degrees(np.arctan((1 - 6.69437999014e-3) * np.tan(np.radians(latitude))))
    assert abs(abs(tilt) - abs(expected)) < 2e-4, (tilt, expected)
    assert np.abs(row["east"]).max() < 1e-6
    if abs(latitude) == 45.0:
        assert 3.3 < abs(row["north"][2]) < 3.4 and row["north"][2] * row["south"][2] < 0
PYTHON
