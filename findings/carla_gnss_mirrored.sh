#!/usr/bin/env bash
# CARLA 0.9.16: latitudes are mirrored: a road that its map has 1000 m to the north of the origin is 1000 m to the south, by `transform_to_geolocation` (by the GNSS sensor, too, as the issue says).
# Lengths are those of a sphere of 0.9996 equatorial radii, whatever projection, scale and ellipsoid the map names: at 49 degrees 1000 m to the east are 1002.3 m on WGS84, to the north 999.4 m.
# Guessed: CARLA's y points to the south, as waypoints of the road show, so latitude falls with y, as it did up to 0.9.15; and `geoReference` of OpenDRIVE is the projection of the map.
# Matters here: a path from a simulated receiver is the mirror image of the camera's path. No rotation aligns them: of two crossing streets of 1 km one is 2 km off. With the sign put right, the scale
# to the east is 0.3 % above that to the north, more than the drift of a good VIO. `geolocation_to_transform` inverts both.
# Source: https://github.com/carla-simulator/carla/issues/9389 (signs of 0.9.15 and 0.9.16), .../issues/3659 (no ellipsoid), .../pull/9552 (not merged); this run, without a server.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m pip --quiet --disable-pip-version-check install --no-compile --target "$folder/packages" carla==0.9.16 pyproj==3.7.2 numpy==2.4.6
PYTHONPATH="$folder/packages" python3 - <<'PYTHON'
from importlib.metadata import version

import carla
import numpy as np
import pyproj

ROAD = """<?xml version="1.0" standalone="yes"?>
<OpenDRIVE><header revMajor="1" revMinor="4" name="" version="1" date="2026-01-01" north="0" south="0" east="0" west="0"><geoReference><![CDATA[{projection}]]></geoReference></header>
<road name="road" length="100" id="0" junction="-1"><link/><planView><geometry s="0" x="{x}" y="{y}" hdg="0" length="100"><line/></geometry></planView><elevationProfile/><lateralProfile/>
<lanes><laneSection s="0"><center><lane id="0" type="none" level="false"/></center>
<right><lane id="-1" type="driving" level="false"><width sOffset="0" a="0.01" b="0" c="0" d="0"/></lane></right></laneSection></lanes></road></OpenDRIVE>"""
ORIGIN = 49.0, 8.0
NAMES = (
    "+proj=tmerc +lat_0=49 +lon_0=8 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs",
    "+proj=tmerc +lat_0=49 +lon_0=8 +k=0.9 +x_0=0 +y_0=0 +R=6371000 +units=m +no_defs",
)


def east_north(latitude, longitude):
    """Return metres of WGS84 to the east and to the north of the origin."""
    azimuth, _, distance = pyproj.Geod(ellps="WGS84").inv(*ORIGIN[::-1], longitude, latitude)
    return distance * np.array((np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))))


print("carla", version("carla"))
found = {}
for name in NAMES:
    for place in ((1000.0, 0.0), (0.0, 1000.0)):  # to the east and to the north in the map
        road = carla.Map("road", ROAD.format(projection=name, x=place[0], y=place[1]))
        start = min(road.generate_waypoints(1.0), key=lambda point: point.s).transform.location
        assert abs(start.x - place[0]) < 0.1 and abs(start.y + place[1]) < 0.1  # CARLA's y is to the south
        fix = road.transform_to_geolocation(start)
        longitude, latitude = pyproj.Proj(name)(*place, inverse=True)
        found[name, place] = east_north(fix.latitude, fix.longitude)
        print(f"{name[:36]} {name[36:60]}: {place} m are ({latitude:.5f}, {longitude:.5f}) degrees by PROJ,",
              f"({fix.latitude:.5f}, {fix.longitude:.5f}) by CARLA: {found[name, place].round(1) + 0.0} m to the east and north")
        back = road.geolocation_to_transform(fix)
        assert np.hypot(back.x - start.x, back.y - start.y) < 0.01
east, north = (found[NAMES[0], place] for place in ((1000.0, 0.0), (0.0, 1000.0)))
assert abs(north[1] + 999.4) < 0.2  # to the south
assert abs(east[0] - 1002.3) < 0.2
assert all(np.allclose(found[NAMES[0], place], found[NAMES[1], place], atol=0.01) for place in ((1000.0, 0.0), (0.0, 1000.0)))
PYTHON
