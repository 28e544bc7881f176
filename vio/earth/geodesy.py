"""WGS84: degrees and ellipsoidal height, earth-centred and local Cartesian coordinates, and UTM."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Tolerance

_A = 6378137.0  # semi-major axis, m
_F = 1 / 298.257223563
_E2 = _F * (2 - _F)
_HEIGHT_STEPS: Tolerance[int] = (
    6  # of the fixed point iteration: 1e-9 m within 100 km of the surface
)
# UTM: scale on the central meridian, false easting and northing, and Krueger's series in n = f / (2
# - f).
_K0 = 0.9996
_EAST_M = 500_000.0
_NORTH_M = 10_000_000.0
_N = _F / (2 - _F)
_RADIUS = _A / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
_ALPHA = (
    _N / 2 - 2 / 3 * _N**2 + 5 / 16 * _N**3,
    13 / 48 * _N**2 - 3 / 5 * _N**3,
    61 / 240 * _N**3,
)


def ecef(geodetic: FloatArray) -> FloatArray:
    """Return earth-centred coordinates (N, 3) of latitude, longitude (degrees) and height (N,
    3).
    """
    lat = np.radians(geodetic[:, 0])
    lon = np.radians(geodetic[:, 1])
    h = geodetic[:, 2]
    across = _A / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    ring = (across + h) * np.cos(lat)
    return np.stack(
        [ring * np.cos(lon), ring * np.sin(lon), (across * (1 - _E2) + h) * np.sin(lat)], axis=1
    )


def geodetic_of(p_ecef: FloatArray) -> FloatArray:
    """Return latitude, longitude (degrees) and height (N, 3) of earth-centred coordinates (N,
    3).
    """
    x, y, z = p_ecef.T
    ring = np.hypot(x, y)
    lat = np.arctan2(z, ring * (1 - _E2))
    for _ in range(_HEIGHT_STEPS):
        across = _A / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
        lat = np.arctan2(z + _E2 * across * np.sin(lat), ring)
    across = _A / np.sqrt(1 - _E2 * np.sin(lat) ** 2)
    height = ring * np.cos(lat) + z * np.sin(lat) - _A**2 / across
    return np.stack([np.degrees(lat), np.degrees(np.arctan2(y, x)), height], axis=1)


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """East, north and up at a point."""

    origin: FloatArray  # (3,) latitude, longitude (degrees), height

    def _axes(self) -> tuple[FloatArray, FloatArray]:
        lat, lon = np.radians(self.origin[:2])
        east = [-np.sin(lon), np.cos(lon), 0.0]
        sin_lat = np.sin(lat)
        cos_lat = np.cos(lat)
        sin_lon = np.sin(lon)
        cos_lon = np.cos(lon)
        north = [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
        up = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
        return np.array([east, north, up]), ecef(self.origin[None])[0]

    def enu(self, geodetic: FloatArray) -> FloatArray:
        """Return east, north, up (N, 3) of latitude, longitude (degrees) and height (N, 3)."""
        R, centre = self._axes()
        out: FloatArray = (ecef(geodetic) - centre) @ R.T
        return out

    def geodetic(self, enu: FloatArray) -> FloatArray:
        """Return latitude, longitude (degrees) and height (N, 3) of east, north, up (N, 3)."""
        R, centre = self._axes()
        return geodetic_of(enu @ R + centre)


def utm_zone(geodetic: FloatArray) -> int:
    """Return the UTM zone (1 to 60) of a point (3,), without the exceptions of Norway and
    Svalbard.
    """
    return int((geodetic[1] + 180) // 6) % 60 + 1


def utm(geodetic: FloatArray, zone: int) -> FloatArray:
    """Return easting and northing (N, 2) of latitude and longitude (degrees) (N, 2 or more) in a
    zone.

    Northings count from the equator, in the south plus 10,000 km.
    Reference: Krueger (1912); third order in n, exact to a millimetre within the zone.
    """
    lat = np.radians(geodetic[:, 0])
    lon = np.radians(geodetic[:, 1] - (6 * zone - 183))
    e = np.sqrt(_E2)
    sin_lat = np.sin(lat)
    t = np.sinh(np.arctanh(sin_lat) - e * np.arctanh(e * sin_lat))
    xi = np.arctan2(t, np.cos(lon))
    eta = np.arctanh(np.sin(lon) / np.sqrt(1 + t**2))
    east = eta.copy()
    north = xi.copy()
    for j, alpha in enumerate(_ALPHA, 1):
        xi_j = 2 * j * xi
        eta_j = 2 * j * eta
        east += alpha * np.cos(xi_j) * np.sinh(eta_j)
        north += alpha * np.sin(xi_j) * np.cosh(eta_j)
    north = _K0 * _RADIUS * north + np.where(lat < 0, _NORTH_M, 0.0)
    return np.stack([_EAST_M + _K0 * _RADIUS * east, north], axis=1)
