"""The ROS 2 node: over a graph made up in one process, and over DDS with three processes on the
loopback interface.
"""

from __future__ import annotations

import importlib.util
import os
import re
import signal
import subprocess
import sys
import threading
import time
import types
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import vio
from tests.commands import refused
from vio.config import Config
from vio.datasets.bags.cdr import decoded, fields_of
from vio.datasets.bags.topics import COMPRESSED, IMAGE, IMU
from vio.datasets.rigs import load_rig
from vio.errors import DataError, EstimationError, MissingDependencyError
from vio.files.trajectories import read_trajectory
from vio.findings import Integrity
from vio.geometry.lie import FloatArray, rotation_from_quat_xyzw
from vio.live.live_odometry import LiveOdometry
from vio.live.pairing import Pairing
from vio.records import Estimate, ImuSample
from vio.ros2.node import NodeSettings, run_node
from vio.ros2.opening import open_transport
from vio.ros2.outputs import FrameNames, Outputs
from vio.ros2.play import Playing, play
from vio.ros2.sensors import Sensors, SensorTopics, Silence, _Step, check_types
from vio.ros2.transport import Quality, publisher
from vio.runs.finished import read_finished_run
from vio.runs.live_folder import LiveRunSettings

TOPICS = SensorTopics("/cam0/image_raw", "/cam1/image_raw", "/imu0")
IMAGES_ALONE = replace(Config(), motion="none")
# Without multicast, which a machine without a network may lack.
LOOPBACK = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address="localhost"/></Peers></Discovery></Domain></CycloneDDS>"""


class Graph:
    """A ROS 2 graph within the process: every message reaches all who subscribed before."""

    def __init__(self) -> None:
        self.takers: dict[str, list[tuple[Member, Callable[[bytes], None]]]] = {}
        self.kinds: dict[str, set[str]] = {}
        self.last: dict[str, bytes] = {}  # of latched topics


class Member:
    """A participant, see `Transport`."""

    def __init__(self, graph: Graph) -> None:
        self._graph, self._come, self._changed = (
            graph,
            list[tuple[Any, bytes]](),
            threading.Condition(),
        )

    def subscribe(
        self, topic: str, kind: str, take: Callable[[bytes], None], quality: Quality
    ) -> None:
        self._graph.takers.setdefault(topic, []).append((self, take))
        if quality == "latched" and topic in self._graph.last:
            self.hand(take, self._graph.last[topic])

    def advertise(self, topic: str, kind: str, quality: Quality) -> Callable[[bytes], None]:
        self._graph.kinds.setdefault(topic, set()).add(kind)

        def publish(data: bytes) -> None:
            if quality == "latched":
                self._graph.last[topic] = data
            for member, take in list(self._graph.takers.get(topic, [])):
                member.hand(take, data)

        return publish

    def hand(self, take: Callable[[bytes], None], data: bytes) -> None:
        with self._changed:
            self._come.append((take, data))
            self._changed.notify()

    def subscribers(self, topic: str) -> int:
        return len(self._graph.takers.get(topic, []))

    def topics(self) -> Mapping[str, frozenset[str]]:
        return {name: frozenset(kinds) for name, kinds in self._graph.kinds.items()}

    def spin(self, timeout_s: float) -> None:
        with self._changed:
            if not self._come:
                self._changed.wait(timeout_s)
            come, self._come = self._come, []
        for take, data in come:
            take(data)

    def close(self) -> None:
        pass


def _pose(data: bytes) -> tuple[int, FloatArray]:
    fields: Any = decoded(data, "nav_msgs/msg/Odometry", "odometry")
    p, q, stamp = fields.pose.pose.position, fields.pose.pose.orientation, fields.header.stamp
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_quat_xyzw(np.array([q.x, q.y, q.z, q.w])), [p.x, p.y, p.z]
    return stamp.sec * 10**9 + stamp.nanosec, T


def _file_run(flight: Path) -> tuple[list[int], FloatArray]:
    trajectory = vio.run(vio.open_dataset(flight), Config()).trajectory
    return trajectory.times_ns.tolist(), trajectory.T_world_body


@pytest.mark.parametrize("calibrated", [True, False])
def test_the_node_gives_the_poses_of_the_file_run(
    flight: Path, tmp_path: Path, calibrated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its calibration file to the bit; by CameraInfo, whose baseline is rounded, nearly so."""
    monkeypatch.setattr("vio.ros2.outputs._SLOW_NS", 200_000_000)
    graph, taken, done = Graph(), dict[str, list[bytes]](), threading.Event()
    published = ("odometry", "path", "landmarks")
    topics = [*(f"/vio/{name}" for name in published), "/tf", "/diagnostics"]
    receiver = Member(graph)
    for topic in topics:
        receiver.subscribe(topic, "", taken.setdefault(topic, []).append, "reliable")
    kept = LiveRunSettings(tmp_path / "out", "/cam0/image_raw", waits=True)
    settings = NodeSettings(TOPICS, quality="reliable", drop="block", kept=kept)
    times, poses = _file_run(flight)
    failures: list[Exception] = []

    def node() -> None:
        try:
            rig = load_rig(flight) if calibrated else None
            run_node(
                Member(graph), settings, Config(), rig, should_stop=done.is_set, say=lambda _: None
            )
        except Exception as error:  # noqa: BLE001 # shown by the main thread
            failures.append(error)

    thread = threading.Thread(target=node)
    thread.start()
    played = play(
        Member(graph),
        vio.open_dataset(flight),
        TOPICS,
        Playing(None, "reliable"),
        lambda: failures,
    )
    assert played.frames == len(times)
    while len(taken["/vio/odometry"]) < len(times) and not failures:
        receiver.spin(0.1)
    publisher(Member(graph), {}).empty("/vio/save")
    deadline = time.monotonic() + 60
    while not (tmp_path / "out" / "trajectory.tum").is_file() and time.monotonic() < deadline:
        time.sleep(0.01)
    saved = (tmp_path / "out" / "trajectory.tum").is_file()
    done.set()
    thread.join()
    receiver.spin(0.0)
    assert saved  # before the end
    assert failures == []
    received = [_pose(data) for data in taken["/vio/odometry"]]
    assert [t for t, _ in received] == times
    tolerance = 0.0 if calibrated else 1e-4
    np.testing.assert_allclose(
        [T[:3, 3] for _, T in received], poses[:, :3, 3], rtol=0, atol=tolerance
    )
    np.testing.assert_allclose([T for _, T in received], poses, rtol=0, atol=tolerance + 1e-12)
    moved: Any = decoded(taken["/tf"][-1], "tf2_msgs/msg/TFMessage", "tf")
    assert (moved.transforms[0].header.frame_id, moved.transforms[0].child_frame_id) == (
        "odom",
        "base_link",
    )
    cloud: Any = decoded(taken["/vio/landmarks"][-1], "sensor_msgs/msg/PointCloud2", "points")
    assert cloud.width > 10
    status: Any = decoded(taken["/diagnostics"][-1], "diagnostic_msgs/msg/DiagnosticArray", "d")
    assert {v.key: v.value for v in status.status[0].values}["dropped"] == "0"
    twist = decoded(taken["/vio/odometry"][-1], "nav_msgs/msg/Odometry", "o").twist
    assert 0 < twist.covariance[0] < 1
    run = read_finished_run(tmp_path / "out")
    assert run.metrics["complete"]
    np.testing.assert_allclose(run.estimates["T_world_imu"], poses, rtol=0, atol=tolerance)
    assert len(run.points) > 10
    assert (tmp_path / "out" / "camchain-imucam.yaml").is_file()


# Messages into the odometry


class Taken:
    """Stands in for the odometry: notes what is added."""

    def __init__(self) -> None:
        self.pairs: list[tuple[int, Any, Any]] = []
        self.samples: list[int] = []
        self.resets = 0

    def add_stereo(self, time_ns: int, left: Any, right: Any) -> None:
        self.pairs.append((time_ns, left, right))

    def add_imu(self, time_ns: int, gyro: Any, accel: Any) -> None:
        if not np.isfinite(gyro).all():
            raise DataError(f"gyro at {time_ns} ns is not finite")
        self.samples.append(time_ns)

    def reset(self) -> None:
        self.resets += 1

    def check(self) -> None:
        """Has not failed."""


def _sent(graph: Graph, topics: SensorTopics = TOPICS) -> tuple[Taken, Sensors, Member]:
    taken, member = Taken(), Member(graph)
    return taken, Sensors(member, topics, taken, "reliable"), member  # type: ignore[arg-type]


def _send(graph: Graph, topic: str, time_ns: int, encoding: str, pixels: Any) -> None:
    """Publish an image message of any encoding; of jpeg and png, a compressed one."""
    out = publisher(Member(graph), {})
    if encoding in ("jpeg", "png"):
        coded = cv2.imencode(f".{encoding}", pixels)[1]
        out._put(topic, time_ns, COMPRESSED, "cam", encoding, coded)
        return
    rows = np.ascontiguousarray(pixels)
    step = rows.strides[0]
    data = rows.reshape(-1).view(np.uint8)
    out._put(topic, time_ns, IMAGE, "cam", *rows.shape[:2], encoding, 0, step, data)


GRAY = np.random.default_rng(0).integers(0, 256, (12, 16), dtype=np.uint8)
FITTING = np.zeros((90, 160), dtype=np.uint8)  # of the size of the rendered flight
SMOOTH = np.tile(np.arange(16, dtype=np.uint8) * 8, (16, 1))


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("mono8", GRAY, GRAY),
        ("bgr8", np.dstack([GRAY] * 3), GRAY),
        ("rgb8", np.dstack([GRAY] * 3), GRAY),
        ("mono16", GRAY.astype(np.uint16) * 16, GRAY),  # twelve bits in sixteen
        ("png", GRAY, GRAY),
        ("jpeg", SMOOTH, SMOOTH),
    ],
)
def test_images_of_all_encodings_are_paired(encoding: str, pixels: Any, expected: Any) -> None:
    graph = Graph()
    suffix = "/compressed" if encoding in ("png", "jpeg") else ""
    topics = SensorTopics(f"/l{suffix}", f"/r{suffix}")
    taken, sensors, member = _sent(graph, topics)
    for k in range(2):
        if k:
            _send(graph, topics.left, 10**9 + k, encoding, pixels)
        _send(graph, topics.cameras[1], 10**9 + 1 + k * 10**8, encoding, pixels)
    member.spin(0.0)
    ((time_ns, left, right),) = taken.pairs
    assert time_ns == 10**9 + 1
    tolerance = 3 if encoding == "jpeg" else 1 if encoding == "mono16" else 0
    for image in (left, right):
        assert np.abs(image.astype(int) - expected).max() <= tolerance
    assert sensors.refused == 0


def test_stamps_that_go_back_begin_anew_or_are_refused(caplog: pytest.LogCaptureFixture) -> None:
    graph = Graph()
    taken, sensors, member = _sent(graph)
    out = publisher(Member(graph), {})
    for time_ns in (
        10**10,
        10**10 + 5,
        10**10 + 5,
        10**10 + 3,
        10**9,
        10**10 + 8,
        10**9,
        10**9 + 7,
    ):
        out.imu("/imu0", "imu", ImuSample(time_ns, np.zeros(3), np.ones(3)))
    out.imu("/imu0", "imu", ImuSample(10**9 + 9, np.full(3, np.nan), np.ones(3)))
    member.spin(0.0)
    assert taken.samples == [10**10, 10**10 + 5, 10**10 + 8, 10**9 + 7]
    assert (taken.resets, sensors.refused) == (1, 5)
    assert "the stamps went back by 9.0 s" in caplog.text
    _send(graph, "/cam0/image_raw", 10**9, "mono8", GRAY)
    _send(graph, "/cam0/image_raw", 10**9 + 1, "bgr8", GRAY)  # truncated: a third of its bytes
    member.spin(0.0)
    assert sensors.refused == 6


def test_one_stamp_far_ahead_begins_nothing_anew() -> None:
    graph = Graph()
    taken, sensors, member = _sent(graph)
    out = publisher(Member(graph), {})
    for time_ns in (10**9, 10**9 + 5, 10**11, 10**9 + 10, 10**9 + 15):
        out.imu("/imu0", "imu", ImuSample(time_ns, np.zeros(3), np.ones(3)))
    member.spin(0.0)
    assert taken.samples == [10**9, 10**9 + 5, 10**9 + 10, 10**9 + 15]
    assert (taken.resets, sensors.refused) == (0, 1)


@pytest.mark.parametrize(("passed_s", "resets"), [(0.1, 1), (60.0, 0)])
def test_a_clock_that_is_set_begins_anew_and_a_gap_does_not(
    passed_s: float, resets: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A minute between two stamps: the time that has passed tells which of the two it is."""
    clock = [100.0]
    monkeypatch.setattr("vio.ros2.sensors.time.monotonic", lambda: clock[0])
    graph = Graph()
    taken, sensors, member = _sent(graph)
    out = publisher(Member(graph), {})
    step_ns = 60 * 10**9
    for k, time_ns in enumerate((10**9, 10**9 + 5, step_ns, step_ns + 5, step_ns + 10)):
        clock[0] += passed_s if k == 2 else 0.0
        out.imu("/imu0", "imu", ImuSample(time_ns, np.zeros(3), np.ones(3)))
        member.spin(0.0)
    kept = [step_ns] if resets == 0 else []
    assert taken.samples == [10**9, 10**9 + 5, *kept, step_ns + 5, step_ns + 10]
    assert (taken.resets, sensors.refused) == (resets, resets)
    assert ("the stamps went ahead by 59.0 s at once" in caplog.text) == (resets == 1)


def test_one_stamp_a_little_ahead_costs_the_frames_up_to_it(flight: Path) -> None:
    graph = Graph()
    image = np.zeros((90, 160), dtype=np.uint8)
    with LiveOdometry(load_rig(flight), Config()) as odometry:
        member = Member(graph)
        sensors = Sensors(member, TOPICS, odometry, "reliable")
        for ms in (1000, 1050, 1100, 2150, 1200):
            for topic in TOPICS.cameras:
                _send(graph, topic, ms * 10**6, "mono8", image)
            member.spin(0.0)
    assert sensors.refused == 1


@pytest.mark.parametrize("what", ["reset", "clock"])
def test_the_node_goes_on_after_a_reset_and_after_a_step_of_the_clock(
    flight: Path, tmp_path: Path, what: str
) -> None:
    graph, taken, done = Graph(), list[bytes](), threading.Event()
    receiver, player, asks = Member(graph), Member(graph), Member(graph)
    receiver.subscribe("/vio/odometry", "", taken.append, "reliable")
    kept = LiveRunSettings(tmp_path / "out", "/cam0/image_raw", waits=True)
    settings = NodeSettings(TOPICS, quality="reliable", drop="block", kept=kept)
    node = threading.Thread(
        target=run_node,
        args=(Member(graph), settings, Config(), load_rig(flight)),
        kwargs={"should_stop": done.is_set, "say": lambda _: None},
    )
    node.start()
    dataset = vio.open_dataset(flight)
    play(player, dataset, TOPICS, Playing(None, "reliable", stop=8), lambda: False)

    def received(count: int) -> list[tuple[int, FloatArray]]:
        deadline = time.monotonic() + 60
        while len(taken) < count and time.monotonic() < deadline:
            receiver.spin(0.1)
        return [_pose(data) for data in taken]

    before = received(7)  # the last one waits for a sample after it
    step_ns = 0
    if what == "reset":
        publisher(asks, {}).empty("/vio/reset")
    else:
        step_ns = 3600 * 10**9
    moved = Shifted(dataset, step_ns)
    play(player, moved, TOPICS, Playing(None, "reliable", wait=False), lambda: False)
    poses = received(len(before) + 7)
    done.set()
    node.join()
    first_ns = int(dataset.recording.frame_times_ns[8]) + step_ns
    poses = [pose for pose in poses if pose[0] >= first_ns]
    assert len(poses) >= 6
    folder = tmp_path / "out-2"
    assert read_finished_run(folder).metrics["complete"]
    saved = read_trajectory(folder / "trajectory.tum")
    assert saved.times_ns is not None
    # a new trajectory, from the origin
    np.testing.assert_allclose(poses[0][1][:3, 3], 0.0, atol=1e-9)
    assert saved.times_ns[0] == poses[0][0]


class Shifted:
    """The second half of a recording, at later times."""

    def __init__(self, dataset: Any, step_ns: int) -> None:
        self._dataset, self._step_ns, self.recording = dataset, step_ns, dataset.recording

    def events(self, start: int = 0, stop: int | None = None) -> Any:
        first_ns = int(self.recording.frame_times_ns[8])
        for event in self._dataset.events(8):
            if event.time_ns > first_ns - 40_000_000:
                yield replace(event, time_ns=event.time_ns + self._step_ns)


def test_pairs_are_made_of_near_stamps() -> None:
    pairing: Pairing[str] = Pairing()
    assert pairing.add(0, 0, "l0") is None
    assert pairing.add(0, 50_000_000, "l1") is None
    assert pairing.add(1, 52_000_000, "r1") == (50_000_000, "l1", "r1")
    assert pairing.add(1, 100_000_000, "r2") is None
    assert pairing.add(0, 100_000_000, "l2") == (100_000_000, "l2", "r2")
    assert pairing.alone == 1  # l0
    for k in range(20):
        assert pairing.add(1, 10**9 * (k + 1), "r") is None
    assert pairing.alone == 11


@pytest.mark.parametrize("lost", [0, 1])
@pytest.mark.parametrize("first", [0, 1])
def test_a_lost_image_costs_its_own_pair_only(lost: int, first: int) -> None:
    """ROS's own synchronizer in Python pairs images of two frames from there on (F60)."""
    pairing: Pairing[int] = Pairing()
    pairs = []
    for k in range(10):
        for side in (first, 1 - first):
            if (side, k) != (lost, 3):
                pairs.append(pairing.add(side, 50_000_000 * k, k))
    assert [pair for pair in pairs if pair] == [(50_000_000 * k, k, k) for k in range(10) if k != 3]
    assert pairing.alone == 1


def test_images_of_another_size_are_left_out_by_name(
    flight: Path, caplog: pytest.LogCaptureFixture
) -> None:
    graph = Graph()
    with LiveOdometry(load_rig(flight), Config()) as odometry:
        member = Member(graph)
        sensors = Sensors(member, TOPICS, odometry, "reliable")
        for time_ns, image in ((10**9, GRAY), (2 * 10**9, GRAY), (3 * 10**9, FITTING)):
            for topic in TOPICS.cameras:
                _send(graph, topic, time_ns, "mono8", image)
        member.spin(0.0)
        assert odometry.inputs._count == 1
    assert sensors.refused == 2
    assert caplog.text.count("left image is 16x12, but the calibration is for 160x90") == 1


def _random_message(size: int) -> bytes:
    return b"\x00\x01\x00\x00" + np.random.default_rng(size).bytes(size)


UNUSABLE: dict[str, tuple[str, bytes, str]] = {
    "nothing": ("/cam0/image_raw", b"", "truncated or of another type"),
    "a header": ("/imu0", b"\x00\x01\x00\x00", "truncated or of another type"),
    "noise for an IMU": ("/imu0", _random_message(37), "truncated or of another type"),
    "noise for an image": ("/cam0/image_raw", _random_message(60), "/cam0/image_raw"),
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_a_message_that_cannot_be_read_is_left_out_by_name(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    topic, data, said = UNUSABLE[name]
    graph = Graph()
    taken, sensors, member = _sent(graph)
    publish = Member(graph).advertise(topic, TOPICS.kinds[topic], "reliable")
    for _ in range(3):
        publish(data)
    publisher(Member(graph), {}).imu("/imu0", "imu", ImuSample(10**9, np.zeros(3), np.ones(3)))
    member.spin(0.0)
    assert sensors.refused == 3
    assert taken.samples == [10**9]
    assert len(caplog.records) == 1
    assert said in caplog.text
    assert "bag" not in caplog.text


@pytest.mark.parametrize(("encoding", "shape"), [("32FC1", (12, 16)), ("mono8", (0, 0))])
def test_an_image_that_is_not_read_is_left_out_by_name(
    encoding: str, shape: tuple[int, int], caplog: pytest.LogCaptureFixture
) -> None:
    graph = Graph()
    taken, sensors, member = _sent(graph)
    kind = np.float32 if encoding == "32FC1" else np.uint8
    out = publisher(Member(graph), {})
    data = np.zeros(shape, dtype=kind)
    for k in range(2):
        step = shape[1] * data.itemsize
        fields = ("cam", *shape, encoding, 0, step, data.reshape(-1).view(np.uint8))
        out._put("/cam0/image_raw", 10**9 + k, IMAGE, *fields)
    member.spin(0.0)
    assert sensors.refused == 2
    assert taken.pairs == []
    assert len(caplog.records) == 1


def test_the_fault_of_the_odometry_is_no_message_s() -> None:
    class Failed(Taken):
        def add_imu(self, time_ns: int, gyro: Any, accel: Any) -> None:
            raise EstimationError("lost")

        def check(self) -> None:
            raise EstimationError("lost")

    graph = Graph()
    member = Member(graph)
    Sensors(member, TOPICS, Failed(), "reliable")  # type: ignore[arg-type]
    publisher(Member(graph), {}).imu("/imu0", "imu", ImuSample(10**9, np.zeros(3), np.ones(3)))
    with pytest.raises(EstimationError, match="lost"):
        member.spin(0.0)


@pytest.mark.parametrize(("word", "level"), [("nominal", 0), ("degraded", 1), ("unusable", 2)])
def test_diagnostics_have_the_integrity_of_the_estimate(
    word: Integrity, level: int, flight: Path
) -> None:
    graph = Graph()
    receiver = Member(graph)
    taken: list[bytes] = []
    receiver.subscribe("/diagnostics", "", taken.append, "reliable")
    rig = load_rig(flight)
    findings = () if word == "nominal" else ("images-frozen",)
    with LiveOdometry(rig, Config(), drop="block") as odometry:
        member = Member(graph)
        sensors = Sensors(member, TOPICS, odometry, "reliable")
        outputs = Outputs(
            member, odometry, sensors, frames=FrameNames(), prefix="/vio", with_tf=False
        )
        estimate = Estimate(10**9, np.eye(4), np.eye(6), integrity=word, findings=findings)
        for stream in odometry._streams.read():
            stream.put(estimate)
        while not taken:
            receiver.spin(0.1)
    outputs.finish()
    status: Any = decoded(taken[0], "diagnostic_msgs/msg/DiagnosticArray", "d").status[0]
    level_of_status = status.level
    assert (
        int(level_of_status[0] if isinstance(level_of_status, bytes) else level_of_status) == level
    )
    values = {v.key: v.value for v in status.values}
    assert values["integrity"] == word
    assert values["findings"] == ", ".join(findings)


def test_silent_unknown_and_wrong_topics_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("vio.ros2.sensors.time.monotonic", lambda: clock[0])
    graph = Graph()
    member = Member(graph)
    member.advertise("/imu0", IMU, "sensor")
    member.advertise("/camera/image_raw", IMAGE, "sensor")
    silence, received = Silence(TOPICS.kinds), dict.fromkeys(TOPICS.kinds, 0)
    assert silence.check(received, member) == []
    clock[0], received["/cam1/image_raw"] = 6.0, 3
    left, imu = silence.check(received, member)
    assert left == (
        "no message on /cam0/image_raw for 5 s: nobody publishes it; topics of its type are "
        "/camera/image_raw"
    )
    assert (
        "/imu0 for 5 s: its publisher sends nothing, or cannot be reached; check the driver" in imu
    )
    assert silence.check(received, member) == []  # once
    clock[0] = 12.0
    assert [
        "its publisher" in line or "nobody" in line for line in silence.check(received, member)
    ] == [True]
    member.advertise("/cam0/image_raw", COMPRESSED, "sensor")
    with pytest.raises(
        DataError, match=r"/cam0/image_raw has sensor_msgs/msg/CompressedImage, not sensor_msgs"
    ):
        check_types(TOPICS.kinds, member)


# The command line and the ways to the graph


def test_the_ways_to_the_graph_import_no_one_that_imports_them() -> None:
    """Also inside of functions."""
    folder = Path(vio.__file__).parent / "ros2"
    imports: dict[str, set[str]] = {}
    for file in folder.glob("*.py"):
        text = file.read_text(encoding="utf-8")
        imports[file.stem] = set(re.findall(r"^ *from vio\.ros2\.(\w+) import", text, re.MULTILINE))
    assert imports["opening"] == {"transport", "dds", "rclpy_transport"}
    while free := [name for name, others in imports.items() if not others & imports.keys()]:
        for name in free:
            del imports[name]
    assert imports == {}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["ros2", "--left", "/a"], "one camera needs an IMU"),
        (["ros2", "--left", "/a", "--right", "/b", "--localise"], "--localise needs --map"),
        (["ros2", "--left", "/a", "--right", "/b", "--frames", "map"], "give three names"),
        (
            ["ros2", "--left", "/a", "--right", "/b", "--calibration", "nowhere"],
            "nowhere does not exist",
        ),
        (["play", "nowhere", "--ros2", "--rate", "0"], "--rate 0: give a positive number, or max"),
        (["play", "nowhere", "--ros2", "--rate", "x"], "--rate x: give a number, or max"),
    ],
)
def test_wrong_arguments_are_named_in_one_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    error = refused(capsys, *arguments)
    assert message in error


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    hidden = ("cyclonedds", "rclpy")
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name, *a: None if name in hidden else find(name, *a)
    )
    with pytest.raises(MissingDependencyError, match=r"extra ros2: .* '\.\[ros2\]' in a clone"):
        open_transport()


def test_the_way_by_rclpy_passes_messages_as_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a stand-in with the signatures of rclpy's reference: ROS itself is not installed
    here.
    """
    made: dict[str, Any] = {"subscriptions": [], "published": []}

    class Publisher:
        def publish(self, message: bytes) -> None:
            made["published"].append(message)

        def get_subscription_count(self) -> int:
            return 2

    class Node:
        def get_name(self) -> str:
            return "vio"

        def create_subscription(
            self, kind: Any, topic: str, callback: Any, qos: Any, *, raw: bool = False
        ) -> None:
            made["subscriptions"].append((kind, topic, callback, qos, raw))

        def create_publisher(self, kind: Any, topic: str, qos: Any) -> Publisher:
            return Publisher()

        def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
            return [("/a", ["std_msgs/msg/Empty"]), ("/vio/odometry", ["nav_msgs/msg/Odometry"])]

        def get_publishers_info_by_topic(self, name: str) -> list[Any]:
            return [types.SimpleNamespace(node_name="vio" if name.startswith("/vio") else "other")]

        def destroy_node(self) -> None:
            made["destroyed"] = True

    class Executor:
        def __init__(self, *, context: Any) -> None: ...

        def add_node(self, node: Any) -> None: ...

        def spin_once(self, timeout_sec: float) -> None:
            made["subscriptions"][0][2](b"cdr")

        def shutdown(self) -> None: ...

    policies = types.SimpleNamespace(KEEP_LAST=1, BEST_EFFORT=2, RELIABLE=3, TRANSIENT_LOCAL=4)
    modules = {
        "rclpy": {
            "init": lambda *, context, domain_id, signal_handler_options: made.update(
                domain=domain_id
            ),
            "create_node": lambda name, *, context: Node(),
            "shutdown": lambda *, context: made.update(shut=True),
        },
        "rclpy.context": {"Context": object},
        "rclpy.executors": {"SingleThreadedExecutor": Executor},
        "rclpy.qos": {
            **dict.fromkeys(("DurabilityPolicy", "HistoryPolicy", "ReliabilityPolicy"), policies),
            "QoSProfile": dict,
        },
        "rclpy.signals": {"SignalHandlerOptions": types.SimpleNamespace(NO=0)},
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {"get_message": lambda kind: kind},
    }
    for name, content in modules.items():
        module = types.ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "vio.ros2.rclpy_transport", raising=False)
    transport = open_transport("rclpy", 7)
    got: list[bytes] = []
    transport.subscribe("/a", "std_msgs/msg/Empty", got.append, "sensor")
    publish = transport.advertise("/b", "std_msgs/msg/Empty", "latched")
    publish(b"data")
    transport.spin(0.1)
    assert got == [b"cdr"]
    assert made["published"] == [b"data"]
    assert made["subscriptions"][0][3]["reliability"] == policies.BEST_EFFORT
    assert made["subscriptions"][0][4] is True
    assert transport.subscribers("/b") == 2
    assert transport.topics() == {"/a": frozenset({"std_msgs/msg/Empty"})}
    transport.close()
    assert made["domain"] == 7
    assert made["shut"]
    assert made["destroyed"]
    monkeypatch.delitem(sys.modules, "vio.ros2.rclpy_transport")


# DDS

needs_dds = pytest.mark.skipif(
    importlib.util.find_spec("cyclonedds") is None, reason="cyclonedds is not installed"
)
needs_loopback = pytest.mark.skipif(
    not Path("/sys/class/net/lo").exists(), reason="no interface named lo"
)


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """A graph of its own for each process that runs tests."""
    number = 20 + os.getpid() % 180
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    return number


@needs_dds
@needs_loopback
def test_messages_pass_over_dds_and_late_ones_get_the_last(domain: int) -> None:
    a, b = open_transport("dds"), open_transport("dds", domain)
    out = publisher(a, {"/cam0/image_raw": IMAGE})
    out.static_transforms(5, [("imu", "cam0", np.eye(4))])
    images: list[bytes] = []
    frames: list[bytes] = []
    b.subscribe("/cam0/image_raw", IMAGE, images.append, "reliable")
    b.subscribe("/tf_static", "tf2_msgs/msg/TFMessage", frames.append, "latched")
    deadline = time.monotonic() + 60
    while not a.subscribers("/cam0/image_raw") and time.monotonic() < deadline:
        b.spin(0.05)
    picture = np.random.default_rng(1).integers(0, 255, (480, 752), dtype=np.uint8)
    for k in range(3):
        out.image("/cam0/image_raw", "cam0", k, picture)
    while (len(images) < 3 or not frames) and time.monotonic() < deadline:
        b.spin(0.05)
    np.testing.assert_array_equal(decoded(images[2], IMAGE, "i").data.reshape(480, 752), picture)
    assert len(frames) == 1
    assert b.topics()["/cam0/image_raw"] == {IMAGE}
    assert "/cam0/image_raw" not in a.topics()
    a.close()
    b.close()
    assert [(f.name, f.kind, f.many) for f in fields_of(IMAGE)][-1] == ("data", "uint8", "sequence")


@pytest.mark.slow
@needs_dds
@needs_loopback
def test_three_processes_give_the_poses_of_the_file_run(
    flight: Path, domain: int, tmp_path: Path
) -> None:
    """Recording, node and this process, which receives; nothing is lost, and the poses are equal
    to the bit.
    """
    times, poses = _file_run(flight)
    receiver, taken = open_transport("dds"), list[bytes]()
    receiver.subscribe("/vio/odometry", "nav_msgs/msg/Odometry", taken.append, "reliable")
    command = [sys.executable, "-m", "vio"]
    arguments = [
        "--left",
        TOPICS.left,
        "--right",
        str(TOPICS.right),
        "--imu",
        str(TOPICS.imu),
        "--reliable",
    ]
    kept = ["--out", str(tmp_path / "out"), "--save-observations"]
    node = subprocess.Popen(
        [*command, "ros2", *arguments, *kept, "--calibration", str(flight), "--drop", "block"],
        stderr=subprocess.PIPE,
    )
    try:
        source = subprocess.run(
            [*command, "play", str(flight), "--ros2", "--reliable", "--rate", "max"], check=True
        )
        assert source.returncode == 0
        deadline = time.monotonic() + 240
        while len(taken) < len(times) and time.monotonic() < deadline:
            receiver.spin(0.2)
        # SIGINT is ignored where a shell started the tests behind it
        node.send_signal(signal.SIGTERM)
        assert node.wait(timeout=60) == 0
    finally:
        receiver.close()
        node.kill()
        node.communicate()
    received = [_pose(data) for data in taken]
    assert [t for t, _ in received] == times
    np.testing.assert_array_equal([T[:3, 3] for _, T in received], poses[:, :3, 3])
    run = read_finished_run(tmp_path / "out")
    np.testing.assert_array_equal(run.estimates["T_world_imu"], poses)
    assert run.metrics["complete"]
    again = vio.run(vio.open_dataset(tmp_path / "out" / "observations.npz"), Config())
    np.testing.assert_array_equal(again.trajectory.T_world_body, poses)


@pytest.mark.slow
@needs_dds
@needs_loopback
def test_a_node_that_is_killed_leaves_a_folder_that_can_be_finished(
    flight: Path, domain: int, tmp_path: Path
) -> None:
    """By SIGKILL, while the recording is played to it again and again until it has written a
    checkpoint and some poses, which a busy machine does later.
    """
    out = tmp_path / "out"
    checkpoint = out / "unfinished" / "checkpoint"
    written = out / "trajectory.tum"

    def is_written() -> bool:
        return checkpoint.is_file() and len(written.read_text().splitlines()) > 20

    command = [sys.executable, "-m", "vio"]
    arguments = ["--left", TOPICS.left, "--right", str(TOPICS.right), "--imu", str(TOPICS.imu)]
    node = subprocess.Popen(
        [*command, "ros2", *arguments, "--reliable", "--calibration", str(flight), "--out", out],
        stderr=subprocess.DEVNULL,
    )
    player = open_transport("dds")
    try:
        play(
            player,
            Repeated(vio.open_dataset(flight), 200),
            TOPICS,
            Playing(1.0, "reliable"),
            is_written,
        )
        assert is_written()
        time.sleep(1.0)
        node.kill()
        node.wait()
    finally:
        player.close()
        node.kill()
    poses = read_trajectory(out / "trajectory.tum")
    assert len(poses) > 10
    subprocess.run([*command, "run", "--resume", out, "--quiet"], check=True)
    run = read_finished_run(out)
    assert run.metrics["stopped"] == "the program was ended"
    assert len(run.trajectory) > 10
    subprocess.run([*command, "report", out], check=True, stdout=subprocess.DEVNULL)


class Repeated:
    """A recording several times, a second later each time."""

    def __init__(self, dataset: Any, times: int) -> None:
        self._dataset = dataset
        self._times = times
        self.recording = dataset.recording

    def events(self, start: int = 0, stop: int | None = None) -> Any:
        for k in range(self._times):
            for event in self._dataset.events(start, stop):
                yield replace(event, time_ns=event.time_ns + k * 10**9)


def test_the_files_for_colcon_name_the_command() -> None:
    folder = Path(__file__).resolve().parents[2] / "ros2" / "stereo_vio"
    launch = (folder / "launch" / "stereo_vio.launch.py").read_text(encoding="utf-8")
    compile(launch, "launch", "exec")
    options = {f"--{name}" for name in re.findall(r'^    "(\w+)": ', launch, re.MULTILINE)} | {
        "--transport"
    }
    text = (Path(vio.__file__).parent / "cli" / "ros2.py").read_text(encoding="utf-8")
    shared = text + (Path(vio.__file__).parent / "cli" / "play.py").read_text(encoding="utf-8")
    assert len(options) == 6
    assert all(f'"{option}"' in shared for option in options)
    assert "<name>stereo_vio</name>" in (folder / "package.xml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("stamped_s", "arrived_s", "back", "ahead"),
    [
        (-0.45, 0.05, False, False),
        (-0.55, 0.05, True, False),
        (4.5, 0.05, False, False),
        (5.5, 0.05, False, True),
        (10.0, 0.9, False, True),
        (10.0, 1.1, False, False),  # a bag that is played ten times as fast
    ],
)
def test_a_stamp_far_from_the_last_one_begins_anew(
    stamped_s: float, arrived_s: float, back: bool, ahead: bool
) -> None:
    step = _Step(round(stamped_s * 1e9), round(arrived_s * 1e9))
    assert (step.is_back, step.is_ahead) == (back, ahead)
