"""Bags as drivers and recorders write them: an IMU in two topics, clocks that are set back, streams
without stamps, and frames that only /tf states.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

rosbags = pytest.importorskip("rosbags", reason="needs rosbags")

from tests.bag_maker import Script, noise_frames, of_stereo  # noqa: E402
from tests.datasets.test_datasets_bags import (  # noqa: E402
    RIG,
    START_NS,
    STORAGES,
    T_BASE_IMU,
    T_CAM0_IMU,
    plain_script,
)
from tests.same_events import frames_of  # noqa: E402
from vio.datasets import DatasetSettings, open_dataset  # noqa: E402
from vio.geometry.lie import se3_exp, se3_inverse  # noqa: E402
from vio.imu.two_sensors import joined_record  # noqa: E402
from vio.protocols import Dataset  # noqa: E402
from vio.records import ImuSample  # noqa: E402

FRAMES = 60  # 3 s
IMU_STEP_NS = 5_000_000


def _path(storage: str, folder: Path) -> Path:
    return folder / ("f.bag" if storage == "bag" else "f")


def _imu_of(dataset: Dataset) -> list[ImuSample]:
    return [event for event in dataset.events(images=False) if isinstance(event, ImuSample)]


def _without(script: Script, *topics: str) -> Script:
    script.notes = [note for note in script.notes if note.topic not in topics]
    return script


# --- an IMU in two topics

NAMES = {
    "realsense": ("/camera/gyro/sample", "/camera/accel/sample"),
    "realsense, ROS 2": ("/camera/camera/gyro/sample", "/camera/camera/accel/sample"),
    "realsense's recorder": (
        "/device_0/sensor_2/Gyro_0/imu/data",
        "/device_0/sensor_2/Accel_0/imu/data",
    ),
    "xsens": ("/imu/angular_velocity", "/imu/acceleration"),
    "phone": ("/gyroscope", "/accelerometer"),
}


def _split(script: Script, gyro: str, accel: str, *, vectors: bool) -> Script:
    """Replace the IMU by a gyro of 200 Hz and an accelerometer of 62.5 Hz."""
    _without(script, "/imu")
    zero = np.zeros(3)
    for k in range(60):
        time_ns = START_NS - 20_000_000 + IMU_STEP_NS * k
        rates = np.array([0.1, 0.2, k])
        if vectors:
            script.vector(gyro, time_ns, rates)
        else:
            script.imu(gyro, ImuSample(time_ns, rates, zero))
    for k in range(20):
        time_ns = START_NS - 10_000_000 + 16_000_000 * k
        force = np.array([1e-9 * (time_ns - START_NS), 0.0, 9.8])
        if vectors:
            script.vector(accel, time_ns, force)
        else:
            script.imu(accel, ImuSample(time_ns, zero, force))
    return script


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("vectors", [False, True], ids=["imu", "vector"])
def test_gyro_and_accelerometer_are_joined_at_the_gyros_stamps(
    names: str, vectors: bool, tmp_path: Path
) -> None:
    gyro, accel = NAMES[names]
    script = _split(plain_script(frames=4), gyro, accel, vectors=vectors)
    dataset = open_dataset(script.write(tmp_path / "f"))
    samples = _imu_of(dataset)
    assert samples[0].time_ns == START_NS - 10_000_000
    assert {b.time_ns - a.time_ns for a, b in pairwise(samples)} == {IMU_STEP_NS}
    for sample in samples:
        force = [1e-9 * (sample.time_ns - START_NS), 0, 9.8]
        np.testing.assert_allclose(sample.accel, force, atol=1e-12)
        assert sample.gyro[2] == (sample.time_ns - START_NS + 20_000_000) / IMU_STEP_NS
    assert any(f"{gyro} and {accel} are joined to one IMU" in n for n in dataset.recording.notes)


def test_two_topics_of_an_imu_may_be_named_and_one_that_has_both_is_preferred(
    tmp_path: Path,
) -> None:
    script = _split(plain_script(frames=4), "/a", "/b", vectors=False)
    settings = DatasetSettings(topics="imu=/a,accel=/b")
    assert len(_imu_of(open_dataset(script.write(tmp_path / "f"), settings))) > 30
    script = plain_script(frames=4)
    script.imu("/camera/gyro/sample", ImuSample(START_NS, np.ones(3), np.zeros(3)))
    script.imu("/camera/accel/sample", ImuSample(START_NS, np.zeros(3), np.ones(3)))
    recording = open_dataset(script.write(tmp_path / "g")).recording
    assert "not used: /camera/accel/sample, /camera/gyro/sample" in recording.notes


def test_one_topic_that_has_either_sensor_in_turn(tmp_path: Path) -> None:
    script = _split(plain_script(frames=4), "/imu", "/imu", vectors=False)
    dataset = open_dataset(script.write(tmp_path / "f"))
    samples = _imu_of(dataset)
    assert len(samples) > 30
    for sample in samples:
        force = [1e-9 * (sample.time_ns - START_NS), 0, 9.8]
        np.testing.assert_allclose(sample.accel, force, atol=1e-12)
        assert sample.gyro[0] == 0.1
    assert any("in messages of their own" in note for note in dataset.recording.notes)


def test_an_accelerometer_is_not_interpolated_over_a_gap() -> None:
    gyro_ns = np.arange(0, 3_000_000_000, 5_000_000)
    accel_ns = np.concatenate([np.arange(0, 10**9, 10**7), np.arange(2 * 10**9, 3 * 10**9, 10**7)])
    joined = joined_record(
        (gyro_ns, np.ones((len(gyro_ns), 3))), (accel_ns, np.ones((len(accel_ns), 3)))
    )
    assert joined is not None
    assert not ((joined.times_ns > 990_000_000) & (joined.times_ns < 2_000_000_000)).any()
    assert (
        len(joined.times_ns) == 199 + 198
    )  # to 0.99 s, and from 2 s to 2.99 s, where it begins anew


# --- clocks that are set back


def _with_clock_set_back(storage: str, step_ns: int, *, log_too: bool) -> Script:
    """A recording whose host's clock is set back after 1.8 s; stamps are 2 to 4 ms before the
    log.
    """
    script = plain_script(storage, FRAMES)
    rng = np.random.default_rng(3)
    notes = []
    for note in sorted(script.notes, key=lambda n: n.logged_ns):
        if note.topic == "/tf_static" or note.topic.endswith("info"):
            notes.append(note)
            continue
        after = note.logged_ns >= START_NS + 1_800_000_000
        time_ns = note.logged_ns - (step_ns if after else 0)
        note.fields.header.stamp.sec = time_ns // 10**9
        if hasattr(note.fields.header.stamp, "nanosec"):
            note.fields.header.stamp.nanosec = time_ns % 10**9
        logged_ns = (time_ns if log_too else note.logged_ns) + int(rng.integers(2e6, 4e6))
        notes.append(replace(note, logged_ns=logged_ns))
    script.notes = notes
    return script


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("log_too", [False, True], ids=["stamps", "stamps and log"])
@pytest.mark.parametrize("step_s", [0.03, 1.53, 1000.0])
def test_a_clock_set_back_does_not_mix_two_periods(
    storage: str, log_too: bool, step_s: float, tmp_path: Path
) -> None:
    script = _with_clock_set_back(storage, round(step_s * 1e9), log_too=log_too)
    if not log_too:
        script.notes.sort(key=lambda n: n.logged_ns)
    dataset = open_dataset(script.write(_path(storage, tmp_path), sort=False))
    times = dataset.recording.frame_times_ns
    assert len(times) == FRAMES
    np.testing.assert_allclose(1e-9 * np.diff(times), 0.05, atol=0.008)
    notes = [note for note in dataset.recording.notes if "the clock was set back" in note]
    (note,) = notes
    size_s = float(note.split("set back by ")[1].split(" s")[0])
    assert size_s == pytest.approx(step_s, abs=0.008)
    assert all(topic in note for topic in ("/imu", "/left/image_raw", "/right/image_raw"))
    samples = _imu_of(dataset)
    numbers = [sample.gyro[2] for sample in samples]
    assert numbers == sorted(numbers)
    assert max(b.time_ns - a.time_ns for a, b in pairwise(samples)) < 2e7
    shown = frames_of(dataset)
    for frame, (_, left, right) in zip(shown, noise_frames(FRAMES), strict=True):
        np.testing.assert_array_equal(frame.left, left)
        np.testing.assert_array_equal(frame.right, right)


def test_a_clock_set_back_in_a_bag_whose_messages_are_compressed(tmp_path: Path) -> None:
    script = _with_clock_set_back("db3", 1_530_000_000, log_too=True)
    packed = open_dataset(script.write(tmp_path / "packed", sort=False, packed=True))
    plain = open_dataset(script.write(tmp_path / "plain", sort=False))
    assert any("the clock was set back" in note for note in packed.recording.notes)
    assert packed.recording.frame_times_ns.tolist() == plain.recording.frame_times_ns.tolist()
    for one, other in zip(frames_of(packed), frames_of(plain), strict=True):
        np.testing.assert_array_equal(one.left, other.left)


def _with_clock_set_forward(step_ns: int, *topics: str) -> Script:
    """A recording in which the clock behind the stamps of topics is set forward after 1.8 s."""
    script = plain_script(frames=FRAMES)
    rng = np.random.default_rng(3)
    for k, note in enumerate(script.notes):
        if note.topic == "/tf_static" or note.topic.endswith("info"):
            continue
        is_after = note.logged_ns >= START_NS + 1_800_000_000 and note.topic in topics
        time_ns = note.logged_ns + (step_ns if is_after else 0)
        note.fields.header.stamp.sec = time_ns // 10**9
        note.fields.header.stamp.nanosec = time_ns % 10**9
        logged_ns = note.logged_ns + int(rng.integers(2e6, 4e6))
        script.notes[k] = replace(note, logged_ns=logged_ns)
    return script


SENSORS = ("/imu", "/left/image_raw", "/right/image_raw")


@pytest.mark.parametrize("step_s", [0.3, 1.53, 1000.0])
def test_a_clock_set_forward_leaves_no_gap(step_s: float, tmp_path: Path) -> None:
    script = _with_clock_set_forward(round(step_s * 1e9), *SENSORS)
    dataset = open_dataset(script.write(tmp_path / "f"))
    times = dataset.recording.frame_times_ns
    assert len(times) == FRAMES
    np.testing.assert_allclose(1e-9 * np.diff(times), 0.05, atol=0.008)
    (note,) = [note for note in dataset.recording.notes if "the clock was set" in note]
    size_s = float(note.split("set forward by ")[1].split(" s")[0])
    assert size_s == pytest.approx(step_s, abs=0.008)
    assert all(topic in note for topic in SENSORS)
    samples = _imu_of(dataset)
    assert max(b.time_ns - a.time_ns for a, b in pairwise(samples)) < 2e7
    first_ns = min(times[0], samples[0].time_ns)
    whole = plain_script(frames=FRAMES)
    expected = open_dataset(whole.write(tmp_path / "whole")).recording.frame_times_ns
    np.testing.assert_allclose(times - first_ns, expected - first_ns, atol=8e6)


@pytest.mark.parametrize("topics", [SENSORS[:1], SENSORS[1:2], SENSORS[1:]])
def test_streams_that_leap_without_the_others_are_no_step(
    topics: tuple[str, ...], tmp_path: Path
) -> None:
    """Cameras whose latency falls as they lose frames look alike."""
    script = _with_clock_set_forward(1_530_000_000, *topics)
    recording = open_dataset(script.write(tmp_path / "f")).recording
    assert not any("the clock was set" in note for note in recording.notes)


def test_frames_and_samples_that_are_lost_are_no_step(tmp_path: Path) -> None:
    script = _with_clock_set_forward(0)
    gap = range(START_NS + 10**9, START_NS + 1_800_000_000)
    script.notes = [note for note in script.notes if note.logged_ns not in gap]
    recording = open_dataset(script.write(tmp_path / "gap")).recording
    assert not any("the clock was set" in note for note in recording.notes)
    assert np.diff(recording.frame_times_ns).max() > 7e8


def test_messages_that_are_recorded_late_are_no_step(tmp_path: Path) -> None:
    """A burst of 30 readings, 150 ms, that arrives 200 ms late."""
    script = plain_script(frames=FRAMES)
    late = range(START_NS + 10**9, START_NS + 10**9 + 30 * IMU_STEP_NS, IMU_STEP_NS)
    script.notes = [
        replace(note, logged_ns=late[-1] + 50_000_000 + (note.logged_ns - late[0]) // 100)
        if note.topic == "/imu" and note.logged_ns in late
        else note
        for note in script.notes
    ]
    recording = open_dataset(script.write(tmp_path / "f")).recording
    assert not any("set back" in note for note in recording.notes)
    assert any("recorded out of order and are sorted" in note for note in recording.notes)


# --- stamps and readings that are missing


def _clear(fields: object) -> None:
    fields.header.stamp.sec = 0  # type: ignore[attr-defined]
    fields.header.stamp.nanosec = 0  # type: ignore[attr-defined]


def test_readings_that_are_not_finite_are_left_out_and_counted(tmp_path: Path) -> None:
    script = plain_script()
    script.imu("/imu", ImuSample(START_NS + 1, np.array([np.nan, 0, 0]), np.zeros(3)))
    dataset = open_dataset(script.write(tmp_path / "f"))
    assert START_NS + 1 not in {sample.time_ns for sample in _imu_of(dataset)}
    assert "1 messages of /imu are not finite and are left out" in dataset.recording.notes


@pytest.mark.parametrize("every", [True, False], ids=["all", "one"])
def test_an_imu_without_stamps(every: bool, tmp_path: Path) -> None:
    script = plain_script()
    expected = [n.logged_ns for n in script.notes if n.topic == "/imu"]
    for note in [n for n in script.notes if n.topic == "/imu"][: None if every else 1]:
        _clear(note.fields)
    dataset = open_dataset(script.write(tmp_path / "f"))
    times = [sample.time_ns for sample in _imu_of(dataset)]
    assert times == (expected if every else expected[1:])[: len(times)]
    words = (
        "/imu have no stamps; the times of logging" if every else "1 messages of /imu have no stamp"
    )
    assert any(words in note for note in dataset.recording.notes)


def test_a_right_camera_without_stamps_is_paired_by_logging(tmp_path: Path) -> None:
    script = plain_script(imu=False)
    script.notes = [
        replace(note, logged_ns=note.logged_ns + 4_000_000)
        if note.topic == "/right/image_raw"
        else note
        for note in script.notes
    ]
    for note in script.notes:
        if note.topic == "/right/image_raw":
            _clear(note.fields)
    dataset = open_dataset(script.write(tmp_path / "f"))
    assert dataset.recording.frame_times_ns.tolist() == [t for t, _, _ in noise_frames(4)]
    for frame, (_, left, right) in zip(frames_of(dataset), noise_frames(4), strict=True):
        np.testing.assert_array_equal(frame.left, left)
        np.testing.assert_array_equal(frame.right, right)


# --- frames


def _without_baseline(script: Script, side_m: float = 0.11) -> Script:
    """Take the baseline out of the CameraInfos, and put it into /tf_static."""
    for note in script.notes:
        if note.topic == "/right/camera_info":
            note.fields.p[3] = 0.0
    script.static(START_NS, "left", "right", se3_exp([side_m, 0, 0, 0, 0, 0]))
    return script


def test_a_baseline_that_only_the_frames_state(tmp_path: Path) -> None:
    recording = open_dataset(_without_baseline(plain_script()).write(tmp_path / "f")).recording
    assert recording.camera.baseline_m == pytest.approx(0.11)
    assert any("P[0, 3] is 0; the baseline of 0.1100 m" in note for note in recording.notes)


@pytest.mark.parametrize("side_m", [-0.11, 0.0])
def test_frames_that_put_the_right_camera_elsewhere_are_refused(
    side_m: float, tmp_path: Path
) -> None:
    bag = _without_baseline(plain_script(), side_m).write(tmp_path / "f")
    with pytest.raises(Exception, match=r"P\[0, 3\] is 0, and the frames"):
        open_dataset(bag)


def test_the_imus_pose_may_be_on_tf_where_it_does_not_change(tmp_path: Path) -> None:
    script = _without(plain_script(), "/tf_static")
    for k in range(5):
        time_ns = START_NS + 10**8 * k
        script.moving(time_ns, "odom", "base", se3_exp([0.1 * k, 0, 0, 0, 0, 0]))
        script.moving(time_ns, "base", "imu", T_BASE_IMU)
        script.moving(time_ns, "base", "left", T_BASE_IMU @ se3_inverse(T_CAM0_IMU))
    recording = open_dataset(script.write(tmp_path / "f")).recording
    np.testing.assert_allclose(recording.T_cam0_imu, T_CAM0_IMU, atol=1e-12)
    assert any("is that of /tf, where it does not change" in note for note in recording.notes)


@pytest.mark.parametrize("inverse", [False, True])
def test_the_layout_of_realsenses_own_recorder(inverse: bool, tmp_path: Path) -> None:
    script = Script("bag")
    streams = [f"/device_0/sensor_0/Infrared_{k}" for k in (1, 2)]
    gyro, accel = NAMES["realsense's recorder"]
    poses = [np.eye(4), se3_exp([0.05, 0, 0, 0, 0, 0]), T_CAM0_IMU]
    for k, (time_ns, left, right) in enumerate(noise_frames(4)):
        for stream, image in zip(streams, (left, right), strict=True):
            script.image(f"{stream}/image/data", time_ns, image)
        assert k < 4
    for stream in streams:
        script.camera_info(f"{stream}/info/camera_info", START_NS, RIG.camera, right=False)
        fields = script.notes[-1].fields
        fields.P[:] = 0.0
        fields.R[:] = 0.0
        fields.distortion_model = "Brown Conrady"
    for stream, T in zip((*streams, gyro.removesuffix("/imu/data")), poses, strict=True):
        script.transform(f"{stream}/tf/0", START_NS, se3_inverse(T) if inverse else T)
    _split(script, gyro, accel, vectors=False)
    recording = open_dataset(script.write(tmp_path / "f.bag")).recording
    assert recording.camera.baseline_m == pytest.approx(0.05)
    assert recording.camera.fu == pytest.approx(RIG.cam0.fu)
    np.testing.assert_allclose(recording.T_cam0_imu, T_CAM0_IMU, atol=1e-12)
    assert recording.motion == {"imu"}


def test_a_pair_of_realsense_by_the_names_of_its_topics(tmp_path: Path) -> None:
    script = of_stereo(Script("mcap"), noise_frames(4))
    for side in ("left", "right"):
        script.camera_info(f"/{side}/camera_info", START_NS, RIG.camera, right=side == "right")
    sides = (("/left", "/Infrared_1"), ("/right", "/Infrared_2"))
    for old, new in sides:
        script.notes = [replace(n, topic=n.topic.replace(old, new)) for n in script.notes]
    assert len(open_dataset(script.write(tmp_path / "f")).recording.frame_times_ns) == 4
