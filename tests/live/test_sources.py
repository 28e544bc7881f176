"""Live sources: videos by OpenCV, a RealSense made by its library, and recordings that repeat
the run to the bit.
"""

from __future__ import annotations

import errno
import functools
import http.server
import itertools
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import cv2
import numpy as np
import pytest

import vio
from tests.same_events import frames_of
from vio.cameras.rig import Rig
from vio.cli import main
from vio.config import Config
from vio.datasets.bags.sdk_stamps import sdk_stamps
from vio.datasets.kitti import write_calibration
from vio.datasets.rigs import load_rig
from vio.datasets.rigs.kalibr import kalibr_text
from vio.datasets.settings import DatasetSettings
from vio.errors import ConfigError, DataError, MissingDependencyError
from vio.files.trajectories import read_trajectory
from vio.geometry.distortion import project_point
from vio.imu.two_sensors import joined_record
from vio.records import ImuSample, StereoFrame
from vio.runs.live_folder import LiveRunSettings
from vio.sources.oak import OakSource
from vio.sources.realsense import RealSenseSource
from vio.sources.recorder import Form, Recorder
from vio.sources.run import LiveOptions, run_source
from vio.sources.source import (
    ImuInterpolation,
    Layout,
    SourceEvent,
    SourceFrame,
    layout_hint,
    open_source,
)


@pytest.fixture(scope="module")
def pairs(flight: Path) -> list[StereoFrame]:
    return frames_of(vio.open_dataset(flight))


@pytest.fixture(scope="module")
def video(pairs: list[StereoFrame], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The images of a flight side by side, without loss."""
    path = tmp_path_factory.mktemp("video") / "pair.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 20.0, (320, 90))
    for pair in pairs:
        writer.write(np.dstack([np.hstack([pair.left, pair.right])] * 3))
    writer.release()
    return path


def test_a_video_gives_the_images_side_by_side(video: Path, pairs: list[StereoFrame]) -> None:
    source = open_source(f"video:{video}")
    frames = [event for event in source.events() if isinstance(event, SourceFrame)]
    source.close()
    assert (source.rig, source.has_imu) == (None, False)
    assert len(frames) == len(pairs)
    assert {b.time_ns - a.time_ns for a, b in itertools.pairwise(frames)} == {50_000_000}
    for frame, pair in zip(frames, pairs, strict=True):
        for image, expected in ((frame.left, pair.left), (frame.right, pair.right)):
            assert np.abs(image.astype(int) - expected).max() <= 1  # of the way through colour
    (single, *_) = open_source(f"video:{video}", "single").events()
    assert (single.left.shape, single.right) == ((90, 320), None)
    (halved, *_) = open_source(f"video:{video}", "top-bottom").events()
    assert halved.left.shape == (45, 320)


def test_a_live_run_is_repeated_from_its_recording(
    video: Path, flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    options = ["--calibration", str(flight), "--drop", "none", "--record", str(tmp_path / "kept")]
    options += ["--view", str(tmp_path / "run.rrd")]
    assert main(["live", f"video:{video}", *options, "--out", str(tmp_path / "out")]) == 0
    assert "16 frames with a pose, 0 left out" in capsys.readouterr().out
    live = read_trajectory(tmp_path / "out" / "trajectory.tum")
    again = vio.run(vio.open_dataset(tmp_path / "kept"), Config()).trajectory
    assert len(live) == len(again)
    np.testing.assert_array_equal(live.T_world_body[:, :3, 3], again.T_world_body[:, :3, 3])
    assert (tmp_path / "out" / "camchain-imucam.yaml").is_file()
    assert (tmp_path / "run.rrd").stat().st_size > 10_000
    assert main(["live", f"video:{video}", *options]) == 1
    assert "kept: is not empty; give --record a new folder" in capsys.readouterr().err


class Replayed:
    """A camera with an IMU, made of a recording's events."""

    has_imu = True
    image_size = None

    def __init__(self, flight: Path, stop_after: int | None = None) -> None:
        self._dataset, self.rig = vio.open_dataset(flight), load_rig(flight)
        self.given, self.closed, self._stop_after = 0, False, stop_after

    def events(self) -> Iterator[SourceEvent | None]:
        yield None
        for event in self._dataset.events():
            if isinstance(event, StereoFrame):
                assert event.left is not None
                yield SourceFrame(event.time_ns, event.left, event.right)
                self.given += 1
            elif isinstance(event, ImuSample):
                yield event

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize("form", get_args(Form))
def test_recordings_have_all_digits_and_ending_early_keeps_everything(
    form: Form, flight: Path, tmp_path: Path
) -> None:
    source = Replayed(flight)
    kept, out = tmp_path / "kept", tmp_path / "out"
    run = run_source(
        source,
        Config(),
        None,
        LiveOptions(LiveRunSettings(out, "camera"), kept, form, drop="none"),
        should_stop=lambda: source.given >= 12,
        say=lambda _: None,
    )
    assert source.closed
    assert run.figures.dropped == 0
    assert run.samples > 100
    again = vio.run(vio.open_dataset(kept), Config()).trajectory
    live = read_trajectory(out / "trajectory.tum")
    assert len(live) == len(again) == 12
    np.testing.assert_array_equal(live.T_world_body[:, :3, 3], again.T_world_body[:, :3, 3])


def test_a_camera_that_fails_leaves_the_trajectory_so_far(flight: Path, tmp_path: Path) -> None:
    class Failing(Replayed):
        def events(self) -> Iterator[SourceEvent | None]:
            for event in super().events():
                if self.given >= 8:
                    raise DataError("the camera was unplugged")
                yield event

    class Slow:
        """Lets the odometry keep up, as what waits is forgotten where an error ends a run."""

        def __init__(self) -> None:
            self.odometry: Any = None

        def start(self, odometry: Any, rig: Any) -> None:
            self.odometry = odometry

        def should_stop(self) -> bool:
            self.odometry._worker.ask(lambda: None)
            return False

    slow = Slow()
    with pytest.raises(DataError, match="was unplugged"):
        run_source(
            Failing(flight),
            Config(),
            None,
            LiveOptions(LiveRunSettings(tmp_path / "out", "camera"), drop="none"),
            should_stop=slow.should_stop,
            say=lambda _: None,
            on_start=slow.start,
        )
    assert len(read_trajectory(tmp_path / "out" / "trajectory.tum")) >= 6


@pytest.mark.parametrize("form", get_args(Form))
def test_a_disk_that_cannot_be_written_ends_the_recording(
    form: Form, flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vio.sources.recorder._WAITING", 1)
    with pytest.raises(DataError, match="cannot be written"):
        Recorder(Path("/dev/null/kept"), load_rig(flight))
    recorder = Recorder(tmp_path / "kept", load_rig(flight), form)
    monkeypatch.setattr("vio.sources.recorder.cv2.imwrite", lambda *_: False)
    monkeypatch.setattr("vio.datasets.bags.writer.BagWriter.image", _full_disk)
    frame = SourceFrame(0, np.zeros((90, 160), dtype=np.uint8), None)

    def record() -> None:
        for k in range(1000):
            recorder.add(replace(frame, time_ns=k))

    for call in (record, recorder.close):
        with pytest.raises(DataError, match="cannot be written"):
            call()


def _full_disk(*_: Any) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None: ...


def test_a_stream_over_the_network_has_times_of_arrival_and_its_end_is_named(
    video: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vio.sources.video._PAUSE_S", 0.0)
    handler = functools.partial(_Quiet, directory=str(video.parent))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            began = time.monotonic_ns()
            source = open_source(f"http://127.0.0.1:{server.server_address[1]}/{video.name}")
            frames: list[SourceFrame] = []
            with pytest.raises(DataError, match="check the cable or the network"):
                frames.extend(event for event in source.events() if event is not None)  # type: ignore[misc]
            source.close()
        finally:
            server.shutdown()
            thread.join()
    times = [began, *(frame.time_ns for frame in frames), time.monotonic_ns()]
    assert times == sorted(times)


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("nonsense", ConfigError, "is no live source; give one of v4l2:, video:"),
        ("v4l2:/dev/video_none", DataError, "there is no such device; video devices are"),
        ("v4l2:99", DataError, "/dev/video99: there is no such device"),
        ("video:nowhere.mp4", DataError, "OpenCV cannot open it; there is no such file"),
        (f"video:{__file__}", DataError, "OpenCV cannot open it; check that it is a video"),
        ("http://127.0.0.1:9/a", DataError, "check address, user and password"),
        ("0", ConfigError, r"did you mean v4l2:0\?"),
        ("/dev/video0", ConfigError, r"did you mean v4l2:/dev/video0\?"),
        (__file__, ConfigError, r"did you mean video:.*test_sources.py\?"),
        ("oak", ConfigError, r"did you mean oak:\?"),
        ("v4l2src ! appsink", ConfigError, "pipelines of GStreamer are not taken"),
    ],
)
def test_absent_sources_are_named(name: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        open_source(name)


@pytest.mark.parametrize(
    ("name", "package", "extra"),
    [("realsense:", "pyrealsense2", "realsense"), ("oak:", "depthai", "oak")],
)
def test_without_the_extra_it_is_named(
    name: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(
        MissingDependencyError, match=rf"extra {extra}: .* '\.\[{extra}\]' in a clone"
    ):
        open_source(name)


@pytest.mark.parametrize(
    ("layout", "size"),
    [("side-by-side", (160, 90)), ("top-bottom", (320, 45)), ("single", (320, 90))],
)
def test_a_video_states_the_size_of_its_images(
    video: Path, layout: Layout, size: tuple[int, int]
) -> None:
    source = open_source(f"video:{video}", layout)
    frame = next(event for event in source.events() if event is not None)
    source.close()
    assert isinstance(frame, SourceFrame)
    assert source.image_size == size == frame.left.shape[::-1]


def test_the_source_states_the_size_that_a_calibration_lacks(
    video: Path, flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_calibration(tmp_path, vio.open_dataset(flight).recording.camera, None)  # KITTI's
    options = ["--calibration", str(tmp_path / "calib.txt"), "--drop", "none"]
    assert main(["live", f"video:{video}", *options]) == 0
    assert "16 frames with a pose, 0 left out; latency" in capsys.readouterr().out


def test_no_frame_of_a_file_is_left_out(
    video: Path, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["live", f"video:{video}", "--calibration", str(flight)]) == 0
    assert "16 frames with a pose, 0 left out" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("layout", "half", "words"),
    [
        (
            "side-by-side",
            (320, 480),
            "each image side-by-side in it 320x480, .* that of one camera",
        ),
        ("side-by-side", (320, 960), "640x480; give --layout top-bottom"),
        ("top-bottom", (1280, 240), "640x480; give --layout side-by-side"),
        ("single", (1280, 480), "give --layout side-by-side"),
        ("side-by-side", (320, 240), "let the camera send that size"),
        ("side-by-side", (644, 480), "check that calibration and camera belong together"),
    ],
)
def test_images_of_another_size_say_which_layout_fits(
    layout: Layout, half: tuple[int, int], words: str
) -> None:
    assert re.search(words, layout_hint(layout, half, (640, 480)))


def test_a_picture_of_one_camera_is_not_halved(
    video: Path, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--calibration", str(flight), "--layout", "top-bottom"]
    assert main(["live", f"video:{video}", *options]) == 1
    assert "give --layout side-by-side" in capsys.readouterr().err


def test_what_a_run_needs_is_named(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["live", f"video:{video}"]) == 1
    assert "no calibration of its own; give --calibration FILE" in capsys.readouterr().err
    assert main(["live", f"video:{video}", "--localise"]) == 1
    assert "--localise needs --map FILE" in capsys.readouterr().err


def test_the_accelerometer_is_interpolated_at_the_times_of_the_gyro() -> None:
    imu = ImuInterpolation()
    out: list[ImuSample] = []
    for k in range(40):  # gyro each 5 ns, accelerometer each 8 ns from 6 on
        if k % 5 == 0:
            out.extend(imu.gyro(k, np.full(3, float(k))))
        if k >= 6 and (k - 6) % 8 == 0:
            out.extend(imu.accel(k, np.array([2.0 * k, 0.0, 1.0])))
    out.extend(imu.accel(38, np.full(3, 99.0)))  # again: left out
    assert [sample.time_ns for sample in out] == [10, 15, 20, 25, 30, 35]
    for sample in out:
        np.testing.assert_allclose(sample.accel, [2.0 * sample.time_ns, 0.0, 1.0])
        np.testing.assert_array_equal(sample.gyro, float(sample.time_ns))


def test_no_acceleration_is_made_up_in_a_gap_of_the_accelerometer() -> None:
    """As where a gyro and an accelerometer of a file are joined."""
    ms = 1_000_000
    gyro = [5 * ms * k for k in range(400)]
    accel = [8 * ms * k for k in range(250) if not 600 < 8 * k < 1100]
    imu = ImuInterpolation()
    events = sorted([(t, "gyro") for t in gyro] + [(t, "accel") for t in accel])
    out = [s for t, kind in events for s in getattr(imu, kind)(t, np.full(3, 1e-9 * t))]
    joined = joined_record(
        *((np.array(t), np.repeat(1e-9 * np.array(t)[:, None], 3, axis=1)) for t in (gyro, accel))
    )
    assert joined is not None
    assert [s.time_ns for s in out] == joined.times_ns.tolist()
    np.testing.assert_allclose([s.accel for s in out], joined.accel)
    assert not [t for t in joined.times_ns.tolist() if 600 * ms < t < 1100 * ms]


def test_a_gyro_beside_a_silent_accelerometer_fills_no_memory() -> None:
    imu = ImuInterpolation()
    list(imu.accel(0, np.zeros(3)))
    for k in range(10_000):
        assert not list(imu.gyro(1 + k, np.zeros(3)))
    assert len(imu._gyro) < 5000


def test_a_realsense_made_by_its_library_gives_pairs_samples_and_calibration(
    tmp_path: Path,
) -> None:
    pytest.importorskip(
        "pyrealsense2", reason="pyrealsense2 or libusb is not installed", exc_type=ImportError
    )
    path = tmp_path / "camera.db3"
    _record_realsense(path)
    source = open_source(f"realsense:{path}")
    events = [event for event in source.events() if event is not None]
    source.close()
    frames = [event for event in events if isinstance(event, SourceFrame)]
    samples = [event for event in events if isinstance(event, ImuSample)]
    assert [f.time_ns for f in frames] == [1_000_000_000 + 50_000_000 * k for k in range(5)]
    for k, frame in enumerate(frames):
        assert (frame.left[0, 0], frame.right[0, 0]) == (20 * k + 1, 20 * k + 2)
    assert source.has_imu
    assert len(samples) == 50
    np.testing.assert_allclose(samples[3].accel, [0.0, 3.0, 1.0])
    rig = source.rig
    assert rig.cam0.fu == 100.0
    np.testing.assert_allclose(rig.T_cam1_cam0[:3, 3], [-0.05, 0.0, 0.0], atol=1e-7)
    with pytest.raises(DataError, match="no such camera; connected are"):
        open_source("realsense:12345")
    with pytest.raises(DataError, match="there is no such file"):
        open_source("realsense:nowhere.bag")


def test_the_bag_of_realsenses_own_recorder_is_read_with_the_times_of_its_frames(
    tmp_path: Path,
) -> None:
    """Its headers have the times of recording, its metadata those of the frames."""
    pytest.importorskip(
        "pyrealsense2", reason="pyrealsense2 or libusb is not installed", exc_type=ImportError
    )
    path = tmp_path / "camera.db3"
    _record_realsense(path)
    dataset = vio.open_dataset(path)
    recording = dataset.recording
    assert recording.frame_times_ns.tolist() == [10**9 + 50_000_000 * k for k in range(5)]
    assert recording.camera.baseline_m == pytest.approx(0.05)
    assert any("the times of the frames are taken" in note for note in recording.notes)
    frames = [event for event in dataset.events() if isinstance(event, StereoFrame)]
    for k, frame in enumerate(frames):
        assert frame.left is not None
        assert frame.right is not None
        assert (frame.left[0, 0], frame.right[0, 0]) == (20 * k + 1, 20 * k + 2)
    assert recording.motion == frozenset()
    assert any("its pose in the camera is unknown" in note for note in recording.notes)
    camera = recording.camera
    rig = Rig.rectified(camera.fu, camera.fv, camera.cu, camera.cv, 0.05, 160, 90)
    calibration = tmp_path / "camchain-imucam.yaml"
    calibration.write_text(kalibr_text(replace(rig, T_cam0_imu=np.eye(4))))
    dataset = vio.open_dataset(path, DatasetSettings(calibration=calibration))
    samples = [event for event in dataset.events() if isinstance(event, ImuSample)]
    assert [sample.time_ns for sample in samples[:3]] == [10**9 + 5_000_000 * j for j in range(3)]
    np.testing.assert_allclose(samples[3].accel, [0.0, 3.0, 1.0])


def test_images_of_a_realsense_are_stamped_at_the_middle_of_their_exposure(tmp_path: Path) -> None:
    """Their stamps are those of the readout; live and from its own bag, with one exposure or a
    changing one.
    """
    pytest.importorskip(
        "pyrealsense2", reason="pyrealsense2 or libusb is not installed", exc_type=ImportError
    )
    path = tmp_path / "camera.db3"
    _record_realsense(path, exposed_us=lambda k: 4000 * (k + 1))
    expected = [1_000_000_000 + 50_000_000 * k - 2_000_000 * (k + 1) for k in range(5)]
    source = open_source(f"realsense:{path}")
    events = list(source.events())
    source.close()
    assert [event.time_ns for event in events if isinstance(event, SourceFrame)] == expected
    assert vio.open_dataset(path).recording.frame_times_ns.tolist() == expected


@pytest.mark.parametrize(
    ("metadata_us", "expected_ns"),
    [
        ({}, 0),
        ({"frame_timestamp": 7_000_000}, 0),
        ({"frame_timestamp": 7_000_000, "sensor_timestamp": 6_995_000}, 5_000_000),
        ({"frame_timestamp": 7_000_000, "sensor_timestamp": 7_000_001}, 0),  # of two clocks
        ({"frame_timestamp": 7_000_000, "sensor_timestamp": 5_000_000}, 0),
    ],
)
def test_half_the_exposure_of_a_realsense_is_what_its_metadata_state(
    metadata_us: dict[str, int], expected_ns: int
) -> None:
    source = object.__new__(RealSenseSource)
    names = SimpleNamespace(frame_timestamp="frame_timestamp", sensor_timestamp="sensor_timestamp")
    source._rs = SimpleNamespace(frame_metadata_value=names)
    frame = SimpleNamespace(
        supports_frame_metadata=metadata_us.__contains__,
        get_frame_metadata=metadata_us.__getitem__,
        get_profile=lambda: SimpleNamespace(fps=lambda: 30),
    )
    assert source._half_exposure_ns(frame) == expected_ns


def test_metadata_of_a_realsense_bag_state_the_middle_of_the_exposure() -> None:
    entries = b"Frame Timestamp=%d;Sensor Timestamp=%d;"
    texts = [
        (k, b"Frame number=1;timestamp=%d.000000;" % (1000 + 50 * k) + entries % pair)
        for k, pair in enumerate([(70_000, 65_000), (120_000, 120_001), (170_000, 110_000)])
    ]
    texts.append((3, b"Frame number=1;timestamp=1150.000000;Sensor Timestamp=1;"))
    assert (sdk_stamps(texts).stamp_ns / 10**6).tolist() == [995.0, 1050.0, 1100.0, 1150.0]


def _record_realsense(path: Path, exposed_us: Callable[[int], int] | None = None) -> None:
    """Record a software device of librealsense: two infrared imagers, gyro and accelerometer; with
    metadata where the exposure of each frame is given.
    """
    import pyrealsense2 as rs

    width, height = 160, 90
    device = rs.software_device()
    stereo, motion = device.add_sensor("Stereo Module"), device.add_sensor("Motion Module")
    videos = []
    for index in (1, 2):
        stream, lens = rs.video_stream(), rs.intrinsics()
        lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = (
            width,
            height,
            100.0,
            100.0,
            79.5,
            44.5,
        )
        lens.model, lens.coeffs = rs.distortion.brown_conrady, [0.0] * 5
        stream.type, stream.index, stream.uid, stream.fmt = (
            rs.stream.infrared,
            index,
            index,
            rs.format.y8,
        )
        stream.width, stream.height, stream.fps, stream.bpp, stream.intrinsics = (
            width,
            height,
            20,
            1,
            lens,
        )
        videos.append(stereo.add_video_stream(stream))
    moved = rs.extrinsics()
    moved.rotation, moved.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [-0.05, 0, 0]
    videos[0].register_extrinsics_to(videos[1], moved)
    inertial = []
    for uid, kind in ((3, rs.stream.gyro), (4, rs.stream.accel)):
        stream = rs.motion_stream()
        stream.type, stream.index, stream.uid, stream.fps, stream.fmt = (
            kind,
            0,
            uid,
            200,
            rs.format.motion_xyz32f,
        )
        stream.intrinsics = rs.motion_device_intrinsic()
        inertial.append(motion.add_motion_stream(stream))
    recorder, kept = rs.recorder(str(path), device), rs.frame_queue(1000)
    sensors = recorder.query_sensors()
    for sensor, profiles in zip(sensors, (videos, inertial), strict=True):
        sensor.open(profiles)
        sensor.start(kept)
    for k in range(5):
        for j in range(10):
            for profile in inertial:
                sample, value = rs.software_motion_frame(), rs.vector()
                value.x, value.y, value.z = float(k), float(j), 1.0
                sample.data, sample.timestamp, sample.profile = (
                    value,
                    1000.0 + 50 * k + 5 * j,
                    profile.as_motion_stream_profile(),
                )
                sample.domain, sample.frame_number = rs.timestamp_domain.hardware_clock, 10 * k + j
                motion.on_motion_frame(sample)
        if exposed_us is not None:
            values, readout_us = rs.frame_metadata_value, 7_000_000 + 50_000 * k
            stereo.set_metadata(values.frame_timestamp, readout_us)
            stereo.set_metadata(values.sensor_timestamp, readout_us - exposed_us(k) // 2)
        for profile in videos:
            image = rs.software_video_frame()
            image.pixels = np.full(width * height, 20 * k + profile.stream_index(), dtype=np.uint8)
            image.stride, image.bpp, image.timestamp, image.profile = (
                width,
                1,
                1000.0 + 50 * k,
                profile.as_video_stream_profile(),
            )
            image.domain, image.frame_number = rs.timestamp_domain.hardware_clock, k
            stereo.on_video_frame(image)
        time.sleep(0.02)  # the recorder writes in a thread of its own
    for sensor in sensors:
        sensor.stop()
        sensor.close()


class _OakQueue:
    def __init__(self, *batches: list[Any]) -> None:
        self._batches = list(batches)

    def tryGetAll(self) -> list[Any]:
        return self._batches.pop(0) if self._batches else []


class _OakDevice:
    """Stands in for depthai's module, its device, pipeline and nodes: with the names of depthai
    3.12.
    """

    CameraBoardSocket = SimpleNamespace(CAM_B="left", CAM_C="right")
    CameraExposureOffset = SimpleNamespace(START="start", MIDDLE="middle", END="end")
    CameraModel = SimpleNamespace(Perspective=0, Fisheye=1, RadialDivision=4)
    IMUSensor = SimpleNamespace(ACCELEROMETER_RAW=0, GYROSCOPE_RAW=1)
    ImgFrame = SimpleNamespace(Type=SimpleNamespace(GRAY8="gray"))
    node = SimpleNamespace(Camera="Camera", IMU="IMU")
    model = 0
    out = property(lambda self: self)

    def __init__(self) -> None:
        self.coefficients, self.is_open, self.socket = (
            [0.1, 0.0, 0.0, 0.0, 0.0] + [0.0] * 9,
            False,
            "",
        )
        self.Device = lambda info: self
        self.Device.getAllAvailableDevices = lambda: [
            SimpleNamespace(getDeviceId=lambda: "14442C", name="1.1")
        ]  # type: ignore[attr-defined]
        self.Pipeline = lambda device: self

    def create(self, kind: str) -> Any:
        return self

    def build(self, socket: str) -> Any:
        self.socket = socket
        return self

    def requestOutput(self, size: Any, *, type: Any, fps: float) -> Any:
        assert size in {(640, 400), (1280, 720), (1280, 800)}  # of its OV9282
        self.step_us = round(1e6 / fps)
        return self

    def enableIMUSensor(self, sensors: list[int], rate: int) -> None:
        assert rate in {25, 50, 100, 200, 400}  # of its BMI270
        self.socket = "imu"

    def setBatchReportThreshold(self, count: int) -> None: ...

    def setMaxBatchReports(self, count: int) -> None: ...

    def createOutputQueue(self) -> _OakQueue:
        if self.socket == "imu":
            return _OakQueue([SimpleNamespace(packets=[_oak_packet(k) for k in range(10)])])
        value = 1 if self.socket == "left" else 2
        return _OakQueue(*([_oak_image(k * self.step_us, value + k)] for k in range(2)))

    def readCalibration(self) -> Any:
        return self

    def getConnectedIMU(self) -> str:
        return "BMI270"

    def getImuToCameraExtrinsics(self, socket: str) -> Any:
        T = np.eye(4)
        T[:3, 3] = [1.0, 2.0, 3.0]  # centimetres
        return T.tolist()

    def getCameraExtrinsics(self, source: str, target: str) -> Any:
        T = np.eye(4)
        T[0, 3] = -7.5
        return T.tolist()

    def getCameraIntrinsics(self, socket: str, width: int, height: int) -> Any:
        return [[400.0, 0.0, width / 2], [0.0, 400.0, height / 2], [0.0, 0.0, 1.0]]

    def getEepromData(self) -> Any:
        stored = SimpleNamespace(distortionCoeff=self.coefficients)
        return SimpleNamespace(cameraData={"left": stored, "right": stored})

    def getDistortionModel(self, socket: str) -> int:
        return self.model

    def start(self) -> None:
        self.is_open = True

    def stop(self) -> None:
        self.is_open = False

    def close(self) -> None: ...


def _oak_packet(k: int) -> Any:
    stamp = timedelta(seconds=1, microseconds=5000 * k)
    read = SimpleNamespace(x=float(k), y=0.0, z=1.0, getTimestampDevice=lambda: stamp)
    return SimpleNamespace(acceleroMeter=read, gyroscope=read)


def _oak_image(after_us: int, value: int) -> Any:
    """Exposed for 4 ms times its value; the exposures of two cameras end together."""
    end = timedelta(seconds=1, microseconds=after_us)
    middle = end - timedelta(milliseconds=2 * value)
    image = np.full((400, 640), value, dtype=np.uint8)
    return SimpleNamespace(
        getCvFrame=lambda: image,
        getTimestampDevice=lambda offset="end": {"middle": middle, "end": end}[offset],
    )


def test_an_oak_gives_pairs_samples_and_calibration_in_metres(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Against a stand-in: no device was at hand."""
    device = _OakDevice()
    monkeypatch.setitem(sys.modules, "depthai", device)  # type: ignore[arg-type]
    monkeypatch.setattr("vio.sources.oak.LOST_S", 0.0)
    source = open_source("oak:14442C")
    events: list[SourceEvent] = []
    with pytest.raises(DataError, match="nothing for 0 s"):
        events.extend(event for event in source.events() if event is not None)
    frames = [event for event in events if isinstance(event, SourceFrame)]
    samples = [event for event in events if isinstance(event, ImuSample)]
    assert [(f.time_ns, f.left[0, 0], f.right[0, 0]) for f in frames if f.right is not None] == [
        (998_000_000, 1, 2),
        (1_046_000_000, 2, 3),
    ]
    assert [s.time_ns for s in samples] == [1_000_000_000 + 5_000_000 * k for k in range(10)]
    rig = source.rig
    np.testing.assert_allclose(rig.T_cam1_cam0[:3, 3], [-0.075, 0.0, 0.0])
    np.testing.assert_allclose(rig.T_cam0_imu[:3, 3], [0.01, 0.02, 0.03])
    assert rig.cam0.model == "radtan"
    source.close()
    assert not device.is_open
    device.coefficients[9] = 0.01
    with pytest.raises(DataError, match="thin prisms or tilt; give --calibration"):
        open_source("oak:")
    with pytest.raises(DataError, match="no such device; connected are: 14442C"):
        open_source("oak:other")


def test_an_oak_takes_each_lens_model_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    device = _OakDevice()
    monkeypatch.setitem(sys.modules, "depthai", device)  # type: ignore[arg-type]
    device.coefficients = []
    assert open_source("oak:").rig.cam0.model == "pinhole"
    device.model = device.CameraModel.Fisheye
    with pytest.raises(DataError, match="a fisheye lens with 0 stored coefficients"):
        open_source("oak:")
    device.coefficients = [0.1, 0.02, 0.0, 0.0, *[0.0] * 10]
    lens = open_source("oak:").rig.cam0
    assert (lens.model, lens.coefficients) == ("equidistant", (0.1, 0.02, 0.0, 0.0))
    device.model = device.CameraModel.RadialDivision
    with pytest.raises(DataError, match="lens model 4 is not known; give --calibration FILE"):
        open_source("oak:")


@pytest.mark.parametrize("name", ["brown_conrady", "inverse_brown_conrady"])
def test_a_realsense_lens_projects_as_librealsense(name: str) -> None:
    rs = pytest.importorskip(
        "pyrealsense2", reason="pyrealsense2 or libusb is not installed", exc_type=ImportError
    )
    found = rs.intrinsics()
    found.width, found.height, found.fx, found.fy = 640, 480, 430.0, 430.0
    found.ppx, found.ppy, found.model = 322.0, 238.0, getattr(rs.distortion, name)
    found.coeffs = [0.15, -0.45, -0.001, 0.0005, 0.4]
    source = object.__new__(RealSenseSource)
    source._name = "realsense:"
    lens = source._lens(found)
    points = np.array([[x, y, 1.0] for x in (-0.7, 0.1, 0.7) for y in (-0.5, 0.2, 0.5)])
    theirs = [rs.rs2_project_point_to_pixel(found, point.tolist()) for point in points]
    plain = points[:, :2] * 430.0 + [322.0, 238.0]
    assert np.abs(theirs - plain).max() > 5.0
    np.testing.assert_allclose(project_point(lens, points)[0], theirs, atol=0.04)


def test_what_depthai_stores_is_read_without_its_distortion() -> None:
    """With depthai's own classes: a fisheye lens that has no coefficients stored ends the process
    in `getDistortionCoefficients`.
    """
    dai = pytest.importorskip("depthai", reason="depthai is not installed")
    stored = dai.CalibrationHandler()
    socket = dai.CameraBoardSocket.CAM_B
    stored.setCameraIntrinsics(socket, [[400.0, 0, 320], [0, 400.0, 200], [0, 0, 1]], 640, 400)
    source = object.__new__(OakSource)
    source._dai = dai
    source._name = "oak:"
    for model in ("Fisheye", "RadialDivision", "Equirectangular", "Cylindrical"):
        stored.setCameraType(socket, getattr(dai.CameraModel, model))
        with pytest.raises(DataError, match="fisheye lens with 0|" + model):
            source._lens(stored, socket)
    stored.setDistortionCoefficients(socket, [0.1, 0.02, 0.0, 0.0])
    stored.setCameraType(socket, dai.CameraModel.Fisheye)
    assert source._lens(stored, socket).model == "equidistant"


def test_the_stand_in_has_only_names_of_depthai() -> None:
    dai = pytest.importorskip("depthai", reason="depthai is not installed")
    for owner, names in (
        (dai.Device, ("getAllAvailableDevices", "readCalibration", "getConnectedIMU", "close")),
        (dai.Pipeline, ("create", "start", "stop")),
        (dai.node.Camera, ("build", "requestOutput")),
        (dai.node.IMU, ("enableIMUSensor", "setBatchReportThreshold", "setMaxBatchReports")),
        (
            dai.CalibrationHandler,
            [name for name in dir(_OakDevice) if name.startswith("get") and "IMU" not in name],
        ),
        (dai.MessageQueue, ("tryGetAll",)),
        (dai.IMUPacket, ("acceleroMeter", "gyroscope")),
        (dai.ImgFrame, ("getCvFrame", "getTimestampDevice")),
        (dai.CameraExposureOffset, ("START", "MIDDLE", "END")),
        (dai.DeviceInfo, ("getDeviceId", "name")),
    ):
        assert [name for name in names if not hasattr(owner, name)] == []


def test_a_recording_that_needs_an_absent_package_says_so(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "apsw", None)
    recorder = Recorder(tmp_path / "kept", load_rig(flight), "mcap")
    with pytest.raises(MissingDependencyError):
        recorder.close()


def test_an_oak_is_lost_after_five_silent_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock of which each look takes a second."""
    monkeypatch.setitem(sys.modules, "depthai", _OakDevice())  # type: ignore[arg-type]
    seconds = iter(range(100))
    clock = SimpleNamespace(monotonic=lambda: float(next(seconds)), sleep=lambda seconds: None)
    monkeypatch.setattr("vio.sources.oak.time", clock)
    source = open_source("oak:")
    events: list[SourceEvent | None] = []
    with pytest.raises(DataError, match="nothing for 5 s"):
        events.extend(source.events())
    assert events[-5:] == [None] * 5
    assert events[-6] is not None
