"""Bags as people record them: stamps that samples share, sensors with two clocks, CameraInfos whose
baseline only the frames state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

rosbags = pytest.importorskip("rosbags", reason="needs rosbags")

from tests.bag_maker import Script  # noqa: E402
from tests.datasets.test_bags_as_recorded import NAMES, _imu_of, _split  # noqa: E402
from tests.datasets.test_datasets_bags import START_NS, plain_script  # noqa: E402
from tests.same_events import assert_same_events  # noqa: E402
from vio.datasets import DatasetSettings, open_dataset  # noqa: E402
from vio.errors import CalibrationError, DataError  # noqa: E402
from vio.geometry.lie import FloatArray, se3_exp  # noqa: E402
from vio.records import ImuSample  # noqa: E402

STEP_NS = 5_000_000


def _with_imu(stamps: list[int], *, logged_at_stamps: bool = False) -> Script:
    """A recording whose IMU's samples are logged 5 ms apart, each with its number as its rate."""
    script = plain_script(frames=20)
    script.notes = [note for note in script.notes if note.topic != "/imu"]
    for k, stamp in enumerate(stamps):
        sample = ImuSample(stamp, np.array([0.01 * k, 0.0, 0.1]), np.array([0.0, 0.0, 9.8]))
        script.imu("/imu", sample, stamp if logged_at_stamps else START_NS + STEP_NS * k)
    return script


def _true(count: int = 200) -> list[int]:
    return [START_NS + STEP_NS * k for k in range(count)]


def test_samples_with_the_time_of_the_last_frame_take_that_of_logging(tmp_path: Path) -> None:
    stamps = [START_NS + 50_000_000 * (k // 10) for k in range(200)]
    dataset = open_dataset(_with_imu(stamps).write(tmp_path / "f"))
    times = [sample.time_ns for sample in _imu_of(dataset)]
    assert times == _true()[: len(times)]
    assert any(
        "180 of 200 messages of /imu have the stamp of" in n for n in dataset.recording.notes
    )


def test_samples_that_no_clock_tells_apart_are_left_out_and_counted(tmp_path: Path) -> None:
    stamps = [START_NS + 20_000_000 * (k // 4) for k in range(200)]
    bag = _with_imu(stamps, logged_at_stamps=True).write(tmp_path / "f")
    dataset = open_dataset(bag)
    assert np.diff([sample.time_ns for sample in _imu_of(dataset)]).min() == 20_000_000
    assert any("150 of 200 messages of /imu have the stamp" in n for n in dataset.recording.notes)


def test_a_few_shared_stamps_are_counted(tmp_path: Path) -> None:
    stamps = _true()
    for k in (20, 40, 60):
        stamps[k] = stamps[k - 1]
    dataset = open_dataset(_with_imu(stamps).write(tmp_path / "f"))
    assert any("3 of 200 messages of /imu" in note for note in dataset.recording.notes)
    assert stamps[20] in [sample.time_ns for sample in _imu_of(dataset)]


def test_messages_that_were_recorded_twice_are_no_shared_stamps(tmp_path: Path) -> None:
    script = _with_imu(_true())
    script.notes += [replace(note) for note in script.notes if note.topic == "/imu"]
    dataset = open_dataset(script.write(tmp_path / "f"))
    assert not any("have the stamp of another one" in note for note in dataset.recording.notes)


def test_a_gyro_and_an_accelerometer_with_two_clocks_are_refused(tmp_path: Path) -> None:
    gyro, accel = NAMES["realsense"]
    script = _split(plain_script(frames=4), gyro, accel, vectors=False)
    for note in script.notes:
        if note.topic == gyro:
            note.fields.header.stamp.sec += 1000
    bag = script.write(tmp_path / "f")
    with pytest.raises(DataError, match=f"{gyro} .*{accel} .*have no time in common"):
        open_dataset(bag)
    assert not _imu_of(open_dataset(bag, DatasetSettings(topics="imu=none")))


def _with_frames(left_shift: float, right_shift: float, *, frames: bool) -> Script:
    """A recording with `P[0, 3]` of both cameras, whose frames may state the baseline."""
    script = plain_script(frames=4)
    for note in script.notes:
        shift = {"/left/camera_info": left_shift, "/right/camera_info": right_shift}
        if note.topic in shift:
            P = getattr(note.fields, "P", None)
            (note.fields.p if P is None else P)[3] = shift[note.topic]
    if frames:
        script.static(START_NS, "left", "right", se3_exp([0.11, 0, 0, 0, 0, 0]))
    return script


@pytest.mark.parametrize("shifts", [(-5.0, -5.0), (0.0, 5.0)], ids=["equal", "sign"])
def test_frames_state_the_baseline_where_infos_contradict_it(
    shifts: tuple[float, float], tmp_path: Path
) -> None:
    recording = open_dataset(_with_frames(*shifts, frames=True).write(tmp_path / "f")).recording
    assert recording.camera.baseline_m == pytest.approx(0.11)
    assert any("gives no positive baseline; the baseline of" in note for note in recording.notes)
    with pytest.raises(CalibrationError, match=r"both are at one place|its sign is wrong"):
        open_dataset(_with_frames(*shifts, frames=False).write(tmp_path / "g"))


@pytest.mark.parametrize(("unit", "size"), [("microseconds", 1000), ("milliseconds", 1_000_000)])
def test_nanoseconds_that_hold_a_larger_unit_are_called_so(
    unit: str, size: int, tmp_path: Path
) -> None:
    def short(time_ns: int) -> int:
        return time_ns // 10**9 * 10**9 + time_ns % 10**9 // size

    true = [START_NS - 900_000_000 + STEP_NS * k for k in range(600)]
    assert _imu_of(open_dataset(_with_imu(true).write(tmp_path / "true")))
    bag = _with_imu([short(time_ns) for time_ns in true]).write(tmp_path / "short")
    with pytest.raises(DataError, match=f"/imu: all its stamps .* as where {unit} were written"):
        open_dataset(bag)


def _renamed(folder: Path) -> None:
    (file,) = folder.glob("*.db3")
    file.rename(folder / "drive_1.db3")


def _killed(folder: Path) -> None:
    """As a recorder leaves it that was killed before it had counted anything."""
    file = folder / "metadata.yaml"
    known = yaml.safe_load(file.read_text())
    known["rosbag2_bagfile_information"] |= {"message_count": 0, "topics_with_message_count": []}
    file.write_text(yaml.safe_dump(known))


@pytest.mark.parametrize("change", [_renamed, _killed])
def test_files_that_their_metadata_do_not_know_are_read_without(
    change: Callable[[Path], None], tmp_path: Path
) -> None:
    usual = open_dataset(plain_script("db3").write(tmp_path / "usual"))
    folder = plain_script("db3").write(tmp_path / "f")
    change(folder)
    assert_same_events(open_dataset(folder), usual)


def test_a_ros_2_bag_whose_topics_have_no_message_is_that(tmp_path: Path) -> None:
    script = plain_script("db3")
    script.notes = [note for note in script.notes if "image" not in note.topic]
    script.empty = [("/left/image_raw", "sensor_msgs/msg/Image")]
    with pytest.raises(DataError, match="holds 0 image topics with messages"):
        open_dataset(script.write(tmp_path / "f"))


def test_a_bag_that_was_not_closed_is_called_so(tmp_path: Path) -> None:
    whole = plain_script("bag").write(tmp_path / "whole.bag").read_bytes()
    file = tmp_path / "drive.bag.active"
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"rosbag reindex, and rename it to .bag"):
        open_dataset(file)


def _infos(change: Callable[[FloatArray, FloatArray, FloatArray], None]) -> Script:
    """A recording whose CameraInfos are changed: K (3, 3), R (3, 3), P (3, 4)."""
    script = plain_script(frames=4)
    for note in script.notes:
        if note.topic.endswith("camera_info"):
            fields = note.fields
            change(fields.k.reshape(3, 3), fields.r.reshape(3, 3), fields.p.reshape(3, 4))
    return script


def _no_rotation(K: FloatArray, R: FloatArray, P: FloatArray) -> None:
    R[:] = 0.0


def _no_rotation_of_raw_images(K: FloatArray, R: FloatArray, P: FloatArray) -> None:
    R[:] = 0.0
    K[0, 0] += 1.0


def _thousandths(K: FloatArray, R: FloatArray, P: FloatArray) -> None:
    P[0, 3] /= 1000


def test_a_rotation_of_zeros_is_none_where_nothing_is_to_be_rectified(tmp_path: Path) -> None:
    usual = open_dataset(plain_script(frames=4).write(tmp_path / "usual"))
    dataset = open_dataset(_infos(_no_rotation).write(tmp_path / "zeros"))
    assert dataset.recording.camera == usual.recording.camera
    assert_same_events(dataset, usual)
    bag = _infos(_no_rotation_of_raw_images).write(tmp_path / "raw")
    with pytest.raises(CalibrationError, match="R is zero, so how the images are to be rectified"):
        open_dataset(bag)


def test_a_baseline_in_thousandths_is_doubted_with_both_readings(tmp_path: Path) -> None:
    recording = open_dataset(_infos(_thousandths).write(tmp_path / "f")).recording
    (doubt,) = [note for note in recording.notes if "P[0, 3] is -focal * baseline" in note]
    assert "divided by 1000 once too often, the baseline is 0.11 m" in doubt


def test_a_camera_info_without_a_size_has_that_of_the_images(tmp_path: Path) -> None:
    usual = open_dataset(plain_script(frames=4).write(tmp_path / "usual"))
    script = plain_script(frames=4)
    for note in script.notes:
        if note.topic.endswith("camera_info"):
            note.fields.width = note.fields.height = 0
    assert_same_events(open_dataset(script.write(tmp_path / "f")), usual)
