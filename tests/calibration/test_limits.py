"""Each limit of the verdicts on a calibration, from both sides."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from vio.calibration.inertial import ImuAlignment
from vio.calibration.lever_arm import LeverArm
from vio.calibration.severity import StereoError, length_grade, rows_grade
from vio.calibration.stereo import RayMatches, StereoEstimate, too_few
from vio.calibration.verdicts import judge_exchange, judge_imu, judge_stereo
from vio.geometry.lie import FloatArray, so3_exp

Says = Callable[[float], bool]
AHEAD = np.array([1.0, 0.0, 0.0])


def _turned(axis: int, deg: float) -> FloatArray:
    phi = np.zeros(3)
    phi[axis] = np.radians(deg)
    return so3_exp(phi)


def _pose(R: FloatArray, t: FloatArray) -> FloatArray:
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def _matches(noise_deg: float = 0.0, count: int = 300, pairs: int = 6) -> RayMatches:
    """Matches of an exact rig whose rays leave their epipolar planes by a median angle."""
    rng = np.random.default_rng(0)
    p = rng.uniform([-4.0, -3.0, 4.0], [4.0, 3.0, 12.0], (count, 3))
    rays = []
    for q in (p, p - 0.2 * AHEAD):
        rays.append(q / np.linalg.norm(q, axis=1)[:, None])
    normal = np.cross(AHEAD, rays[0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    off = np.radians(noise_deg) * np.where(np.arange(count) % 2, 1.0, -1.0)
    ray1 = rays[1] + off[:, None] * normal
    ray1 /= np.linalg.norm(ray1, axis=1)[:, None]
    return RayMatches(np.arange(count) % pairs, rays[0], ray1)


def _stereo(
    R: FloatArray,
    t: FloatArray = AHEAD,
    *,
    segments: int | None = None,
    sigma_deg: float = 1e-4,
    noise_deg: float = 0.0,
) -> list[str]:
    """What is found of a given rotation and direction, where the true ones are none and x."""
    estimate = StereoEstimate(np.eye(3), AHEAD, sigma_deg, sigma_deg, 300, 6, 0.01, segments)
    found = judge_stereo(estimate, _pose(R.T, t), _matches(noise_deg))
    return [finding.fault for finding in found]


def _exchanged(as_given_deg: float, other_deg: float) -> bool:
    T = _pose(np.eye(3), AHEAD)
    return bool(judge_exchange(_matches(as_given_deg), _matches(other_deg), T))


def _imu(
    R: FloatArray | None = None,
    t: FloatArray | None = None,
    offset_s: float = 0.0,
    sigma_s: float = 1e-5,
    sigma_deg: float = 1e-3,
    sigma_m: float = 1e-4,
    given: FloatArray | None = None,
) -> list[str]:
    """What is found where rotation, place and clock of the IMU are measured."""
    measured = ImuAlignment(
        np.eye(3) if R is None else R,
        np.full(3, sigma_deg),
        offset_s,
        sigma_s,
        np.zeros(3),
        0.01,
        200,
        None,
    )
    place = np.array([0.3, 0.2, 0.1])
    arm = LeverArm(place if t is None else place + t, np.full(3, sigma_m), 20)
    T = _pose(np.eye(3) if given is None else given, place)
    return [finding.fault for finding in judge_imu(measured, arm, T)]


ROTATION = "left-right rotation wrong"
DIRECTION = "baseline direction wrong"
VERDICTS: dict[str, tuple[Says, float, float]] = {
    "rotation": (lambda x: ROTATION in _stereo(_turned(2, x)), 0.27, 0.33),
    "rotation in motion": (lambda x: ROTATION in _stereo(_turned(2, x), segments=9), 0.045, 0.055),
    "rotation: sigmas": (
        lambda x: ROTATION in _stereo(_turned(2, x), segments=9, sigma_deg=0.02),
        0.09,
        0.11,
    ),
    "rotation: clearly worse": (
        lambda x: ROTATION in _stereo(_turned(2, x), noise_deg=0.5),
        4.2,
        5.1,
    ),
    "direction": (
        lambda x: DIRECTION in _stereo(np.eye(3), _turned(1, x) @ AHEAD, segments=9),
        0.9,
        1.1,
    ),
    "direction: inverted": (
        lambda x: DIRECTION in _stereo(np.eye(3), -_turned(1, x) @ AHEAD, segments=9),
        18.0,
        22.0,
    ),
    "exchanged: fits": (lambda x: not _exchanged(3.0, x), 0.17, 0.23),
    "exchanged: better": (lambda x: _exchanged(x, 0.1), 0.18, 0.22),
    "matches": (lambda n: too_few(_matches(count=int(n))) is None, 149, 150),
    "pairs": (lambda n: too_few(_matches(pairs=int(n))) is None, 2, 3),
    "IMU: rotation": (lambda x: _imu(_turned(0, x)) != [], 0.45, 0.55),
    "IMU: rotation, sigmas": (lambda x: _imu(_turned(0, x), sigma_deg=0.2) != [], 0.9, 1.1),
    "IMU: inverse": (
        lambda x: _imu(_turned(0, x - 40.0), given=_turned(0, 40.0))[0].endswith("wrong"),
        4.5,
        5.5,
    ),
    "IMU: place": (lambda x: _imu(t=np.array([x, 0.0, 0.0])) != [], 0.027, 0.033),
    "IMU: clock": (lambda x: _imu(offset_s=x) != [], 0.0018, 0.0022),
    "IMU: clock is known": (lambda x: _imu(offset_s=0.1, sigma_s=x) == [], 0.0045, 0.0055),
    "rows: negligible": (lambda x: rows_grade(x) != "negligible", 0.13, 0.17),
    "rows: unusable": (lambda x: rows_grade(x) == "unusable", 1.8, 2.2),
    "lengths: negligible": (lambda x: length_grade(x) != "negligible", 0.18, 0.22),
    "lengths: unusable": (lambda x: length_grade(x) == "unusable", 9.0, 11.0),
    "lengths: beyond doubt": (
        lambda x: StereoError(0.05, 20.0, x, 0.5).grade != "negligible",
        1.4,
        1.7,
    ),
}


@pytest.mark.parametrize(("says", "below", "above"), VERDICTS.values(), ids=VERDICTS)
def test_limits_of_verdicts(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
