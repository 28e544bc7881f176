"""`LiveOdometry` is running, failed or closed, and every call answers by that; none waits for a
worker that has ended.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA, STEP_NS, T_CAM0_IMU, Flight
from vio.config import Config
from vio.errors import DataError, EstimationError, VioError
from vio.geometry.lie import se3_from_parts, se3_log, so3_log
from vio.imu.findings import ImuVerdict
from vio.live.inputs import _Stamps
from vio.live.live_odometry import LiveOdometry
from vio.live.prediction import PosePredictor
from vio.live.worker import QuietCollector
from vio.records import Estimate, FrameResult, ImuSample

CONFIG = replace(Config(), motion="none")
NOISE = np.random.default_rng(3)
SEEN = [Flight(frames=8).observe(k, 0.3, NOISE) for k in range(7)]
_PATIENCE_S = 60.0


def _add(live: LiveOdometry, k: int) -> None:
    live.add_observations(k * STEP_NS, SEEN[k].ids, SEEN[k].z)


_OPEN: list[LiveOdometry] = []


@pytest.fixture(autouse=True)
def closed_at_the_end() -> Iterator[None]:
    """One that stays open keeps its thread, and the collector of the process as it set it up."""
    users = QuietCollector._users
    yield
    while _OPEN:
        with contextlib.suppress(VioError):  # what made it fail
            _OPEN.pop().close()
    assert QuietCollector._users == users


def _running(on_frame: Callable[[FrameResult], None] | None = None) -> LiveOdometry:
    live = LiveOdometry(CAMERA, CONFIG, T_cam0_imu=T_CAM0_IMU, on_frame=on_frame, drop="none")
    _OPEN.append(live)
    _add(live, 0)
    return live


_LOST = EstimationError("lost for good")


def _failed(error: BaseException = _LOST) -> LiveOdometry:
    def fails(result: FrameResult) -> None:
        raise error

    live = _running(fails)
    live._worker._thread.join(_PATIENCE_S)
    return live


def _closed() -> LiveOdometry:
    live = _running()
    live.close()
    return live


def _settled() -> LiveOdometry:
    live = _running()
    live._worker.ask(lambda: None)
    return live


CALLS: dict[str, Callable[[LiveOdometry], Any]] = {
    "add": lambda live: _add(live, 1),
    "warm_up": lambda live: live._worker.ask(lambda: None),  # its way into the worker
    "reset": lambda live: live.reset(),
    "landmarks": lambda live: live.landmarks(),
    "check": lambda live: live.check(),
    "predict": lambda live: live.predict(0),
    "next": lambda live: next(iter(live), None),
    "latest": lambda live: live.latest(),
    "figures": lambda live: live.figures,
    "warnings": lambda live: live.warnings,
    "calibrated_rig": lambda live: live.calibrated_rig(),
    "close": lambda live: live.close(),
}
# What each call answers in a state, where it is no answer: the error that it raises.
_WORK = ("add", "warm_up", "reset", "landmarks")
REFUSED = {
    "running": {},
    "failed": dict.fromkeys((*_WORK, "check", "predict", "next", "close"), "lost for good"),
    "closed": dict.fromkeys(_WORK, "is closed"),
}
MAKERS = {"running": _settled, "failed": _failed, "closed": _closed}


def _within_patience(call: Callable[[], Any]) -> str:
    """Return what a call answers or raises; a call that hangs fails."""
    found: list[str] = []

    def make() -> None:
        try:
            call()
            found.append("answers")
        except Exception as error:  # noqa: BLE001 # compared below
            found.append(str(error))

    thread = threading.Thread(target=make, daemon=True)
    thread.start()
    thread.join(_PATIENCE_S)
    assert found, "the call hangs"
    return found[0]


PAIRS = [(name, state) for name in CALLS for state in MAKERS]
PAIRS.remove(("next", "running"))  # waits for the next estimate, as it should


@pytest.mark.parametrize(("name", "state"), PAIRS)
def test_every_call_answers_by_the_state(name: str, state: str) -> None:
    live = MAKERS[state]()
    assert live.state == state
    assert REFUSED[state].get(name, "answers") in _within_patience(lambda: CALLS[name](live))
    assert live.state == ("closed" if (name, state) == ("close", "running") else state)


@pytest.mark.parametrize("error", [SystemExit(3), KeyboardInterrupt(), GeneratorExit()])
def test_what_ends_a_thread_in_silence_is_named(error: BaseException) -> None:
    live = _failed(error)
    assert live.state == "failed"
    for name in ("add", "landmarks", "reset", "check", "next", "close"):
        said = _within_patience(lambda name=name: CALLS[name](live))
        assert f"{type(error).__name__} " in said
        assert "ended this odometry" in said


def test_an_error_that_is_raised_again_and_again_does_not_grow() -> None:
    live = _failed()
    depths = []
    for _ in range(5):
        with pytest.raises(EstimationError) as raised:
            live.check()
        depths.append(len(raised.traceback))
    assert len(set(depths)) == 1


def test_a_call_that_waits_as_the_worker_fails_is_answered() -> None:
    entered = threading.Event()
    go_on = threading.Event()

    def fails(result: FrameResult) -> None:
        entered.set()
        go_on.wait(_PATIENCE_S)
        sys.exit(3)

    live = _running(fails)
    assert entered.wait(_PATIENCE_S)
    answers: list[str] = []
    waiting = [
        threading.Thread(target=lambda: answers.append(_within_patience(live.landmarks)))
        for _ in range(3)
    ]
    for thread in waiting:
        thread.start()
    while live._worker._queue._calls.qsize() < len(waiting):
        threading.Event().wait(0.001)
    go_on.set()
    for thread in waiting:
        thread.join(_PATIENCE_S)
    assert ["SystemExit 3 ended" in answer for answer in answers] == [True] * 3


def test_a_put_that_waits_for_room_is_ended_by_a_failure() -> None:
    def fails(result: FrameResult) -> None:
        sys.exit(3)

    live = LiveOdometry(
        CAMERA, CONFIG, T_cam0_imu=T_CAM0_IMU, on_frame=fails, drop="block", queue_frames=1
    )

    def add_all() -> None:
        for k in range(7):
            _add(live, k)
        live.close()

    assert "SystemExit 3 ended" in _within_patience(add_all)


def test_a_callback_that_adds_a_frame_to_a_full_queue_does_not_wait_for_itself() -> None:
    numbers: list[int] = []
    held: list[LiveOdometry] = []
    full = threading.Event()
    added = threading.Event()

    def on_frame(result: FrameResult) -> None:
        numbers.append(result.frame.index)
        if len(numbers) == 1:
            full.wait(_PATIENCE_S)
            _add(held[0], 2)
            added.set()

    held.append(
        LiveOdometry(
            CAMERA,
            CONFIG,
            T_cam0_imu=T_CAM0_IMU,
            on_frame=on_frame,
            drop="block",
            queue_frames=1,
        )
    )

    def add_all() -> None:
        _add(held[0], 0)
        _add(held[0], 1)
        full.set()
        added.wait(_PATIENCE_S)
        held[0].close()

    assert _within_patience(add_all) == "answers"
    assert numbers == [0, 1, 2]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_in_a_forked_process_calls_that_need_the_thread_are_refused() -> None:
    live = _settled()
    reader, writer = os.pipe()
    if (child := os.fork()) == 0:  # no thread but this one, and no test beyond here
        try:
            said = [_within_patience(lambda name=name: CALLS[name](live)) for name in _WORK]
            os.write(writer, "\n".join(said).encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as answers:
        said = answers.read().splitlines()
    os.waitpid(child, 0)
    assert len(said) == len(_WORK)
    assert all("fork" in line for line in said)
    live.close()


def test_calls_from_a_callback_do_not_wait_for_their_own_thread() -> None:
    counts: list[int] = []
    held: list[LiveOdometry] = []

    def on_frame(result: FrameResult) -> None:
        counts.append(len(held[0].landmarks().ids))
        if len(counts) == 3:
            held[0].close()

    held.append(LiveOdometry(CAMERA, CONFIG, T_cam0_imu=T_CAM0_IMU, on_frame=on_frame, drop="none"))

    def add_all() -> None:
        for k in range(7):
            _add(held[0], k)
        held[0].close()

    assert _within_patience(add_all) in ("answers", "this odometry is closed; build a new one")
    assert len(counts) >= 3


def test_streams_that_nobody_reads_are_forgotten() -> None:
    live = _running()
    kept = iter(live)
    for k in range(1, 7):
        iter(live)
        _add(live, k)
        gc.collect()
        assert len(live._streams) == 1
    live.close()
    assert len(list(kept)) >= 6


def test_a_prediction_that_lags_is_answered_from_what_was_known() -> None:
    flight = Flight(frames=60)
    samples = flight.imu(np.random.default_rng(0), np.zeros(6))
    with LiveOdometry(CAMERA, T_cam0_imu=T_CAM0_IMU, drop="none") as live:
        stream = iter(live)
        for k in range(60):
            for s in samples:
                if (k - 1) * STEP_NS < s.time_ns <= k * STEP_NS:
                    live.add_imu(s.time_ns, s.gyro, s.accel)
            seen = flight.observe(k, 0.3, np.random.default_rng(k))
            live.add_observations(k * STEP_NS, seen.ids, seen.z)
        live._worker.ask(lambda: None)
        for _ in range(41):
            then = next(stream)
        newest = live.latest()
        assert newest is not None
        assert newest.time_ns > then.time_ns + 10 * STEP_NS
        asked_ns = then.time_ns + STEP_NS // 3
        late = live.predict(asked_ns)
        assert late.time_ns == asked_ns
        R, p, *_ = flight.state(asked_ns * 1e-9)
        true = np.linalg.inv(flight.T_world_imu(40)) @ se3_from_parts(R, p)
        moved = np.linalg.inv(then.T_world_imu) @ late.T_world_imu
        assert np.linalg.norm(se3_log(np.linalg.inv(true) @ moved)) < 3e-3
        with pytest.raises(DataError, match="too long before the newest estimate"):
            live.predict(newest.time_ns - 2_500_000_000)


def test_a_silent_imu_is_not_held_for_ever() -> None:
    """A body brakes and turns until its IMU falls silent, and goes on straight at 1 m/s."""
    live = PosePredictor(9.81)
    for k in range(201):
        braking = np.array([-4.0, 0.0, 9.81])
        live.sample(ImuSample(k * 5_000_000, np.array([0.0, 0.0, 0.5]), braking))
    T = np.eye(4)
    for k in range(20, 60):
        T = T.copy()
        T[0, 3] = 0.05 * k
        live.estimate(Estimate(k * 50_000_000, T, np.eye(6), velocity_world=np.array([1.0, 0, 0])))
        moved = live.predict((50 * k + 300) * 1_000_000).T_world_imu
        if k > 40:
            assert moved[0, 3] == pytest.approx(0.05 * k + 0.3, abs=1e-9)
            assert moved[1, 0] == pytest.approx(0.0, abs=1e-9)


def test_predictions_take_the_offset_of_the_clocks_into_account() -> None:
    """A body whose rate of turn changes; its IMU's clock is 40 ms ahead, as the filter has found."""
    live = PosePredictor(9.81)
    offset_ns = 40_000_000
    for k in range(60):
        t = 5e-3 * k
        gyro = np.array([0.0, 0.0, 20.0 * t])
        live.sample(ImuSample(k * 5_000_000 + offset_ns, gyro, np.array([0.0, 0.0, 9.81])))
    here = Estimate(
        100_000_000, np.eye(4), np.eye(6), velocity_world=np.zeros(3), time_offset_s=0.04
    )
    live.estimate(here)
    turn = so3_log(live.predict(200_000_000).T_world_imu[:3, :3])[2]
    assert turn == pytest.approx(10.0 * (0.2**2 - 0.1**2), abs=1e-6)


@pytest.mark.parametrize(
    ("verdict", "rate"),
    [(ImuVerdict(gyro_factor=np.radians(1.0)), 0.5), (ImuVerdict(usable=False), 0.0)],
)
def test_predictions_take_samples_as_the_filter_does(verdict: ImuVerdict, rate: float) -> None:
    """Of a gyro in degrees a second, which the monitor has found, or that is not used any more."""
    live = LiveOdometry(CAMERA, T_cam0_imu=T_CAM0_IMU, drop="none")
    _OPEN.append(live)
    for k in range(4):
        for n in range(10):
            t = (k - 1) * STEP_NS + n * STEP_NS // 10
            live.add_imu(t, np.zeros(3), np.array([0.0, 0.0, 9.81]))
        live.add_observations(k * STEP_NS, SEEN[0].ids, SEEN[0].z)
    live._worker.ask(lambda: None)
    live._odometry._processor.pipeline._imu = verdict
    gyro = np.degrees([0.0, 0.0, 0.5])
    for n in range(1, 41):
        live.add_imu(3 * STEP_NS + n * STEP_NS // 10, gyro, np.array([0.0, 0.0, 9.81]))
    before, after = (live.predict(k * STEP_NS).T_world_imu[:3, :3] for k in (3, 7))
    turn = rate * 4e-9 * STEP_NS
    assert so3_log(before.T @ after)[2] == pytest.approx(turn, abs=0.05 * turn + 1e-3)


def test_past_poses_lie_between_their_neighbours() -> None:
    """The motion of a body that moves by a metre a second along x, without samples."""
    live = PosePredictor(9.81)
    estimate = _settled().latest()
    assert estimate is not None
    estimate = replace(estimate, velocity_world=None)
    for k in range(40):
        T = np.eye(4)
        T[0, 3] = 0.1 * k
        live.estimate(replace(estimate, time_ns=k * 100_000_000, T_world_imu=T))
    for time_ns in (3_900_000_000, 3_850_000_000, 3_500_000_000, 2_130_000_000):
        x = live.predict(time_ns).T_world_imu[0, 3]
        assert x == pytest.approx(time_ns * 1e-9, abs=1e-6)
    with pytest.raises(DataError, match="too long before"):
        live.predict(1_800_000_000)


@pytest.mark.parametrize(
    ("steps_s", "taken"),
    [
        ((0.1, 3, 3, 3, 3), [0, 1, 3, 4, 5]),  # a slow camera after a first step that was quick
        ((0.1, 0.1, 2.5, 2.6, 2.4), [0, 1, 2, 4, 5]),
        ((0.1, 3600, 0.1, 0.1), [0, 1, 3, 4]),  # a clock that steps
        ((0.1, 3600, -3599.9, 0.1), [0, 1, 3, 4]),  # one wrong stamp
        ((0.1, 3600, 10.0, -3609.8), [0, 1, 4]),  # two wrong ones that do not agree
    ],
)
def test_stamps_that_jump_are_confirmed_by_the_next(
    steps_s: tuple[float, ...], taken: list[int]
) -> None:
    stamps = _Stamps("frame", 1_000_000)
    times = np.cumsum([0.0, *steps_s])
    found = []
    for k, seconds in enumerate(times):
        time_ns = round(seconds * 1e9)
        try:
            stamps.check_order(time_ns)
        except VioError:
            continue
        if stamps.takes(time_ns, lambda line: None):
            found.append(k)
    assert found == taken
