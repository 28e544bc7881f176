"""The front door for live use: the same poses as a recorded run, however events arrive, and
refusals without harm.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import vio
from tests.filters.test_msckf import CAMERA, STEP_NS, T_CAM0_IMU, Flight
from vio.cameras.rig import Rig
from vio.config import Config
from vio.errors import CalibrationError, ConfigError, DataError, VioError
from vio.geometry.lie import FloatArray, se3_from_parts, se3_log
from vio.live.build import Parts
from vio.live.odometry import Odometry
from vio.numerics.threads import BlasLimit, one_blas_thread
from vio.records import Estimate, FrameResult, FrontendOutput, ImuSample, StereoFrame
from vio.sim.effects import CLEAN
from vio.sim.imu import ImuNoise
from vio.sim.motion import hand_held
from vio.sim.rigs import small_rig
from vio.sim.sequence import SimulatedRecording, simulate
from vio.sim.world import room

FRAMES = 12
IMAGES_ALONE = replace(Config(), motion="none")


@pytest.fixture(scope="module")
def recording() -> SimulatedRecording:
    motion = hand_held(duration_s=2.0)
    return SimulatedRecording(
        simulate(
            room(seed=1),
            small_rig(320, 200),
            motion,
            rate_hz=10.0,
            imu=ImuNoise(),
            effects=CLEAN,
            seed=1,
        )
    )


@pytest.fixture(scope="module")
def events(recording: SimulatedRecording) -> list[Any]:
    return list(recording.events(0, FRAMES))


@pytest.fixture(scope="module")
def rig(recording: SimulatedRecording) -> Rig:
    camera = recording.recording.camera
    numbers = (
        camera.fu,
        camera.fv,
        camera.cu,
        camera.cv,
        camera.baseline_m,
        camera.width,
        camera.height,
    )
    return Rig.rectified(*numbers, recording.recording.T_cam0_imu)


def _arrays(samples: list[ImuSample]) -> tuple[Any, Any, Any]:
    return [s.time_ns for s in samples], [s.gyro for s in samples], [s.accel for s in samples]


@pytest.mark.parametrize("arrival", ["in order", "imu late", "images late"])
def test_live_events_give_the_poses_of_the_recorded_run(
    recording: SimulatedRecording, events: list[Any], rig: Rig, arrival: str
) -> None:
    recorded = vio.run(recording, Config(), stop=FRAMES)
    results: list[FrameResult] = []
    odometry = Odometry(rig, on_frame=results.append)
    late_ns = {"in order": 0, "imu late": 90_000_000, "images late": -150_000_000}[arrival]

    def arrives(event: Any) -> int:
        return int(event.time_ns) + (0 if isinstance(event, StereoFrame) else late_ns)

    batch: list[ImuSample] = []
    for event in sorted(events, key=arrives):
        if not isinstance(event, StereoFrame):
            batch.append(event)
            if len(batch) < 7 and event is not events[-1]:
                continue
            odometry.add_imu(*_arrays(batch))
            batch = []
        else:
            if batch:
                odometry.add_imu(*_arrays(batch))
                batch = []
            buffers = event.left.copy(), event.right.copy()
            odometry.add_stereo(event.time_ns, *buffers)
            for buffer in buffers:
                buffer[:] = 0  # as a driver does that fills its buffer again
    if batch:
        odometry.add_imu(*_arrays(batch))
    odometry.finish()
    assert [r.log.index for r in results] == list(range(FRAMES))
    poses = np.array([r.estimate.T_world_imu for r in results])
    np.testing.assert_array_equal(poses, recorded.trajectory.T_world_body)
    assert odometry.estimate is results[-1].estimate
    assert odometry.warnings == recorded.warnings


def test_a_calibration_of_other_images_is_named_live_from_the_first_frame_on(
    recording: SimulatedRecording, rig: Rig
) -> None:
    """The images are rectified, and the lenses that are given are those of raw ones."""
    assert rig.cam1 is not None
    bend = (-0.28, 0.07, 0.0, 0.0)
    bent = [replace(c, model="radtan", coefficients=bend) for c in (rig.cam0, rig.cam1)]
    read = replace(rig, cam0=bent[0], cam1=bent[1], T_cam0_imu=None)
    with Odometry(read, IMAGES_ALONE) as odometry:
        for event in recording.events(0, 15):
            if isinstance(event, StereoFrame):
                assert event.left is not None
                assert event.right is not None
                odometry.add_stereo(event.time_ns, event.left, event.right)
        found = next(f for f in odometry.findings if f.code == "calibration-misread")
    assert found.first_frame == 0
    assert odometry.estimate is not None
    assert odometry.estimate.integrity == "unusable"


def _fly(odometry: Odometry, frames: int = 30, first: int = 0) -> list[Estimate]:
    """Feed features and IMU samples of a flight."""
    flight, noise = Flight(frames=frames + 1), np.random.default_rng(3)
    samples = flight.imu(noise, np.zeros(6)) if odometry.motion == "imu" else []
    out = []
    for k in range(first, frames):
        for s in samples:
            if (k - 1) * STEP_NS < s.time_ns <= k * STEP_NS:
                odometry.add_imu(s.time_ns, s.gyro, s.accel)
        seen = flight.observe(k, 0.3, noise)
        estimate = odometry.add_observations(k * STEP_NS, seen.ids, seen.z)
        assert estimate is not None
        out.append(estimate)
    return out


def _error(estimate: Estimate, k: int) -> FloatArray:
    flight = Flight()
    T_shift = flight.T_world_imu(0)
    return se3_log(np.linalg.inv(flight.T_world_imu(k)) @ T_shift @ estimate.T_world_imu)


def test_observations_of_a_front_end_of_the_callers_own() -> None:
    estimates = _fly(Odometry(CAMERA, IMAGES_ALONE, T_cam0_imu=T_CAM0_IMU))
    assert np.linalg.norm(_error(estimates[-1], 29)[:3]) < 0.02


def test_reset_begins_a_new_trajectory() -> None:
    odometry = Odometry(CAMERA, T_cam0_imu=T_CAM0_IMU)
    first = _fly(odometry, 8)
    odometry.reset()
    assert odometry.estimate is None
    for was, now in zip(first, _fly(odometry, 8), strict=True):
        np.testing.assert_array_equal(was.T_world_imu, now.T_world_imu)


@pytest.mark.parametrize("motion", ["imu", "none"])
def test_a_prediction_between_frames_is_as_good_as_the_next_frame(motion: Any) -> None:
    odometry = Odometry(CAMERA, replace(Config(), motion=motion), T_cam0_imu=T_CAM0_IMU)
    last = _fly(odometry)[-1]
    flight = Flight(frames=40)
    if motion == "imu":
        for s in flight.imu(np.random.default_rng(4), np.zeros(6)):
            if 29 * STEP_NS < s.time_ns <= 30 * STEP_NS:
                odometry.add_imu(s.time_ns, s.gyro, s.accel)
    for part in (0.0, 0.3, 0.5, 1.0):
        time_ns = 29 * STEP_NS + round(part * STEP_NS)
        pose = odometry.predict(time_ns)
        R, p, *_ = flight.state(time_ns * 1e-9)
        true = np.linalg.inv(flight.T_world_imu(29)) @ se3_from_parts(R, p)
        moved = np.linalg.inv(last.T_world_imu) @ pose.T_world_imu
        error = se3_log(np.linalg.inv(true) @ moved)
        assert np.linalg.norm(error[:3]) < (2e-3 if motion == "imu" else 5e-3) * (part > 0) + 1e-9
        assert np.linalg.norm(error[3:]) < 2e-3 * (part > 0) + 1e-9


def test_a_prediction_before_the_estimate_is_refused() -> None:
    odometry = Odometry(CAMERA, IMAGES_ALONE)
    with pytest.raises(DataError, match="before the first estimate"):
        odometry.predict(0)
    _fly(odometry, 3)
    with pytest.raises(DataError, match="too long before the newest estimate"):
        odometry.predict(-1)


def test_predictions_do_not_wait_for_the_thread_that_adds() -> None:
    odometry = Odometry(CAMERA, T_cam0_imu=T_CAM0_IMU)
    _fly(odometry, 3)
    failures: list[BaseException] = []
    done = threading.Event()

    def ask() -> None:
        try:
            while not done.is_set():
                newest = odometry.estimate
                assert np.isfinite(odometry.predict(newest.time_ns + 2 * STEP_NS).T_world_imu).all()
        except BaseException as error:  # noqa: BLE001 # shown by the main thread
            failures.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        with odometry._lock:  # a call that takes long
            assert np.isfinite(odometry.predict(3 * STEP_NS).T_world_imu).all()
        _fly(odometry, 20, first=3)
    finally:
        done.set()
        thread.join()
    assert failures == []


ONE = np.zeros(3)
IMAGE = np.zeros((200, 320), dtype=np.uint8)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda o: o.add_imu(50, ONE, ONE), "not after the last one"),
        (lambda o: o.add_imu(100, ONE, ONE), "not after the last one"),
        (lambda o: o.add_imu([300, 200], [ONE, ONE], [ONE, ONE]), "must increase"),
        (lambda o: o.add_imu([200, 200], [ONE, ONE], [ONE, ONE]), "must increase"),
        (
            lambda o: o.add_imu(np.array([300, 200], np.uint64), [ONE, ONE], [ONE, ONE]),
            "must increase",
        ),
        (lambda o: o.add_imu(1e9, ONE, ONE), "integer nanoseconds"),
        (lambda o: o.add_imu(200, np.zeros(4), ONE), r"gyro has shape \(4,\)"),
        (lambda o: o.add_imu([200, 300], ONE, ONE), "gyro has shape"),
        (lambda o: o.add_imu(200, ONE, [0, np.nan, 0]), "accel at 200 ns is not finite"),
        (lambda o: o.add_imu(200, [0, 1e9, 0], ONE), "gyro at 200 ns is .* beyond any sensor"),
        (lambda o: o.add_imu(200, ["x", 1, 2], ONE), "gyro is not numeric"),
        (lambda o: o.add_velocity(200, ONE, ONE), "set the configuration's motion"),
        (lambda o: o.add_stereo(100, IMAGE, IMAGE), "not after the last one"),
        (lambda o: o.add_stereo(1.5, IMAGE, IMAGE), "integer number of nanoseconds"),
        (lambda o: o.add_stereo(2**70, IMAGE, IMAGE), "is no time of a clock"),
        (lambda o: o.add_imu(2**63 - 1, ONE, ONE), "no time of a clock"),
        (
            lambda o: o.add_stereo(200, IMAGE.astype(np.float64), IMAGE),
            "the left image has shape .* float64",
        ),
        (
            lambda o: o.add_stereo(200, IMAGE, IMAGE[:, :300]),
            "the right image is 300x200, .* 320x200",
        ),
        (lambda o: o.add_stereo(200, IMAGE[:10], IMAGE[:10]), "calibration is for 320x200"),
        (lambda o: o.add_stereo(200, None, IMAGE), "the left image"),
        (
            lambda o: o.add_stereo(200, np.zeros((200, 320, 4), dtype=np.uint8), IMAGE),
            "the left image",
        ),
        (lambda o: o.add_observations(200, [1], [[1, 2, 0, 2]]), "observations came after images"),
    ],
)
def test_wrong_calls_are_refused_and_change_nothing(
    rig: Rig, events: list[Any], call: Callable[[Odometry], Any], message: str
) -> None:
    odometry = Odometry(rig)
    frame = next(e for e in events if isinstance(e, StereoFrame))
    odometry.add_imu(100, ONE, [0, 0, 9.81])
    odometry.add_stereo(100, frame.left, frame.right)
    before = odometry.estimate
    with pytest.raises(VioError, match=message):
        call(odometry)
    assert odometry.estimate is before
    odometry.add_imu(200, ONE, [0, 0, 9.81])
    assert odometry.add_stereo(200, frame.left, frame.right) is not None


@pytest.mark.parametrize(
    ("ids", "z", "message"),
    [
        ([1, 1], np.ones((2, 4)), "an id occurs twice"),
        ([1], np.ones((2, 4)), "disagree in length"),
        ([1], [[1, 2, np.nan, 2]], "1 pixels are not finite"),
        ([1], [[1e13, 2, 0, 2]], "1 pixels are .* in no image"),
        (["a"], np.ones((1, 4)), "ids are whole numbers"),
    ],
)
def test_wrong_observations_are_refused(ids: Any, z: Any, message: str) -> None:
    odometry = Odometry(CAMERA, IMAGES_ALONE)
    with pytest.raises(DataError, match=message):
        odometry.add_observations(5, ids, z)
    assert odometry.add_observations(5, [1], [[1, 2, 0, 2]]) is not None


def _live(odometry: Odometry, times_ns: list[int]) -> list[bool]:
    """Which frames, each with its IMU sample, brought an estimate."""
    seen = Flight().observe(0, 0.0, np.random.default_rng(0))
    given = []
    for time_ns in times_ns:
        odometry.add_imu(time_ns, ONE, [0.0, 0.0, 9.81])
        given.append(odometry.add_observations(time_ns, seen.ids, seen.z) is not None)
    return given


def test_one_stamp_far_ahead_costs_one_frame_and_is_named() -> None:
    odometry = Odometry(CAMERA, T_cam0_imu=T_CAM0_IMU)
    times = [k * STEP_NS for k in range(12)]
    times[6] += 60_000_000_000
    assert _live(odometry, times) == [k != 6 for k in range(12)]
    named = [line for line in odometry.warnings if "ahead of the last one" in line]
    assert [line.partition(" at ")[0] for line in named] == ["sample", "frame"]
    assert "60.1 s ahead" in named[1]


def test_a_pause_is_no_wrong_stamp_once_a_second_frame_confirms_it() -> None:
    odometry = Odometry(CAMERA, T_cam0_imu=T_CAM0_IMU)
    times = [k * STEP_NS + (10_000_000_000 if k >= 6 else 0) for k in range(12)]
    assert _live(odometry, times) == [k != 6 for k in range(12)]


@pytest.mark.parametrize("step_ns", [1, 50, 50_000])
def test_stamps_in_another_unit_are_refused_for_ever(step_ns: int) -> None:
    """Frame numbers, ms and us: the steps over several refused stamps are no right ones."""
    odometry = Odometry(CAMERA, IMAGES_ALONE)
    seen = Flight().observe(0, 0.0, np.random.default_rng(0))
    for k in range(30):
        if k < 3:
            assert odometry.add_observations(k * step_ns, seen.ids, seen.z) is not None
            continue
        with pytest.raises(DataError, match=f"come {step_ns} ns apart, .* give integer nanosec"):
            odometry.add_observations(k * step_ns, seen.ids, seen.z)


def test_a_camera_whose_first_stamps_are_quick_goes_on() -> None:
    odometry = Odometry(CAMERA, IMAGES_ALONE)
    seen = Flight().observe(0, 0.0, np.random.default_rng(0))
    for time_ns in (0, 1000, 2000, 50_000_000, 100_000_000, 100_001_000):
        assert odometry.add_observations(time_ns, seen.ids, seen.z) is not None


def test_slow_cameras_have_no_jumps() -> None:
    odometry = Odometry(CAMERA, IMAGES_ALONE)
    seen = Flight().observe(0, 0.0, np.random.default_rng(0))
    for k in range(6):
        assert odometry.add_observations(k * 3_000_000_000, seen.ids, seen.z) is not None
    assert not [line for line in odometry.warnings if "ahead" in line]


@pytest.mark.parametrize("T", [np.full((4, 4), np.nan), np.diag([1.0, 1.0, -1.0, 1.0]), np.eye(3)])
def test_wrong_extrinsics_are_refused_with_a_back_end_of_the_callers_own(T: Any) -> None:
    with pytest.raises(VioError, match="T_cam0_imu"):
        Odometry(
            CAMERA, IMAGES_ALONE, T_cam0_imu=T, parts=Parts(frontend=Picky(), backend=object())
        )


def test_extrinsics_that_the_caller_writes_into_later_are_not_changed() -> None:
    mine = T_CAM0_IMU.copy()
    odometry = Odometry(CAMERA, T_cam0_imu=mine)
    mine[:] = 0.0
    np.testing.assert_array_equal(odometry.T_cam0_imu, T_CAM0_IMU)
    np.testing.assert_array_equal(odometry.T_cam0_body, T_CAM0_IMU)


def test_a_pixel_that_is_not_seen_may_be_anything() -> None:
    odometry = Odometry(CAMERA, IMAGES_ALONE)
    assert odometry.add_observations(5, [1], [[1, 2, np.nan, np.nan]], [False]) is not None


class Picky:
    """A front end that refuses five frames."""

    def process(self, frame: StereoFrame, prior: Any = None) -> FrontendOutput:
        if 3 <= frame.index < 8:
            raise DataError(f"frame {frame.index}: too dark")
        seen = Flight().observe(frame.index, 0.3, np.random.default_rng(frame.index))
        return FrontendOutput(replace(seen, time_ns=frame.time_ns), 0, 0, 0)


def test_frames_that_the_front_end_refuses_are_skipped_and_said() -> None:
    odometry = Odometry(CAMERA, IMAGES_ALONE, T_cam0_imu=T_CAM0_IMU, parts=Parts(frontend=Picky()))
    images = np.random.default_rng(0).integers(0, 255, (12, 480, 752), dtype=np.uint8)
    given = [odometry.add_stereo(k * STEP_NS, images[k], images[k]) is not None for k in range(12)]
    assert given == [not 3 <= k < 8 for k in range(12)]
    assert odometry.frames_refused == 5
    assert [line for line in odometry.warnings if "skipped" in line] == [
        "frame skipped: frame 3: too dark"
    ]


def test_colour_images_are_taken(rig: Rig, events: list[Any]) -> None:
    frame = next(e for e in events if isinstance(e, StereoFrame))
    results: list[FrameResult] = []
    odometry = Odometry(rig, IMAGES_ALONE, on_frame=results.append)
    colour = [np.repeat(image[:, :, None], 3, axis=2) for image in (frame.left, frame.right)]
    odometry.add_stereo(0, *colour)
    assert results[0].log.matched > 50


def test_raw_images_are_rectified_inside() -> None:
    K = np.array([[200.0, 0, 160], [0, 200, 100], [0, 0, 1]])
    T_cam1_cam0 = se3_from_parts(np.eye(3), [-0.1, 0.0, 0.0])
    raw = Rig.raw(
        K,
        K,
        T_cam1_cam0,
        320,
        200,
        model="radtan",
        distortion0=(-0.2, 0, 0, 0),
        distortion1=(-0.2, 0, 0, 0),
    )
    odometry = Odometry(raw)
    assert odometry.motion is None
    assert odometry.camera != raw.cam0
    noise = np.random.default_rng(0).integers(0, 255, (200, 320), dtype=np.uint8)
    assert odometry.add_stereo(0, noise, noise) is not None


def test_what_the_rig_does_not_have_is_refused_at_once() -> None:
    with pytest.raises(ConfigError, match="T_cam0_imu"):
        Odometry(CAMERA, replace(Config(), motion="imu"))
    with pytest.raises(CalibrationError):
        Odometry(Rig.rectified(500, 500, 300, 200, -0.1, 640, 480))


@pytest.mark.parametrize("fails", [False, True])
def test_one_blas_thread_inside_and_the_callers_number_outside(
    fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # as outside of these tests, which hold one thread
    monkeypatch.setattr("vio.numerics.threads._pinned", 0)
    inside: list[int] = []

    def threads() -> list[int]:
        return [
            info["num_threads"]
            for info in threadpool_info()
            if info["user_api"] == "blas" and "opencv" not in info["filepath"]
        ]

    def on_frame(result: FrameResult) -> None:
        if fails:
            raise RuntimeError("of the caller")

    class Spy:
        def select(self, seen: Any, motion: Any = None) -> Any:
            inside.extend(threads())
            raise DataError("enough")

    with threadpool_limits(limits=2, user_api="blas"):
        odometry = Odometry(CAMERA, IMAGES_ALONE, parts=Parts(selector=Spy()), on_frame=on_frame)
        with pytest.raises(DataError):
            odometry.add_observations(0, [1], [[1, 2, 0, 2]])
        assert set(threads()) == {2}
    assert set(inside) == {1}


def test_within_a_run_the_number_of_blas_threads_is_not_asked_for_again() -> None:
    """The run holds it at one; each question takes as long as ten IMU samples."""
    with one_blas_thread():
        assert isinstance(BlasLimit()(), contextlib.nullcontext)


def test_the_public_names_are_there() -> None:
    assert {"Odometry", "Rig", "load_rig", "run", "open_dataset", "load_config", "evaluate"} <= set(
        dir(vio)
    )
    for name in vio.__all__:
        assert getattr(vio, name) is not None
