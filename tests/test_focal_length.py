"""A focal length that is off: found by the camera's turns against the gyro's, and taken over."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.test_inertial_check import Watched, _checked, _gyro, _observe, _real, _recording
from tests.test_online_calibration import CAMERA, OFF, T_CAM0_IMU, Shaking, _samples, fly_with
from vio.filters.msckf import Msckf
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.records import TURNS_NOT_SHOWN, ImuSample, Observations, TurnComparison, UpdateReport
from vio.sim.motion import evaluate, hand_held, rotate_body_axes
from vio.sim.rigs import R_FLU_EUROC_IMU
from vio.watch.finding import InertialFinding


def _longer(camera: StereoCamera) -> StereoCamera:
    return replace(camera, fu=1.05 * camera.fu, fv=1.05 * camera.fv)


def _compared(
    it: Watched, camera: StereoCamera, samples: list[ImuSample] | None = None
) -> tuple[TurnComparison | None, list[InertialFinding]]:
    check, found = _checked(replace(it, camera=camera), samples=samples)
    return check.turns, found


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
    T_world_imu = evaluate(motion, np.array(times)).T_world_imu
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


_CLEAR = TurnComparison(-0.05, 0.004, gyro_agrees=True)


class _Told(Msckf):
    """A filter that is told of the focal length from a frame on."""

    found: TurnComparison = TURNS_NOT_SHOWN

    told_in = 40

    def update(self, observations: Observations) -> UpdateReport:
        self.take_turns(None if observations.frame_index < self.told_in else self.found)
        return super().update(observations)


def _fly(
    camera: StereoCamera, found: TurnComparison, told_in: int = 40
) -> tuple[_Told, list[tuple[float, float] | None], FloatArray]:
    """Fly with a camera as calibrated; return the filter, what it says in each frame, and its errors (frames, 3), m."""
    noise, flight = np.random.default_rng(0), Shaking(120)
    filt = _Told(camera, T_CAM0_IMU, OFF, motion="imu")
    filt.found, filt.told_in = found, told_in
    estimates, errors = fly_with(filt, flight, _samples(flight, OFF, 0.0, noise), noise, 0.5)
    scales = [e.stereo_scale for e in estimates]
    said = [None if s is None else next(iter(s.percent().values())) for s in scales]
    return filt, said, errors


def test_a_filter_that_is_told_takes_the_focal_length_over_and_improves_it() -> None:
    _, said, errors = _fly(_longer(CAMERA), _CLEAR)
    assert said[:40] == [None] * 40  # and none of a baseline
    assert said[-1] is not None
    percent, sigma = said[-1]
    assert abs(percent - 100 * (1 / 1.05 - 1)) < 3 * sigma
    assert sigma < 0.3
    told, untold = (
        np.linalg.norm(e[80:] - e[80], axis=1).max() for e in (errors, _fly(_longer(CAMERA), TURNS_NOT_SHOWN)[2])
    )
    assert told < 0.5 * untold


def test_what_is_not_beyond_doubt_changes_nothing() -> None:
    given = _fly(CAMERA, TurnComparison(-0.05, 0.012, gyro_agrees=True))
    plain = _fly(CAMERA, TURNS_NOT_SHOWN)
    np.testing.assert_array_equal(given[2], plain[2])


def test_a_baseline_is_judged_once_the_turns_are_compared() -> None:
    short = replace(CAMERA, baseline_m=CAMERA.baseline_m / 1.1)
    told = _fly(short, TURNS_NOT_SHOWN, 0)[1]
    found_in = told.index(next(x for x in told if x is not None))
    _, said, _ = _fly(short, TURNS_NOT_SHOWN, found_in + 10)
    assert said[: found_in + 10] == [None] * (found_in + 10)
    assert said[-1] is not None
    assert abs(said[-1][0] - 10.0) < 3 * said[-1][1]
