"""Units, axes, signs and clocks of an IMU are named before a calibration is tried."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.calibration.test_camera_imu import DENSITIES, OFFSET_S, POSE_SIGMA, _record
from vio.errors import DataError
from vio.geometry.lie import FloatArray
from vio.records import ImuRecord
from vio.targets.imu_checks import _intervals, check_imu
from vio.targets.inertial import _weak, calibrate_imu

SWAPPED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1.0]])
CYCLIC = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]])


def _gyro(change: Callable[[FloatArray], FloatArray]) -> Callable[[ImuRecord], ImuRecord]:
    return lambda imu: replace(imu, gyro=change(imu.gyro))


def _accel(change: Callable[[FloatArray], FloatArray]) -> Callable[[ImuRecord], ImuRecord]:
    return lambda imu: replace(imu, accel=change(imu.accel))


def _both(change: Callable[[FloatArray], FloatArray]) -> Callable[[ImuRecord], ImuRecord]:
    return lambda imu: replace(imu, gyro=change(imu.gyro), accel=change(imu.accel))


WRONG: dict[str, tuple[Callable[[ImuRecord], ImuRecord], str]] = {
    "degrees": (_gyro(np.degrees), "the gyro is in deg/s: multiply its readings by pi/180"),
    "radians twice": (_gyro(np.radians), "converted from deg/s twice"),
    "millidegrees": (_gyro(lambda w: 1e3 * np.degrees(w)), "the gyro is in mdeg/s"),
    "g": (_accel(lambda a: a / 9.81), "the readings are in g: multiply by 9.81"),
    "milli-g": (_accel(lambda a: 1e3 * a / 9.81), r"in mg \(multiply by 0.00981\)"),
    "no gravity": (_accel(lambda a: a - a.mean(axis=0)), "gravity has been taken out"),
    "gyro's sign": (_gyro(np.negative), "or its rates have the wrong sign"),
    "left-handed": (_both(lambda x: x @ SWAPPED), "the gyro's axes are left-handed"),
    "gyro's order": (_gyro(lambda w: w @ CYCLIC), "accelerometer are not those of the gyro"),
    "accelerometer's order": (_accel(lambda a: a @ CYCLIC), r"its axes contain \[\+z \+x \+y\]"),
    "accelerometer's sign": (_accel(np.negative), "all readings have the wrong sign"),
    "accelerometer first": (
        lambda imu: replace(imu, gyro=imu.accel, accel=imu.gyro),
        "gyro and accelerometer are exchanged: the gyro's readings come first",
    ),
    "another recording": (_gyro(lambda w: 1e-3 * w[::-1]), "the gyro explains"),
    "microseconds": (
        lambda imu: replace(imu, times_ns=imu.times_ns // 1000),
        "the IMU's stamps are microseconds",
    ),
    "another epoch": (
        lambda imu: replace(imu, times_ns=imu.times_ns + 10**18),
        "the clocks may have different epochs",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_names_a_wrong_imu_in_one_line(name: str) -> None:
    change, words = WRONG[name]
    poses, imu = _record(1)
    with pytest.raises(DataError, match=words) as caught:
        calibrate_imu(poses, change(imu), DENSITIES)
    assert "\n" not in str(caught.value)
    assert "T_cam0_imu" not in str(caught.value)  # none is given


@pytest.mark.parametrize("seed", [4, 6])
def test_takes_no_chance_for_axes_or_units_where_clocks_are_too_far_apart(seed: int) -> None:
    """Some offset of hundreds explains most of a rotation, by a reflection or a factor."""
    poses, imu = _record(seed)
    late = replace(imu, times_ns=imu.times_ns + 8 * 10**9)
    with pytest.raises(DataError, match="the clocks may be further apart"):
        calibrate_imu(poses, late, DENSITIES)


@pytest.mark.parametrize("seed", range(4))
def test_says_nothing_of_a_right_imu(seed: int) -> None:
    poses, imu = _record(seed)
    sigma = float(POSE_SIGMA[3])
    assert check_imu(poses.times_ns, poses.T_cam0_board, sigma, imu) == 0.0
    turned = replace(imu, gyro=imu.gyro @ CYCLIC, accel=imu.accel @ CYCLIC)  # mounted otherwise
    assert check_imu(poses.times_ns, poses.T_cam0_board, sigma, turned) == 0.0


def test_calibrates_and_names_clocks_that_are_seconds_apart() -> None:
    poses, imu = _record(2)
    late = replace(imu, times_ns=imu.times_ns + 1_700_000_000)
    found = calibrate_imu(poses, late, DENSITIES)
    assert found.time_offset_s == pytest.approx(1.7 + OFFSET_S, abs=5e-5)
    assert any("ahead of the camera's by +1.712 s" in text for text in found.weak)


@pytest.mark.parametrize(("seconds", "count"), [(0.45, 1), (0.55, 0)])
def test_views_that_follow_late_give_no_rate(seconds: float, count: int) -> None:
    """Over half a second a hand turns to and fro."""
    times_ns = np.array([0, round(seconds * 1e9)])
    assert len(_intervals(times_ns, np.tile(np.eye(4), (2, 1, 1))).begin_ns) == count


@pytest.mark.parametrize(("below", "named"), [(True, 0), (False, 3 + 3 + 1)])
def test_weak_are_five_millimetres_a_fifth_of_a_degree_and_a_millisecond(
    below: bool, named: int
) -> None:
    sigma = np.repeat([0.005, np.radians(0.2), 0.001], [3, 3, 1])
    assert len(_weak(sigma * (0.9 if below else 1.1))) == named
