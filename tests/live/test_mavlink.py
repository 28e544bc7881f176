"""Estimates to a flight controller: frames, covariance, time, and both ways, held against pymavlink's
decoding and what PX4's and ArduPilot's documents and handlers ask for.
"""

from __future__ import annotations

import math
import os
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA, STEP_NS, T_CAM0_IMU, Flight
from vio.config import Config
from vio.errors import ConfigError, DataError
from vio.geometry.lie import FloatArray, se3_exp, so3_exp
from vio.live.live_odometry import LiveOdometry
from vio.mavlink.link import SerialLink, UdpLink, open_link
from vio.mavlink.messages import LocalFrame, Mounting, StampClock, VehicleState, quality_of
from vio.mavlink.output import MavlinkOutput, MavlinkSettings, checked_mounting
from vio.records import Estimate

common = pytest.importorskip("pymavlink.dialects.v20.common", reason="needs the extra mavlink")
pytest.importorskip("serial", reason="needs the extra mavlink")

_PATIENCE_S = 60.0
MAV_FRAME_LOCAL_NED = 1
MAV_FRAME_BODY_FRD = 12
MAV_FRAME_LOCAL_FRD = 20


def _turn(axis: str, angle_deg: float) -> FloatArray:
    return so3_exp(np.eye(3)["xyz".index(axis)] * math.radians(angle_deg))


def _estimate(R_world_body: FloatArray, p: FloatArray, **values: Any) -> Estimate:
    T = np.eye(4)
    T[:3, :3] = R_world_body
    T[:3, 3] = p
    return Estimate(10**9, T, np.diag([1.0, 4.0, 9.0, 0.01, 0.04, 0.09]), **values)


# A vehicle that flies in north, east, down, and an IMU mounted upside down and turned.
R_FRD_CAM0 = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
R_CAM0_IMU = _turn("x", 100) @ _turn("y", 170)
R_FRD_IMU = R_FRD_CAM0 @ R_CAM0_IMU
R_WORLD_NED = np.diag([1.0, -1.0, -1.0]) @ _turn("z", 33)  # z up, an unknown heading


def _flown(R_ned_frd: FloatArray, p_ned: FloatArray, v_ned: FloatArray) -> Estimate:
    """The estimate, of the IMU in its upright world, of a vehicle's true state."""
    return _estimate(
        R_WORLD_NED @ R_ned_frd @ R_FRD_IMU,
        R_WORLD_NED @ p_ned,
        velocity_world=R_WORLD_NED @ v_ned,
        velocity_covariance=np.diag([0.1, 0.2, 0.3]),
    )


def _frame(heading_deg: float | None = None) -> LocalFrame:
    T_cam0_imu = np.eye(4)
    T_cam0_imu[:3, :3] = R_CAM0_IMU
    return LocalFrame(Mounting().R_frd_body(T_cam0_imu), is_upright=True, heading_deg=heading_deg)


def test_a_vehicle_is_found_in_north_east_down_where_its_heading_is_given() -> None:
    frame = _frame(heading_deg=70.0)
    start = _turn("z", 70) @ _turn("y", 5) @ _turn("x", -3)
    frame.state(_flown(start, np.zeros(3), np.zeros(3)), 0)
    R = _turn("z", 120) @ _turn("y", -20) @ _turn("x", 10)
    p = np.array([4.0, -2.0, -7.0])
    v = np.array([1.0, 2.0, -0.5])
    found = frame.state(_flown(R, p, v), 0)
    np.testing.assert_allclose(found.p_local, p, atol=1e-9)
    np.testing.assert_allclose(found.R_local_frd, R, atol=1e-9)
    np.testing.assert_allclose(np.degrees(found.roll_pitch_yaw), [10, -20, 120], atol=1e-9)
    assert found.v_frd is not None
    np.testing.assert_allclose(R @ found.v_frd, v, atol=1e-9)


def test_without_a_heading_the_frame_begins_with_that_of_the_vehicle() -> None:
    frame = _frame()
    start = _turn("z", -40) @ _turn("y", 10)
    first = frame.state(_flown(start, np.zeros(3), np.zeros(3)), 0)
    np.testing.assert_allclose(np.degrees(first.roll_pitch_yaw), [0, 10, 0], atol=1e-9)
    ahead = _turn("z", -40) @ np.array([3.0, 0.0, 0.0])
    moved = frame.state(_flown(start, ahead, ahead), 0)
    np.testing.assert_allclose(moved.p_local, [3.0, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("pitch_deg", [90.0, -90.0, 89.0, -89.0])
def test_a_nose_that_points_up_or_down_has_the_heading_of_its_belly(pitch_deg: float) -> None:
    start = _turn("z", 25) @ _turn("y", pitch_deg)
    first = _frame().state(_flown(start, np.zeros(3), np.zeros(3)), 0)
    np.testing.assert_allclose(first.R_local_frd, _turn("y", pitch_deg), atol=1e-9)


def test_without_an_imu_the_vehicle_is_level_at_the_start() -> None:
    frame = LocalFrame(Mounting().R_frd_body(np.eye(4)), is_upright=False)
    first = frame.state(_estimate(np.eye(3), np.zeros(3)), 0)
    np.testing.assert_allclose(first.R_local_frd, np.eye(3), atol=1e-12)
    # the camera looks ahead: along its z is forward, x is right, y is down
    moved = frame.state(_estimate(np.eye(3), np.array([1.0, 2.0, 3.0])), 0)
    np.testing.assert_allclose(moved.p_local, [3.0, 1.0, 2.0], atol=1e-12)
    assert moved.v_frd is None


@pytest.mark.parametrize(
    ("mounting", "axis"),
    [
        (Mounting(), [1, 0, 0]),
        (Mounting(pitch_deg=-90), [0, 0, 1]),  # it looks down
        (Mounting(yaw_deg=90), [0, 1, 0]),  # to the right
        (Mounting(yaw_deg=180), [-1, 0, 0]),
        (Mounting(roll_deg=180), [1, 0, 0]),  # upside down
        (Mounting(pitch_deg=30), [math.cos(math.radians(30)), 0, -0.5]),
    ],
)
def test_the_optical_axis_is_where_the_mounting_says(mounting: Mounting, axis: list[float]) -> None:
    found = mounting.R_frd_body(np.eye(4)) @ [0, 0, 1]
    np.testing.assert_allclose(found, axis, atol=1e-12)


def test_the_covariance_is_that_of_poses_drawn_from_the_estimate() -> None:
    """By samples: xi in T_imu_world = exp(xi) T_imu_world_hat."""
    rng = np.random.default_rng(0)
    R = _turn("z", 50) @ _turn("x", 20)
    shape = rng.normal(size=(6, 6)) * 0.01
    estimate = replace(
        _flown(R, np.array([1.0, 2.0, 3.0]), np.zeros(3)), covariance=shape @ shape.T
    )
    frame = _frame()
    mean = frame.state(estimate, 0)
    moved = []
    for xi in rng.multivariate_normal(np.zeros(6), estimate.covariance, size=4000):
        T = np.linalg.inv(se3_exp(xi) @ np.linalg.inv(estimate.T_world_imu))
        state = frame.state(replace(estimate, T_world_imu=T), 0)
        turned = state.R_local_frd @ mean.R_local_frd.T
        angles = [turned[2, 1], turned[0, 2], turned[1, 0]]
        moved.append([*(state.p_local - mean.p_local), *angles])
    found = np.cov(np.array(moved).T)
    scale = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    assert np.abs((found - mean.pose_covariance) / scale).max() < 0.1
    P = mean.pose_covariance
    upper = mean.pose_covariance_21
    assert len(upper) == 21
    # where PX4 and ArduPilot read the variances of x y z roll pitch yaw
    assert [upper[k] for k in (0, 6, 11, 15, 18, 20)] == np.diag(P).tolist()


def test_a_reset_begins_a_new_frame_and_is_counted() -> None:
    frame = _frame()
    states = [
        frame.state(_flown(_turn("z", angle), np.zeros(3), np.zeros(3)), trajectory)
        for angle, trajectory in ((0, 0), (30, 0), (80, 1), (90, 257))
    ]
    assert [state.reset_counter for state in states] == [0, 0, 1, 1]
    yaws = [math.degrees(state.roll_pitch_yaw[2]) for state in states]
    np.testing.assert_allclose(yaws, [0, 30, 0, 0], atol=1e-9)


def test_stamps_are_placed_on_a_clock_that_the_autopilot_can_be_told() -> None:
    wall, boot = 1_700_000_000 * 10**9, 5_000 * 10**9
    assert StampClock(wall, boot, wall - 10**8).placed_ns(wall - 10**8, wall) == wall - 10**8
    since_boot = StampClock(wall, boot, boot - 10**8)
    assert since_boot.is_known
    assert not since_boot.is_wall
    device = StampClock(wall, boot, 77)
    assert not device.is_known
    arrivals = [(0, 100), (1000, 1040), (2000, 2090), (3000, 3060)]
    placed = [device.placed_ns(stamp, now) for stamp, now in arrivals]
    assert placed == [100, 1040, 2040, 3040]


def test_the_quality_follows_from_the_integrity() -> None:
    estimate = _estimate(np.eye(3), np.zeros(3))
    words: tuple[Any, ...] = ("nominal", "degraded", "unusable")
    assert [quality_of(replace(estimate, integrity=word)) for word in words] == [100, 50, -1]


@pytest.mark.parametrize(
    "address",
    ["", "udp", "udp:1.2.3.4", "udp:host:0", "udp::1", "udp:host:99999", "tcp:host:1", "serial:"],
)
def test_wrong_addresses_are_named(address: str) -> None:
    with pytest.raises(ConfigError, match="give udp:HOST:PORT, or serial:DEVICE"):
        open_link(address)


def test_a_device_that_is_not_there_is_named() -> None:
    for address in ("serial:/dev/none", "serial:/dev/none:57600"):
        with pytest.raises(DataError, match="check device and rights"):
            open_link(address)


@pytest.mark.parametrize("text", ["", "1,2", "1,2,3,4", "a,b,c", "nan,0,0", "0,0,400"])
def test_wrong_mountings_are_named(text: str) -> None:
    with pytest.raises(ConfigError, match="--mount"):
        checked_mounting(text)


# The whole way


class Autopilot:
    """The other end: decodes by pymavlink, and asks for the time."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(_PATIENCE_S)
        self.mav = common.MAVLink(None, 1, common.MAV_COMP_ID_AUTOPILOT1)
        self.address = f"udp:127.0.0.1:{self.socket.getsockname()[1]}"
        self.sender: Any = None

    def receive(self) -> list[Any]:
        data, self.sender = self.socket.recvfrom(65536)
        return list(self.mav.parse_buffer(data) or ())

    def until(self, kind: str) -> Any:
        end_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < end_s:
            for message in self.receive():
                if message.get_type() == kind:
                    return message
        raise AssertionError(f"no {kind} has come")


@pytest.fixture
def autopilot() -> Iterator[Autopilot]:
    made = Autopilot()
    yield made
    made.socket.close()


def _fly(live: LiveOdometry, frames: int = 12, from_ns: int = 0, imu: bool = True) -> None:
    flight = Flight(frames=frames + 1)
    samples = flight.imu(np.random.default_rng(3), np.zeros(6)) if imu else []
    for k in range(frames):
        for s in samples:
            if (k - 1) * STEP_NS < s.time_ns <= k * STEP_NS:
                live.add_imu(from_ns + s.time_ns, s.gyro, s.accel)
        seen = flight.observe(k, 0.3, np.random.default_rng(k))
        live.add_observations(from_ns + k * STEP_NS, seen.ids, seen.z)


def _accepted_by_px4(message: Any) -> bool:
    """What PX4's receiver and EKF2 ask of ODOMETRY: known frames, a unit quaternion, finite
    position, positive variances.
    """
    variances = [message.pose_covariance[k] for k in (0, 6, 11, 15, 18, 20)]
    variances += [message.velocity_covariance[k] for k in (0, 6, 11)]
    return (
        message.frame_id in (MAV_FRAME_LOCAL_NED, MAV_FRAME_LOCAL_FRD)
        and message.child_frame_id == MAV_FRAME_BODY_FRD
        and abs(np.linalg.norm(message.q) - 1) < 1e-6
        and all(math.isfinite(x) for x in (message.x, message.y, message.z))
        and all(x > 0 or k < 6 for k, x in enumerate(variances))
        and min(variances) >= 0
    )


def _accepted_by_ardupilot(message: Any) -> bool:
    """What ArduPilot's handler asks for: these two frames alone, and a velocity that is finite,
    as it is turned into the vehicle's frame as it is.
    """
    return (
        message.frame_id == MAV_FRAME_LOCAL_FRD
        and message.child_frame_id == MAV_FRAME_BODY_FRD
        and all(math.isfinite(x) for x in (message.vx, message.vy, message.vz))
        and message.quality >= 0
    )


def test_odometry_reaches_an_autopilot_and_both_accept_it(autopilot: Autopilot) -> None:
    settings = MavlinkSettings(autopilot.address)
    results = []
    from_ns = time.monotonic_ns()
    live = LiveOdometry(CAMERA, T_cam0_imu=T_CAM0_IMU, drop="block", on_frame=results.append)
    with MavlinkOutput(live, settings), live:
        _fly(live, from_ns=from_ns)
    autopilot.socket.settimeout(0.5)
    found = []
    try:
        while True:
            found += autopilot.receive()
    except TimeoutError:
        pass
    sent = [message for message in found if message.get_type() == "ODOMETRY"]
    assert len(sent) == len(results) >= 10
    assert all(_accepted_by_px4(message) for message in sent)
    assert all(_accepted_by_ardupilot(message) for message in sent)
    frame = LocalFrame(Mounting().R_frd_body(live.T_cam0_body), is_upright=True)
    for message, result in zip(sent, results, strict=True):
        state: VehicleState = frame.state(result.estimate, 0)
        assert message.time_usec == result.estimate.time_ns // 1000
        got = [message.x, message.y, message.z, *message.q, message.vx, message.vy, message.vz]
        assert state.v_frd is not None
        expected = [*state.p_local, *state.quaternion_wxyz, *state.v_frd]
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(message.pose_covariance, state.pose_covariance_21, 1e-5, 1e-12)
        assert message.reset_counter == 0
        assert message.estimator_type == common.MAV_ESTIMATOR_TYPE_VIO
        assert message.get_srcComponent() == common.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
    times = [message.time_usec for message in sent]
    assert times == sorted(set(times))
    assert any(message.get_type() == "HEARTBEAT" for message in found)


@pytest.mark.parametrize("lacks_velocity", [False, True])
def test_positions_are_sent_without_a_velocity_where_asked_or_needed(
    lacks_velocity: bool,
    autopilot: Autopilot,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    original = LocalFrame.state

    def state(self: LocalFrame, estimate: Estimate, trajectory: int) -> VehicleState:
        return original(self, replace(estimate, velocity_world=None), trajectory)

    if lacks_velocity:
        monkeypatch.setattr(LocalFrame, "state", state)
    message = "odometry" if lacks_velocity else "vision"
    alone = replace(Config(), motion="none")
    live = LiveOdometry(CAMERA, alone, T_cam0_imu=T_CAM0_IMU, drop="block")
    with MavlinkOutput(live, MavlinkSettings(autopilot.address, message)), live:
        _fly(live, frames=4, imu=False)
    sent = autopilot.until("VISION_POSITION_ESTIMATE")
    for value in (sent.x, sent.y, sent.z, sent.roll, sent.pitch, sent.yaw):
        assert abs(value) < 1e-6, "the first pose is the frame's origin"
    assert len(sent.covariance) == 21
    assert caplog.text.count("no velocity is estimated") == lacks_velocity


def test_unusable_poses_are_sent_by_the_message_that_can_say_so_alone(
    autopilot: Autopilot, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = LocalFrame.state
    seen: list[int] = []

    def state(self: LocalFrame, estimate: Estimate, trajectory: int) -> VehicleState:
        seen.append(estimate.time_ns)
        is_first = len(seen) == 1
        word: Any = "unusable" if is_first else "degraded"
        return original(self, replace(estimate, integrity=word), trajectory)

    monkeypatch.setattr(LocalFrame, "state", state)
    settings = MavlinkSettings(autopilot.address, "vision")
    live = LiveOdometry(CAMERA, T_cam0_imu=T_CAM0_IMU, drop="block")
    from_ns = time.monotonic_ns()
    with MavlinkOutput(live, settings), live:
        _fly(live, frames=4, from_ns=from_ns)
    assert len(seen) >= 2
    assert autopilot.until("VISION_POSITION_ESTIMATE").usec == seen[1] // 1000
    seen.clear()
    live = LiveOdometry(CAMERA, T_cam0_imu=T_CAM0_IMU, drop="block")
    with MavlinkOutput(live, MavlinkSettings(autopilot.address)), live:
        _fly(live, frames=4, from_ns=from_ns)
    qualities = [autopilot.until("ODOMETRY").quality for _ in range(2)]
    assert qualities == [-1, 50]


def test_the_autopilot_learns_the_clock_of_the_stamps(autopilot: Autopilot) -> None:
    """As PX4's MavlinkTimesync does: it sends its own time, and halves the way there and back."""
    from_ns = time.time_ns()
    live = LiveOdometry(CAMERA, T_cam0_imu=T_CAM0_IMU, drop="block")
    with MavlinkOutput(live, MavlinkSettings(autopilot.address)):
        with live:
            _fly(live, frames=3, from_ns=from_ns)
            odometry = autopilot.until("ODOMETRY")
        own_ns = 123_456_789
        ask = autopilot.mav.timesync_encode(0, own_ns).pack(autopilot.mav)
        autopilot.socket.sendto(b"noise" + ask, autopilot.sender)
        before_ns = time.time_ns()
        autopilot.socket.sendto(ask, autopilot.sender)
        answer = autopilot.until("TIMESYNC")
    assert answer.ts1 == own_ns
    assert abs(answer.tc1 - before_ns) < _PATIENCE_S * 1e9
    assert abs(odometry.time_usec * 1000 - answer.tc1) < 2 * _PATIENCE_S * 1e9, "one clock"


def test_a_way_that_is_gone_ends_nothing_and_is_named_once(
    autopilot: Autopilot, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(self: UdpLink, data: bytes) -> object:
        raise OSError(101, "Network is unreachable")

    monkeypatch.setattr(UdpLink, "write", fails)
    live = LiveOdometry(CAMERA, T_cam0_imu=T_CAM0_IMU, drop="block")
    with MavlinkOutput(live, MavlinkSettings(autopilot.address)), live:
        _fly(live, frames=6)
    assert caplog.text.count("Network is unreachable; tried again") == 1


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a pseudo-terminal")
def test_a_serial_line_carries_both_ways() -> None:
    there, here = os.openpty()
    try:
        link = SerialLink(os.ttyname(here), 57600)
        mav = common.MAVLink(link, 1, 197)
        mav.vision_position_estimate_send(5, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3, [0.5] * 21, 7)
        decoder = common.MAVLink(None)
        (message,) = decoder.parse_buffer(os.read(there, 4096)) or ()
        assert (message.usec, message.x, message.reset_counter) == (5, 1.0, 7)
        os.write(there, b"back")
        found = b""
        while len(found) < 4:
            found += link.read()
        assert found == b"back"
        link.close()
    finally:
        os.close(there)
        os.close(here)
