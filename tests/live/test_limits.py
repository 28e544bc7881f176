"""Each limit of live use, from both sides."""

from __future__ import annotations

import termios
import time
from collections.abc import Callable, Iterator
from http import HTTPStatus
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, patch

import numpy as np
import pytest

from vio.datasets.frame_times import pair_stamps
from vio.errors import NOTE, DataError, VioError
from vio.geometry.lie import FloatArray, so3_exp
from vio.geometry.stereo import StereoCamera
from vio.live import map_service
from vio.live.figures import LiveMonitor
from vio.live.inputs import Inputs, _Stamps, checked_time
from vio.live.pairing import Pairing
from vio.live.prediction import PosePredictor
from vio.live.processor import EventOrder, _wait_ns
from vio.mavlink.link import open_link
from vio.mavlink.messages import LocalFrame, StampClock
from vio.mavlink.output import MavlinkOutput
from vio.records import Estimate, ImuSample, Landmarks, StereoFrame
from vio.ros2 import sensors
from vio.ros2.outputs import FrameNames, Outputs
from vio.ros2.play import _wait_for_subscribers
from vio.ros2.sensors import Sensors, SensorTopics, Silence, _Step
from vio.sources.oak import OakSource
from vio.sources.realsense import RealSenseSource
from vio.sources.video import VideoSource

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


def _is_refused(call: Callable[[], object]) -> bool:
    try:
        call()
    except (VioError, map_service._RefusedError):
        return True
    return False


def _jump_is_held(step_s: float, last_step_s: float = 0.1) -> bool:
    stamps = _Stamps("frame", 0)
    said: list[str] = []
    time_s = 0.0
    for step in (0.0, last_step_s, step_s):
        time_s += step
        taken = stamps.takes(round(1e9 * time_s), said.append)
    return not taken


def _inputs() -> Inputs:
    camera = StereoCamera(8.0, 8.0, 4.0, 4.0, 0.1, kind="mono")
    return Inputs(camera, (None,), "imu", 0, None, lambda line: None)


def _frames_taken(step_ns: float, frames: int = 20) -> int:
    """How many frames are taken that come at a step, until one is refused."""
    inputs = _inputs()
    for k in range(frames):
        try:
            inputs.images(round(step_ns * k), np.zeros((4, 4), np.uint8))
        except DataError:
            return k
    return frames


def _samples_fit(step_ns: float) -> bool:
    times = np.round(step_ns * np.arange(5)).astype(np.int64)
    values = np.zeros((5, 3))
    return not _is_refused(lambda: _inputs().samples("imu", times, values, values))


def _request_fits(megabytes: float) -> bool:
    """Whether a request is read; it ends early here."""
    handler: Any = SimpleNamespace(
        headers={"Content-Length": str(round(megabytes * 2**20))},
        rfile=SimpleNamespace(read=lambda length: b""),
    )
    try:
        map_service._Handler._body(handler)
    except map_service._RefusedError as error:
        return error.status != HTTPStatus.REQUEST_ENTITY_TOO_LARGE
    return True


CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)


def _is_another_camera(share: float) -> bool:
    return _is_refused(lambda: map_service._check_camera({"fu": 400.0 * (1.0 + share)}, CAMERA))


class _Clock:
    """Time that passes where somebody sleeps or waits."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __enter__(self) -> _Clock:
        self._patches = [
            patch.object(time, "monotonic", lambda: self.now_s),
            patch.object(time, "sleep", self.sleep),
        ]
        for each in self._patches:
            each.start()
        return self

    def __exit__(self, *_: object) -> None:
        for each in self._patches:
            each.stop()

    def sleep(self, seconds: float) -> None:
        self.now_s += max(seconds, 0.02)


def _beats(within_s: float) -> int:
    """How often an autopilot hears of this computer."""
    with _Clock() as clock:
        output = MagicMock()
        output._ended.is_set = lambda: clock.now_s > 1000.0 + within_s
        output._link.read = lambda: clock.sleep(0.02)
        MavlinkOutput._listen(output)
    return int(output._beat.call_count)


def _is_lost(source: Any, within_s: float) -> bool:
    """Whether a device from which nothing comes has gone after so many seconds, as
    `vio.sources.source` says.
    """
    with _Clock() as clock:
        events: Iterator[Any] = source.events()
        try:
            while clock.now_s < 1000.0 + within_s:
                next(events)
        except DataError:
            return True
    return False


def _oak() -> OakSource:
    source = OakSource.__new__(OakSource)
    source._name = "oak"
    source._dai = MagicMock()
    source._imu = None
    source._images = [SimpleNamespace(tryGetAll=list)] * 2
    return source


def _video_is_lost(reads: int) -> bool:
    source = VideoSource.__new__(VideoSource)
    source._name = "0"
    source._is_file = False
    source._video = MagicMock()
    source._video.grab.return_value = False
    with _Clock():
        events = source.events()
        return _is_refused(lambda: [next(events) for _ in range(reads)])


def _opened_oak(coefficients: list[float], model: str) -> tuple[OakSource, Any]:
    """An OAK of depthai's interface, whose lenses have some coefficients."""
    source = OakSource.__new__(OakSource)
    source._name = "oak"
    source._dai = MagicMock()
    device = source._dai.Device.return_value
    stored = device.readCalibration.return_value
    stored.getCameraIntrinsics.return_value = np.diag([400.0, 400.0, 1.0])
    stored.getImuToCameraExtrinsics.return_value = np.eye(4)
    stored.getCameraExtrinsics.return_value = np.eye(4)
    stored.getDistortionModel.return_value = getattr(source._dai.CameraModel, model)
    stored.getEepromData.return_value.cameraData.__getitem__.return_value.distortionCoeff = (
        coefficients
    )
    source._open(None)
    return source, source._dai.Pipeline.return_value.create.return_value


def test_an_oak_is_asked_for_what_its_sensors_have() -> None:
    """OV9282 and BMI270, by depthai's documentation."""
    source, node = _opened_oak([0.1] * 4, "Perspective")
    output = node.build.return_value.requestOutput
    assert output.call_args.args[0] in {(640, 400), (1280, 720), (1280, 800)}
    assert node.enableIMUSensor.call_args.args[1] in {25, 50, 100, 200, 400}
    assert source.rig is not None
    assert (source.rig.cam0.width, source.rig.cam0.height) == output.call_args.args[0]
    # a camera's usual rate, of which the IMU gives ten samples an image
    assert 10 * output.call_args.kwargs["fps"] == node.enableIMUSensor.call_args.args[1]


@pytest.mark.parametrize("coefficient", [7, 8])
def test_an_oaks_coefficients_are_those_of_the_rational_polynomial(coefficient: int) -> None:
    values = [0.0] * 14
    values[coefficient] = 0.1
    assert _is_refused(lambda: _opened_oak(values, "Perspective")) == (coefficient > 7)


@pytest.mark.parametrize("count", [3, 4])
def test_an_oaks_fisheye_has_four_coefficients(count: int) -> None:
    assert _is_refused(lambda: _opened_oak([0.1] * count, "Fisheye")) == (count < 4)


def test_an_autopilots_line_has_a_usual_rate() -> None:
    with patch("vio.mavlink.link.SerialLink") as link:
        open_link("serial:/dev/ttyTHS1")
    assert hasattr(termios, f"B{link.call_args.args[1]}")


def test_a_realsense_is_asked_for_images_that_it_has() -> None:
    """Infrared images of a D435, by its data sheet."""
    sizes = {
        (1280, 720): (6, 15, 30),
        (848, 480): (6, 15, 30, 60, 90),
        (640, 480): (6, 15, 30, 60, 90),
        (640, 360): (6, 15, 30, 60, 90),
        (480, 270): (6, 15, 30, 60, 90),
        (424, 240): (6, 15, 30, 60, 90),
    }
    source = RealSenseSource.__new__(RealSenseSource)
    source._is_file = False
    source._rs = SimpleNamespace(format=SimpleNamespace(y8=1))
    used = []
    for (width, height), rates in sizes.items():
        for rate in rates:
            profile = MagicMock()
            profile.format.return_value = 1
            video = profile.as_video_stream_profile.return_value
            video.width.return_value = width
            video.height.return_value = height
            video.fps.return_value = rate
            used += [(width, height, rate)] if source._is_usable(profile) else []
    assert len(used) == 1


def _outputs() -> Any:
    odometry = MagicMock()
    odometry.__iter__.return_value = iter(())
    odometry.warnings = ()
    points = np.zeros((30_000, 3))
    odometry.landmarks.return_value = Landmarks(np.arange(30_000), points, np.zeros((30_000, 3, 3)))
    outputs = Outputs(
        MagicMock(),
        odometry,
        MagicMock(gyro=np.zeros(3)),
        frames=FrameNames(),
        prefix="",
        with_tf=False,
    )
    outputs._out = MagicMock()
    return outputs


def _variances(**known: Any) -> FloatArray:
    _, _, covariance = _outputs()._twist(Estimate(0, np.eye(4), np.eye(6), **known))
    return np.diag(covariance)


def _published_points() -> int:
    outputs = _outputs()
    outputs._path = list
    outputs._odometry.figures.configure_mock(
        latency_median_ms=None, latency_95_ms=None, latency_worst_ms=None
    )
    outputs._publish_slowly(0, _estimate(0))
    return len(outputs._out.points.call_args.args[3])


def _published_poses(frames: int) -> int:
    outputs = _outputs()
    outputs._publish_slowly = lambda *_: None
    for k in range(frames):
        outputs._publish(_estimate(k))
    return len(outputs._recent)


def _waits_for_others(seconds: float) -> bool:
    """Whether playing still waits after so many seconds, where one of two topics has a
    subscriber.
    """
    with _Clock() as clock:
        transport = MagicMock()
        transport.subscribers = lambda topic: topic == "left"
        transport.spin = clock.sleep
        _wait_for_subscribers(transport, ["left", "right"], lambda: None, lambda: False)
        return clock.now_s - 1000.0 > seconds


@pytest.mark.parametrize("waits", [False, True])
def test_playing_says_that_it_waits(waits: bool, caplog: pytest.LogCaptureFixture) -> None:
    transport = MagicMock()
    transport.subscribers = lambda topic: not waits
    with caplog.at_level(NOTE):
        _wait_for_subscribers(transport, ["left"], lambda: None, iter([False, True]).__next__)
    assert ("waiting for a subscriber to left; --now" in caplog.text) == waits


def _is_silent(seconds: float) -> bool:
    with _Clock() as clock:
        silence = Silence({"a": "b"})
        clock.now_s += seconds
        transport = MagicMock()
        transport.topics.return_value = {}
        return bool(silence.check({}, transport))


def _sensors() -> Any:
    return Sensors(MagicMock(), SensorTopics("left", "right"), MagicMock(), "reliable")


def _reasons_are_all_named(count: int) -> bool:
    subject = _sensors()
    with patch.object(sensors, "log") as log:
        for k in range(count):
            subject._refuse("left", "x" * (k + 1))
    return bool(log.warning.call_count == count)


def _bands(images: int) -> int:
    """Of how many 16-bit images the levels are looked at."""
    subject = _sensors()
    with (
        patch.object(sensors, "band_of_message", lambda *_, **__: 1),
        patch.object(sensors, "levels_of", len),
    ):
        for _ in range(images):
            levels = subject._gray_levels(None, "", "")
    return int(levels)


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
    "stamps: of a clock": (lambda x: _is_refused(lambda: checked_time(int(x))), 2**61.8, 2**62.2),
    "stamps: jump": (_jump_is_held, 1.8, 2.2),
    "stamps: jump by steps": (lambda x: _jump_is_held(x, 1.0), 4.5, 5.5),
    "stamps: frames": (lambda x: _frames_taken(x) == 20, 450_000, 550_000),
    "stamps: short steps": (lambda n: _frames_taken(1000) < n, 3, 4),
    "stamps: samples": (_samples_fit, 9_000, 11_000),
    "map: request": (lambda x: not _request_fits(x), 60.0, 68.0),
    "map: camera": (_is_another_camera, 0.9e-3, 1.1e-3),
    "autopilot: beats": (lambda x: _beats(x) > 1, 0.9, 1.1),
    "autopilot: beats later": (lambda x: _beats(x) > 5, 4.6, 5.4),
    "oak: lost": (lambda x: _is_lost(_oak(), x), 4.5, 5.5),
    "video: lost": (lambda n: _video_is_lost(int(n)), 50, 51),
    "ROS: unknown": (lambda x: bool(_variances()[0] < x), 0.9e6, 1.1e6),
    "ROS: rates": (
        lambda x: bool(_variances(gyro_bias=np.zeros(3))[3] < x * x),
        0.009,
        0.011,
    ),
    "ROS: points": (lambda n: _published_points() < n, 18_000, 22_000),
    "ROS: path": (lambda n: _published_poses(int(n)) < n, 2000, 2001),
    "ROS: others": (lambda x: not _waits_for_others(x), 0.9, 1.1),
    "ROS: silent": (_is_silent, 4.5, 5.5),
    "ROS: reasons": (lambda n: not _reasons_are_all_named(int(n)), 50, 51),
    "ROS: levels": (lambda n: _bands(int(n)) < n, 8, 9),
    "clock: back": (lambda x: _Step(-round(MS * x), 0).is_back, 450.0, 550.0),
    "clock: ahead": (lambda x: not _Step(20_000 * MS, round(MS * x)).is_ahead, 1800.0, 2200.0),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_live_use(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
