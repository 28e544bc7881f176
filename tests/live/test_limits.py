"""Each limit of live use, from both sides."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from vio.datasets.frame_times import pair_stamps
from vio.errors import DataError
from vio.geometry.lie import so3_exp
from vio.live.figures import LiveMonitor
from vio.live.pairing import Pairing
from vio.live.prediction import PosePredictor
from vio.live.processor import EventOrder, _wait_ns
from vio.mavlink.messages import LocalFrame, StampClock
from vio.records import Estimate, ImuSample, StereoFrame
from vio.ros2.sensors import _Step

Says = Callable[[float], bool]
MS = 1_000_000


def _slow(monkeypatch: pytest.MonkeyPatch, latency_s: float, frames: int) -> bool:
    """Whether a computer is said to fall behind after some results."""
    now = 0.0
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    monitor = LiveMonitor(judges_latency=True)
    said = []
    for k in range(frames):
        monitor.arrived(k)
        now += latency_s
        said.append(monitor.result(k))
    return any(line is not None for line in said)


@pytest.mark.parametrize(
    ("latency_s", "frames", "is_slow"),
    [(0.45, 30, False), (0.55, 30, True), (2.0, 9, False), (2.0, 10, True)],
)
def test_late_results_mean_a_slow_computer(
    monkeypatch: pytest.MonkeyPatch, latency_s: float, frames: int, is_slow: bool
) -> None:
    assert _slow(monkeypatch, latency_s, frames) == is_slow


@pytest.mark.parametrize(("left_out", "is_slow"), [(9, False), (10, True)])
def test_frames_that_are_left_out_mean_a_slow_computer(left_out: int, is_slow: bool) -> None:
    monitor = LiveMonitor(judges_latency=True)
    for k in range(50):
        monitor.arrived(k)
        monitor.queued(fits=k >= left_out)
    assert (monitor.result(49) is not None) == is_slow


def _estimate(time_ns: int = 0, speed_mps: float = 0.0, **more: float) -> Estimate:
    return Estimate(
        time_ns,
        np.eye(4),
        np.eye(6),
        velocity_world=np.array([speed_mps, 0.0, 0.0]),
        **more,  # type: ignore[arg-type]
    )


def _carried_m(seconds: float) -> float:
    """How far a pose is carried on without samples at 1 m/s."""
    predictor = PosePredictor(9.81)
    predictor.estimate(_estimate(0, 1.0))
    return float(predictor.predict(round(1e9 * seconds)).T_world_imu[0, 3])


def _late_estimate_moves(late_s: float) -> bool:
    """Whether an estimate is carried over all samples that came since its frame."""
    predictor = PosePredictor(9.81)
    last_ns = round(1e9 * late_s)
    for t in range(0, last_ns + 1, 50 * MS):
        predictor.sample(ImuSample(t, np.zeros(3), np.array([0.0, 0.0, 9.81])))
    predictor.estimate(_estimate(0, 0.0))
    rate = np.array([0.0, 0.0, 1.0])
    early = PosePredictor(9.81)
    for t in range(0, last_ns + 1, 50 * MS):
        gyro = rate if t == 50 * MS else np.zeros(3)
        early.sample(ImuSample(t, gyro, np.array([0.0, 0.0, 9.81])))
    early.estimate(_estimate(0, 0.0))
    R = early.predict(last_ns).T_world_imu
    return bool(abs(R[1, 0]) < 1e-6)


def _past_is_known(seconds: float) -> bool:
    predictor = PosePredictor(9.81)
    for k in range(100):
        predictor.estimate(_estimate(100 * MS * k))
    try:
        predictor.predict(100 * MS * 99 - round(1e9 * seconds))
    except DataError:
        return False
    return True


def _due(later_ms: float) -> bool:
    """Whether a frame without samples is due once another one has come."""
    order = EventOrder(wait_for_imu=True)
    list(order.add(StereoFrame(0, 0, None, None)))
    return bool(list(order.add(StereoFrame(1, round(MS * later_ms), None, None))))


def _waits(offset_s: float, sigma_s: float) -> bool:
    return _wait_ns(_estimate(0, 0.0, time_offset_s=offset_s, time_offset_sigma_s=sigma_s)) > 0


def _pairs(apart_ms: float) -> bool:
    pairing: Pairing[str] = Pairing()
    pairing.add(0, 0, "left")
    return pairing.add(1, round(MS * apart_ms), "right") is not None


def _pairs_of_lists(apart_ms: float) -> bool:
    left = 100 * MS * np.arange(5)
    try:
        return len(pair_stamps(left, left + round(MS * apart_ms))[0]) == 5
    except DataError:
        return False


def _still_waiting(images: int) -> bool:
    pairing: Pairing[str] = Pairing()
    for k in range(images):
        pairing.add(0, 100 * MS * k, "left")
    return pairing.add(1, 0, "right") is not None


def _heading_deg(level: float) -> float:
    """Where the nose of a vehicle points at the start that is rolled, and whose nose points up but
    for a level part: 0, unless its belly says what is ahead.
    """
    T = np.eye(4)
    T[:3, :3] = so3_exp([0.0, -np.arccos(level), 0.0]) @ so3_exp([0.7, 0.0, 0.0])
    frame = LocalFrame(np.diag([1.0, -1.0, -1.0]), is_upright=True)
    R = frame.state(Estimate(0, T, np.eye(6)), 0).R_local_frd
    return float(np.degrees(np.arctan2(R[1, 0], R[0, 0])))


def _is_wall_clock(apart_s: float) -> bool:
    return StampClock(10**18, 10**12, 10**18 - round(1e9 * apart_s)).is_wall


def _quickest_is_known(arrivals: int) -> bool:
    """Whether the quickest of all arrivals counts after so many slower ones."""
    clock = StampClock(0, 10**15, 10**12)
    clock.placed_ns(0, 10**15)
    for k in range(1, arrivals):
        clock.placed_ns(k, 10**15 + 10**9 + k)
    return clock.placed_ns(arrivals, 10**15 + 10**9 + arrivals) < 10**15 + 10**8


LIMITS: dict[str, tuple[Says, float, float]] = {
    "prediction: held": (lambda x: _carried_m(10.0) < x, 0.45, 0.55),
    "prediction: late": (_late_estimate_moves, 1.8, 2.3),
    "prediction: past": (lambda x: not _past_is_known(x), 1.8, 2.3),
    "order: without samples": (_due, 90.0, 100.0),
    "order: offset": (lambda x: _waits(x, 1e-6), 0.0009, 0.0011),
    "order: offset, sigmas": (lambda x: _waits(x, 0.001), 0.0027, 0.0033),
    "pairs": (lambda x: not _pairs(x), 2.7, 3.3),
    "pairs of lists": (lambda x: not _pairs_of_lists(x), 2.7, 3.3),
    "pairs: waiting": (lambda n: not _still_waiting(int(n)), 10, 11),
    "nose: points up": (lambda x: abs(_heading_deg(x)) < 1.0, 0.09, 0.11),
    "clock: of this computer": (lambda x: not _is_wall_clock(x), 9.0, 11.0),
    "clock: arrivals": (lambda n: not _quickest_is_known(int(n)), 190, 210),
    "clock: back": (lambda x: _Step(-round(MS * x), 0).is_back, 450.0, 550.0),
    "clock: ahead": (lambda x: not _Step(20_000 * MS, round(MS * x)).is_ahead, 1800.0, 2200.0),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_live_use(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
