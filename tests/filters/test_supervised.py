"""One world throughout: images alone until an IMU begins, and a filter that is begun anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from tests.filters.test_msckf import CAMERA, EXACT_RIG, STEP_NS, T_CAM0_IMU, Flight
from vio.errors import DivergedError
from vio.evaluation.consistency import nees, nees_bounds
from vio.filters.supervised import SupervisedMsckf
from vio.geometry.lie import (
    FloatArray,
    se3_from_parts,
    se3_inverse,
    se3_log,
    so3_exp,
    transform_points,
)
from vio.geometry.upright import nearest_yaw
from vio.records import Estimate, ImuSample


def test_images_carry_the_frames_before_an_imu_that_begins_late() -> None:
    """The world stays that of the first frame: no jump at the handover, and gravity is known in
    that world.
    """
    flight, settings, rng = Flight(64), EXACT_RIG, np.random.default_rng(3)
    filt = SupervisedMsckf(CAMERA, T_CAM0_IMU, settings)
    samples = [x for x in flight.imu(rng, np.zeros(6)) if x.time_ns > 1_480_000_000]
    errors, covariances = [], []
    for k in range(flight.frames):
        while samples and samples[0].time_ns <= k * STEP_NS:
            filt.propagate(samples.pop(0))
        assert filt.update(flight.observe(k, 0.2, rng, 40)).used > 20 or k == 0
        estimate = filt.estimate()
        T_true = se3_inverse(flight.T_world_imu(0)) @ flight.T_world_imu(k)
        errors.append(se3_log(se3_inverse(T_true) @ estimate.T_world_imu))
        covariances.append(estimate.covariance)
    e = np.array(errors)
    assert np.linalg.norm(e[:, :3], axis=1).max() < 0.05
    assert np.linalg.norm(np.diff(e[:, :3], axis=0), axis=1).max() < 0.02
    assert nees(e, np.array(covariances))[1:].mean() < nees_bounds(6, 1)[1]
    gravity = flight.T_world_imu(0)[:3, :3].T @ [0, 0, -9.81]
    assert np.linalg.norm(estimate.gravity_world - gravity) < 9.81 * np.radians(1.5)
    v = flight.T_world_imu(0)[:3, :3].T @ flight.state((flight.frames - 1) * 0.05)[2]
    assert np.linalg.norm(estimate.velocity_world - v) < 0.05
    p_first = transform_points(se3_inverse(flight.T_world_imu(0)), flight.points)
    found = filt.landmarks()
    assert np.median(np.linalg.norm(found.p_world - p_first[found.ids], axis=1)) < 0.1


_SPLICE = 50  # frame at which the record goes on from another place
_SKIPPED = 55  # frames of the flight that are left out there
_TURN: FloatArray = so3_exp([1.2, 0.4, 0.0])  # (3, 3) by which all of it is tilted after that
_UP = np.array([0.0, 0.0, 9.81])


@pytest.fixture(scope="module")
def spliced() -> tuple[Flight, SupervisedMsckf, list[Estimate]]:
    """A flight that goes on elsewhere and tilted, with stamps that go on: no such motion exists."""
    flight = Flight(150)
    rng = np.random.default_rng(5)
    filt = SupervisedMsckf(CAMERA, T_CAM0_IMU, EXACT_RIG)
    samples = flight.imu(rng, np.zeros(6))
    estimates = []
    good: Estimate | None = None
    for k in range(95):
        shift = _SKIPPED if k >= _SPLICE else 0
        begin_ns = (k + shift - 1) * STEP_NS
        for x in samples:
            if begin_ns < x.time_ns <= begin_ns + STEP_NS:
                filt.propagate(_moved(flight, x, shift))
        seen = flight.observe(k + shift, 0.2, rng, 60)
        try:
            filt.update(replace(seen, frame_index=k, time_ns=k * STEP_NS))
        except DivergedError:
            filt.restart(replace(seen, frame_index=k, time_ns=k * STEP_NS))
        estimates.append(filt.estimate())
        if k == _SPLICE - 1:
            good = estimates[-1]
        if k == 82:
            assert good is not None
            anew = filt.begin_anew(good)
            assert anew is not None
            estimates[-1] = anew
    return flight, filt, estimates


def _moved(flight: Flight, x: ImuSample, shift: int) -> ImuSample:
    """A sample of the flight as it goes on elsewhere."""
    if not shift:
        return x
    assert x.accel is not None
    R = flight.state(x.time_ns * 1e-9)[0]
    accel = x.accel + R.T @ (_TURN.T @ _UP - _UP)
    return replace(x, time_ns=x.time_ns - shift * STEP_NS, accel=accel)


def _truth(flight: Flight, k: int) -> FloatArray:
    if k < _SPLICE:
        return flight.T_world_imu(k)
    return se3_from_parts(_TURN, np.zeros(3)) @ flight.T_world_imu(k + _SKIPPED)


def test_a_filter_that_is_begun_anew_knows_its_motion_again(
    spliced: tuple[Flight, SupervisedMsckf, list[Estimate]],
) -> None:
    flight, filt, estimates = spliced
    last = estimates[-1]
    assert last.accel_bias is not None
    assert np.linalg.norm(last.accel_bias) < 0.3
    up = _truth(flight, 94)[2, :3]
    assert np.degrees(np.arccos(up @ last.T_world_imu[2, :3])) < 1.0
    moved = se3_inverse(estimates[83].T_world_imu) @ last.T_world_imu
    truth = se3_inverse(_truth(flight, 83)) @ _truth(flight, 94)
    assert np.linalg.norm(se3_log(se3_inverse(truth) @ moved)[:3]) < 0.02
    relative = filt.relative(86, 94)
    assert relative is not None
    smoothed = filt.smoothed(94)
    assert smoothed is not None
    np.testing.assert_allclose(smoothed.T_world_imu, last.T_world_imu, atol=1e-9)


def test_a_filter_that_is_begun_anew_goes_on_from_the_last_good_pose(
    spliced: tuple[Flight, SupervisedMsckf, list[Estimate]],
) -> None:
    """Its position and heading are those of before, with the uncertainty of the time since."""
    flight, _, estimates = spliced
    good = estimates[_SPLICE - 1]
    new = estimates[82]
    np.testing.assert_allclose(new.T_world_imu[:3, 3], good.T_world_imu[:3, 3], atol=1e-9)
    first = flight.T_world_imu(0)
    yaw = so3_exp([0.0, 0.0, nearest_yaw(first[:3, :3])])
    to_truth = se3_from_parts(yaw, first[:3, 3])  # an upright world whose origin is the first pose
    xi = se3_log(se3_inverse(to_truth @ new.T_world_imu) @ _truth(flight, 82))
    assert xi @ np.linalg.solve(new.covariance, xi) < chi2.ppf(0.99, 6)
    sigma_m = np.sqrt(np.trace(new.covariance[:3, :3]))
    assert 2.0 < sigma_m < 20.0


def test_points_of_before_and_after_a_new_start_are_one_map(
    spliced: tuple[Flight, SupervisedMsckf, list[Estimate]],
) -> None:
    _, filt, _ = spliced
    found = filt.landmarks()
    taken = filt.take_landmarks()
    assert len(np.unique(found.ids)) == len(found.ids) > 60
    assert np.isin(taken.ids, found.ids).all()


def test_nothing_begins_anew_before_a_sample_has_come() -> None:
    flight = Flight(10)
    filt = SupervisedMsckf(CAMERA, T_CAM0_IMU, EXACT_RIG)
    filt.update(flight.observe(0, 0.2, np.random.default_rng(0)))
    assert filt.begin_anew(filt.estimate()) is None
