"""An IMU that is turned against its calibration: what the rates show of it, and when."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vio.geometry.lie import FloatArray, so3_exp
from vio.monitor.gyro import turned_finding
from vio.monitor.gyro_fit import GyroFit
from vio.monitor.turned_imu import Turn, judge_turn, turn_of_gyro

R_GIVEN = so3_exp([0.4, -1.1, 0.7])
AXIS = np.array([0.36, 0.48, 0.8])


def _fit(
    turn_rad: FloatArray, *, scale: float = 1.0, noise: float = 0.0, count: int = 200
) -> GyroFit:
    """Rates of a gyro that is turned beyond the given rotation, and a camera's with noise."""
    rng = np.random.default_rng(0)
    camera = rng.normal(0.0, 0.3, (count, 3))
    gyro = camera @ so3_exp(turn_rad) @ R_GIVEN / scale  # true = exp(turn) given
    camera = camera + noise * rng.normal(size=(count, 3)) + [0.01, -0.02, 0.0]
    S = camera.T @ camera / count
    return GyroFit(
        0.0, S, S, S, np.eye(3), np.zeros(3), 0.01, 1e-6, count, camera, gyro, np.zeros((count, 3)),
        np.ones(count, np.bool_), np.ones(count),
    )  # fmt: skip


def _judged(fit: GyroFit, *, clipped: bool = False) -> Turn | None:
    return judge_turn(fit, R_GIVEN, clipped=clipped)


def _found(deg: float, *, noise: float = 0.0, count: int = 200, clipped: bool = False) -> bool:
    fit = _fit(np.radians(deg) * AXIS, noise=noise, count=count)
    return _judged(fit, clipped=clipped) is not None


@pytest.mark.parametrize("deg", [0.0, 2.0, 12.0, 35.0])
@pytest.mark.parametrize("scale", [1.0, 1.07])
def test_the_turn_and_the_scale_of_a_gyro_are_fitted_together(deg: float, scale: float) -> None:
    """Whatever its bias."""
    turn = np.radians(deg) * AXIS
    found = turn_of_gyro(_fit(turn, scale=scale), R_GIVEN)
    np.testing.assert_allclose(found.rotation, turn, atol=1e-5)
    assert found.scale == pytest.approx(scale)
    assert found.sigma < 1e-5


def test_the_standard_deviation_is_that_of_repeated_fits() -> None:
    """By a jackknife, of the most uncertain component."""
    errors, sigmas = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        fit = _fit(np.zeros(3))
        noisy = replace(fit, camera=fit.camera + 0.05 * rng.normal(size=fit.camera.shape))
        found = turn_of_gyro(noisy, R_GIVEN)
        errors.append(found.rotation)
        sigmas.append(found.sigma)
    spread = float(np.std(errors, axis=0).max())
    assert 0.8 < np.median(sigmas) / spread < 1.6


@pytest.mark.parametrize(("deg", "found"), [(3.3, False), (3.7, True), (39.0, True), (41.0, False)])
def test_a_turn_is_more_than_a_calibration_by_hand_and_less_than_other_axes(
    deg: float, found: bool
) -> None:
    assert _found(deg) == found


def test_a_turn_must_be_clear_of_its_uncertainty() -> None:
    """It is fitted as 6.0 and 5.7 degrees, with standard deviations of 1.1 and 0.87."""
    assert not _found(5.0, noise=0.13)
    assert _found(5.0, noise=0.1)


def test_a_turn_needs_intervals_rotation_about_two_axes_and_readings_in_range() -> None:
    assert not _found(8.0, count=59)
    assert _found(8.0, count=60)
    assert not _found(8.0, clipped=True)
    fit = _fit(np.radians(8.0) * AXIS)
    flat = fit.S_cc * np.outer([1.0, 1e-4, 1e-4], [1.0, 1e-4, 1e-4])
    assert _judged(replace(fit, S_cc=flat)) is None
    flat = fit.S_cc * np.outer([1.0, 1.0, 1e-4], [1.0, 1.0, 1e-4])
    assert _judged(replace(fit, S_cc=flat)) is not None
    assert _judged(replace(fit, unexplained=0.3)) is None


def test_the_finding_states_the_rotation_and_turns_the_readings() -> None:
    turn = np.radians(8.0) * AXIS
    found = turned_finding(turn_of_gyro(_fit(turn), R_GIVEN), R_GIVEN)
    assert (found.fault, found.is_disabling) == ("extrinsics rotation", True)
    assert "turned by 8.0 deg" in found.seen
    assert f"[[{(so3_exp(turn) @ R_GIVEN)[0, 0]:.4f}, " in found.explanation
    assert found.turn_rad is not None
    # a reading that is turned, mapped as given, is the reading mapped as it is
    np.testing.assert_allclose(
        R_GIVEN @ so3_exp(np.array(found.turn_rad)), so3_exp(turn) @ R_GIVEN, atol=1e-5
    )
