"""Positions by GNSS, as the readers of `gnss` give them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Tolerance
from vio.records import BoolArray, IntArray

SIGMA_M = 3.0  # horizontal, where nothing states it: a receiver without corrections under open sky
UP_SHARE = 2.0  # of a vertical standard deviation to a horizontal one, likewise
_MIN_SIGMA_M = 0.01
_NO_DEGREES: Tolerance[float] = 1e-9
_HEIGHTS_M = (-1000.0, 50_000.0)


@dataclass(frozen=True, slots=True)
class GnssFixes:
    """WGS84 positions of an antenna."""

    times_ns: IntArray  # (N,) increasing
    geodetic: FloatArray  # (N, 3) latitude, longitude (degrees), ellipsoidal height (m)
    covariance: FloatArray  # (N, 3, 3) east, north, up, m^2
    has_height: BoolArray  # (N,)
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.times_ns)


def checked_fixes(
    times_ns: IntArray,
    geodetic: FloatArray,
    covariance: FloatArray | None,
    where: str,
    notes: tuple[str, ...] = (),
) -> GnssFixes:
    """Return positions in the order of time, without those that are not finite or repeat a stamp.

    Args:
        times_ns: (N,) stamps.
        geodetic: (N, 3) latitude, longitude, height; NaN: not known.
        covariance: (N, 3, 3); NaN or zero: not known; None: of none.
        where: for messages.
        notes: about what was read.

    Raises:
        DataError: there is no position, or one is none of WGS84.
    """
    order = np.argsort(times_ns, kind="stable")
    times_ns = times_ns[order]
    geodetic = geodetic[order]
    if covariance is None:
        C = np.full((len(order), 3, 3), np.nan)
    else:
        C = covariance[order]
    # receivers write 0, 0 while they have no fix
    nowhere = (np.abs(geodetic[:, :2]) < _NO_DEGREES).all(axis=1)
    stated = np.isfinite(geodetic[:, :2]).all(axis=1) & ~nowhere
    rows = np.flatnonzero(stated)
    keep = rows[np.unique(times_ns[rows], return_index=True)[1]]
    if not len(keep):
        raise DataError(f"{where}: holds no position; give a record with a fix")
    notes += (
        f"{len(order) - len(keep)} of {len(order)} rows without a position or of a repeated time "
        "are skipped",
    ) * (len(keep) < len(order))
    times_ns = times_ns[keep]
    geodetic = geodetic[keep].copy()
    C = C[keep].copy()
    outside = (np.abs(geodetic[:, 0]) > 90) | (np.abs(geodetic[:, 1]) > 360)
    if outside.any():
        lat, lon = geodetic[int(np.argmax(outside)), :2]
        raise DataError(
            f"{where}: {lat:g}, {lon:g} is no latitude and longitude in degrees; give positions in "
            "WGS84 (divide receivers' 1e-7 degrees by 1e7, convert NMEA's ddmm.mmmm, and those of "
            "another datum or projection, first)"
        )
    has_height = (
        np.isfinite(geodetic[:, 2])
        & (geodetic[:, 2] > _HEIGHTS_M[0])
        & (geodetic[:, 2] < _HEIGHTS_M[1])
    )
    geodetic[~has_height, 2] = 0.0
    if not has_height.all():
        notes += (f"{int((~has_height).sum())} positions have no height",)
    variances = np.diagonal(C, axis1=1, axis2=2)
    stated = np.isfinite(C).all(axis=(1, 2)) & (variances > 0).all(axis=1)
    C[~stated] = SIGMA_M**2 * np.diag([1.0, 1.0, UP_SHARE**2])
    if not stated.all():
        taken = f"{SIGMA_M:g} m is taken, {UP_SHARE * SIGMA_M:g} m in height"
        notes += (f"{int((~stated).sum())} positions state no covariance; {taken}",)
    C = (C + np.swapaxes(C, 1, 2)) / 2 + _MIN_SIGMA_M**2 * np.eye(3)
    C[np.linalg.eigvalsh(C)[:, 0] <= 0] = SIGMA_M**2 * np.diag([1.0, 1.0, UP_SHARE**2])
    return GnssFixes(times_ns, geodetic, C, has_height, notes)
