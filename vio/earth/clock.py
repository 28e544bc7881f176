"""Whether GNSS positions fit a trajectory much better at other times: their clock is another one.

A constant error of the stamps moves positions along the path, as far as the speed is constant;
where the speed or the direction changes, it deforms the path, which no placing of it explains.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.datasets.gnss_fixes import GnssFixes
from vio.earth.alignment import Path, places_between
from vio.earth.geodesy import LocalFrame
from vio.geometry.lie import FloatArray
from vio.records import NS_PER_S

ComplexArray: TypeAlias = npt.NDArray[np.complex128]


class _ClockRules(NamedTuple):
    """When another clock is said."""

    most_s: float = 1.5  # that is looked for
    step_s: float = 0.05
    least_s: float = 0.1
    fewest: int = 20  # positions at all of these times
    better: float = 0.4  # residual at the best time, of that as stamped
    sigmas: float = 1.0  # of a position, with the timing that is usual, which residuals exceed
    timing_m: float = 0.1
    rounds: int = 5  # of the robust fit


_CLOCK = _ClockRules()


def clock_doubt(
    path: Path, fixes: GnssFixes, lever_arm_m: FloatArray, time_offset_ns: int
) -> str | None:
    """Return a note where positions fit the path at other times; None: they do not, or cannot tell.

    Args:
        path: the trajectory.
        fixes: positions of an antenna.
        lever_arm_m: (3,) the antenna in the body frame.
        time_offset_ns: added to the stamps of the positions.
    """
    count = round(_CLOCK.most_s / _CLOCK.step_s)
    shifts_s = _CLOCK.step_s * np.arange(-count, count + 1)
    times_ns = fixes.times_ns + time_offset_ns
    ends = [places_between(path, times_ns + round(s * NS_PER_S))[2] for s in shifts_s[[0, -1]]]
    common = ends[0] & ends[1]
    if int(common.sum()) < _CLOCK.fewest:
        return None
    antenna = _level(path, lever_arm_m)
    enu = LocalFrame(fixes.geodetic[int(np.argmax(common))].copy()).enu(fixes.geodetic)[common]
    measured = enu[:, 0] + 1j * enu[:, 1]
    residuals = []
    for shift_s in shifts_s:
        before, share, _ = places_between(path, times_ns[common] + round(shift_s * NS_PER_S))
        residuals.append(
            _residual((1 - share) * antenna[before] + share * antenna[before + 1], measured)
        )
    best = int(np.argmin(residuals))
    stamped = residuals[count]
    sigma = np.sqrt(np.median(np.trace(fixes.covariance[common, :2, :2], axis1=1, axis2=2)) / 2)
    least_m = _CLOCK.sigmas * float(np.hypot(sigma, _CLOCK.timing_m))
    at_end = best in (0, len(shifts_s) - 1)
    clear = residuals[best] < _CLOCK.better * stamped and stamped > least_m
    if at_end or not clear or abs(shifts_s[best]) < _CLOCK.least_s:
        return None
    offset_s = time_offset_ns / NS_PER_S + float(shifts_s[best])
    return (
        f"doubtful: the positions fit the path to {residuals[best]:.2g} m (median) with {shifts_s[best]:+.2g} s "
        f"added to their times, and to {stamped:.2g} m as they are: their clock seems to be another one; "
        f"give --time-offset={offset_s:.2f}"
    )


def _level(path: Path, lever_arm_m: FloatArray) -> ComplexArray:
    """Return the antenna (K,) at each pose, level, as complex numbers."""
    T = path.T_map_body
    p = T[:, :3, 3] + T[:, :3, :3] @ lever_arm_m
    up = path.up_map
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    side /= np.linalg.norm(side)
    level: ComplexArray = p @ side + 1j * (p @ np.cross(up, side))
    return level


def _residual(antenna: ComplexArray, measured: ComplexArray) -> float:
    """Return the median distance of positions (N,) from a path that is turned, moved and scaled to
    fit them robustly, both as complex numbers.
    """
    weight: FloatArray = np.ones(len(measured))
    for _ in range(_CLOCK.rounds):
        a = antenna - np.average(antenna, weights=weight)
        b = measured - np.average(measured, weights=weight)
        square = float(weight @ np.abs(a) ** 2)
        turn = complex(weight @ (np.conj(a) * b)) / square if square else 0.0
        apart: FloatArray = np.abs(b - turn * a)
        weight = 1 / (1 + (apart / max(float(np.median(apart)), 1e-9)) ** 2)
    return float(np.median(apart))
