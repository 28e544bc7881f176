"""A view that does not continue that of the frame before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA, STEP_NS, T_CAM0_IMU, Flight
from vio.config import Config
from vio.live.odometry import Odometry
from vio.monitor.view_change import ViewChange
from vio.records import Estimate, Observations, observations

IMAGES_ALONE = replace(Config(), motion="none")
COUNT = 100  # features of a frame


def _frame(k: int, first: int, count: int = COUNT, step_ns: int = STEP_NS) -> Observations:
    """Frame k shows the features from a number on."""
    ids = np.arange(first, first + count)
    return observations(k, k * step_ns, ids, np.ones((count, 4)))


def _codes(
    firsts: list[int],
    ratio: float | None,
    *,
    measured: bool = False,
    imu: bool = False,
    step_ns: int = STEP_NS,
) -> list[str]:
    """The codes of what the last of some frames shows, which brings an innovation ratio."""
    check = ViewChange()
    found = []
    for k, first in enumerate(firsts):
        last = k == len(firsts) - 1
        given = ratio if last else 1.0
        found = check.frame(_frame(k, first, step_ns=step_ns), given, measured=measured, imu=imu)
    return [finding.code for finding in found]


USUAL = [0, 10, 20, 30, 40, 50]


def test_a_view_of_which_nothing_is_left_is_named() -> None:
    assert _codes([*USUAL, 50 + COUNT], None) == ["view-changed"]
    assert _codes([*USUAL, 50 + COUNT], None, measured=True) == ["no-features"]


def test_the_few_features_that_are_left_must_contradict_the_motion() -> None:
    assert _codes([*USUAL, 113], 2.0) == ["view-changed"]  # 37 of 100: 0.41 of the usual 90
    assert _codes([*USUAL, 113], 1.9) == []
    assert _codes([*USUAL, 112], 2.0) == []


def test_fewer_must_be_left_where_a_sensor_has_measured_the_motion() -> None:
    assert _codes([*USUAL, 128], 2.0, measured=True) == ["no-features"]  # 22, a quarter of 90
    assert _codes([*USUAL, 127], 2.0, measured=True) == []


def test_a_motion_sensor_has_measured_the_motion() -> None:
    """Also where images of noise, as in the dark, seem to contradict it."""
    assert _codes([*USUAL, 130], 4.0, measured=True) == ["no-features"]
    assert _codes([*USUAL, 130], 40.0, measured=True, imu=True) == ["no-features"]


def test_the_first_steps_of_a_fast_camera_find_the_velocity_and_leave_no_imu() -> None:
    """Frame 6 comes after 0.12 s at 50 frames/s; 0.3 s count."""
    assert _codes([*USUAL, 60], 15.0, measured=True, imu=True, step_ns=20_000_000) == []
    later = [10 * k for k in range(15)]
    assert _codes([*later, 150], 15.0, measured=True, imu=True, step_ns=20_000_000) == [
        "imu-disagrees"
    ]


def test_images_that_leave_the_imu_at_once_are_named() -> None:
    assert _codes([*USUAL, 60], 12.0, measured=True, imu=True) == ["imu-disagrees"]
    assert _codes([*USUAL, 60], 11.9, measured=True, imu=True) == []
    assert _codes([*USUAL, 60], 12.0, measured=True) == []
    assert _codes([*USUAL, 60], 12.0) == []


def test_frames_in_a_row_are_one_shock() -> None:
    check = ViewChange()
    named = []
    for k in range(40):
        ratio = 20.0 if 10 <= k < 15 or k in (17, 30) else 1.0
        if check.frame(_frame(k, 10 * k), ratio, measured=True, imu=True):
            named.append(k)
    assert named == [10, 30]


def test_a_rig_whose_frames_never_share_much_has_no_other_view() -> None:
    assert _codes([51 * k for k in range(6)] + [1000], None) == []  # 49 of 100
    assert _codes([50 * k for k in range(6)] + [1000], None) == ["view-changed"]


def test_five_frames_say_what_is_usual() -> None:
    assert _codes([*USUAL[1:], 1000], None) == []


def test_a_frame_with_few_features_shows_no_view() -> None:
    check = ViewChange()
    for k, first in enumerate(USUAL):
        check.frame(_frame(k, first), 1.0, measured=False, imu=False)
    assert check.frame(_frame(6, 1000, 29), None, measured=False, imu=False) == []
    assert len(check.frame(_frame(7, 2000, 30), None, measured=False, imu=False)) == 1


def _said(numbers: list[int]) -> list[str]:
    """What is said of images that show the views of these numbers, of which neighbours overlap."""
    check = ViewChange()
    found = []
    last = None
    first = 0
    for k, number in enumerate(numbers):
        if last is not None:
            first += 10 if number == last + 1 else 3 * COUNT
        last = number
        found += check.frame(_frame(k, first), 1.0 if k < 8 else None, measured=False, imu=False)
    return [finding.message for finding in found]


@pytest.mark.parametrize("base", [0, 1])
@pytest.mark.parametrize("count", [30, 60, 95])
def test_images_numbered_in_the_order_of_text_are_named(base: int, count: int) -> None:
    numbers = sorted(range(base, base + count), key=str)
    lines = _said(numbers)
    assert len(lines) >= 3
    assert ["order of text (1, 10, 11, …, 2)" in line for line in lines[2:]] == [True] * (
        len(lines) - 2
    )
    assert "as after a jolt" in lines[0]


def test_jolts_are_no_order_of_text() -> None:
    for jumps in ([10, 11, 20, 30], [9, 20, 31, 42], [10, 11, 12]):
        numbers = [k + 50 * sum(k >= jump for jump in jumps) for k in range(50)]
        assert not any("order of text" in line for line in _said(numbers))


def _elsewhere(flight: Flight, k: int, later: int, noise: np.random.Generator) -> Observations:
    """What the flight sees some frames later, by other features, at the time of frame k."""
    seen = flight.observe(k + later, 0.3, noise)
    return replace(seen, frame_index=k, time_ns=k * STEP_NS, ids=seen.ids + 10_000)


@pytest.mark.parametrize("later", [0, 40])
def test_the_covariance_covers_a_jump_between_joined_recordings(later: int) -> None:
    """Images alone: the filter took the motion across the joint to be as smooth as before."""
    flight = Flight()
    noise = np.random.default_rng(1)
    odometry = Odometry(CAMERA, IMAGES_ALONE, T_cam0_imu=T_CAM0_IMU)
    estimates: list[Estimate] = []
    for k in range(60):
        seen = flight.observe(k, 0.3, noise) if k < 20 else _elsewhere(flight, k, later, noise)
        estimate = odometry.add_observations(k * STEP_NS, seen.ids, seen.z)
        assert estimate is not None
        estimates.append(estimate)
    assert [f.frame for f in odometry.findings if f.code == "view-changed"] == [20]
    assert estimates[19].integrity == "nominal"
    assert {e.integrity for e in estimates[20:40]} == {"unusable"}
    after = estimates[-1]
    assert after.integrity == "nominal"
    first = flight.T_world_imu(0)
    true = np.linalg.inv(first) @ flight.T_world_imu(59 + later)
    mine = np.linalg.inv(estimates[0].T_world_imu) @ after.T_world_imu
    sigma = np.sqrt(np.trace(after.covariance[:3, :3]))
    assert np.linalg.norm(mine[:3, 3] - true[:3, 3]) < 3 * sigma
