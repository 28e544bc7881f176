"""A focal length that is off: found by the camera's rotation against the gyro's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.monitor.test_inertial_check import Watched, _checked, _gyro, _observe, _real, _recording
from vio.geometry.stereo import StereoCamera
from vio.imu.findings import InertialFinding
from vio.records import ImuSample, RotationComparison
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
    assert abs(turns.excess) < max(4 * turns.sigma, 0.003)
    assert not turns.differ
    assert found == []


@pytest.mark.parametrize("seed", [0, 1])
def test_a_wrong_scale_of_the_gyro_is_no_focal_length(seed: int) -> None:
    it = _recording("room", seed)
    turns, found = _compared(it, it.camera, _gyro(it, lambda rate: 1.05 * rate))
    assert abs(turns.excess - (1 / 1.05 - 1)) < max(4 * turns.sigma, 0.003)
    assert turns.differ
    assert not turns.gyro_agrees
    assert [f.fault for f in found] == ["camera turns"]
    assert "the gyro's scale is off" in found[0].explanation


@pytest.mark.parametrize("flight", ["V1_02", "MH_03"])
def test_real_gyros_turn_as_their_cameras_do(data_dir: Path, flight: str) -> None:
    it = _real(data_dir / "euroc_real_imu" / flight, 30.0)
    turns, _ = _compared(it, it.camera)
    assert not turns.differ


def test_a_focal_length_that_is_off_shows_in_the_turns() -> None:
    """By more or by less: what moves the image may pass for motion, so the share itself measures
    nothing.
    """
    near, motion = (
        _recording("room", 0),
        rotate_body_axes(hand_held(duration_s=20, seed=0), R_FLU_EUROC_IMU),
    )
    times = [seen.time_ns for seen in near.frames]
    T_world_imu = motion_at(motion, np.array(times)).T_world_imu
    it = replace(
        near, frames=_observe(near.camera, T_world_imu, near.T_cam0_imu, times, 8.0, 0, 0.1)
    )
    turns, found = _compared(it, _longer(it.camera))
    assert turns.differ
    assert turns.gyro_agrees
    (finding,) = found
    assert "msckf.stereo_focal_sigma" in finding.explanation
    assert "gyro's scale" not in finding.explanation
    right, _ = _compared(it, it.camera)
    assert not right.differ


def test_without_turns_nothing_is_said() -> None:
    it = _recording("still", 4)
    still = replace(it, frames=it.frames[:100])
    assert _compared(still, _longer(it.camera)) == (None, [])
