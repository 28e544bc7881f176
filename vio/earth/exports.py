"""Paths and points on the earth as GeoJSON, KML and a table in UTM."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from vio.earth.geodesy import utm, utm_zone
from vio.files.printable import printable
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, IntArray


def _positions(geodetic: FloatArray) -> list[list[float]]:
    """Return longitude, latitude, height, as both formats order them; 1e-9 degrees are 0.1 mm."""
    return [[round(lon, 9), round(lat, 9), round(h, 4)] for lat, lon, h in geodetic.tolist()]


def _feature(kind: str, geodetic: FloatArray, **properties: str) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": _positions(geodetic)}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def write_geojson(
    path: Path, name: str, track: FloatArray, fixes: FloatArray, used: BoolArray
) -> None:
    """Write a track (K, 3), and the GNSS positions (N, 3) with whether they were used (N,), as
    GeoJSON (RFC 7946).
    """

    features = [_feature("LineString", track, name=name, what="trajectory")]
    for what, rows in (("GNSS positions used", used), ("GNSS positions refused", ~used)):
        if rows.any():
            features.append(_feature("MultiPoint", fixes[rows], name=name, what=what))
    path.write_text(
        json.dumps({"type": "FeatureCollection", "features": features}) + "\n", encoding="utf-8"
    )


def write_points_geojson(path: Path, name: str, points: FloatArray) -> None:
    """Write points (M, 3) as one feature."""
    path.write_text(json.dumps(_feature("MultiPoint", points, name=name)) + "\n", encoding="utf-8")


def write_kml(path: Path, name: str, track: FloatArray) -> None:
    """Write a track (K, 3) as KML 2.2; drawn on the ground, as heights are above the ellipsoid."""
    line = " ".join(",".join(map(str, row)) for row in _positions(track))
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml '
        'xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark>'
        f"<name>{escape(printable(name))}</name><LineString><altitudeMode>clampToGround</altitudeMode>"
        f"<coordinates>{line}</coordinates></LineString></Placemark></Document></kml>\n",
        encoding="utf-8",
    )


def write_utm(path: Path, geodetic: FloatArray, times_ns: IntArray | None = None) -> str:
    """Write points (K, 3) in the UTM zone of the first, with times (K,) where given; return its
    EPSG code.
    """
    zone = utm_zone(geodetic[0])
    south = bool(geodetic[0, 0] < 0)
    epsg = f"EPSG:{(32700 if south else 32600) + zone}"
    xy = utm(geodetic, zone)
    xy[:, 1] += 1e7 * (float(south) - (geodetic[:, 0] < 0))  # all in the hemisphere of the first
    rows = [
        f"{e:.4f},{n:.4f},{h:.4f}" for (e, n), h in zip(xy.tolist(), geodetic[:, 2], strict=True)
    ]
    if times_ns is not None:
        rows = [f"{t},{row}" for t, row in zip(times_ns.tolist(), rows, strict=True)]
    head = f"# {epsg}, UTM zone {zone}{'S' if south else 'N'}, WGS84, height above the ellipsoid\n"
    head += ("" if times_ns is None else "time_ns,") + "easting_m,northing_m,height_m\n"
    path.write_text(head + "\n".join(rows) + "\n", encoding="utf-8")
    return epsg
