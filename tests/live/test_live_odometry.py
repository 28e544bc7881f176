"""Live use with a worker: the poses of `Odometry` to the bit, calls that never wait, frames left
out, orderly ends.
"""

from __future__ import annotations

import gc
import logging
import threading
import weakref
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vio
from tests.filters.test_msckf import CAMERA, STEP_NS, T_CAM0_IMU, Flight
from vio.config import Config
from vio.errors import ConfigError, DataError, EstimationError, VioError
from vio.live import live_odometry
from vio.live.build import MapUse, Parts
from vio.live.figures import LiveMonitor
from vio.live.live_odometry import LiveOdometry
from vio.live.odometry import Odometry
from vio.live.worker import EventQueue, QueuedCall
from vio.records import Estimate, FrameResult, FrontendOutput, ImuSample, StereoFrame

IMAGES_ALONE = replace(Config(), motion="none")
# equal ones would be left out
IMAGES = np.random.default_rng(0).integers(0, 255, (6, 480, 752), dtype=np.uint8)
IMAGE = IMAGES[0]
FRAMES = 12
_PATIENCE_S = 60  # so that what blocks where it must not fails, and does not hang


class Held:
    """A front end that works when it is let; its features are those of a flight."""

    def __init__(self) -> None:
        self.entered, self.go_on = threading.Semaphore(0), threading.Semaphore(0)
        self.times: list[int] = []

    def process(self, frame: StereoFrame, prior: Any = None) -> FrontendOutput:
        self.entered.release()
        self.go_on.acquire(timeout=_PATIENCE_S)
        self.times.append(frame.time_ns)
        seen = Flight().observe(frame.index, 0.3, np.random.default_rng(frame.index))
        return FrontendOutput(replace(seen, time_ns=frame.time_ns), 0, 0, 0)

    def release(self) -> None:
        self.go_on.release(1000)


@pytest.fixture
def held() -> Iterator[Held]:
    front_end = Held()
    yield front_end
    front_end.release()  # so that no worker outlives a test that fails


def _images(held: Held, **options: Any) -> LiveOdometry:
    return LiveOdometry(
        CAMERA, IMAGES_ALONE, T_cam0_imu=T_CAM0_IMU, parts=Parts(frontend=held), **options
    )


def _events(frames: int = FRAMES) -> tuple[list[ImuSample], list[Any]]:
    flight, noise = Flight(frames=frames + 1), np.random.default_rng(3)
    samples = flight.imu(noise, np.zeros(6))
    return samples, [flight.observe(k, 0.3, noise) for k in range(frames)]


@pytest.mark.parametrize(("warm", "most_hz"), [(False, None), (True, None), (False, 10.0)])
def test_threads_give_the_poses_of_one_call_after_the_other(
    flight: Path, warm: bool, most_hz: float | None
) -> None:
    config = replace(Config(), dataset=replace(Config().dataset, max_frame_rate=most_hz))
    dataset = vio.open_dataset(flight)
    recording, events = dataset.recording, list(dataset.events())
    expected: list[FrameResult] = []
    one = Odometry(
        recording.camera, config, T_cam0_imu=recording.T_cam0_imu, on_frame=expected.append
    )
    for event in events:
        if isinstance(event, StereoFrame):
            one.add_stereo(event.time_ns, event.left, event.right)
        elif isinstance(event, ImuSample):
            one.add_imu(event.time_ns, event.gyro, event.accel)
    one.finish()
    results: list[FrameResult] = []
    with LiveOdometry(
        recording.camera,
        config,
        T_cam0_imu=recording.T_cam0_imu,
        on_frame=results.append,
        drop="block",
        queue_frames=1,
    ) as live:
        if warm:
            live.warm_up()
        reader: list[Estimate] = []
        threads = [
            threading.Thread(target=_drive, args=(live, events)),
            threading.Thread(target=lambda stream: reader.extend(stream), args=(iter(live),)),
        ]
        threads[1].start()
        threads[0].start()
        threads[0].join()
    threads[1].join()
    for a, b, c in zip(expected, results, reader, strict=True):
        np.testing.assert_array_equal(a.estimate.T_world_imu, b.estimate.T_world_imu)
        np.testing.assert_array_equal(a.estimate.covariance, b.estimate.covariance)
        assert c is b.estimate
        assert a.frame.index == b.frame.index
    assert live.latest() is results[-1].estimate
    assert (live.figures.results, live.figures.dropped, live.figures.waiting) == (
        len(expected),
        0,
        0,
    )
    assert live.warnings == one.warnings


def _drive(live: LiveOdometry, events: list[Any]) -> None:
    """Add images in this thread, and samples in another one, which is up to a frame ahead or
    behind.
    """
    turn, sampled = threading.Semaphore(2), threading.Semaphore(1)

    def samples() -> None:
        for event in events:
            if isinstance(event, StereoFrame):
                turn.acquire()
                sampled.release()
            else:
                live.add_imu(event.time_ns, event.gyro, event.accel)

    thread = threading.Thread(target=samples)
    thread.start()
    for event in events:
        if isinstance(event, StereoFrame):
            sampled.acquire()
            buffers = event.left.copy(), event.right.copy()
            live.add_stereo(event.time_ns, *buffers)
            for buffer in buffers:
                buffer[:] = 0  # as a driver does that fills its buffer again
            turn.release()
    thread.join()


@pytest.mark.parametrize(("drop", "kept"), [("oldest", [0, 3, 4]), ("none", [0, 1, 2, 3, 4])])
def test_calls_return_while_the_worker_is_busy(held: Held, drop: Any, kept: list[int]) -> None:
    live = _images(held, drop=drop, queue_frames=2)
    live.add_stereo(0, IMAGE, IMAGE)
    held.entered.acquire()  # the worker is at the first frame, and stays there
    for k in range(1, 5):
        live.add_stereo(k * STEP_NS, IMAGES[k], IMAGES[k])
    assert live.figures.waiting == len(kept) - 1
    held.release()
    live.close()
    assert held.times == [k * STEP_NS for k in kept]
    assert live.figures.dropped == 5 - len(kept)
    assert live.figures.results == len(kept)


@pytest.mark.parametrize("copied", [True, False])
def test_images_are_copied_unless_the_caller_leaves_them_alone(copied: bool) -> None:
    taken: list[StereoFrame] = []

    class Noting:
        def process(self, frame: StereoFrame, prior: Any = None) -> FrontendOutput:
            taken.append(frame)
            raise DataError("seen enough")

    left, right = IMAGES[0].copy(), IMAGES[1][::-1]
    parts = Parts(frontend=Noting())
    with LiveOdometry(
        CAMERA, IMAGES_ALONE, T_cam0_imu=T_CAM0_IMU, parts=parts, copy_images=copied
    ) as live:
        live.add_stereo(0, left, right)
    (frame,) = taken
    assert (frame.left is left) != copied
    assert frame.right.flags.c_contiguous
    np.testing.assert_array_equal(frame.right, right)


def test_blocking_waits_for_room() -> None:
    queue, added = EventQueue(1, "block"), threading.Event()
    queue.put(QueuedCall(lambda: None, frame=True))
    queue.put(QueuedCall(lambda: None))  # samples find room

    def add() -> None:
        queue.put(QueuedCall(lambda: None, frame=True))
        added.set()

    thread = threading.Thread(target=add)
    thread.start()
    assert queue.frames == 1
    assert queue.take() is not None
    thread.join(timeout=60)
    assert added.is_set()


def test_the_limit_on_the_rate_leaves_frames_out_before_the_queue(held: Held) -> None:
    config = replace(IMAGES_ALONE, dataset=replace(Config().dataset, max_frame_rate=10.0))
    live = LiveOdometry(
        CAMERA, config, T_cam0_imu=T_CAM0_IMU, parts=Parts(frontend=held), queue_frames=1
    )
    live.add_stereo(0, IMAGE, IMAGE)
    held.entered.acquire()
    live.add_stereo(100_000_000, IMAGES[1], IMAGES[1])
    live.add_stereo(120_000_000, IMAGES[2], IMAGES[2])  # would take the other one's place
    held.release()
    live.close()
    assert held.times == [0, 100_000_000]
    assert live.figures.dropped == 0


def test_predictions_use_samples_that_the_worker_has_not_seen(held: Held) -> None:
    samples, _ = _events()
    live = LiveOdometry(CAMERA, T_cam0_imu=T_CAM0_IMU, parts=Parts(frontend=held))
    held.go_on.release()
    before = [s for s in samples if s.time_ns <= STEP_NS]
    live.add_imu([s.time_ns for s in before], [s.gyro for s in before], [s.accel for s in before])
    live.add_stereo(0, IMAGE, IMAGE)
    held.entered.acquire()
    first = next(iter(live)) if live.latest() is None else live.latest()
    assert first is not None
    live.add_stereo(STEP_NS, IMAGES[1], IMAGES[1])
    held.entered.acquire()  # the worker is at the second frame, and stays there
    held_still = live.predict(2 * STEP_NS).T_world_imu
    for s in samples:
        if STEP_NS < s.time_ns <= 2 * STEP_NS:
            live.add_imu(s.time_ns, s.gyro, s.accel)
    moved = live.predict(2 * STEP_NS).T_world_imu
    reference = Odometry(CAMERA, T_cam0_imu=T_CAM0_IMU)
    for s in samples:
        if s.time_ns <= 2 * STEP_NS:
            reference._predictor.sample(s)
    reference._predictor.estimate(first)
    np.testing.assert_array_equal(moved, reference.predict(2 * STEP_NS).T_world_imu)
    assert not np.array_equal(moved, held_still)
    held.release()
    live.close()


class Lost:
    def select(self, seen: Any, motion: Any = None) -> Any:
        raise EstimationError("lost for good")


@pytest.mark.parametrize("whose", ["odometry", "callback"])
def test_what_ends_the_worker_is_raised_by_all_calls(whose: str) -> None:
    def on_frame(result: FrameResult) -> None:
        raise EstimationError("lost for good")

    live = LiveOdometry(
        CAMERA,
        IMAGES_ALONE,
        parts=Parts(selector=Lost()) if whose == "odometry" else Parts(),
        on_frame=on_frame if whose == "callback" else None,
    )
    stream = iter(live)
    live.add_observations(0, [1], [[1, 2, 0, 2]])
    with pytest.raises(EstimationError, match="for good"):
        list(stream)
    for call in (lambda: live.add_observations(5, [1], [[1, 2, 0, 2]]), live.reset, live.close):
        with pytest.raises(EstimationError, match="for good"):
            call()


def test_a_closed_odometry_takes_nothing(held: Held) -> None:
    live = _images(held)
    held.release()
    live.close()
    live.close()
    with pytest.raises(VioError, match="is closed"):
        live.add_stereo(0, IMAGE, IMAGE)
    assert list(live) == []


def test_an_error_in_the_block_forgets_what_waits(held: Held) -> None:
    def fly() -> None:
        with _images(held, drop="none") as live:
            for k in range(4):
                live.add_stereo(k * STEP_NS, IMAGES[k], IMAGES[k])
            held.entered.acquire()
            held.go_on.release()
            raise KeyError("of the caller")

    with pytest.raises(KeyError, match="of the caller"):
        fly()
    assert held.times[:1] == [0]
    assert len(held.times) < 4


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda o: o.add_stereo(STEP_NS, IMAGE[:, :300], IMAGE), "the left image is 300x480"),
        (lambda o: o.add_stereo(0, IMAGE, IMAGE), "not after the last one"),
        (lambda o: o.add_images(STEP_NS, IMAGE), "this rig takes two images"),
        (lambda o: o.add_imu(0, np.zeros(3), np.zeros(3)), "runs on motion none"),
    ],
)
def test_wrong_calls_are_refused_by_the_call_itself(held: Held, call: Any, message: str) -> None:
    live = _images(held)
    held.release()
    live.add_stereo(0, IMAGE, IMAGE)
    with pytest.raises(VioError, match=message):
        call(live)
    live.add_stereo(2 * STEP_NS, IMAGES[1], IMAGES[1])
    live.close()
    assert held.times == [0, 2 * STEP_NS]


class Refusing:
    def select(self, seen: Any, motion: Any = None) -> Any:
        raise DataError("not these")


def test_what_only_the_worker_can_refuse_is_counted_and_said() -> None:
    live = LiveOdometry(CAMERA, IMAGES_ALONE, parts=Parts(selector=Refusing()))
    live.add_observations(0, [1], [[1, 2, 0, 2]])
    live.close()
    assert live.figures.refused == 1
    assert live.warnings == ("not these",)


def test_of_frames_that_are_refused_for_hours_the_newest_lines_are_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(live_odometry, "_MAX_LINES", 3)
    live = LiveOdometry(CAMERA, IMAGES_ALONE, parts=Parts(selector=Refusing()), drop="none")
    for k in range(10):
        live.add_observations(k * STEP_NS, [1], [[1, 2, 0, 2]])
    live.close()
    assert live.figures.refused == 10
    assert live.warnings == ("not these",) * 3


def test_reset_begins_a_new_trajectory() -> None:
    _, seen = _events()
    with LiveOdometry(CAMERA, IMAGES_ALONE, T_cam0_imu=T_CAM0_IMU, drop="block") as live:
        passes = []
        for _ in range(2):
            stream = iter(live)
            for k in range(4):
                live.add_observations(k * STEP_NS, seen[k].ids, seen[k].z)
            passes.append([next(stream).T_world_imu for _ in range(4)])
            live.reset()
            assert live.latest() is None
    np.testing.assert_array_equal(*passes)
    with pytest.raises(ConfigError, match="drop='newest'"):
        LiveOdometry(CAMERA, drop="newest")  # type: ignore[arg-type]


def test_a_reset_lets_the_trajectory_before_it_go() -> None:
    """Found by the soak: the collector was told to pass over it, and 3 MiB stayed at each reset."""
    _, seen = _events()
    with LiveOdometry(CAMERA, IMAGES_ALONE, T_cam0_imu=T_CAM0_IMU, drop="block") as live:
        live.add_observations(0, seen[0].ids, seen[0].z)
        live.landmarks()  # which waits for the frame
        earlier = weakref.ref(live._odometry._processor.pipeline)
        holding = [earlier()]
        holding.append(holding)  # type: ignore[arg-type] # a cycle that holds it
        del holding
        gc.freeze()
        live.reset()
        assert earlier() is None


def test_a_slow_computer_is_named_once(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("vio.live.figures.time.perf_counter", lambda: clock[0])
    said, monitor = [], LiveMonitor(judges_latency=True)
    for k in range(40):  # results come 0.8 s late
        clock[0] = 0.05 * k
        monitor.arrived(k)
        monitor.queued(fits=True)
        clock[0] += 0.8
        said.append(monitor.result(k))
    lines = [line for line in said if line is not None]
    assert lines == ["falling behind by 0.8 s: use --config fast, or set dataset.max_frame_rate"]
    assert said.index(lines[0]) == 9
    found = monitor.figures(2)
    assert (found.results, found.waiting) == (40, 2)
    assert found.latency_median_ms == pytest.approx(800)
    assert found.latency_worst_ms == pytest.approx(800)
    assert str(found) == (
        "40 frames with a pose, 0 left out; latency 800 ms (median), 800 (95 %), 800 (worst)"
    )
    quiet, full = LiveMonitor(judges_latency=False), LiveMonitor(judges_latency=True)
    assert full.figures(0).latency_worst_ms is None
    for k in range(12):
        for each in (quiet, full):
            each.arrived(k)
            each.queued(fits=k < 2)
    assert quiet.result(11) is None
    line = full.result(11)
    assert "10 of the last 12 frames left out" in line


def test_results_after_a_reset_are_counted_where_times_begin_anew() -> None:
    """A frame that waited for samples has no result, and the publisher starts again at 0."""
    monitor = LiveMonitor(judges_latency=True)
    monitor.arrived(10**12)
    for k in range(3):
        monitor.arrived(k)
        monitor.result(k)
    assert monitor.results == 3
    monitor.arrived(4)  # left out
    monitor.arrived(5)
    monitor.result(5)
    assert monitor.figures(0).results == 4
    assert not monitor._arrived


def test_frames_that_never_have_a_result_are_not_kept_for_ever() -> None:
    """As where an odometry stands still without a start, or sees nothing, for a night."""
    monitor = LiveMonitor(judges_latency=True)
    for k in range(30_000):
        monitor.arrived(k)
    assert len(monitor._arrived) <= 10_000
    monitor.result(29_999)
    assert monitor.results == 1


def test_a_time_that_comes_again_is_that_of_the_newest_frame() -> None:
    """As where one camera found no start before a recording began again."""
    monitor = LiveMonitor(judges_latency=True)
    for k in range(4):
        monitor.arrived(k)
    monitor._arrived = deque((t, s - 1000.0) for t, s in monitor._arrived)
    for k in range(4):
        monitor.arrived(k)
    for k in range(2, 4):
        monitor.result(k)
    worst_ms = monitor.figures(0).latency_worst_ms
    assert worst_ms is not None
    assert worst_ms < 1000.0
    assert not monitor._arrived


def test_a_frame_may_arrive_while_a_result_is_noted() -> None:
    monitor = LiveMonitor(judges_latency=True)
    threads: list[threading.Thread] = []

    class _Time(int):
        """A time, beside whose comparison another thread notes a frame."""

        def __eq__(self, other: object) -> bool:
            threads.append(threading.Thread(target=monitor.arrived, args=(9,)))
            threads[-1].start()
            threads[-1].join(0.05)
            return int(self) == other

        __hash__ = int.__hash__

    for k in range(3):
        monitor.arrived(k)
    monitor.result(_Time(1))
    for thread in threads:
        thread.join()
    assert monitor.figures(0).results == 1
    assert [t for t, _ in monitor._arrived if t != 9] == [2]


@pytest.fixture
def usual_gc() -> Iterator[None]:
    """The collector as Python has it, whatever commands in this process have set."""
    before = gc.get_threshold()
    gc.set_threshold(700, 10, 10)
    yield
    gc.set_threshold(*before)


@pytest.mark.usefixtures("usual_gc")
def test_warming_up_changes_no_pose_and_says_nothing(caplog: pytest.LogCaptureFixture) -> None:
    thresholds = gc.get_threshold()
    small = replace(CAMERA, width=320, height=200, cu=160.0, cv=100.0)
    with (
        caplog.at_level(logging.DEBUG, logger="vio"),
        LiveOdometry(small, T_cam0_imu=T_CAM0_IMU) as live,
    ):
        live.warm_up()
        assert live.latest() is None
        assert live.figures.results == 0
        assert live._odometry._frontend._images is not None
        assert gc.get_freeze_count() > 1000
        assert gc.get_threshold() != thresholds
    assert gc.get_freeze_count() == 0
    assert gc.get_threshold() == thresholds
    assert [r for r in caplog.records if r.levelno >= logging.WARNING] == []
    sizeless = replace(CAMERA, width=None, height=None)
    with LiveOdometry(sizeless) as live, pytest.raises(DataError, match="size of the images"):
        live.warm_up()


def test_warming_up_reaches_what_a_run_reaches() -> None:
    """The made-up images are followed, triangulated and used: else nothing would be compiled."""
    from vio.live.warm_up import _configs, sway

    small = replace(CAMERA, width=320, height=200, cu=160.0, cv=100.0)
    for config in (*_configs(Config()), *_configs(IMAGES_ALONE)):
        results: list[FrameResult] = []
        odometry = Odometry(small, config, T_cam0_imu=T_CAM0_IMU, on_frame=results.append)
        sway(odometry, config)
        assert len(results) == 40
        assert np.median([r.report.used for r in results]) > 20
        assert results[-1].report.landmarks > 0 or config.msckf.calibrate_stereo == "on"
        assert odometry.warnings == ()


def test_points_that_do_not_change_are_kept_up_to_a_number() -> None:
    _, seen = _events(24)
    live = LiveOdometry(
        CAMERA, IMAGES_ALONE, T_cam0_imu=T_CAM0_IMU, drop="block", keep_landmarks=200
    )
    all_of_them = Odometry(CAMERA, IMAGES_ALONE, T_cam0_imu=T_CAM0_IMU)
    for k, one in enumerate(seen):
        ids = one.ids + 1000 * (k // 3)  # after three frames, all features are other ones
        live.add_observations(k * STEP_NS, ids, one.z)
        all_of_them.add_observations(k * STEP_NS, ids, one.z)
        live._worker.ask(live._keep_points)
    ours, theirs = live.landmarks(), all_of_them.landmarks()
    live.close()
    assert len(np.unique(ours.ids)) == len(ours.ids)
    assert 0 < len(ours.ids) < len(theirs.ids)
    # the newest ones are there
    assert set(ours.ids) >= set(theirs.ids[theirs.ids >= theirs.ids.max() - 999])
    np.testing.assert_array_equal(
        ours.p_world, theirs.p_world[np.searchsorted(theirs.ids, ours.ids)]
    )


def test_a_map_that_is_behind_holds_up_no_frame(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vio.mapping import session

    go_on, extract = threading.Event(), session.extract
    monkeypatch.setattr(
        session, "_KEYFRAMES", session._KEYFRAMES._replace(max_shared_share=1.0)
    )  # nearly every frame is a keyframe

    def waits(*images: Any) -> Any:
        go_on.wait(timeout=_PATIENCE_S)
        return extract(*images)

    monkeypatch.setattr(session, "extract", waits)
    warmed: list[int] = []
    monkeypatch.setattr("vio.mapping.features.extract", lambda *images: warmed.append(len(images)))
    dataset = vio.open_dataset(flight)
    recording = dataset.recording
    results: list[FrameResult] = []
    with LiveOdometry(
        recording.camera,
        IMAGES_ALONE,
        T_cam0_imu=recording.T_cam0_imu,
        on_frame=results.append,
        map=MapUse(tmp_path / "a.map"),
        drop="block",
    ) as live:
        live.warm_up()
        assert warmed == [2]
        for event in dataset.events():
            if isinstance(event, StereoFrame):
                live.add_stereo(event.time_ns, event.left, event.right)
        live._worker.ask(lambda: None)  # all frames are done, and no keyframe is
        assert len(results) == len(recording.frame_times_ns) > session.HANDOVER_FRAMES
        assert sum(r.is_keyframe for r in results) == session._KEYFRAMES.max_waiting
        go_on.set()
    assert (tmp_path / "a.map").is_file()
