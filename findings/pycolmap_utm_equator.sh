#!/usr/bin/env bash
# pycolmap 4.2.1: `GPSTransform.ellipsoid_to_utm` puts all positions into one zone, which it returns, so that a trajectory across a meridian of zones stays whole; across the equator it does not: northings
# of each point are those of its own hemisphere, and two points 221 m apart are 9 999 779 m apart. No hemisphere is returned, and `utm_to_ellipsoid` takes one for all: a point 111 m to the south comes back
# at 89.5 degrees of latitude. In Bergen the zone is 31, where maps, and the package utm, have 32 V: eastings differ by 331 km.
# Guessed: positions that become one array with one zone are in one frame: that is what the array is for.
# Matters here: reconstructions and trajectories are aligned to such positions. In Quito, Kampala or Pontianak, where roads cross the equator, no alignment fits, or RANSAC keeps one side of it. `vio` aligns in a local
# east, north, up frame, which COLMAP's `ellipsoid_to_enu` is too.
# Source: COLMAP's src/colmap/geometry/gps.cc; for the exception of zone 32 V, NGA.SIG.0012, 7-4; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/packages" pycolmap==4.2.1 utm==0.9.0 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import numpy as np
import pycolmap
import utm

print("pycolmap", version("pycolmap"), "utm", version("utm"))
gps = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)


def length(points):
    return float(np.linalg.norm(points[1] - points[0]))


for name, pair in (("across 12 degrees east", [[48.0, 11.999, 0.0], [48.0, 12.001, 0.0]]), ("across the equator", [[0.001, 32.5, 0.0], [-0.001, 32.5, 0.0]])):
    pair = np.array(pair)
    projected, zone = gps.ellipsoid_to_utm(pair)
    local = gps.ellipsoid_to_enu(pair, *pair[0])
    back = gps.utm_to_ellipsoid(projected, zone, True)
    print(f"{name}: {length(local):.1f} m apart in east, north, up, {length(projected):.1f} m in zone {zone}; back: latitudes {np.round(back[:, 0], 4).tolist()}")
    if pair[1, 0] > 0:
        assert abs(length(projected) / length(local) - 1) < 2e-3 and np.allclose(back, pair, atol=1e-6)
    else:
        assert length(local) < 222 and abs(length(projected) - (1e7 - 221)) < 1 and back[1, 0] > 89

bergen = (60.39, 5.32)
projected, zone = gps.ellipsoid_to_utm(np.array([[*bergen, 0.0]]))
easting, northing, number, letter = utm.from_latlon(*bergen)
print(f"Bergen: zone {zone}, {projected[0, 0]:.0f} m east; by utm {number} {letter}, {easting:.0f} m east")
assert zone == 31 and (number, letter) == (32, "V") and abs(projected[0, 0] - easting) > 3e5
PYTHON
