"""A focal length that is off: found by the camera's turns against the gyro's, and taken over."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.test_inertial_check import Watched, _checked, _gyro, _observe, _real, _recording
from tests.test_online_calibration import CAMERA, OFF, T_CAM0_IMU, Shaking, _samples, fly_with
from vio.filters.msckf import Msckf
from vio.filters.settings import MsckfSettings
from vio.filters.window import Window
from vio.geometry.lie import FloatArray, se3_inverse, se3_log
from vio.geometry.stereo import StereoCamera
from vio.imu.findings import InertialFinding
from vio.records import ROTATION_NOT_COMPARABLE, ImuSample, Observations, RotationComparison, UpdateReport
from vio.sim.motion import hand_held, motion_at, rotate_body_axes
from vio.sim.rigs import R_FLU_EUROC_IMU


def _longer(camera: StereoCamera) -> StereoCamera:
    return replace(camera, fu=1.05 * camera.fu, fv=1.05 * camera.fv)


def _compared(
    it: Watched, camera: StereoCamera, samples: list[ImuSample] | None = None
) -> tuple[RotationComparison | None, list[InertialFinding]]:
    check, found = _checked(replace(it, camera=camera), samples=samples)
    return check.rotation_comparison, found


@pytest.mark.parametrize("seed", [0, 1])
def test_a_correct_pair_and_a_correct_gyro_turn_alike(seed: int) -> None:
    turns, found = _compared(_recording("room", seed), _recording("room", seed).camera)
    assert turns is not None
    assert abs(turns.excess) < max(4 * turns.sigma, 0.003)
    assert not turns.differ
    assert found == []


@pytest.mark.parametrize("seed", [0, 1])
def test_a_wrong_scale_of_the_gyro_is_no_focal_length(seed: int) -> None:
    it = _recording("room", seed)
    turns, found = _compared(it, it.camera, _gyro(it, lambda rate: 1.05 * rate))
    assert turns is not None
    assert abs(turns.excess - (1 / 1.05 - 1)) < max(4 * turns.sigma, 0.003)
    assert turns.differ
    assert not turns.gyro_agrees
    assert [f.fault for f in found] == ["camera turns"]
    assert "the gyro's scale is off" in found[0].explanation


@pytest.mark.parametrize("flight", ["V1_02", "MH_03"])
def test_real_gyros_turn_as_their_cameras_do(data_dir: Path, flight: str) -> None:
    it = _real(data_dir / "euroc_real_imu" / flight, 30.0)
    turns, _ = _compared(it, it.camera)
    assert turns is not None
    assert not turns.differ


def test_a_focal_length_that_is_off_shows_in_the_turns() -> None:
    """By more or by less: what moves the image may pass for motion, so the share itself measures nothing."""
    near, motion = _recording("room", 0), rotate_body_axes(hand_held(duration_s=20, seed=0), R_FLU_EUROC_IMU)
    times = [seen.time_ns for seen in near.frames]
    T_world_imu = motion_at(motion, np.array(times)).T_world_imu
    it = replace(near, frames=_observe(near.camera, T_world_imu, near.T_cam0_imu, times, 8.0, 0, 0.1))
    turns, found = _compared(it, _longer(it.camera))
    assert turns is not None
    assert turns.differ
    assert turns.gyro_agrees
    assert found == []  # the filter takes it over, and says so
    right, _ = _compared(it, it.camera)
    assert right is not None
    assert not right.differ


def test_without_turns_nothing_is_said() -> None:
    it = _recording("still", 4)
    still = replace(it, frames=it.frames[:100])
    assert _compared(still, _longer(it.camera)) == (None, [])


_CLEAR = RotationComparison(-0.05, 0.004, gyro_agrees=True)


class _Told(Msckf):
    """A filter that is told of the focal length from a frame on."""

    found: RotationComparison = ROTATION_NOT_COMPARABLE
    before: RotationComparison | None = None
    told_in = 40

    def update(self, observations: Observations) -> UpdateReport:
        self.take_rotation_comparison(self.before if observations.frame_index < self.told_in else self.found)
        return super().update(observations)


def _fly(
    camera: StereoCamera, found: RotationComparison, told_in: int = 40, before: RotationComparison | None = None
) -> tuple[_Told, list[tuple[float, float] | None], FloatArray]:
    """Fly with a camera as calibrated; return the filter, what it says in each frame, and its errors (frames, 3), m."""
    noise, flight = np.random.default_rng(0), Shaking(120)
    filt = _Told(camera, T_CAM0_IMU, OFF, motion="imu")
    filt.found, filt.told_in, filt.before = found, told_in, before
    estimates, errors = fly_with(filt, flight, _samples(flight, OFF, 0.0, noise), noise, 0.5)
    scales = [e.stereo_scale for e in estimates]
    said = [None if s is None else next(iter(s.percent().values())) for s in scales]
    return filt, said, errors


def test_a_filter_that_is_told_takes_the_focal_length_over_and_improves_it() -> None:
    filt, said, errors = _fly(_longer(CAMERA), _CLEAR)
    assert said[:40] == [None] * 40  # and none of a baseline
    assert said[-1] is not None
    percent, sigma = said[-1]
    assert abs(percent - 100 * (1 / 1.05 - 1)) < 3 * sigma
    assert sigma < 0.3
    told, untold = (
        np.linalg.norm(e[80:] - e[80], axis=1).max()
        for e in (errors, _fly(_longer(CAMERA), ROTATION_NOT_COMPARABLE)[2])
    )
    assert told < 0.5 * untold
    # What the wrong one did until then is taken back: 0.6 m of error before, and nothing is less known than it was.
    assert np.linalg.norm(errors[39]) > 0.5
    assert np.linalg.norm(errors[41:], axis=1).max() < 0.2 * np.linalg.norm(errors[39])
    R = filt.estimate().T_world_imu[:3, :3]
    assert np.sqrt((R @ filt.estimate().covariance[3:, 3:] @ R.T)[2, 2]) < 0.005  # of yaw, rad; 0.06 after a new start


def _window_of(camera: StereoCamera, settings: MsckfSettings) -> Window:
    """Fly with a camera as calibrated and nearly without noise of the pixels; return the window at the end."""
    noise, flight = np.random.default_rng(0), Shaking(20)
    filt = Msckf(camera, T_CAM0_IMU, settings, motion="imu")
    fly_with(filt, flight, _samples(flight, settings, 0.0, noise), noise, 0.002)
    assert filt._window is not None
    return filt._window


def _difference(a: Window, b: Window) -> tuple[FloatArray, ...]:
    """What the means of two windows differ by: camera poses, velocity, landmarks."""
    pairs = zip(a.clones, b.clones, strict=True)
    poses = np.array([se3_log(x.T_world_imu @ se3_inverse(y.T_world_imu)) for x, y in pairs])
    return poses, a.nav.velocity - b.nav.velocity, a.landmarks - b.landmarks


@pytest.mark.parametrize(
    "settings", [OFF, replace(OFF, calibrate_stereo="on"), replace(OFF, calibrate_camera_imu="time_offset")]
)
def test_errors_depend_on_the_focal_length_as_a_filter_with_another_one_shows(settings: MsckfSettings) -> None:
    """Two filters whose focal lengths differ by a hundred-thousandth: what is followed is the difference."""
    by = 1e-5
    right, longer = (
        _window_of(replace(CAMERA, fu=k * CAMERA.fu, fv=k * CAMERA.fv), settings) for k in (1.0, float(np.exp(by)))
    )
    assert longer.prior.focal is not None
    plain = copy.deepcopy(longer)
    for window, moved in ((right, 0.0), (plain, 0.0), (longer, -by * longer.prior.focal.error_D_bias)):
        window.relinearise(moved - window.prior.delta)  # to the prior's mean
    assert (len(right.landmarks) > 0) == (settings.calibrate_stereo != "on")
    for without, given in zip(_difference(right, plain), _difference(right, longer), strict=True):
        assert np.linalg.norm(given) <= 0.1 * np.linalg.norm(without)


def test_what_is_not_beyond_doubt_changes_nothing() -> None:
    given = _fly(CAMERA, RotationComparison(-0.05, 0.012, gyro_agrees=True))
    plain = _fly(CAMERA, ROTATION_NOT_COMPARABLE)
    np.testing.assert_array_equal(given[2], plain[2])


@pytest.mark.parametrize(("sigma", "followed"), [(0.004, False), (0.006, True)])
def test_a_focal_length_is_followed_until_the_turns_agree_beyond_doubt(sigma: float, followed: bool) -> None:
    noise, flight = np.random.default_rng(0), Shaking(5)
    filt = Msckf(CAMERA, T_CAM0_IMU, OFF, motion="imu")
    filt.take_rotation_comparison(RotationComparison(0.005, sigma, gyro_agrees=True))
    fly_with(filt, flight, _samples(flight, OFF, 0.0, noise), noise, 0.5)
    assert filt._window is not None
    assert (filt._window.prior.focal is not None) == followed


def test_a_baseline_is_judged_once_the_turns_are_compared() -> None:
    short = replace(CAMERA, baseline_m=CAMERA.baseline_m / 1.1)
    told = _fly(short, ROTATION_NOT_COMPARABLE, 0)[1]
    found_in = told.index(next(x for x in told if x is not None))
    _, said, _ = _fly(short, ROTATION_NOT_COMPARABLE, found_in + 10)
    assert said[: found_in + 10] == [None] * (found_in + 10)
    assert said[-1] is not None
    assert abs(said[-1][0] - 10.0) < 3 * said[-1][1]


def test_a_baseline_that_was_taken_over_stays_reported_once_the_focal_length_is_a_state() -> None:
    """It is 20 % off, and estimated on beside the focal length: the one may have passed for the other."""
    short = replace(CAMERA, baseline_m=CAMERA.baseline_m / 1.2)
    filt, said, _ = _fly(short, _CLEAR, 100, before=ROTATION_NOT_COMPARABLE)
    assert said[99] is not None
    scale = filt.estimate().stereo_scale
    assert scale is not None
    for name, off in (("baseline", 20.0), ("focal length", 0.0)):
        percent, sigma = scale.percent()[name]
        assert abs(percent - off) < 3 * sigma
        assert sigma < 2.0
